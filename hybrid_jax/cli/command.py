"""Run a verb of the command line: parse its options, print its errors in one line, set its exit code."""

import contextlib
import difflib
import inspect
import io
import os
import re
import signal
import sys
import time
import warnings
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from functools import partial
from importlib import import_module
from itertools import takewhile
from typing import Any, TypeVar, cast, get_args, get_type_hints

import tyro

from hybrid_jax import checks
from hybrid_jax.cli import INTERRUPTED
from hybrid_jax.cli.help import expected, option_of, short_help, values
from hybrid_jax.runtime import configure

Options = TypeVar("Options")
# Exit codes. For a signal it is 128 + its number.
BAD_INPUT, FAILED_CHECKS, NOTHING_CHANGED = 2, 3, 4
VERBS = {
    "inspect": "check what logs contain, and write a vehicle file from them",
    "fit": "learn a model of a vehicle from its logs",
    "adapt": "adapt a model to logs from after a change, and say what changed",
    "check": "compare a model's predictions with flights",
    "plan": "plan the flight from which a model learns most",
    "replay": "show a flight and the predictions of a model in 3-D",
    "export": "write a model as C, CasADi functions or StableHLO",
}
USAGE = """usage: hybrid-jax VERB ...

Learn a model of a multirotor from a folder of flight logs, and adapt it after a
change. For other systems, use hj.fit and hj.adapt in Python.

{verbs}

For example: hybrid-jax fit before/ -o source.npz
hybrid-jax VERB --help lists the common options, --help-all all of them.
Exit codes: 0 done, 2 bad input, 3 logs fail checks, 4 nothing changed (adapt)."""

# Arguments in messages of the library, and the corresponding options of the commands that have them.
READ_LOGS = ("inspect", "fit", "adapt", "check", "replay", "real_flight")
_SAME = ("columns", "polynomial", "topics", "motor_order", "dt", "delay")
FLAGS = {name: f"--{name.replace('_', '-')}" for name in _SAME} | {"failed": "--ignore-checks"}
_KEYS = ("columns", "polynomial")  # also words of column maps, so options only before a value
_NAMED, _FREE = "|".join(FLAGS), "|".join(name for name in FLAGS if name not in _KEYS)
_VALUE = r"\([^)]*\)|\{[^}]*\}|\"[^\"]*\"|[^\s,;:)]+"


class Explained(ValueError):
    """Invalid input whose message has several lines."""


class ChecksFailed(Exception):
    """Some logs failed checks; `args` are lines for the user."""


def run(arguments: Sequence[str]) -> None:
    """Run a verb; on errors, end the process with a line on stderr and an exit code."""
    verb, *given = arguments or ["--help"]
    with exit_codes(f"hybrid-jax {verb}", verb, INTERRUPTED):
        if verb in ("-h", "--help"):
            print(USAGE.format(verbs="\n".join(f"  {name:<8} {about}" for name, about in VERBS.items())))
            return
        if verb not in VERBS:
            raise ValueError(f"no such verb{_meant(verb, VERBS)}; see hybrid-jax --help")
        module = import_module(f"hybrid_jax.cli.{verb}")
        options = parsed(module.Options, f"hybrid-jax {verb}", given)
        configure()
        checks.writable_folder("--out", options.out)
        if (output := getattr(options, "output", None)) is not None:
            checks.writable_folder("--output", output if verb == "export" else output.parent)
            if verb != "export" and output.is_dir():
                raise ValueError(f"--output {output}: is a folder; name a file in it")
        _ = getattr(options, "reading", None)  # raises an error for invalid options before anything is read
        code = module.run(options)
    sys.exit(code)


def parsed(
    kind: type[Options],
    program: str,
    arguments: Sequence[str] | None,
    default: Options | None = None,
    description: str = "",
    common: Collection[str] | None = None,
) -> Options:
    """Parse a command line into a dataclass; ValueError if it is invalid. `common` are the options listed by --help."""
    output, given = io.StringIO(), list(sys.argv[1:] if arguments is None else arguments)
    description = description or inspect.cleandoc(str(kind.__doc__))
    if {"-h", "--help"} & {*given}:
        print(short_help(kind, program, description, default, common))
        sys.exit(0)
    known = dict(_options(kind))
    given = ["--help"] if "--help-all" in given else split_lists(given, known)
    try:
        with contextlib.redirect_stderr(output):
            return cast(Options, tyro.cli(kind, prog=program, args=given, description=description, default=default))
    except SystemExit as stop:
        if not stop.code:
            raise  # --help
        usage = short_help(kind, program, "", default, common).partition("\n")[0]
        raise ValueError(f"{_complaint(known, given, output.getvalue(), usage)}; see --help") from None


def _options(kind: type) -> Iterator[tuple[str, str]]:
    """Return each option of a dataclass, with what a user types after it."""
    for name, hint in get_type_hints(kind, include_extras=True).items():
        marks = getattr(hint, "__metadata__", ())
        if option := option_of(name, marks):
            yield f"--{option}", values(hint)
        else:  # a dataclass whose fields are options
            yield from _options(get_args(hint)[0])


def _complaint(known: Mapping[str, str], given: Sequence[str], box: str, usage: str) -> str:
    """Explain in one line what is wrong with a command line, from the box that tyro draws."""
    # An unknown option is reported first, whereas tyro would report a missing argument.
    for word in (re.split(r"[=.]", word)[0] for word in given if word.startswith("--")):
        if word.replace("--no-", "--", 1) not in (*known, "--help"):
            return f"Unrecognized options: {word}{_meant(word, known)}"
    lines = [line.strip("│| ") for line in box.splitlines()]
    rules = [i for i, line in enumerate(lines) if line.startswith(("─", "╭", "╰", "---", "+"))]
    text = " ".join(lines[rules[0] + 1 : rules[1]]) if len(rules) > 1 else " ".join(box.split())
    if text.startswith("Missing from"):
        return f"an argument is missing; {usage}"
    if (found := re.match(r"Error parsing (--[\w-]+): ", text)) and found[1] in known:
        at = max(i for i, word in enumerate(given) if word.partition("=")[0] == found[1])
        typed = [given[at].partition("=")[2], *takewhile(lambda word: not word.startswith("--"), given[at + 1 :])]
        return f"{found[1]} must be {expected(known[found[1]])}, got {' '.join(filter(None, typed))}"
    if found := re.match(r"invalid choice '(.*)' for argument '(--[\w-]+)'. Expected one of \((.*)\)", text):
        choices = found[3].replace("'", "").removesuffix(",")
        return f"{found[2]} must be one of {choices}, got {found[1]}{_meant(found[1], choices.split(', '))}"
    return re.sub(r"^Error parsing \w+: ", "", text).removesuffix(".")


def split_lists(arguments: Sequence[str], known: Mapping[str, str]) -> list[str]:
    """Split comma-separated values, for example 10,50, of options with several values."""
    words, option = [], ""
    for word in arguments:
        option, _, value = word.partition("=") if word.startswith("--") else (option, "", word)
        several = " " in known.get(option, "") and word != option
        words += [option] * word.startswith("--") + value.split(",") if several else [word]
    return words


@contextlib.contextmanager
def exit_codes(program: str, command: str, interrupted: str) -> Iterator[None]:
    """On invalid input or a signal, end the process with one line on stderr and an exit code."""
    for name in ("stderr", "stdout"):
        stream = getattr(sys, name) or open(os.devnull, "w")  # noqa: SIM115  None where it is closed
        if stream is getattr(sys, f"__{name}__"):
            binary = io.BufferedWriter(_Output(program, stream.fileno()))
            stream = io.TextIOWrapper(binary, stream.encoding, line_buffering=True)
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a letter that a terminal cannot show should not end a run
        setattr(sys, name, stream)
    before, warnings.showwarning = warnings.showwarning, partial(_warn, program)
    try:
        yield
    except (ValueError, OSError, ImportError) as error:
        text = str(error)
        if isinstance(error, OSError) and error.filename is not None and error.strerror:
            text = f"{error.filename}: {error.strerror.lower()}"  # without the number of the error
        message = in_flags(text if isinstance(error, Explained) else " ".join(text.split()), command)
        message = re.sub(r"(;|, or) pass like=$", "", message)  # which a command does not have
        if command in VERBS:  # an argument at the start is one of its options
            message = re.sub(r"^([a-z_]+)(?=(\[\d\])? must )", lambda found: _flag(found[1]), message)
        lines, code = [message], BAD_INPUT
    except ChecksFailed as failed:
        lines, code = [in_flags(line, command) for line in failed.args], FAILED_CHECKS
    except KeyboardInterrupt as stop:
        lines, code = [interrupted], 128 + (stop.args[0] if stop.args else signal.SIGINT)
    else:
        return
    finally:
        warnings.showwarning = before
    for line in lines:
        print(f"{program}:", "\n".join(map(printable, line.split("\n"))), file=sys.stderr)
    sys.exit(code)


def _warn(program: str, message: Warning | str, *_: Any) -> None:
    """Print a warning as one line, without the place in the library where it was raised."""
    print(f"{program}: warning:", printable(" ".join(str(message).split())), file=sys.stderr)


def printable(text: str) -> str:
    """Escape characters that a terminal might act on, for example in the name of a file."""
    return "".join(each if each.isprintable() or each == "\N{NO-BREAK SPACE}" else repr(each)[1:-1] for each in text)


class _Output(io.FileIO):
    """Standard output or error that may be full or closed, for example by `| head -1`: files are still written."""

    def __init__(self, program: str, number: int):
        super().__init__(number, "w", closefd=False)
        self.program = program

    def write(self, text, /) -> int:
        try:
            return super().write(text)
        except OSError as error:
            os.dup2(os.open(os.devnull, os.O_WRONLY), self.fileno())
            if sys.stdout.fileno() == self.fileno() and not isinstance(error, BrokenPipeError):
                print(f"{self.program}: standard output: {error.strerror}; the rest is not shown", file=sys.stderr)
            return memoryview(text).nbytes


def _meant(word: str, known: Iterable[str]) -> str:
    near = difflib.get_close_matches(word, list(known), 1)
    return f"; did you mean {near[0]}?" if near else ""


def _flag(argument: str) -> str:
    return f"--{'learn' if argument == 'parameters' else argument.replace('_', '-')}"


def in_flags(message: str, command: str = READ_LOGS[0]) -> str:
    """Replace `argument=value` and `argument must …` in a message by the options of a command, if it has them."""
    if command not in READ_LOGS:
        return message

    def option(found: Any) -> str:
        flag, value = FLAGS[found[1]], found[2]
        if value in ("True", '"warn"'):
            return flag
        pairs = re.sub(r"\"([^\"]*)\": *", r"\1=", value)
        typed = re.sub(r"[(){}\"]", "", pairs).replace(", ", "," if value.startswith("(") else " ").rstrip(",…")
        return f"{flag} {typed}".rstrip()

    message = re.sub(rf"\b({_NAMED})=({_VALUE})", option, message)
    return re.sub(rf"(?<![-\w])({_FREE})(?=: | must | needs )", lambda found: FLAGS[found[1]], message)


@contextlib.contextmanager
def step(doing: str) -> Iterator[Callable[[str], None]]:
    """Print on stderr what is being done, then the result (set by the yielded function) and the duration."""
    began, found = time.perf_counter(), [""]
    print(f"{doing} …", file=sys.stderr, flush=True)
    yield lambda text: found.__setitem__(0, f"{text}, ")
    print(f"{doing}: {found[0]}{time.perf_counter() - began:.1f} s", file=sys.stderr, flush=True)
