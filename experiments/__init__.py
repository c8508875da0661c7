"""The experiments: programs that you start with `python -m experiments.NAME`."""

import os
import signal
import sys

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # else XLA reports slow compilations


def _leave(*_) -> None:
    os.write(2, b"interrupted\n")
    os._exit(128 + signal.SIGINT)


def interruptible() -> None:
    """Let Ctrl-C raise again, once all modules are there."""
    if signal.getsignal(signal.SIGINT) is _leave:
        signal.signal(signal.SIGINT, signal.default_int_handler)


# Ctrl-C while modules load: where an extension does, an exception would be lost or become another.
if sys.argv[0] == "-m" and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, _leave)
