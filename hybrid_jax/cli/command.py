"""Run a verb of the command line: parse its options, print its errors in one line, set its exit code."""

import contextlib
import difflib
import inspect
import io
import os
import re
import signal
import sys
import threading
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from importlib import import_module
from typing import Any, NoReturn, TypeVar, cast, get_type_hints

import tyro

from hybrid_jax.cli.flags import in_flags
from hybrid_jax.cli.help import option_of, short_help
from hybrid_jax.runtime import configure

Options = TypeVar("Options")
# Exit codes; that of a signal is 128 + its number. ADAPTED is 0.
BAD_INPUT, FAILED_CHECKS, NOTHING_CHANGED = 2, 3, 4
VERBS = {
    "inspect": "check what logs contain, and write a vehicle file from them",
    "fit": "learn a vehicle from its logs",
    "identify": "learn a vehicle from its commands and any measurements",
    "adapt": "adapt a model to logs after a change, and say what changed",
    "check": "compare a model's predictions with flights",
    "plan": "plan the most informative flight for a model",
    "replay": "show a flight in 3-D, and where a model expects the vehicle",
    "export": "write a model as C, CasADi functions or StableHLO",
}
INTERRUPTED = "interrupted, nothing was written"
USAGE = """usage: hybrid-jax VERB ...

From folders of logs to a model that can be trusted:

{verbs}

hybrid-jax VERB --help says more, VERB --help-all all.
Exit codes: 0 done, 2 bad input, 3 logs fail checks, 4 nothing changed (adapt)."""


class Explained(ValueError):
    """Invalid input whose message has several lines."""


class ChecksFailed(Exception):
    """Some logs failed checks; `args` are lines for the user."""


def run(arguments: Sequence[str]) -> None:
    """Run a verb; on errors, end the process with a line on stderr and an exit code."""
    if not arguments or arguments[0] in ("-h", "--help"):
        print(USAGE.format(verbs="\n".join(f"  {name:<8} {about}" for name, about in VERBS.items())))
        return
    verb, *given = arguments
    with exit_codes(f"hybrid-jax {verb}", verb, INTERRUPTED):
        if verb not in VERBS:
            raise ValueError(f"no such verb{_meant(verb, VERBS)}; see hybrid-jax --help")
        module = import_module(f"hybrid_jax.cli.{verb}")
        options = parsed(module.Options, f"hybrid-jax {verb}", split_lists(given, module.LISTS))
        configure()
        with answering(f"hybrid-jax {verb}", INTERRUPTED, end=True):
            code = module.run(options)
    sys.exit(code)


@contextlib.contextmanager
def answering(program: str, answer: str, end: bool = False) -> Iterator[None]:
    """Answer the first Ctrl-C at once, even while XLA is busy, and perhaps end the process."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    ear, mouth = os.pipe()
    os.set_blocking(mouth, False)

    def listen() -> None:
        with open(ear, "rb", buffering=0) as signals:
            while number := signals.read(1):
                if number[0] == signal.SIGINT:
                    os.write(2, f"{program}: {answer}\n".encode())
                    if end:  # files are renamed when complete, so none is left partial
                        os._exit(128 + signal.SIGINT)
                    return

    threading.Thread(target=listen, daemon=True).start()
    before = signal.set_wakeup_fd(mouth, warn_on_full_buffer=False)  # to which a signal is written at once
    handler = signal.signal(signal.SIGINT, lambda *_: None) if end else None
    try:
        yield
    finally:
        if handler is not None:
            signal.signal(signal.SIGINT, handler)
        signal.set_wakeup_fd(before)
        os.close(mouth)


def parsed(
    kind: type[Options],
    program: str,
    arguments: Sequence[str] | None,
    default: Options | None = None,
    description: str = "",
    common: Collection[str] | None = None,
) -> Options:
    """Parse a command line into a dataclass; raise ValueError if it is invalid. `common`: options of --help."""
    output, given = io.StringIO(), list(sys.argv[1:] if arguments is None else arguments)
    description = description or inspect.cleandoc(str(kind.__doc__))
    if {"-h", "--help"} & {*given}:
        print(short_help(kind, program, description, default, common))
        sys.exit(0)
    given = ["--help"] if "--help-all" in given else given
    try:
        with contextlib.redirect_stderr(output):
            return cast(Options, tyro.cli(kind, prog=program, args=given, description=description, default=default))
    except SystemExit as stop:
        if not stop.code:
            raise  # --help
        message = _message(output.getvalue())
        hints = get_type_hints(kind, include_extras=True).items()
        known = [f"--{option_of(name, getattr(hint, '__metadata__', ()))}" for name, hint in hints]
        # One that is wrong is named even where an argument is missing, which the parser finds first.
        for word in (re.split(r"[=.]", word)[0] for word in given if word.startswith("--")):
            if word.replace("--no-", "--", 1) not in (*known, "--help"):
                message = f"Unrecognized options: {word}{_meant(word, known)}"
        raise ValueError(f"{message}; see --help") from None


def split_lists(arguments: Sequence[str], lists: Sequence[str]) -> list[str]:
    """Split comma-separated values, for example 10,50, of options with several values."""
    words, option = [], ""
    for word in arguments:
        option, _, value = word.partition("=") if word.startswith("--") else (option, "", word)
        several = option in lists and word != option
        words += [option] * word.startswith("--") + value.split(",") if several else [word]
    return words


@contextlib.contextmanager
def exit_codes(program: str, command: str, interrupted: str) -> Iterator[None]:
    """On invalid input or a signal, end the process with one line on stderr and an exit code."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal or pipe that cannot show a letter ends no run
    if sys.stdout is sys.__stdout__:
        sys.stdout = io.TextIOWrapper(
            io.BufferedWriter(_Output(program)), sys.stdout.encoding, "replace", line_buffering=True
        )
    try:
        yield
    except (ValueError, OSError, ImportError) as error:
        message = str(error) if isinstance(error, Explained) else " ".join(str(error).split())
        _end(program, [in_flags(command, message)], BAD_INPUT)
    except ChecksFailed as failed:
        _end(program, [in_flags(command, line) for line in failed.args], FAILED_CHECKS)
    except KeyboardInterrupt as stop:
        _end(program, [interrupted], 128 + (stop.args[0] if stop.args else signal.SIGINT))


class _Output(io.FileIO):
    """Standard output that ignores being full or closed, for example by `| head -1`; files are still written."""

    def __init__(self, program: str):
        super().__init__(sys.stdout.fileno(), "w", closefd=False)
        self.program = program

    def write(self, text, /) -> int:
        try:
            return super().write(text)
        except OSError as error:
            print(f"{self.program}: standard output: {error.strerror}; what is left is not shown", file=sys.stderr)
            os.dup2(os.open(os.devnull, os.O_WRONLY), self.fileno())
            return memoryview(text).nbytes


def _end(program: str, lines: Sequence[str], code: int) -> NoReturn:
    for line in lines:
        print(f"{program}: {line}", file=sys.stderr)
    sys.exit(code)


def _meant(word: str, known: Any) -> str:
    near = difflib.get_close_matches(word, list(known), 1)
    return f"; did you mean {near[0]}?" if near else ""


def _message(box: str) -> str:
    """Extract the message from the box that tyro draws around an error, without the class name."""
    lines = [line.strip("│| ") for line in box.splitlines()]
    rules = [i for i, line in enumerate(lines) if line.startswith(("─", "╭", "╰", "---", "+"))]
    text = " ".join(lines[rules[0] + 1 : rules[1]]) if len(rules) > 1 else " ".join(box.split())
    return re.sub(r"^Error parsing \w+: ", "", text).removesuffix(".")


@contextlib.contextmanager
def step(doing: str) -> Iterator[Callable[[str], None]]:
    """Print on stderr what is being done, then the result (set by the yielded function) and the duration."""
    began, found = time.perf_counter(), [""]
    print(f"{doing} …", file=sys.stderr, flush=True)
    yield lambda text: found.__setitem__(0, text)
    print(
        f"{doing}: {f'{found[0]}, ' * bool(found[0])}{time.perf_counter() - began:.1f} s", file=sys.stderr, flush=True
    )
