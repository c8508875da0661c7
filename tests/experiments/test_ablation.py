"""Ablations: the configuration of each value, tables and figure, and the files of a run."""

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
from rich.console import Console

from experiments.ablation import PRESETS, Choice, experiment, varied
from experiments.paper.conditions import Noise, measured
from hybrid_jax.io.datasets import Dataset
from hybrid_jax.trajectories import Trajectories


@pytest.mark.parametrize("choice", get_args(Choice))
def test_every_choice_has_its_default_once(choice):
    config = PRESETS["paper"]
    changed = list(varied(choice, config).values())
    assert changed.count(config) == 1
    assert len({str(other) for other in changed}) == len(changed) > 2


def test_contradictory_values_are_refused_before_any_flight(tmp_path):
    config = replace(PRESETS["smoke"], batch_size=1, norm="none", over=("weight", "norm"), out=tmp_path)
    with pytest.raises(ValueError, match="--batch-size must be at least 2 with --norm batch"):
        experiment(config, Console(quiet=True))
    assert not list(tmp_path.iterdir())


def test_noise_has_its_size_and_spares_the_test_split():
    x = np.zeros((400, 10, 13), np.float32)
    x[..., 3] = 1
    clean = Trajectories(x[:, 0], np.zeros((400, 10, 4), np.float32), x, 0.01)
    noisy = measured(Dataset({"train": clean, "test": clean}, {}), 2.0, seed=0)
    np.testing.assert_array_equal(noisy.splits["test"].x, x)
    off = noisy.splits["train"].x - x
    # 4000 draws of a normal: its spread is known to 1.1 %.
    np.testing.assert_allclose(off[..., 0].std(), 2 * Noise().position, rtol=0.05)
    np.testing.assert_allclose(off[..., 12].std(), 2 * Noise().body_rates, rtol=0.05)
    np.testing.assert_allclose(np.linalg.norm(noisy.splits["train"].x0[:, 3:7], axis=1), 1, rtol=1e-6)
