"""Systems that are served from fit to file: `SYSTEMS[name]()` is a truth, a changed one, a model and windows."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from pendulum import pendulum, whirling

import hybrid_jax as hj
from hybrid_jax.dynamics import AbstractVectorField, Terms, rigid_body
from hybrid_jax.dynamics.base import as_field
from hybrid_jax.networks import InputScaling
from hybrid_jax.vehicle import QUATERNION

ODD = replace(  # a vehicle without any symmetry
    hj.IRIS, mass=2.1, inertia=(0.05, 0.02, 0.06), thrust_coefficient=1.1e-5, torque_coefficient=2e-6, gravity=9.7,
    rotor_positions=((0.2, -0.1), (-0.15, 0.2), (0.1, 0.3), (-0.2, -0.25)), spin=(1.0, 1.0, -1.0, -1.0),
)  # fmt: skip
HOVER = InputScaling(hj.IRIS.hover_speed, hj.IRIS.hover_speed / 10)
STEPS = 10
GRID = 32


@dataclass(frozen=True)
class System:
    """A system to learn on windows of `truth` and to adapt to those of `changed`, `target`.

    The physics of the model has wrong parameters and leaves out a force.
    """

    truth: AbstractVectorField
    changed: AbstractVectorField
    model: AbstractVectorField
    train: hj.Trajectories
    validation: hj.Trajectories
    target: hj.Trajectories
    test: hj.Trajectories


class Car(AbstractVectorField):
    """A single-track car: x = (X [m], Y [m], yaw [rad], v_x, v_y [m/s, body], yaw rate [rad/s]), u = (steering [rad],
    acceleration [m/s²]).

    A tyre's lateral force is c α for a small slip angle α, and saturates at `grip` times its load if that is given.
    """

    log_front: Float[Array, ""]  # log of the cornering stiffness over the nominal one
    log_rear: Float[Array, ""]
    grip: float | None = eqx.field(static=True, default=None)
    drag: float = eqx.field(static=True, default=0.0)  # [1/m]

    def __call__(self, x, u):
        _, _, yaw, v, side, rate = x
        mass, inertia, front, rear = 1500.0, 2500.0, 1.2, 1.6
        load = mass * 9.81 / (front + rear)

        def tyre(log_stiffness, slip, arm):
            force = 8e4 * jnp.exp(log_stiffness) * slip
            return force if self.grip is None else self.grip * load * arm * jnp.tanh(force / (self.grip * load * arm))

        ahead = tyre(self.log_front, u[0] - jnp.arctan2(side + front * rate, v), rear)
        behind = tyre(self.log_rear, -jnp.arctan2(side - rear * rate, v), front)
        return jnp.stack(
            [
                v * jnp.cos(yaw) - side * jnp.sin(yaw),
                v * jnp.sin(yaw) + side * jnp.cos(yaw),
                rate,
                u[1] - ahead * jnp.sin(u[0]) / mass + side * rate - self.drag * v**2,
                (ahead * jnp.cos(u[0]) + behind) / mass - v * rate,
                (front * ahead * jnp.cos(u[0]) - rear * behind) / inertia,
            ]
        )


class Burgers(AbstractVectorField):
    """∂w/∂t = −w ∂w/∂s + ν ∂²w/∂s² + u sin 2πs + r w (1 − w²) at `GRID` points of a ring of length 1."""

    log_viscosity: Float[Array, ""]
    reaction: float = eqx.field(static=True, default=0.0)

    def __call__(self, x, u):
        ahead, behind = jnp.roll(x, -1), jnp.roll(x, 1)
        slope, bend = (ahead - behind) * (GRID / 2), (ahead - 2 * x + behind) * GRID**2
        force = u[0] * jnp.sin(2 * jnp.pi * jnp.arange(GRID) / GRID).astype(x.dtype)
        return -x * slope + jnp.exp(self.log_viscosity) * bend + force + self.reaction * x * (1 - x**2)


class Dense(AbstractVectorField):
    """Equinox' own network of [x, u]."""

    network: eqx.nn.MLP

    def __call__(self, x, u):
        return self.network(jnp.concatenate([x, u]))


class Convolution(AbstractVectorField):
    """Two layers of Equinox' convolution along the ring; blind to u."""

    first: eqx.nn.Conv1d
    second: eqx.nn.Conv1d

    def __call__(self, x, u):
        return self.second(jax.nn.tanh(self.first(x[None])))[0]


class Gain(AbstractVectorField):
    """A user's wrapper around another field."""

    log_gain: Float[Array, ""]
    field: AbstractVectorField

    def __call__(self, x, u):
        return jnp.exp(self.log_gain) * self.field(x, u)


def car(front=1.0, rear=1.0, **options):
    """A car whose cornering stiffnesses are these factors of the nominal ones."""
    return Car(jnp.log(jnp.asarray(front)), jnp.log(jnp.asarray(rear)), **options)


def burgers(viscosity, reaction=0.0):
    """Burgers' equation with a viscosity and a rate of reaction."""
    return Burgers(jnp.log(jnp.asarray(viscosity)), reaction)


def windows(field, start, inputs, dt, count, seed):
    """Windows of a field from `start(rng, count)` (n, d) under `inputs(rng, (n, t))` (n, t, m)."""
    rng = np.random.default_rng(seed)
    x0 = jnp.asarray(start(rng, count), np.float32)
    u = jnp.asarray(inputs(rng, (count, STEPS)), np.float32)
    return hj.Trajectories(x0, u, jax.jit(hj.rollout_batch)(field, x0, u, dt), dt)


def _system(truth, changed, model, start, inputs, dt) -> System:
    drawn = zip((truth, truth, changed, changed), (60, 30, 20, 30), strict=True)
    made = [windows(field, start, inputs, dt, count, seed) for seed, (field, count) in enumerate(drawn)]
    return System(truth, changed, model, *made)


def _pendulum(wrap=lambda network: network, made=pendulum, most=(2.0, 4.0)) -> System:
    residual = hj.residual_network(2, 1, jax.random.key(1), hidden=16)
    return _system(
        truth=made(0.5, 0.8), changed=made(0.7, 0.8), model=hj.Hybrid(made(0.6), wrap(residual)),
        start=lambda rng, n: rng.uniform(-1, 1, (n, 2)) * most,
        inputs=lambda rng, shape: 3 * rng.normal(size=(*shape, 1)), dt=0.05,
    )  # fmt: skip


def _circle() -> System:
    """A pendulum that whirls, with angles that are given within half a turn."""
    system = _pendulum(made=whirling, most=(np.pi, 8.0))
    space, names = system.truth.state_space, ("train", "validation", "target", "test")
    wrapped = {name: wrap(space, getattr(system, name)) for name in names}
    assert all(np.abs(np.diff(one.x[..., 0])).max() > 6 for one in wrapped.values())  # it jumps
    return replace(system, **wrapped)


def wrap(space, data):
    """The windows with states as they are usually given."""
    usual = jnp.vectorize(space.normalise, signature="(d)->(d)")
    return replace(data, x0=usual(data.x0), x=usual(data.x))


def _car() -> System:
    """Anywhere within 100 m, at 10 to 25 m/s; inputs are held over a window but for a tenth of them."""
    low, high = [-100, -100, -np.pi, 10, -1, -0.4], [100, 100, np.pi, 25, 1, 0.4]

    def inputs(rng, shape):
        return [0.12, 3.0] * (rng.uniform(-1, 1, (shape[0], 1, 2)) + 0.1 * rng.normal(size=(*shape, 2)))

    return _system(
        truth=car(grip=0.9, drag=1e-3), changed=car(0.7, 0.8, grip=0.9, drag=1e-3),
        model=hj.Hybrid(car(1.3, 0.8), hj.residual_network(6, 2, jax.random.key(1), hidden=16)),
        start=lambda rng, n: rng.uniform(low, high, (n, 6)), inputs=inputs, dt=0.05,
    )  # fmt: skip


def _multirotor() -> System:
    def real(shift, learn=("Ix", "Iy", "k_rotors", "drag", "centre_of_mass"), drag=0.3):
        return jax.tree.map(lambda leaf: leaf + shift, rigid_body(hj.IRIS, learn, Terms(drag=(drag, drag, 0.1))))

    def start(rng, n):
        q = np.array([1.0, 0, 0, 0]) + 0.2 * rng.normal(size=(n, 4))
        q /= np.linalg.norm(q, axis=-1, keepdims=True)
        position, velocity, rates = (scale * rng.normal(size=(n, 3)) for scale in (1, 2, 1))
        return np.concatenate([position, q, velocity, rates], axis=-1)

    def inputs(rng, shape):
        shakes = 0.1 * rng.normal(size=(shape[0], 1, 4)) + 0.02 * rng.normal(size=(*shape, 4))
        return hj.IRIS.hover_speed * (1 + shakes)

    model = hj.Hybrid(real(0.0, drag=0.0), hj.residual_network(13, 4, jax.random.key(1), hidden=16))
    return _system(real(0.05), real(0.15), model, start, inputs, 0.01)


def _convolution() -> System:
    first, second = jax.random.split(jax.random.key(1))
    options = {"kernel_size": 5, "padding": "SAME", "padding_mode": "CIRCULAR"}
    residual = Convolution(eqx.nn.Conv1d(1, 3, **options, key=first), eqx.nn.Conv1d(3, 1, **options, key=second))

    def start(rng, n):
        wave = 2 * np.pi * (np.arange(1, 4)[:, None] * np.arange(GRID) / GRID)
        return (0.5 * rng.normal(size=(n, 1, 3)) @ np.sin(wave) + 0.5 * rng.normal(size=(n, 1, 3)) @ np.cos(wave))[:, 0]

    return _system(
        truth=burgers(0.01, 1.0), changed=burgers(0.015, 1.0), model=hj.Hybrid(burgers(0.02), residual), start=start,
        inputs=lambda rng, shape: rng.normal(size=(*shape, 1)), dt=0.01,
    )  # fmt: skip


MAKERS = {"pendulum": _pendulum, "circle": _circle, "car": _car, "multirotor": _multirotor}
MAKERS |= {"wrapper": lambda: _pendulum(lambda network: Gain(jnp.zeros(()), network)), "ring_convolution": _convolution}
SYSTEMS: dict[str, Callable[[], System]] = {name: cache(make) for name, make in MAKERS.items()}


def flying(count=6, seed=0):
    """States and inputs of a multirotor, one in a row: within some metres, at any attitude."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(count, 13))
    x[:, QUATERNION] /= np.linalg.norm(x[:, QUATERNION], axis=1, keepdims=True)
    return x, rng.uniform(400, 900, (count, 4))


def columns(count=6, seed=0):
    """The same as a minibatch, one in a column."""
    return [jnp.asarray(part.T) for part in flying(count, seed)]


@eqx.filter_jit
def one_by_one(field, x, u):
    return jax.vmap(field, -1, -1)(x, u)


@eqx.filter_jit
def train_batch(field, x, u):
    """A field on a minibatch as one program, for tests that compare ways to evaluate it."""
    return as_field(field).train_batch(x, u)


@eqx.filter_jit
def infer_batch(field, x, u):
    return as_field(field).infer_batch(x, u)
