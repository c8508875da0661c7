"""Adapt a trained field to a few windows of a changed system, and say how well its parameters are known.

    source = hj.fit(hj.Hybrid(pendulum, network), train, validation, key)
    result = hj.adapt(source.best, windows)
    print(result.report())
    result.parameters["log_length"].value, result.parameters["log_length"].low

By default the windows choose: the source as it is, its physical parameters θ_p by least squares, with these a constant
disturbance and, of a rigid body, drag and the rotors' efficiencies, and last the network, held at the source's weights
(`Auto`). `METHODS` lists the other methods by name; `Method` says how to write one.
"""

from hybrid_jax.adaptation.adapting import METHODS, Adaptation, Parameter, adapt
from hybrid_jax.adaptation.auto import Auto
from hybrid_jax.adaptation.expert_augmentation import Augmentation, ExpertAugmented, expert_augmented
from hybrid_jax.adaptation.methods import FineTune, LeastSquares, Method, Ridge, Solution, Source
from hybrid_jax.adaptation.plausible import Plausible
from hybrid_jax.adaptation.pooling import pool

__all__ = ["METHODS", "Adaptation", "Augmentation", "Auto", "ExpertAugmented", "FineTune", "LeastSquares", "Method"]
__all__ += ["Parameter", "Plausible", "Ridge", "Solution", "Source", "adapt", "expert_augmented", "pool"]
