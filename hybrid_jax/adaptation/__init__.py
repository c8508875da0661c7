"""Adapt a trained field to a few windows of a changed system, with confidence intervals for its parameters.

    source = hj.fit(hj.Hybrid(pendulum, network), train, validation, key)
    result = hj.adapt(source.best, windows)
    print(result.report())

By default (`Auto`) the most probable change is chosen. `METHODS` lists the other methods, and `Method` shows how to
write your own.
"""

from hybrid_jax.adaptation.adapting import METHODS, adapt
from hybrid_jax.adaptation.auto import Auto
from hybrid_jax.adaptation.methods import FineTune, LeastSquares, Method, Ridge, Solution, Source
from hybrid_jax.adaptation.plausible import Plausible
from hybrid_jax.adaptation.pooling import pool
from hybrid_jax.adaptation.records import RecordAdaptation, adapt_records
from hybrid_jax.adaptation.results import Adaptation, Parameter

__all__ = ["METHODS", "Adaptation", "Auto", "FineTune", "LeastSquares", "Method"]
__all__ += ["Parameter", "Plausible", "RecordAdaptation", "Ridge", "Solution", "Source"]
__all__ += ["adapt", "adapt_records", "pool"]
