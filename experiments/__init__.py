"""The experiments: programs that you start with `python -m experiments.NAME`."""

import sys


def _say_in_a_line(kind, error, trace) -> None:
    """Report Ctrl-C while modules load, before a program can."""
    if issubclass(kind, KeyboardInterrupt):
        print("interrupted", file=sys.stderr)
    else:
        sys.__excepthook__(kind, error, trace)


sys.excepthook = _say_in_a_line
