"""Laws of compiled programs, optimised as users have them; the rest of the suite does not optimise (conftest.py)."""

import os

import pytest
from smoke import script

from hybrid_jax.runtime import FLAGS, WHOLE_LOOPS

pytestmark = pytest.mark.slow

LAWS = ("tests/sweep/test_sweep.py", "tests/networks/test_residual.py")


def test_they_hold():
    script("-m", "pytest", "-n", "0", "-p", "no:cacheprovider", *LAWS, env=os.environ | {FLAGS: WHOLE_LOOPS})
