"""Save and load models and datasets. Files contain data but no code, and a checksum detects damage."""

from hybrid_jax.io.datasets import Dataset, load_dataset, save_dataset
from hybrid_jax.io.models import Model, check_savable, load, save
from hybrid_jax.io.structure import portable

__all__ = ["Dataset", "Model", "check_savable", "load", "load_dataset", "portable", "save", "save_dataset"]
