"""Which inputs and outputs of a network go together, and a few pairs in which each of them occurs."""

import pytest

from hybrid_jax.networks.factory import GO_WITH, INPUTS, OUTPUTS

PAIRS = [(read, written) for read in INPUTS for written in OUTPUTS if read in GO_WITH.get(written, INPUTS)]
FEW = [pair for pair in PAIRS if "all" in pair or pair == ("body", "motion")]


def mostly_slow(pairs):
    """Parameters of a test, slow but for those of a few pairs."""
    return [pytest.param(*pair, marks=[pytest.mark.slow] * (pair not in FEW)) for pair in pairs]
