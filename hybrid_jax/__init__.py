"""Hybrid models of dynamical systems, ẋ = f_p(x, u; θ_p) + f_d(x, u; θ_d), adapted from seconds of new data.

    source = hj.fit(hj.Hybrid(physics, hj.residual_network(d, m, key)), train, validation, key)
    result = hj.adapt(source.best, windows)
    hj.save("model.npz", result.field)

The packages from the bottom up: `dynamics` (vector fields, physics), `networks` (residuals), `io` (models and data as
files), `training` (`fit`), `adaptation` (`adapt`), `sweep` (many runs as one program), `sim` (a MuJoCo quadrotor),
`flights` (recorded logs), `control` (closed-loop flight), `export` (StableHLO, CasADi, C), `identification` (a vehicle
from its logs).
"""

import lazy_loader

# Names are imported when they are first used (Scientific Python's SPEC 1). Importing all takes longer than JAX itself.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
