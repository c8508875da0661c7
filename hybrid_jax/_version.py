"""The installed version. Imported when first used, because `importlib.metadata` takes longer than the package."""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("hybrid_jax")
except PackageNotFoundError:  # a checkout that is not installed
    __version__ = "0+unknown"
