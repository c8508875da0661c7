"""The console script `hybrid-jax`: learn, check, adapt and export models from folders of logs."""

import os
import signal
import sys
import threading
from collections.abc import Sequence
from typing import NoReturn

__all__ = ["main"]
EXTRA = ("tyro", "matplotlib")  # what the script needs beside the library


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a command line.

    Args:
        arguments: a verb and its options, by default `sys.argv`.
    """
    main_thread = threading.current_thread() is threading.main_thread()
    alone = main_thread and signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if alone:  # where an extension loads, an exception would be lost or become another
        signal.signal(signal.SIGINT, _leave)
    try:
        from hybrid_jax.cli.command import run

        run(sys.argv[1:] if arguments is None else arguments)
    except ModuleNotFoundError as error:
        if error.name not in EXTRA:
            raise
        print(f"hybrid-jax: needs {error.name}: pip install 'hybrid_jax[cli]'", file=sys.stderr)
        sys.exit(2)
    finally:
        if alone:
            signal.signal(signal.SIGINT, signal.default_int_handler)


def _leave(*_) -> NoReturn:
    os.write(2, b"hybrid-jax: interrupted, nothing was written\n")
    os._exit(128 + signal.SIGINT)
