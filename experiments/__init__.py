"""The experiments: programs that are started as `python -m experiments.NAME`."""

import sys


def _say_in_a_line(kind, error, trace) -> None:
    """Ctrl-C while modules load, before a program can say so itself."""
    if issubclass(kind, KeyboardInterrupt):
        print("interrupted", file=sys.stderr)
    else:
        sys.__excepthook__(kind, error, trace)


sys.excepthook = _say_in_a_line
