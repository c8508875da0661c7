"""Run all benchmarks and print one table of their ratios: python -m benchmarks --help"""

import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal, get_args

import tyro
from rich.console import Console

from benchmarks.timing import BAD_INPUT, Ratio, check_file, ratio_table
from hybrid_jax.io.files import json_text, read_json, write_atomic

Benchmark = Literal["sweep", "grids"]
PEERS = "training_peers"


@dataclass(frozen=True)
class Options:
    """Run every benchmark in its own process and print one table of ratios: a few minutes on two idle cores.
    `python -m benchmarks.sweep --help` describes what a benchmark measures.
    """

    preset: Literal["full", "smoke"] = "full"
    """full: the reported numbers. smoke: a functional check; its numbers mean nothing."""
    out: Path | None = None
    """Also write the numbers of all benchmarks to this file as JSON."""
    only: tuple[Benchmark, ...] = get_args(Benchmark)
    """Which benchmarks to run."""
    peers: bool = False
    """Also run training_peers, a gradient step beside JAX alone and PyTorch on one core: some five minutes more, mostly
    in `torch.compile`. Libraries that are not installed are skipped: pip install -e '.[peers]'."""


def measured(name: str, preset: str) -> dict[str, Any]:
    """Run one benchmark and return its report. Tables go to stderr."""
    with TemporaryDirectory() as folder:
        report = Path(folder) / f"{name}.json"
        command = [sys.executable, "-m", f"benchmarks.{name}", "--preset", preset, "--out", str(report)]
        if subprocess.run(command, stdout=sys.stderr, check=False).returncode:
            raise RuntimeError(f"benchmark {name} failed; see its output above")
        return read_json(report)


def main() -> None:
    """The command line. Exit code 2 and one line on stderr for bad input, 1 if a benchmark fails."""
    options = tyro.cli(Options, prog="python -m benchmarks", description=Options.__doc__)
    try:
        check_file("--out", options.out)
        names = options.only + ((PEERS,) if options.peers else ())
        reports = [measured(name, options.preset) for name in names]
    except (ValueError, RuntimeError) as error:
        print(f"benchmarks: {error}", file=sys.stderr)
        sys.exit(BAD_INPUT if isinstance(error, ValueError) else 1)
    console = Console()
    ratios = [
        Ratio(f"{report['benchmark']}: {ratio['what']}", ratio["value"], ratio["at_most"], ratio["at_least"])
        for report in reports
        for ratio in report["ratios"]
    ]
    console.print(ratio_table(ratios))
    for report in reports:
        for row in report["rows"]:
            if "skipped" in row:
                console.print(f"{report['benchmark']}: {row['rival']}: {row['skipped']}", markup=False)
    if options.out is not None:
        write_atomic(options.out, json_text({"benchmarks": reports}))


if __name__ == "__main__":
    main()
