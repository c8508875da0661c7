"""The command line of all experiments: options, presets, one-line errors, exit codes."""

import argparse
import contextlib
import gc
import inspect
import io
import re
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, TypeVar

import tyro
from filelock import FileLock, Timeout
from rich.console import Console

from experiments.runner.cache import source_digest
from experiments.runner.flags import in_flags
from experiments.runner.options import Run
from experiments.runner.run_record import ChecksFailed, OtherRun, recorded
from hybrid_jax import checks, kernels
from hybrid_jax.runtime import configure
from hybrid_jax.sweep import hosts

Options = TypeVar("Options")
BAD_INPUT, FAILED_CHECKS = 2, 3  # exit codes; that of a signal is 128 + its number


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
    given = sys.argv[1:] if arguments is None else arguments
    fresh = " without --fresh" if "--fresh" in given else ""
    with _exit_codes(name, f"interrupted; the same command{fresh} goes on from here"):
        config = read(name, about, given, presets)
        checks.writable_folder("--out", config.out)
        checks.writable_folder("--cache", config.cache)
        configure()
        gc.freeze()  # tracing makes millions of objects, and to look for garbage among them takes an eighth of its time
        gc.set_threshold(50_000, 20, 20)
        if config.distributed:
            alike = config.described() | {name: source_digest(name) for name in ("hybrid_jax", "experiments")}
            try:
                hosts.initialize(config.coordinator, config.processes, config.process_id, alike)
            except ValueError as error:
                raise ValueError(f"--distributed: {error}") from error
        # Compiles the kernels beside what comes first, if there are none yet: GCC takes some seconds.
        threading.Thread(target=kernels.status, daemon=True).start()
        signal.signal(signal.SIGTERM, _interrupt)
        main = hosts.is_main_process()  # it alone prints and writes
        console, folder = Console(stderr=True, quiet=not main), config.out / name
        with contextlib.ExitStack() as stack:
            if main:
                folder.mkdir(parents=True, exist_ok=True)
                try:
                    stack.enter_context(FileLock(folder / ".lock", timeout=0))  # released with the process
                except Timeout:
                    wait = "wait for it, or choose another folder"
                    raise ValueError(f"--out: another run is writing to {folder}; {wait}") from None
                say = partial(console.print, highlight=False, soft_wrap=True)
                stack.enter_context(recorded(folder, config, say))
            experiment(config, console)


def check(name: str, about: str, arguments: Sequence[str], presets: Mapping[str, Run]) -> None:
    """End the process, as `run` does, if the command line is not one of this experiment."""
    with _exit_codes(name, "interrupted"):
        read(name, about, arguments, presets)


def call(
    name: str, kind: type[Options], command: Callable[[Options], None], arguments: Sequence[str] | None = None
) -> None:
    """Read the options, a dataclass with the command's description, and run a command. Errors as in `run`."""
    with _exit_codes(name, "interrupted, nothing was written"):
        command(_parsed(partial(tyro.cli, kind, description=inspect.cleandoc(kind.__doc__ or "")), name, arguments))


def split_lists(arguments: Sequence[str], lists: Sequence[str]) -> list[str]:
    """Split comma-separated values, such as 10,50, of the options that take several values."""
    words, option = [], ""
    for word in arguments:
        option, _, value = word.partition("=") if word.startswith("--") else (option, "", word)
        several = option in lists and word != option
        words += [option] * word.startswith("--") + value.split(",") if several else [word]
    return words


def read(name: str, about: str, arguments: Sequence[str], presets: Mapping[str, Run]) -> Run:
    """The configuration given by a command line: a preset, changed by the other options."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--preset", nargs="?", default=Run.preset, const="")
    chosen = parser.parse_known_args(arguments)[0].preset
    if chosen not in presets:
        raise ValueError(f"--preset must be one of {', '.join(presets)}, got {chosen!r}")
    kind = type(presets[chosen])
    description = "\n\n".join([about, *(each.__doc__ or "" for each in kind.__mro__ if issubclass(each, Run))])
    cli = partial(tyro.cli, kind, description=description, default=presets[chosen])
    return _parsed(cli, name, arguments)


def _parsed(cli: Callable[..., Options], name: str, arguments: Sequence[str] | None) -> Options:
    """The options that a command line gives; ValueError if it gives none."""
    output = io.StringIO()
    try:
        with contextlib.redirect_stderr(output):
            return cli(prog=f"python -m experiments.{name}", args=arguments)
    except SystemExit as stop:
        if not stop.code:
            raise  # --help
        raise ValueError(f"{_message(output.getvalue())}; see --help") from None


@contextlib.contextmanager
def _exit_codes(name: str, interrupted: str) -> Iterator[None]:
    """End the process with one line on stderr and an exit code on bad input and on a signal."""
    try:
        yield
    except (ValueError, OSError, ImportError) as error:
        message = str(error) if isinstance(error, OtherRun) else " ".join(str(error).split())
        print(f"{name}: {in_flags(name, message)}", file=sys.stderr)
        sys.exit(BAD_INPUT)
    except ChecksFailed as failed:
        for line in failed.args:
            print(f"{name}: {in_flags(name, line)}", file=sys.stderr)
        sys.exit(FAILED_CHECKS)
    except KeyboardInterrupt as stop:
        print(f"{name}: {interrupted}", file=sys.stderr)
        sys.exit(128 + (stop.args[0] if stop.args else signal.SIGINT))


def _message(box: str) -> str:
    """The text in the first part of the box that tyro draws around an error, without the name of our class."""
    lines = [line.strip("│ ") for line in box.splitlines()]
    rules = [i for i, line in enumerate(lines) if line.startswith(("─", "╭", "╰"))]
    text = " ".join(lines[rules[0] + 1 : rules[1]]) if len(rules) > 1 else " ".join(box.split())
    return re.sub(r"^Error parsing \w+: ", "", text).removesuffix(".")


def _interrupt(number: int, frame) -> None:
    raise KeyboardInterrupt(number)
