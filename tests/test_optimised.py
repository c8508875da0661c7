"""Laws of what is compiled, on programs as users have them: the rest of the suite does not optimise (conftest.py)."""

import os
import subprocess
import sys
from pathlib import Path

from hybrid_jax.runtime import FLAGS, WHOLE_LOOPS

ROOT = Path(__file__).parents[1]
LAWS = ("tests/test_sweep.py", "tests/test_residual.py")


def test_they_hold():
    run = [sys.executable, "-m", "pytest", "-n", "0", "-p", "no:cacheprovider", *LAWS]
    finished = subprocess.run(run, capture_output=True, text=True, cwd=ROOT, env=os.environ | {FLAGS: WHOLE_LOOPS})
    assert finished.returncode == 0, finished.stdout
