"""Run the console script `hybrid-jax` by `python -m hybrid_jax`."""

from hybrid_jax.cli import main

if __name__ == "__main__":
    main()
