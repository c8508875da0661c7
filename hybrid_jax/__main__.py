"""`python -m hybrid_jax` is the console script `hybrid-jax`."""

from hybrid_jax.cli import main

if __name__ == "__main__":
    main()
