"""Laws of compiled programs, optimised as users have them; the rest of the suite does not optimise (conftest.py)."""

import os

import pytest
from smoke import script

from hybrid_jax.runtime import FLAGS, WHOLE_LOOPS

pytestmark = pytest.mark.slow

# Those of rounding and of the derivative written by hand, which fusing kernels may change.
SWEEP = (
    "a_lane_is_the_same_run_alone",
    "a_lane_is_a_run_by_the_plain_function",
    "lanes_that_share_a_chunk_are_the_same_runs",
    "every_lane_comes_to_its_own_end",
    "a_diverged_lane_changes_no_bit_of_another",
)
NETWORK = (
    "the_derivative_written_by_hand_is_that_of_the_plain_formula",
    "the_gradient_of_a_minibatch_is_that_of_its_samples_one_by_one",
    "what_few_samples_use_is_the_same_network_with_the_same_slopes_and_so_is_its_file",
)
LAWS = [
    f"tests/{file}.py::test_{law}"
    for file, laws in {"sweep/test_sweep": SWEEP, "networks/test_residual": NETWORK}.items()
    for law in laws
]


def test_they_hold():
    script("-m", "pytest", "-n", "0", "-p", "no:cacheprovider", *LAWS, env=os.environ | {FLAGS: WHOLE_LOOPS})
