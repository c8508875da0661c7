"""Parameters for the slow run, and the pairs of inputs and outputs of a network, of which few are not for it alone."""

import pytest

from hybrid_jax.networks.views import INPUTS, OUTPUTS

PAIRS = [(read, written) for read in INPUTS for written in OUTPUTS]
FEW = [pair for pair in PAIRS if "all" in pair or pair == ("body", "accelerations")]


def mostly_slow(pairs):
    """Parameters of a test, slow but for those of a few pairs."""
    return [pytest.param(*pair, marks=[pytest.mark.slow] * (pair not in FEW)) for pair in pairs]


def slow(*values):
    """Parameters of a test for the slow run alone."""
    return [pytest.param(value, marks=pytest.mark.slow) for value in values]
