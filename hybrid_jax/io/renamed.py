"""Names of classes in files of earlier versions, and the classes of today."""

from collections.abc import Callable
from typing import Any

from hybrid_jax.dynamics.base import Frozen, Hybrid, RunningStats
from hybrid_jax.dynamics.baselines import FrozenRates, HoldState, Kinematics
from hybrid_jax.dynamics.disturbance import ConstantDisturbance
from hybrid_jax.dynamics.multirotor import Multirotor
from hybrid_jax.dynamics.rigid_body import ForcedBody, RigidBody
from hybrid_jax.dynamics.terms import Terms
from hybrid_jax.networks import views
from hybrid_jax.networks.mlp import FusedNetwork, LinearResidual, LinearSkip, ResidualNetwork
from hybrid_jax.networks.normalisation import BatchNorm, Bias, ChannelScaling, InputScaling, LayerNorm
from hybrid_jax.vehicle import Vehicle

# Format 1 names a class by its bare name; format 2 by "module:qualname". A class that moves or is renamed gets an entry
# here: the class today, or a function from the saved fields (name → value) to the object.
RENAMED: dict[str, type | Callable[[dict[str, Any]], Any]] = {
    **{cls.__name__: cls for cls in (ForcedBody, Frozen, FrozenRates, HoldState, Hybrid, Kinematics, LinearResidual)},
    **{cls.__name__: cls for cls in (Multirotor, ResidualNetwork, RigidBody, views.Accelerations, views.BodyFrame)},
    **{cls.__name__: cls for cls in (views.BodyMotion, views.Motion, views.RotorThrust)},
    **{cls.__name__: cls for cls in (BatchNorm, Bias, InputScaling, LayerNorm, Terms, Vehicle)},
    "hybrid_jax.dynamics.kinematics:Kinematics": Kinematics,
    "hybrid_jax.networks.fused:FusedNetwork": FusedNetwork,
    "hybrid_jax.networks.rotor_thrust:RotorThrust": views.RotorThrust,
    "hybrid_jax.networks.scaling:ChannelScaling": ChannelScaling,
    "hybrid_jax.networks.scaling:InputScaling": InputScaling,
    "ConstantDisturbance": lambda fields: ConstantDisturbance(fields["acceleration"]),
    "DeployedNetwork": FusedNetwork,
    "LinearPath": LinearSkip,
    "NearGround": views.GroundDistance,
    "Placeless": views.DropXY,
    "Statistics": RunningStats,
    "TiltOnly": views.DropXYYaw,
}
