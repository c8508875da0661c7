"""The vehicle in MuJoCo and in MJX: iris.xml with the constants of a vehicle."""

# MuJoCo's compiled modules have no type stubs.
# pyright: reportAttributeAccessIssue=false

import contextlib
import io
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import jax
import jax.numpy as jnp
import mujoco
from jaxtyping import Array, Float

with contextlib.redirect_stdout(io.StringIO()):  # mjx prints a message about its optional Warp backend
    from mujoco import mjx

from hybrid_jax.sim.forces import Parameters
from hybrid_jax.vehicle import IRIS, Input, State, Vehicle


def build_model(vehicle: Vehicle) -> mujoco.MjModel:
    """Build the scene for C MuJoCo: one free body whose controls are the squared rotor speeds [(rad/s)²]."""
    spec = mujoco.MjSpec.from_file(str(Path(__file__).with_name("iris.xml")))
    spec.option.gravity = [0.0, 0.0, -vehicle.gravity]
    body = spec.body("vehicle")
    for i in range(vehicle.rotors, 4):
        spec.delete(spec.actuator(f"rotor{i}"))
        spec.delete(spec.site(f"rotor{i}"))
    for i in range(4, vehicle.rotors):
        body.add_site(name=f"rotor{i}")
        spec.add_actuator(name=f"rotor{i}", target=f"rotor{i}", trntype=mujoco.mjtTrn.mjTRN_SITE)
    body.mass, body.inertia = vehicle.mass, vehicle.inertia
    reaction = vehicle.torque_coefficient / vehicle.thrust_coefficient
    for i, (x, y) in enumerate(vehicle.rotor_positions):
        spec.site(f"rotor{i}").pos = [x, y, 0.0]
        actuator = spec.actuator(f"rotor{i}")
        actuator.gainprm[0] = vehicle.thrust_coefficient
        actuator.gear = [0, 0, 1, 0, 0, vehicle.spin[i] * reaction]
    return spec.compile()


def traced_model(p: Parameters) -> mjx.Model:
    """Build the scene for MJX, in the current precision, with the parameters of a vehicle, which may be traced."""
    # Concrete even while tracing, so that MJX sees the model's structure as constants.
    with jax.ensure_compile_time_eval():
        places, spin = ((each * len(p.spin))[: len(p.spin)] for each in (IRIS.rotor_positions, IRIS.spin))
        model = mjx.put_model(build_model(replace(IRIS, rotor_positions=places, spin=spin)))
    thrust, reaction = jnp.array([0.0, 0, 1, 0, 0, 0]), jnp.array([0.0, 0, 0, 0, 0, 1])
    ratio = p.spin * p.torque_coefficient / p.thrust_coefficient
    replaced: dict[str, Any] = {
        "opt.gravity": jnp.array([0.0, 0.0, -1.0]) * p.gravity,
        "body_mass": model.body_mass.at[1].set(p.mass),
        "body_subtreemass": model.body_subtreemass.at[:].set(p.mass),
        "body_inertia": model.body_inertia.at[1].set(p.inertia),
        "site_pos": p.rotor_positions,
        "actuator_gear": thrust + ratio[:, None] * reaction,
        "actuator_gainprm": model.actuator_gainprm.at[:, 0].set(p.thrust_coefficient),
    }
    return cast(mjx.Model, model.tree_replace(replaced))


def accelerations(p: Parameters, x: State, u: Input, applied: Float[Array, "6"]) -> Float[Array, "6"]:
    """Return v̇ and ω̇ for rotor speeds u [rad/s] and an additional force [N] and torque [N m]."""
    model = traced_model(p)
    forces = jnp.stack([jnp.zeros_like(applied), applied])
    data = mjx.make_data(model).replace(qpos=x[:7], qvel=x[7:], ctrl=u**2, xfrc_applied=forces)
    return mjx.forward(model, data).qacc
