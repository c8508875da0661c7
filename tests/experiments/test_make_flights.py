"""Flights that were made before: what an experiment takes from a file of them, and what it refuses."""

import numpy as np
import pytest
from surface import refusal

from experiments.make_flights import chosen_flights
from experiments.paper.study import placeholder
from hybrid_jax.io.datasets import Dataset, save_dataset
from hybrid_jax.sim.domain import PARAMETER_SHIFT, SOURCE
from hybrid_jax.sim.flight import SplitSpec


def windows(count, steps):
    flights = placeholder(SplitSpec(count, steps))
    flights.x[..., 0] = np.arange(count)[:, None]
    return flights


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "flights.npz"
    splits = {"train": windows(8, 10), "validation": windows(4, 10)}
    save_dataset(path, Dataset(splits, {"config": SOURCE.describe() | {"seed": 3}}))
    return path


def test_the_first_windows_are_taken_so_that_sizes_are_nested(file):
    few = chosen_flights(file, SOURCE, {"train": SplitSpec(3, 10)}).splits["train"]
    more = chosen_flights(file, SOURCE, {"train": SplitSpec(8, 10)}).splits["train"]
    assert (len(few), len(more)) == (3, 8)
    np.testing.assert_array_equal(few.x, more.x[:3])


@pytest.mark.parametrize(
    ("domain", "splits", "said"),
    [
        (SOURCE, {"train": SplitSpec(9, 10)}, "9 windows of split 'train' requested, but it has 8"),
        (SOURCE, {"test": SplitSpec(1, 100)}, "has no split 'test'"),
        (SOURCE, {"train": SplitSpec(3, 20)}, "split 'train' has windows of 10 steps, expected 20"),
        (PARAMETER_SHIFT, {"train": SplitSpec(3, 10)}, 'domain is "source", expected "parameter_shift"'),
    ],
)
def test_what_the_file_does_not_have_is_refused_in_one_line(file, domain, splits, said):
    refusal(lambda: chosen_flights(file, domain, splits), file, said)
