"""Laws of compiled programs, optimised as users have them; the rest of the suite does not optimise (conftest.py)."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from hybrid_jax.runtime import FLAGS, WHOLE_LOOPS

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]
LAWS = ("tests/sweep/test_sweep.py", "tests/networks/test_residual.py")


def test_they_hold():
    run = [sys.executable, "-m", "pytest", "-n", "0", "-p", "no:cacheprovider", *LAWS]
    finished = subprocess.run(run, capture_output=True, text=True, cwd=ROOT, env=os.environ | {FLAGS: WHOLE_LOOPS})
    assert finished.returncode == 0, finished.stdout
