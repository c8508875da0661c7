"""The comparison from its command line, in the smallest preset: what each method leaves alone, and the report."""

import equinox as eqx
import numpy as np
import pytest
from smoke import experiments

import hybrid_jax

pytestmark = pytest.mark.slow

METHODS = (
    *("hybrid", "expert_augmentation", "theta_p_only", "theta_d_only", "last_layer", "least_squares"),
    "constant_disturbance",
)
DOMAINS = ("parameter_shift", "external_force")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Left by one run of the methods that share the pre-trained hybrid, or of all."""
    folder = tmp_path_factory.mktemp("comparison")
    options = ("--methods", *METHODS)
    (run,) = experiments("comparison", "comparison", folder=folder, options=options)
    assert run.returncode == 0, run.stderr
    assert "Table" not in run.stderr
    assert "Report: " in run.stdout
    return folder / "out" / "comparison"


def field(folder, domain, model, mode="fine_tuned", n=20):
    return hybrid_jax.load(folder / "models" / domain / f"{model}-{mode}-{n}-seed0.npz").field


@pytest.mark.parametrize("domain", DOMAINS)
def test_what_a_method_does_not_adapt_stays_as_it_was(folder, domain):
    source = field(folder, domain, "hybrid", "source_only", 0)
    for model in ("theta_p_only", "least_squares", "constant_disturbance"):
        adapted = field(folder, domain, model)
        assert eqx.tree_equal(adapted.residual, source.residual)
        physics = adapted.physics.physics if model == "constant_disturbance" else adapted.physics
        assert not eqx.tree_equal(physics, source.physics)
    only_network, last = (field(folder, domain, model) for model in ("theta_d_only", "last_layer"))
    for adapted in (only_network, last):
        assert eqx.tree_equal(adapted.physics, source.physics)
        assert not eqx.tree_equal(adapted.residual, source.residual)
    np.testing.assert_array_equal(last.residual.weight_in, source.residual.weight_in)
    assert eqx.tree_equal(field(folder, domain, "expert_augmentation", "source_only", 0).expert.field, source)
