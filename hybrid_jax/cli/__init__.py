"""The console script `hybrid-jax`: learn, check, adapt and export models from folders of logs."""

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Iterator, Sequence

__all__ = ["main"]
EXTRA = ("tyro", "matplotlib")  # packages that the script needs beside the library
INTERRUPTED = "interrupted; each file that was written is complete"


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a command line.

    Args:
        arguments: a verb and its options, by default `sys.argv`.
    """
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # otherwise XLA reports slow compilations
    given = sys.argv[1:] if arguments is None else arguments
    try:
        with answering(" ".join(["hybrid-jax", *given[:1]]), INTERRUPTED, end=True):  # also while modules load
            from hybrid_jax.cli.command import run

            run(given)
    except ModuleNotFoundError as error:
        if error.name not in EXTRA:
            raise
        print(f"hybrid-jax: needs {error.name}: pip install 'hybrid_jax[cli]'", file=sys.stderr)
        sys.exit(2)


@contextlib.contextmanager
def answering(program: str, answer: str, end: bool = False) -> Iterator[None]:
    """Answer the first Ctrl-C at once, even while XLA is busy; if `end`, also end the process."""
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
    before = signal.set_wakeup_fd(mouth, warn_on_full_buffer=False)  # Python writes signals to it at once
    handler = signal.signal(signal.SIGINT, lambda *_: None) if end else None
    try:
        yield
    finally:
        if handler is not None:
            signal.signal(signal.SIGINT, handler)
        signal.set_wakeup_fd(before)
        os.close(mouth)
