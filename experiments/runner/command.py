"""The command line of all experiments: options, presets, one-line errors, exit codes."""

import contextlib
import io
import os
import signal
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import tyro
from filelock import FileLock, Timeout
from rich.console import Console

from experiments.runner.options import Run
from experiments.runner.run_record import OtherRun, recorded
from hybrid_jax.runtime import configure
from hybrid_jax.sweep import hosts

Options = TypeVar("Options")
BAD_INPUT, INTERRUPTED, TERMINATED = 2, 130, 143


class Terminated(KeyboardInterrupt):
    """SIGTERM: handled as an interrupt, with its own exit code."""


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
        arguments: of the command line; by default the process's own.
        presets: the choices of --preset by name, all of the class that `experiment` takes; "paper" is the default.
    """
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    try:
        config = read(name, about, arguments, presets)
        check_folder("--out", config.out)
        configure(config.cache)
        if config.distributed:
            hosts.initialize(config.coordinator, config.processes, config.process_id)
        signal.signal(signal.SIGTERM, _terminate)
        quiet = not hosts.is_main_process()  # only process 0 prints and writes
        console, folder = Console(stderr=True, quiet=quiet), config.out / name
        say = partial(console.print, highlight=False, soft_wrap=True)
        with contextlib.ExitStack() as stack:
            if hosts.is_main_process():
                stack.enter_context(locked(folder))
                stack.enter_context(recorded(folder, config, say))
            experiment(config, console)
    except (ValueError, OSError) as error:
        message = str(error) if isinstance(error, OtherRun) else " ".join(str(error).split())
        print(f"{name}: {message}", file=sys.stderr)
        sys.exit(BAD_INPUT)
    except KeyboardInterrupt as stop:
        fresh = " without --fresh" if "--fresh" in arguments else ""
        print(f"{name}: interrupted; the same command{fresh} goes on from here", file=sys.stderr)
        sys.exit(TERMINATED if isinstance(stop, Terminated) else INTERRUPTED)


def call(
    name: str, kind: type[Options], command: Callable[[Options], None], arguments: Sequence[str] | None = None
) -> None:
    """Read the command line of a command without presets and run it. Errors as in `run`.

    Args:
        kind: a dataclass of the options; its docstring is the description.
    """
    try:
        command(tyro.cli(kind, prog=f"python -m experiments.{name}", description=kind.__doc__, args=arguments))
    except (ValueError, OSError, ImportError) as error:
        print(f"{name}: {' '.join(str(error).split())}", file=sys.stderr)
        sys.exit(BAD_INPUT)
    except KeyboardInterrupt:
        print(f"{name}: interrupted, nothing was written", file=sys.stderr)
        sys.exit(INTERRUPTED)


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold the lock of an output folder. It is released with the process, however that ends.

    Raises:
        ValueError: another run holds it.
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


def read(name: str, about: str, arguments: list[str], presets: Mapping[str, Run]) -> Run:
    """The configuration given by a command line: a preset, changed by the other options.

    Raises:
        ValueError: an unknown preset, or options that do not fit together.
    """
    preset = presets[_preset(arguments, presets)]
    kind = type(preset)
    description = "\n\n".join([about, *(each.__doc__ or "" for each in kind.__mro__ if issubclass(each, Run))])
    output = io.StringIO()
    try:
        with contextlib.redirect_stderr(output):
            return tyro.cli(
                kind, prog=f"python -m experiments.{name}", description=description, args=arguments, default=preset
            )
    except SystemExit as stop:
        if not stop.code:
            raise  # --help
        raise ValueError(f"{_message(output.getvalue())}; see --help") from None


def _message(box: str) -> str:
    """The text in the first part of the box that tyro draws around an error."""
    lines = [line.strip("│ ") for line in box.splitlines()]
    rules = [i for i, line in enumerate(lines) if line.startswith(("─", "╭", "╰"))]
    return " ".join(lines[rules[0] + 1 : rules[1]]) if len(rules) > 1 else " ".join(box.split())


def check_folder(option: str, folder: Path) -> None:
    """Create a folder and check that it can be written, before work begins.

    Raises:
        ValueError: it cannot be created or written.
    """
    probe = folder / f".writable.{os.getpid()}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise ValueError(f"{option} {folder}: cannot be written: {error.strerror}") from error


def _preset(arguments: list[str], presets: Mapping[str, Run]) -> str:
    for i, argument in enumerate(arguments):
        name, _, value = argument.partition("=")
        if name == "--preset":
            chosen = value or next(iter(arguments[i + 1 :]), "")
            if chosen not in presets:
                raise ValueError(f"--preset must be one of {', '.join(presets)}, got {chosen!r}")
            return chosen
    return Run.preset
