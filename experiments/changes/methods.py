"""Common methods of adapting a vehicle's model to ten seconds of flight, beside `hj.adapt`."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

import hybrid_jax as hj
from experiments.paper.conditions import sensor_noise
from experiments.worlds.flights import PHYSICS
from experiments.worlds.world import DT, World
from hybrid_jax.adaptation import Adaptation, FineTune, Method, Parameter

CHANGING = 1.0  # m/s² and rad/s²: the filter's prior of a disturbance


class Task(NamedTuple):
    """The inputs of a method.

    Attributes:
        world: with the known vehicle before the change.
        source: the hybrid that was trained before the change.
        learned: its training windows.
        windows: of the flight to adapt to.
        noise: of that flight; 1 is typical.
        many: windows of many flights without noise, for training and early stopping, as in the paper; None if not
            needed.
    """

    world: World
    source: hj.AbstractVectorField
    learned: hj.Trajectories
    windows: hj.Trajectories
    noise: float
    many: tuple[hj.Trajectories, hj.Trajectories] | None


class Model(NamedTuple):
    """The result of a method: a field, its parameters, and further results of `hj.adapt`."""

    field: hj.AbstractVectorField
    parameters: Mapping[str, Parameter]
    result: Adaptation | None = None


def adapted(method: Method | str, task: Task) -> Model:
    """Run `hj.adapt` on the one flight; its last fifth is for early stopping if the method needs that."""
    learned = task.learned if method == AUTO else None
    return _of(hj.adapt(task.source, task.windows, method=method, learned_from=learned))


def as_in_the_paper(task: Task) -> Model:
    """Train by Adam on windows of many flights, with others for early stopping, all without noise."""
    assert task.many is not None
    return _of(hj.adapt(task.source, task.many[0], method=FineTune(), validation=task.many[1]))


def white_box(task: Task) -> Model:
    """Fit physics without a network by least squares, from nominal values, without a source."""
    return _of(hj.adapt(hj.rigid_body(task.world.vehicle, PHYSICS), task.windows, method="least_squares"))


def kalman_filter(task: Task) -> Model:
    """Estimate the same parameters by an extended Kalman filter, sample by sample."""
    noise, physics = sensor_noise(task.noise), hj.rigid_body(task.world.vehicle, PHYSICS)
    online = hj.OnlineAdaptation(physics, DT, tuple(noise.tolist()), disturbance=CHANGING)
    x, u = (jnp.asarray(part).reshape(-1, part.shape[-1]) for part in (task.windows.x, task.windows.u))
    state = _filtered(online, jnp.asarray(task.windows.x0[0]), x, u)
    found = {name: Parameter(float(v[0]), float(v[1]), float(v[2])) for name, v in online.intervals(state).items()}
    return Model(online.model(state), found)


@eqx.filter_jit
def _filtered(online: hj.OnlineAdaptation, start, x, u):
    return jax.lax.scan(lambda state, new: (online.update(state, *new), None), online.begin(start), (x, u))[0]


def _of(result: Adaptation) -> Model:
    return Model(result.field, result.parameters, result)


AUTO, NOT_ADAPTED = "auto", "source"
METHODS: dict[str, Callable[[Task], Model]] = {
    AUTO: partial(adapted, AUTO),
    NOT_ADAPTED: partial(adapted, NOT_ADAPTED),
    "fine_tune_paper": as_in_the_paper,
    "fine_tune": partial(adapted, FineTune()),
    "l2_sp": partial(adapted, FineTune(l2_sp=1e-2)),
    "white_box": white_box,
    "kalman_filter": kalman_filter,
}
