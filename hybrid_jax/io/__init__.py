"""Models and datasets as files with data and no code, written atomically and verified by a checksum."""

from hybrid_jax.io.datasets import Dataset, load_dataset, save_dataset
from hybrid_jax.io.models import Model, check_savable, load, save
from hybrid_jax.io.structure import portable

__all__ = ["Dataset", "Model", "check_savable", "load", "load_dataset", "portable", "save", "save_dataset"]
