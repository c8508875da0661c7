"""The command line of all experiments: options, presets, one-line errors, exit codes."""

import argparse
import contextlib
import gc
import signal
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from inspect import cleandoc
from typing import Any, TypeVar

from filelock import FileLock, Timeout
from rich.console import Console

from experiments import interruptible
from experiments.runner.cache import source_digest
from experiments.runner.options import COMMON, Run, check_rules
from experiments.runner.run_record import recorded
from hybrid_jax import checks
from hybrid_jax.cli import answering
from hybrid_jax.cli.command import exit_codes, parsed
from hybrid_jax.runtime import configure
from hybrid_jax.sweep import hosts

Options = TypeVar("Options")
# Of the full experiment on two cores, as the stages of the report in docs/reference took together.
MINUTES = {"param_shift": 35, "external_force": 35, "changes": 160, "ablation": 160, "closed_loop": 90, "excitation": 9}
MINUTES |= {"online": 42, "reaction_diffusion": 54}


def run(
    name: str,
    about: str,
    experiment: Callable[[Any, Console], None],
    arguments: Sequence[str] | None = None,
    *,
    presets: Mapping[str, Run],
) -> None:
    """Read the command line and run an experiment. Bad input ends in one line on stderr and exit code 2.

    Args:
        name: of the module in `experiments`, and of the subfolder of --out.
        about: first paragraph of --help.
        presets: the choices of --preset by name, all of the class that `experiment` takes.
    """
    interruptible()
    given = sys.argv[1:] if arguments is None else arguments
    fresh = " without --restart" if "--restart" in given else ""
    with exit_codes(name, name, f"interrupted; the same command{fresh} goes on from here"):
        config = read(name, about, given, presets)
        checks.writable_folder("--out", config.out)
        checks.writable_folder("--cache", config.cache)
        configure()
        gc.freeze()  # tracing makes millions of objects, and to look for garbage among them takes an eighth of its time
        gc.set_threshold(50_000, 20, 20)
        if config.distributed:
            alike = config.described() | {name: source_digest(name) for name in ("hybrid_jax", "experiments")}
            try:
                hosts.initialize(config.coordinator, config.processes, config.process_id, alike, config.timeout)
            except ValueError as error:
                raise ValueError(f"--distributed: {error}") from error
        for number in (signal.SIGTERM, signal.SIGHUP):
            if signal.getsignal(number) != signal.SIG_IGN:  # as `nohup` leaves it
                signal.signal(number, _interrupt)
        main = hosts.is_main_process()  # it alone prints and writes
        console, folder = Console(stderr=True, quiet=not main), config.out / name
        with contextlib.ExitStack() as stack:
            stack.enter_context(answering(name, "interrupted at the end of this block; Ctrl-C again stops it"))
            if main:
                folder.mkdir(parents=True, exist_ok=True)
                try:
                    stack.enter_context(FileLock(folder / ".lock", timeout=0))  # released with the process
                except Timeout:
                    wait = "wait for it, or choose another folder"
                    raise ValueError(f"--out: another run is writing to {folder}; {wait}") from None
                say = partial(console.print, highlight=False, soft_wrap=True)
                stack.enter_context(recorded(folder, config, say))
            try:
                experiment(config, console)
            except hosts.PeerLost as lost:
                on = "the same command goes on from what process 0 has saved, with any number of processes"
                raise hosts.PeerLost(f"{lost}; {on}") from lost


def check(name: str, about: str, arguments: Sequence[str], presets: Mapping[str, Run]) -> None:
    """End the process, like `run`, if the command line does not fit this experiment."""
    with exit_codes(name, name, "interrupted"):
        read(name, about, arguments, presets)


def call(
    name: str, kind: type[Options], command: Callable[[Options], None], arguments: Sequence[str] | None = None
) -> None:
    """Read the options, a dataclass with the command's description, and run a command. Errors as in `run`."""
    interruptible()
    with exit_codes(name, name, "interrupted, nothing was written"):
        options = parsed(kind, _program(name), arguments)
        check_rules("--", options)
        command(options)


def read(name: str, about: str, arguments: Sequence[str], presets: Mapping[str, Run]) -> Run:
    """Return the configuration of a command line: a preset, changed by the other options."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--preset", nargs="?", default=Run.preset, const="")
    chosen = parser.parse_known_args(arguments)[0].preset
    if chosen not in presets:
        raise ValueError(f"--preset must be one of {', '.join(presets)}, got {chosen!r}")
    kind = type(presets[chosen])
    about += f" The full run takes about {MINUTES[name]} minutes on two cores." if name in MINUTES else ""
    description = "\n\n".join([about, *(cleandoc(each.__doc__ or "") for each in (kind, Run))])
    return parsed(kind, _program(name), arguments, presets[chosen], description, COMMON)


def _program(name: str) -> str:
    return f"python -m experiments.{name}"


def _interrupt(number: int, frame) -> None:
    raise KeyboardInterrupt(number)
