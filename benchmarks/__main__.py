"""Every benchmark, and one table of the ratios that matter: python -m benchmarks --help"""

import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal, get_args

import tyro
from rich.console import Console

from benchmarks.timing import Ratio, ratio_table
from experiments.runner.command import BAD_INPUT, check_folder
from hybrid_jax.io.files import json_text, read_json, write_atomic

Benchmark = Literal["training_step", "rollout", "sweep", "environment", "compilation", "scaling", "growth", "ingest"]
PEERS = "training_peers", "environment_peers"


@dataclass(frozen=True)
class Options:
    """Run every benchmark, each in a process of its own, and print one table of ratios: about eleven minutes on two
    quiet cores. What a benchmark measures is told by `python -m benchmarks.rollout --help` and so on.
    """

    preset: Literal["full", "smoke"] = "full"
    """full: what is reported. smoke: does it work; its numbers say nothing."""
    out: Path | None = None
    """Also write the numbers of all benchmarks to this file as JSON, and figures beside it."""
    only: tuple[Benchmark, ...] = get_args(Benchmark)
    """Which benchmarks to run."""
    peers: bool = False
    """Also run those against rivals, training_peers and environment_peers, on one core: some eight minutes more, mostly
    in `torch.compile`. A rival that is not installed is named and skipped: pip install -e '.[peers]'."""


def measured(name: str, preset: str, out: Path | None) -> dict[str, Any]:
    """The report of one benchmark; its tables are shown on stderr when it is done, its figures are put beside `out`.

    Raises:
        RuntimeError: it failed, for instance because two programs do not compute the same.
    """
    with TemporaryDirectory() as folder:
        report = Path(folder) / f"{name}.json"
        command = [sys.executable, "-m", f"benchmarks.{name}", "--preset", preset, "--out", str(report)]
        if subprocess.run(command, stdout=sys.stderr, check=False).returncode:
            raise RuntimeError(f"benchmark {name} failed; what it says stands above")
        for figure in report.parent.glob(f"{name}.[!j]*"):
            if out is not None:
                write_atomic(out.with_name(f"{out.stem}-{figure.name}"), figure.read_bytes())
        return read_json(report)


def ratios_of(reports: Sequence[dict[str, Any]]) -> list[Ratio]:
    """The ratios of all reports, each with the name of its benchmark."""
    return [
        Ratio(f"{report['benchmark']}: {ratio['what']}", ratio["value"], ratio["at_most"], ratio["at_least"])
        for report in reports
        for ratio in report["ratios"]
    ]


def absences(reports: Sequence[dict[str, Any]]) -> list[str]:
    """A line for each rival that a benchmark skipped: which, and what would change that."""
    rows = [(report["benchmark"], row) for report in reports for row in report["rows"]]
    return [f"{name}: {row['rival']}: {row['skipped']}" for name, row in rows if "skipped" in row]


def main() -> None:
    """The command line. Bad input ends in one line on stderr and exit code 2, a benchmark that fails in 1."""
    options = tyro.cli(Options, prog="python -m benchmarks", description=Options.__doc__)
    try:
        if options.out is not None:
            check_folder("--out", options.out.parent)
        names = options.only + (PEERS if options.peers else ())
        reports = [measured(name, options.preset, options.out) for name in names]
    except (ValueError, RuntimeError) as error:
        print(f"benchmarks: {error}", file=sys.stderr)
        sys.exit(BAD_INPUT if isinstance(error, ValueError) else 1)
    console = Console()
    console.print(ratio_table(ratios_of(reports)))
    for line in absences(reports):
        console.print(line, markup=False)
    if options.out is not None:
        write_atomic(options.out, json_text({"benchmarks": reports}))


if __name__ == "__main__":
    main()
