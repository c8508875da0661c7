"""What the commands of all experiments share: options, presets, one-line errors, exit codes."""

import contextlib
import io
import os
import signal
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import tyro
from filelock import FileLock, Timeout
from rich.console import Console

from experiments.paper.config import PRESETS, Run
from experiments.runner.run_record import OtherRun, recorded
from hybrid_jax.runtime import configure
from hybrid_jax.sweep import hosts

BAD_INPUT, INTERRUPTED, TERMINATED = 2, 130, 143


class Terminated(KeyboardInterrupt):
    """Told to stop by SIGTERM: all that an interrupt does, with an exit code of its own."""


def run(
    name: str,
    about: str,
    experiment: Callable[[Any, Console], None],
    arguments: Sequence[str] | None = None,
    presets: Mapping[str, Run] = PRESETS,
) -> None:
    """Read the command line and run an experiment. Bad input ends in one line on stderr and exit code 2.

    Args:
        presets: by name what --preset chooses from, all of the class that `experiment` takes; "paper" is the default.
    """
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    try:
        config = read(name, about, arguments, presets)
        check_folder("--out", config.out)
        configure(config.cache)
        if config.distributed:
            hosts.initialize(config.coordinator, config.processes, config.process_id)
        signal.signal(signal.SIGTERM, _terminate)
        quiet = not hosts.is_main_process()  # process 0 alone speaks and writes
        console, folder = Console(stderr=True, quiet=quiet), config.out / name
        say = partial(console.print, highlight=False, soft_wrap=True)
        with contextlib.ExitStack() as held:
            if hosts.is_main_process():
                held.enter_context(alone(folder))
                held.enter_context(recorded(folder, config, say))
            experiment(config, console)
    except OtherRun as error:
        print(f"{name}: {error}", file=sys.stderr)
        sys.exit(BAD_INPUT)
    except (ValueError, OSError) as error:
        print(f"{name}: {' '.join(str(error).split())}", file=sys.stderr)
        sys.exit(BAD_INPUT)
    except KeyboardInterrupt as stop:
        fresh = " without --fresh" if "--fresh" in arguments else ""
        print(f"{name}: interrupted; the same command{fresh} goes on from here", file=sys.stderr)
        sys.exit(TERMINATED if isinstance(stop, Terminated) else INTERRUPTED)


@contextlib.contextmanager
def alone(folder: Path) -> Iterator[None]:
    """Be the only run that writes into a folder; the lock goes with the process, however that ends.

    Raises:
        ValueError: another run writes there now.
    """
    folder.mkdir(parents=True, exist_ok=True)
    lock = FileLock(folder / ".lock", timeout=0)
    try:
        lock.acquire()
    except Timeout:
        raise ValueError(f"--out: another run is writing to {folder}; wait for it, or choose another folder") from None
    try:
        yield
    finally:
        lock.release()


def _terminate(signal_number, frame) -> None:
    raise Terminated


def read(name: str, about: str, arguments: list[str], presets: Mapping[str, Run] = PRESETS) -> Run:
    """The configuration of a command line: the preset, and what the other options change of it.

    Raises:
        ValueError: an unknown preset, or options that do not fit together.
    """
    preset = presets[_preset(arguments)]
    kind = type(preset)
    described = [each.__doc__ or "" for each in kind.__mro__ if issubclass(each, Run)]
    description = "\n\n".join([about, *described])
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            return tyro.cli(
                kind, prog=f"python -m experiments.{name}", description=description, args=arguments, default=preset
            )
    except SystemExit as stop:
        if not stop.code:
            raise  # --help
        raise ValueError(f"{_essence(said.getvalue())}; see --help") from None


def _essence(box: str) -> str:
    """What tyro says in the first part of the box that it draws around an error."""
    lines = [line.strip("│ ") for line in box.splitlines()]
    rules = [i for i, line in enumerate(lines) if line.startswith(("─", "╭", "╰"))]
    return " ".join(lines[rules[0] + 1 : rules[1]]) if len(rules) > 1 else " ".join(box.split())


def check_folder(option: str, folder: Path) -> None:
    """Make the folder, or say in one line why results could not be written there, before hours are spent on them.

    Raises:
        ValueError: it cannot be made, or not be written.
    """
    probe = folder / f".writable.{os.getpid()}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise ValueError(f"{option} {folder}: cannot be written: {error.strerror}") from error


def _preset(arguments: list[str]) -> str:
    for i, argument in enumerate(arguments):
        name, _, value = argument.partition("=")
        if name == "--preset":
            chosen = value or next(iter(arguments[i + 1 :]), "")
            if chosen not in PRESETS:
                raise ValueError(f"--preset must be one of {', '.join(PRESETS)}, got {chosen!r}")
            return chosen
    return Run.preset
