"""What the benchmarks against rivals share: which of them are installed, and one core for all."""

import os
from importlib.util import find_spec
from typing import Any

PEERS = "pip install -e '.[peers]'"


def installed(*packages: str) -> bool:
    """Whether all of these can be imported."""
    return all(find_spec(package) is not None for package in packages)


def skipped(rival: str, remedy: str = PEERS) -> dict[str, Any]:
    """The row of a rival that is not measured; `remedy` is what would change that."""
    return {"rival": rival, "skipped": f"skipped: {remedy}"}


def keep_to_one_core() -> None:
    """Compare core for core: this process, and every thread it starts from now on, runs on the last of its cores.

    Call it before the first array is made. Only Linux can do this; elsewhere the report says how many cores were used.
    """
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
