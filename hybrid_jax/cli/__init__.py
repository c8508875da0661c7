"""The console script `hybrid-jax`: learn, check, adapt and export models from folders of logs."""

import sys
from collections.abc import Sequence

__all__ = ["main"]
EXTRA = ("tyro", "matplotlib")  # what the script needs beside the library


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a command line.

    Args:
        arguments: a verb and its options, by default `sys.argv`.
    """
    try:
        from hybrid_jax.cli.command import run
    except ModuleNotFoundError as error:
        if error.name not in EXTRA:
            raise
        print(f"hybrid-jax: needs {error.name}: pip install 'hybrid_jax[cli]'", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:  # before the script can say so itself
        print("hybrid-jax: interrupted, nothing was written", file=sys.stderr)
        sys.exit(130)
    run(sys.argv[1:] if arguments is None else arguments)
