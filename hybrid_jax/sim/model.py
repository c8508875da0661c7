"""iris.xml with the constants of a vehicle, for C MuJoCo, and with traced parameters, for MJX."""

# MuJoCo's compiled modules carry no type stubs.
# pyright: reportAttributeAccessIssue=false

from pathlib import Path
from typing import cast

import jax
import jax.numpy as jnp
import mujoco
from mujoco import mjx

from hybrid_jax.sim.forces import Parameters
from hybrid_jax.vehicle import IRIS, Vehicle


def build_model(vehicle: Vehicle) -> mujoco.MjModel:
    """The scene for C MuJoCo: one free body whose controls are the squared rotor speeds [(rad/s)²]."""
    spec = mujoco.MjSpec.from_file(str(Path(__file__).with_name("iris.xml")))
    spec.option.gravity = [0.0, 0.0, -vehicle.gravity]
    body = spec.body("vehicle")
    body.mass, body.inertia = vehicle.mass, vehicle.inertia
    reaction = vehicle.torque_coefficient / vehicle.thrust_coefficient
    for i, (x, y) in enumerate(vehicle.rotor_positions):
        spec.site(f"rotor{i}").pos = [x, y, 0.0]
        actuator = spec.actuator(f"rotor{i}")
        actuator.gainprm[0] = vehicle.thrust_coefficient
        actuator.gear = [0, 0, 1, 0, 0, vehicle.spin[i] * reaction]
    return spec.compile()


def traced_model(p: Parameters) -> mjx.Model:
    """The scene for MJX, in the current precision, with the parameters of a vehicle, which may be traced."""
    # Concrete even while tracing, so that MJX sees the model's structure as constants.
    with jax.ensure_compile_time_eval():
        model = mjx.put_model(build_model(IRIS))
    thrust, reaction = jnp.array([0.0, 0, 1, 0, 0, 0]), jnp.array([0.0, 0, 0, 0, 0, 1])
    ratio = p.spin * p.torque_coefficient / p.thrust_coefficient
    replaced = model.tree_replace(
        {
            "opt.gravity": jnp.array([0.0, 0.0, -1.0]) * p.gravity,
            "body_mass": model.body_mass.at[1].set(p.mass),
            "body_subtreemass": model.body_subtreemass.at[:].set(p.mass),
            "body_inertia": model.body_inertia.at[1].set(p.inertia),
            "site_pos": p.rotor_positions,
            "actuator_gear": thrust + ratio[:, None] * reaction,
            "actuator_gainprm": model.actuator_gainprm.at[:, 0].set(p.thrust_coefficient),
        }
    )
    return cast(mjx.Model, replaced)
