"""Names of classes in files of earlier versions, and the classes of today."""

from collections.abc import Callable
from typing import Any

from hybrid_jax.dynamics.base import Frozen, Hybrid, RunningStats
from hybrid_jax.dynamics.baselines import FrozenRates, HoldState
from hybrid_jax.dynamics.disturbance import ConstantDisturbance
from hybrid_jax.dynamics.kinematics import Kinematics
from hybrid_jax.dynamics.multirotor import Multirotor
from hybrid_jax.dynamics.rigid_body import ForcedBody, RigidBody
from hybrid_jax.dynamics.terms import Terms
from hybrid_jax.networks.fused import FusedNetwork
from hybrid_jax.networks.mlp import LinearResidual, LinearSkip, ResidualNetwork
from hybrid_jax.networks.normalisation import BatchNorm, Bias, LayerNorm
from hybrid_jax.networks.rotor_thrust import RotorThrust
from hybrid_jax.networks.scaling import InputScaling
from hybrid_jax.networks.views import Accelerations, BodyFrame, BodyMotion, DropXY, DropXYYaw, GroundDistance, Motion
from hybrid_jax.vehicle import Vehicle

# Format 1 names a class by its bare name; format 2 by "module:qualname". A class that moves or is renamed gets an entry
# here: the class today, or a function from the saved fields (name → value) to the object.
RENAMED: dict[str, type | Callable[[dict[str, Any]], Any]] = {
    **{cls.__name__: cls for cls in (ForcedBody, Frozen, FrozenRates, HoldState, Hybrid)},
    **{cls.__name__: cls for cls in (Kinematics, LinearResidual, Multirotor, ResidualNetwork, RigidBody, RotorThrust)},
    **{cls.__name__: cls for cls in (Accelerations, BodyFrame, BodyMotion, Motion)},
    **{cls.__name__: cls for cls in (BatchNorm, Bias, InputScaling, LayerNorm, Terms, Vehicle)},
    "ConstantDisturbance": lambda fields: ConstantDisturbance(fields["acceleration"]),
    "DeployedNetwork": FusedNetwork,
    "LinearPath": LinearSkip,
    "NearGround": GroundDistance,
    "Placeless": DropXY,
    "Statistics": RunningStats,
    "TiltOnly": DropXYYaw,
}
