"""The closed loop of a plant and a controller with its prediction model and estimator, and its tracking performance."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from hybrid_jax import checks
from hybrid_jax.control.controller import Controller, Plan, checked_states
from hybrid_jax.control.cost import Scalar, plan_cost
from hybrid_jax.control.observer import observer_of
from hybrid_jax.control.sensitivities import advance, lagged_speeds
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.dynamics.batching import like
from hybrid_jax.dynamics.rigid_body import RIGID_BODY_SPACE
from hybrid_jax.rotation import heading
from hybrid_jax.runtime import entry
from hybrid_jax.vehicle import POSITION, QUATERNION, Input, State

Plant = Callable[[State, Input, Scalar], State]  # the state one period after time t [s], u held

SATURATION_MARGIN = 0.01  # share of its range from a limit, within which a rotor speed counts as saturated
FAR = 10.0  # m from the reference, beyond which a flight counts as crashed


class Flight(eqx.Module):
    """A closed-loop flight of t periods.

    Attributes:
        x: true states (t + 1, 13), the initial one first.
        u: rotor speed commands in each period (t, 4) [rad/s].
        plans: plan of the controller at each call.
        estimates: state of the estimator at each call.
        speeds: rotor speeds at the start of each period (t, 4) [rad/s].
    """

    x: Float[Array, "*n t+1 13"]
    u: Float[Array, "*n t 4"]
    plans: Plan
    estimates: Any
    speeds: Float[Array, "*n t 4"]


@dataclass(frozen=True)
class Hardware:
    """Latency, rotor lag and noise between controller and vehicle.

    A sample at time t sets the command from t + latency on, and the rotors follow with a lag. The plant's input is
    their mean speed over each period. Sensors add white noise to each entry of the state. You get a ValueError for a
    negative or infinite number.

    Attributes:
        latency: time from a sample to its command [s], a multiple of the controller's period.
        rotor_lag: time constant of the rotors [s].
        noise: noise standard deviations of position [m], quaternion, velocity [m/s] and body rates [rad/s].
    """

    latency: float = 0.0
    rotor_lag: float = 0.0
    noise: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)

    def __post_init__(self):
        checks.not_negative("latency", self.latency)
        checks.not_negative("rotor_lag", self.rotor_lag)
        if not isinstance(self.noise, tuple) or len(self.noise) != 4:
            raise ValueError(f"noise must be four standard deviations, got {checks.short_repr(self.noise)}")
        for size in self.noise:
            checks.not_negative("noise", size)

    def delay(self, period: float) -> int:
        """Return the latency in periods.

        Args:
            period: period of the controller [s].
        """
        periods = round(self.latency / period)
        if abs(periods * period - self.latency) > 1e-6 * period:
            raise ValueError(f"latency must be a multiple of the period {period}, got {self.latency}")
        return periods

    def measure(self, x: State, key: PRNGKeyArray) -> State:
        """Add sensor noise to the state."""
        if not any(self.noise):
            return x
        noise = jnp.asarray(self.sizes(), x.dtype) * jax.random.normal(key, x.shape, x.dtype)
        return RIGID_BODY_SPACE.normalise(x + noise)

    def sizes(self) -> Float[np.ndarray, "13"]:
        """Return the standard deviation of each entry of the state."""
        return np.repeat(self.noise, [3, 4, 3, 3])


class Performance(eqx.Module):
    """Tracking performance of a flight.

    Attributes:
        position_rmse: RMS position error [m].
        yaw_rmse: RMS yaw error [rad].
        largest_error: largest position error [m].
        crashed: whether it went below the ground, too far from the reference, or not finite.
        saturation: fraction of the rotor speeds that are at a limit.
    """

    position_rmse: Scalar
    yaw_rmse: Scalar
    largest_error: Scalar
    crashed: Bool[Array, ""]
    saturation: Scalar


class LoopState(eqx.Module):
    """The state of a closed loop between two periods."""

    x: State  # true
    seen: State  # by the sensors
    speeds: Input  # of the rotors [rad/s]
    sent: Float[Array, "l 4"]  # commands on their way, the oldest first
    plan: Plan
    estimate: Any
    key: PRNGKeyArray


class Loop(NamedTuple):
    """A closed loop that you can stop and continue. `fly` uses it.

    Attributes:
        controller: plans at each period.
        hardware: latency, rotor lag and noise.
        estimator: an `AbstractEstimator`, or one with its methods.
    """

    controller: Controller
    hardware: Hardware
    estimator: Any

    def begin(self, x0: State, plan: Plan, key: PRNGKeyArray) -> LoopState:
        """Return the loop's state at the start of a flight: x0, with the rotors at the speeds of the plan.

        Args:
            x0: true state (13,).
            plan: initial plan, which sets the rotor speeds.
        """
        key, now = jax.random.split(key)
        seen, speeds = self.hardware.measure(x0, now), self.controller.speeds(plan)[0].astype(x0.dtype)
        sent = jnp.tile(speeds, (self.hardware.delay(self.controller.period), 1))
        return LoopState(x0, seen, speeds, sent, plan, self.estimator.begin(seen), key)

    def tick(
        self, plant: Plant, reference: Float[Array, "n 13"], now: LoopState, i: Int[Array, ""]
    ) -> tuple[LoopState, Input]:
        """Simulate the i-th period; also return the command [rad/s].

        The controller plans from the predicted state at the arrival of the command.

        Args:
            plant: the true vehicle, as in `fly`.
            reference: a state for each period (n, 13).
            now: result of `begin` or the last `tick`.
            i: index of the period, from 0.
        """
        controller, estimator, period = self.controller, self.estimator, self.controller.period
        model, x, speeds = estimator.model(now.estimate), estimator.start(now.estimate, now.seen), now.speeds
        for command in now.sent:
            mean, speeds = lagged_speeds(speeds, command, self.hardware.rotor_lag, period)
            x = advance(model, x, estimator.effective(now.estimate, mean), period)
        wanted = controller.horizon(reference, i + len(now.sent))
        u, plan = controller(model, wanted, x, now.plan, estimator.effective(now.estimate, speeds))
        u = estimator.command(now.estimate, x, u)
        sent = jnp.concatenate([now.sent, u[None]])
        mean, speeds = lagged_speeds(now.speeds, sent[0], self.hardware.rotor_lag, period)
        x = plant(now.x, mean, i * period).astype(now.x.dtype)
        key, noise = jax.random.split(now.key)
        seen = self.hardware.measure(x, noise)
        return LoopState(x, seen, speeds, sent[1:], plan, estimator.update(now.estimate, seen, mean), key), u


@entry
def fly(
    plant: Plant,
    model: AbstractVectorField,
    reference: Float[Array, "n 13"],
    x0: State,
    controller: Controller,
    bandwidth: Scalar | float = 0.0,
    *,
    hardware: Hardware | None = None,
    estimator: Any = None,
    key: PRNGKeyArray | None = None,
) -> Flight:
    """Fly a plant along a reference for n − 1 − horizon periods.

    The function is pure: you can use it under `jit`, and under `vmap` over any argument. A crash does not stop a
    flight; divergence continues as infinity or NaN. `plans` and `estimates`, the largest parts of the result, cost
    nothing if your compiled function does not return them.

    Args:
        x0: true state at the start (13,).
        controller: plans at each period.
        plant: returns the state one period later.
        model: prediction model of the controller and of the observer. One from `fit_disturbance` observes its own
            errors; another with hidden states needs an estimator.
        reference: one state per period (see `references.sample`).
        bandwidth: bandwidth of the disturbance observer [rad/s]; 0 for none.
        hardware: latency, rotor lag and noise, by default none. The controller should have the same `rotor_lag`.
        estimator: replaces the observer and supplies the model; for example an `OnlineAdaptation`.
        key: random key, required for noise.

    Raises:
        ValueError: if shapes do not match, the reference is not longer than the horizon, or noise has no key. Unless
            traced, also if a number is not finite, a quaternion's norm is not 1, or the bandwidth is negative.
    """
    checks.not_negative("bandwidth", bandwidth)
    hardware = Hardware() if hardware is None else hardware
    if key is None and any(hardware.noise):
        raise ValueError("key must be a random key, because the hardware has noise")
    x0, reference, plan = checked_states("x0", x0, reference, controller.begin())
    periods = len(reference) - 1 - controller.steps * controller.stride
    if periods < 1:
        raise ValueError(f"reference must be longer than the horizon, got {len(reference)} samples")
    estimator = observer_of(model, bandwidth, controller.period) if estimator is None else estimator
    loop = Loop(controller, hardware, estimator)

    def tick(now, i):
        after, u = loop.tick(plant, reference, now, i)
        return after, (after.x, u, after.plan, now.estimate, now.speeds)

    start = like(loop.begin(x0, plan, jax.random.key(0) if key is None else key), x0)
    x, u, plans, estimates, speeds = jax.lax.scan(tick, start, jnp.arange(periods))[1]
    return Flight(jnp.concatenate([x0[None], x]), u, plans, estimates, speeds)


def performance(flight: Flight, reference: Float[Array, "n 13"], controller: Controller) -> Performance:
    """Compute the tracking performance after the initial state.

    Args:
        flight: a flight from `fly`.
        reference: a state for each period (n, 13).
        controller: the flight's controller, for the limits of the rotor speeds.
    """
    x, wanted = flight.x[1:], reference[1 : len(flight.x)]
    error = jnp.linalg.norm(x[:, POSITION] - wanted[:, POSITION], axis=-1)
    yaw_error = heading(x[:, QUATERNION]) - heading(wanted[:, QUATERNION])
    yaw_error = jnp.arctan2(jnp.sin(yaw_error), jnp.cos(yaw_error))
    sound = jnp.isfinite(x).all(axis=-1) & (x[:, POSITION.stop - 1] >= 0) & (error <= FAR)
    low, high = controller.min_speed, controller.vehicle.max_rotor_speed
    margin = SATURATION_MARGIN * (high - low)
    at_limit = (flight.u < low + margin) | (flight.u > high - margin)
    rmse, yaw_rmse = (jnp.sqrt(jnp.mean(jnp.square(each))) for each in (error, yaw_error))
    return Performance(rmse, yaw_rmse, error.max(), ~sound.all(), at_limit.mean())


def open_loop_costs(
    plant: Plant,
    flight: Flight,
    reference: Float[Array, "n 13"],
    controller: Controller,
    calls: Sequence[int],
    hardware: Hardware | None = None,
) -> tuple[Float[Array, " c"], Float[Array, " c"]]:
    """Return the predicted costs of some plans, and their costs if the plant executes them to their end.

    Plans that are executed to their end reveal the model's full error. A plan begins when its command arrives, so the
    flight must continue after a call for at least the latency.

    Args:
        plant: the true vehicle, as in `fly`.
        flight: a flight from `fly`.
        reference: a state for each period (n, 13).
        controller: the flight's controller.
        calls: indices of the controller's calls, from 0.
        hardware: the flight's hardware, by default none.
    """
    hardware = Hardware() if hardware is None else hardware
    stride, delay = controller.stride, hardware.delay(controller.period)

    def period(now, inputs):
        (x, speeds), (command, t) = now, inputs
        mean, speeds = lagged_speeds(speeds, command, hardware.rotor_lag, controller.period)
        x = plant(x, mean, t)
        return (x, speeds), x

    def actual_cost(i: Scalar) -> Scalar:
        plan, i = jax.tree.map(lambda leaf: leaf[i], flight.plans), i + delay
        commands = jnp.repeat(controller.speeds(plan), stride, axis=0)
        times = controller.period * (i + jnp.arange(len(commands)))
        states = jax.lax.scan(period, (flight.x[i], flight.speeds[i]), (commands, times))[1][stride - 1 :: stride]
        return plan_cost(controller.weights, controller.horizon(reference, i), states, jnp.tanh(plan.variables))

    chosen = jnp.asarray(calls)
    return flight.plans.cost[chosen], jax.vmap(actual_cost)(chosen)
