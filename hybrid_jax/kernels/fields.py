"""Rollouts of the paper's models by kernels: all intervals in one call, and its derivative.

A model is a rigid body, a network with one hidden layer and ReLU, or their sum, in single precision, by RK4.
"""

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hybrid_jax.dynamics.base import AbstractVectorField, as_field
from hybrid_jax.dynamics.composition import Hybrid
from hybrid_jax.dynamics.equations import derivative
from hybrid_jax.dynamics.rigid_body import LEARNED, RigidBody
from hybrid_jax.dynamics.terms import Terms
from hybrid_jax.integrate import RK4, Solver, integrate
from hybrid_jax.kernels import library
from hybrid_jax.networks.activations import ACTIVATIONS
from hybrid_jax.networks.mlp import ResidualNetwork
from hybrid_jax.networks.normalisation import BatchNorm, Bias, ChannelScaling, InputScaling
from hybrid_jax.networks.normalised_layer import normalised_layer
from hybrid_jax.state import STATE_SIZE
from hybrid_jax.vehicle import Vehicle

RELU = ACTIVATIONS["relu"]
Shaped = Array | np.ndarray | jax.ShapeDtypeStruct
VECTOR = 16  # numbers in a vector, at most: of windows the kernels take at least so many
UNITS = 2 * VECTOR  # hidden units that a kernel works on at once, at most: their number is a multiple of it


class Constants(NamedTuple):
    """What a kernel is compiled for besides shapes."""

    dt: float
    vehicle: Vehicle | None  # of the rigid body, if there is one
    epsilon: float  # of batch normalisation

    def numbers(self) -> list[float]:
        """dt, ε, and the vehicle as rigid_body.h has it."""
        numbers = [self.dt, self.epsilon]
        if (vehicle := self.vehicle) is not None:
            rotors = [(*position, spin) for position, spin in zip(vehicle.rotor_positions, vehicle.spin, strict=True)]
            body = vehicle.mass, vehicle.gravity, vehicle.inertia[2], vehicle.torque_coefficient
            numbers += [*body, *np.ravel(rotors)]
        return numbers

    def physics(self, theta: Float[Array, " 3"], x, u) -> Float[Array, "d b"] | float:
        """ẋ of the rigid body."""
        if self.vehicle is None:
            return 0.0
        known = {name: (value,) for name, value in zip(LEARNED, theta, strict=True)}
        return derivative(self.vehicle, Terms(), known, tuple(x), tuple(u))


class KernelField(NamedTuple):
    """A field for which there are kernels."""

    physics: RigidBody | None
    network: ResidualNetwork | None

    def serves(self, x0: Shaped, u: Shaped, windows_axis: int) -> bool:
        """Whether the kernels are for these arrays, of which they check no shapes themselves."""
        if (x0.ndim, u.ndim) != (2, 3) or x0.shape[windows_axis] != u.shape[windows_axis]:
            return False
        arrays = jax.tree.leaves((eqx.filter((self.physics, self.network), eqx.is_array), x0, u))
        single = all(array.dtype == jnp.float32 for array in arrays)
        fits = self._fits(x0.shape[1 + windows_axis], u.shape[2 + windows_axis])
        return single and fits and x0.shape[windows_axis] >= VECTOR and library.is_available()

    def _fits(self, d: int, inputs: int) -> bool:
        """Whether states of d numbers and so many inputs are those of physics and network."""
        if (network := self.network) is not None:
            h = len(network.weight_in)
            shapes = network.weight_in.shape, network.weight_out.shape, network.bias_out.shape
            of_norm = [array.shape for array in jax.tree.leaves(network.norm)]
            if shapes != ((h, d + inputs), (d, h), (d,)) or set(of_norm) != {(h,)} or h % UNITS:
                return False
        if self.physics is None:
            return True
        scalars = all(jnp.ndim(ratio) == 0 for ratio in self.physics.deviations.values())
        return scalars and (d, inputs) == (STATE_SIZE, self.physics.vehicle.rotors)

    def rollout(self, x0: Float[Array, "d b"], u: Float[Array, "t m b"], dt: float) -> Float[Array, "t d b"]:
        """In training mode, in which batch normalisation takes the scaling's offset away."""
        d, m, network = len(x0), len(x0) + u.shape[1], self.network
        layers, epsilon = [jnp.zeros(shape, jnp.float32) for shape in ((0, m), 0, 0, (d, 0), d)], 0.0
        if network is not None:
            assert isinstance(network.norm, BatchNorm)
            weight_in, epsilon = network.weight_in * _input_scaling(network, d)[1], network.norm.epsilon
            layers = [weight_in, network.norm.gain, network.norm.shift, *self._output_layer(network, x0)]
        return _rollout(self._constants(dt, epsilon), self._theta(), *layers, x0, u)

    def predict(self, x0: Float[Array, "n d"], u: Float[Array, "n t m"], dt: float) -> Float[Array, "n t d"]:
        """In inference mode."""
        d, m, network = x0.shape[1], x0.shape[1] + u.shape[2], self.network
        layers = [jnp.zeros(shape, jnp.float32) for shape in (m, m, (0, m), 0, (d, 0), d)]
        if network is not None:
            assert isinstance(network.norm, BatchNorm | Bias)
            hidden, output = network.norm.fold(network.weight_in), self._output_layer(network, x0.T)
            layers = [*_input_scaling(network, d), *hidden, *output]
        return _predict(self._constants(dt), self._theta(), *layers, x0, u)

    def _constants(self, dt: float, epsilon: float = 0.0) -> Constants:
        return Constants(float(dt), self.physics.vehicle if self.physics else None, epsilon)

    def _theta(self) -> Float[Array, " 3"]:
        known = self.physics.theta() if self.physics else dict.fromkeys(LEARNED, jnp.zeros((), jnp.float32))
        return jnp.stack([known[name] for name in LEARNED])

    def _output_layer(self, network: ResidualNetwork, x: Float[Array, "d b"]) -> list[Array]:
        """W₂ and b₂ with what scaling and physics do to the network's output, which are factors of its rows."""
        layer = [network.scaling.outputs(part) for part in (network.weight_out, network.bias_out)]
        return layer if self.physics is None else [as_field(self.physics).apply_residual(x, part) for part in layer]


def _input_scaling(network: ResidualNetwork, d: int) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
    """z = ([x, u] − offset) factor."""
    sizes = d, network.weight_in.shape[1] - d
    zeros, ones = (tuple(jnp.full(size, value, jnp.float32) for size in sizes) for value in (0, 1))
    at_zero, factor = jax.jvp(network.scaling.concatenate, zeros, ones)
    return -at_zero / factor, factor


def serves_training(field: AbstractVectorField, x0: Shaped, u: Shaped, solver: Solver, windows_axis: int) -> bool:
    """Whether `trained` serves a minibatch of these shapes, whose windows lie along an axis."""
    return _training_kernel(field, x0, u, solver, 1, windows_axis) is not None


def trained(
    field: AbstractVectorField, x0: Float[Array, "d b"], u: Float[Array, "t m b"], dt: float, solver: Solver, substeps=1
) -> Float[Array, "t d b"] | None:
    """The trajectories of a minibatch in training mode, or None if no kernel is for them."""
    own = _training_kernel(field, x0, u, solver, substeps, -1)
    return own and own.rollout(x0, u, dt)


def predicted(
    field: AbstractVectorField, x0: Array | np.ndarray, u: Array | np.ndarray, dt: float, solver: Solver
) -> Float[Array, "n t d"] | None:
    """The trajectories of windows x0 (n, d), u (n, t, m) in inference mode, or None if no kernel is for them."""
    own = _kernel_field(field, solver, 1)
    if own and (own.network is None or type(own.network.norm) in (BatchNorm, Bias)) and own.serves(x0, u, 0):
        return own.predict(jnp.asarray(x0), jnp.asarray(u), dt)
    return None


def _training_kernel(field, x0: Shaped, u: Shaped, solver: Solver, substeps: int, axis: int) -> KernelField | None:
    own = _kernel_field(field, solver, substeps)
    fits = own and (own.network is None or type(own.network.norm) is BatchNorm) and own.serves(x0, u, axis)
    return own if fits else None


def _kernel_field(field: AbstractVectorField, solver: Solver, substeps: int) -> KernelField | None:
    alone = (field, None) if isinstance(field, RigidBody) else (None, field)
    physics, network = (field.physics, field.residual) if type(field) is Hybrid else alone
    if type(solver) is not RK4 or (solver.substeps, substeps) != (1, 1):
        return None
    if physics is not None and not (type(physics) is RigidBody and _is_plain(physics)):
        return None
    if network is not None:
        if type(network) is not ResidualNetwork or network.activation != "relu":
            return None
        if type(network.scaling) not in (InputScaling, ChannelScaling):
            return None
    return KernelField(physics, network)  # pyright: ignore[reportArgumentType]


def _is_plain(body: RigidBody) -> bool:
    return set(body.deviations) == set(LEARNED) and body.terms == Terms()


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _rollout(constants: Constants, *arrays: Array) -> Float[Array, "t d b"]:
    """`_plain_rollout`, each way in one call."""
    return _forward(constants, *arrays)[0]


def _plain_rollout(constants: Constants, theta, weight_in, gain, shift, weight_out, bias_out, x0, u):
    layers = weight_in, gain, shift, weight_out, bias_out

    def field(x, u):
        y: Array = normalised_layer(constants.epsilon, RELU, *layers, jnp.concatenate([x, u]))  # pyright: ignore[reportAssignmentType]
        return constants.physics(theta, x, u) + y

    return integrate(field, x0, u, constants.dt, RK4())


def _forward(constants: Constants, *arrays: Array):
    (h, m), x0, u = arrays[1].shape, *arrays[-2:]
    kept = len(u) * 4 * (x0.size + (m * x0.shape[1] + h if h else 0))  # of every stage, see rollout.cc
    results = [jax.ShapeDtypeStruct(shape, x0.dtype) for shape in ((len(u), *x0.shape), (kept,))]

    def kernel(*arrays):
        return library.call("rollout_forward", results, *arrays, numbers=constants.numbers())

    def plain(*arrays):
        return [_plain_rollout(constants, *arrays), jnp.zeros(kept, x0.dtype)]

    states, saved = library.with_derivative(kernel, plain)(*arrays)
    return states, (*arrays, saved)


def _backward(constants: Constants, saved: tuple[Array, ...], d_states: Float[Array, "t d b"]):
    results = [jax.ShapeDtypeStruct(array.shape, array.dtype) for array in saved[:-1]]

    def kernel(*arrays):
        return tuple(library.call("rollout_backward", results, *arrays, numbers=constants.numbers()))

    def plain(*arrays):
        *arrays, _, d_states = arrays
        return jax.vjp(partial(_plain_rollout, constants), *arrays)[1](d_states)

    return library.with_derivative(kernel, plain)(*saved, d_states)


_rollout.defvjp(_forward, _backward)


def _predict(constants: Constants, *arrays: Array) -> Float[Array, "n t d"]:
    x0, u = arrays[-2:]
    states = jax.ShapeDtypeStruct((*u.shape[:2], x0.shape[1]), x0.dtype)

    def kernel(*arrays):
        return library.call("prediction", states, *arrays, numbers=constants.numbers())

    return library.with_derivative(kernel, partial(_plain_prediction, constants))(*arrays)


def _plain_prediction(constants: Constants, theta, offset, factor, weight_in, bias_in, weight_out, bias_out, x0, u):
    def field(x, u):
        z = (jnp.concatenate([x, u]) - offset[:, None]) * factor[:, None]
        hidden = RELU(weight_in @ z + bias_in[:, None])
        return constants.physics(theta, x, u) + weight_out @ hidden + bias_out[:, None]

    states = integrate(field, jnp.moveaxis(x0, 0, -1), jnp.moveaxis(u, 0, -1), constants.dt, RK4())
    return jnp.moveaxis(states, -1, 0)
