"""Extended Kalman filters of state, θ_p and a constant disturbance that adapt while the system runs.

The filter state is z = [x, θ]: the state x of the system, because one-step predictions need it without noise, and θ,
all parameters of the physics and the disturbance.

- A test of the innovations detects a change (`change_test`); an alarm resets the variance of the changed parameters.
- θ follows a slow random walk; while innovations are biased, it is faster for the disturbance (without one, for all).
- Filters of a few parameters may compete with the filter of all (`multiple_model`).
- Directions of θ that are not excited keep their value and variance (`excitation`).
- An inconsistent estimate is replaced by the last good one (`consistency`).
"""

import math
from collections.abc import Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hybrid_jax import checks
from hybrid_jax.dynamics.base import AbstractEstimator, AbstractVectorField, state_space
from hybrid_jax.dynamics.disturbance import disturbance_of, physics_of, with_disturbance
from hybrid_jax.dynamics.rigid_body import vehicle_in
from hybrid_jax.estimation.least_squares import ravel_parameters
from hybrid_jax.estimation.uncertainty import Interval, intervals
from hybrid_jax.integrate import check_callable, check_field
from hybrid_jax.online import consistency, excitation, kalman, multiple_model
from hybrid_jax.online.change_test import EAGER, PART, ChangeTest
from hybrid_jax.online.excitation import Excitation
from hybrid_jax.online.hypotheses import Hypothesis, ModelSet, Subspace, model_set, subspace_of
from hybrid_jax.online.kalman import Belief, Correction, Each, Field, FilterModel
from hybrid_jax.online.multiple_model import Verdict
from hybrid_jax.online.rotor_order import RotorOrder
from hybrid_jax.online.samples import HUGE, Sample, SampleHistory, classify
from hybrid_jax.online.sensor_signs import SensorSigns
from hybrid_jax.online.state import DISTURBANCE, Flags, Numbers, OnlineState, flags_of, named_priors
from hybrid_jax.online.tuning import BREEZE, HOLD, MEMORY, PAUSE, TAKEN, Tuning
from hybrid_jax.runtime import entry

RISE, FALL = 10.0, 0.2  # rates of `OnlineState.log_walk` [1/s]


class OnlineAdaptation(AbstractEstimator):
    """Estimate the parameters of any field and a constant disturbance while the system runs, with their covariance.

        filter = hj.OnlineAdaptation(field, dt=0.01, noise=0.02, disturbance=1.0)
        update, state = eqx.filter_jit(filter.update), filter.begin(x)
        state = update(state, x, u)  # at each sample; then filter.model(state), filter.intervals(state)

    You should compile `update`, which makes it some hundred times as fast. You can use all methods under `jit`, and
    under `vmap` over stacked states. A sample of another shape raises ValueError; for invalid numbers see `flags`.

    Attributes:
        field: the model. Its physics is adapted from its present values, and its network does not change.
        dt: time between two samples [s].
        noise: standard deviation of the measurement of each state.
        prior: standard deviation of each parameter before and after a change, in the physics' own parametrisation (for
            example logarithms for a rigid body). It is one number for all, or a number by name: efficiency[0] is one
            entry, efficiency a whole array. Zero keeps a parameter constant.
        disturbance: standard deviation of the constant part of ẋ at each disturbed state; 0 for none.
        indices: indices of the disturbed states, by default the field's or its state space's.
        process: standard deviation of the white process noise of each state [1/√s].
        hypotheses: exclusive changes of a few parameters, weighted by likelihood; until a change the model is `field`.
        tuning: settings of forgetting and change detection.
        names: names of the parameters, in the order of θ.
        scales: the prior standard deviation of each parameter, in the same order.

    Raises:
        ValueError: if a number is out of range, a name is unknown, or the physics has no parameters.
    """

    field: AbstractVectorField
    dt: float = eqx.field(static=True)
    noise: tuple[float, ...] = eqx.field(static=True)
    process: tuple[float, ...] = eqx.field(static=True)
    names: tuple[str, ...] = eqx.field(static=True)
    scales: tuple[float, ...] = eqx.field(static=True)
    hypotheses: tuple[Subspace, ...] = eqx.field(static=True)
    tuning: Tuning = eqx.field(static=True)

    def __init__(
        self,
        field: AbstractVectorField,
        dt: float,
        noise: Numbers,
        prior: float | Mapping[str, float] = 0.3,
        disturbance: Numbers = 0.0,
        indices: tuple[int, ...] | None = None,
        process: Numbers = 0.0,
        hypotheses: tuple[Hypothesis, ...] = (),
        tuning: Tuning | None = None,
    ):
        checks.positive("dt", dt, "a positive number of seconds")
        for name, numbers, check in (("noise", noise, checks.positive), ("process", process, checks.not_negative)):
            for number in np.ravel(numbers).tolist():
                check(name, number)
        check_callable(field)
        tuning = Tuning() if tuning is None else tuning
        checks.instance("tuning", tuning, Tuning)
        self.tuning = tuning.at(dt)
        indices = None if indices is None else checks.places("indices", indices)
        if np.any(disturbance):
            known = disturbance_of(field) is not None or state_space(physics_of(field)).disturbed is not None
            if indices is None and not known:
                raise ValueError("indices must say which states are disturbed, as the field's state space does not")
            field = with_disturbance(field, indices)
        self.field, self.dt = field, float(dt)
        self.noise, self.process = (tuple(np.ravel(numbers).tolist()) for numbers in (noise, process))
        self.names, self.scales = named_priors(field, prior, disturbance)
        given = checks.list_of("hypotheses", hypotheses, Hypothesis, least=0)
        self.hypotheses = tuple(subspace_of(each, self.names, self.scales) for each in given)

    @entry
    def begin(self, x: Float[Array, " d"]) -> OnlineState:
        """Return the state before the first sample x, at the field's own parameters."""
        x, indices = jnp.asarray(x, float), getattr(disturbance_of(self.field), "indices", None)
        if x.ndim != 1:
            raise ValueError(f"x must be one sample (d,), got shape {x.shape}")
        for name, values in (("noise", self.noise), ("process", self.process)):
            if len(values) not in (1, len(x)):
                raise ValueError(f"{name} must be one number, or {len(x)}, one for each state, got {len(values)}")
        if indices is not None:
            checks.places("indices", indices, len(x))
        p, none, zero = ravel_parameters(self.field)[0].size, jnp.zeros_like(x), jnp.zeros((), x.dtype)
        theta, variances = jnp.zeros(p, x.dtype), self._variances(x)
        zeros = dict.fromkeys(("theta", "trusted", "settled", "reset", "log_walk"), theta)
        zeros |= dict.fromkeys(("alarms", "burst", "changes", "restarts"), zero)
        return OnlineState(
            x=x,
            root=kalman.diagonal_root(variances, theta + 1),
            excitation=Excitation.begin(len(x), p, x.dtype),
            test=ChangeTest.begin(p, x.dtype),
            mixture=multiple_model.initial(self._models(), x, variances) if self.hypotheses else None,
            nis=zero + 1,
            signs=SensorSigns.begin(state_space(self.field, len(x)), x),
            order=RotorOrder.begin(vehicle.rotors if (vehicle := vehicle_in(self.field)) else 0, len(x) + p, x.dtype),
            history=SampleHistory(x, none, zero, none),
            **zeros,
        )

    @entry
    def update(
        self,
        state: OnlineState,
        x: Float[Array, " d"],
        u: Float[Array, " m"],
        elapsed: Float[Array, ""] | float = 1.0,
        each: Each = jax.vmap,
    ) -> OnlineState:
        """Update the state after one period.

        Args:
            x: the new sample; NaN for a state that was not measured.
            u: the mean applied input over the period (after latency and rotor lag), not the command.
            elapsed: number of periods since the last update. After more than one, the state is reset to the sample.
            each: how to map a function over the filters of all hypotheses, for example `jax.vmap`.
        """
        checks.not_negative("elapsed", elapsed)
        x, u = jnp.asarray(x, state.x.dtype), jnp.asarray(u, state.x.dtype)
        if x.shape != state.x.shape:
            raise ValueError(f"x must be one sample of shape {state.x.shape}, like the state, got shape {x.shape}")
        check_field(self.field, x, u)
        x = state_space(self.field, len(x)).nearest(x, state.x)
        sample, history = classify(x, u, elapsed, state.history, self.dt, self.tuning.gap)
        model = self._filter_model(sample, each)
        d, variances, tuning, periods = len(x), model.variances, self.tuning, self.dt / self.tuning.pace
        belief, excited, slope, correction = self._filtered(state, model, sample)
        part = np.where(self._varies(), PART, EAGER)
        test, reset = state.test.after(correction, sample, periods, tuning, PAUSE, part)
        alarmed = jnp.max(reset) > 0
        verdict = Verdict(None, belief.z[d:], jnp.square(correction.white), alarmed, alarmed)
        if state.mixture is not None:
            verdict = multiple_model.update(state.mixture, self._models(), model, sample, belief, correction)
            unexplained = verdict.unexplained & (test.quiet > HOLD)
            test, alarmed = test.reset(unexplained, 0.0), alarmed | unexplained
            reset = jnp.where(unexplained, 1.0, reset)
        if (order := state.order) is not None:
            order = order.after(state.joint, self._rates, slope, belief, correction, sample, alarmed, model)
        signs = state.signs if state.signs is None else state.signs.after(slope, belief, sample, model)
        # After a change the state is reset too, since it has followed the wrong model.
        belief = kalman.reset_state(belief, sample, alarmed, variances)
        new = OnlineState(
            x=belief.z[:d],
            theta=belief.z[d:],
            root=belief.root,
            excitation=excited,
            test=test,
            mixture=verdict.mixture,
            reset=reset,
            log_walk=self._log_walk(state, sample, alarmed),
            order=order,
            signs=signs,
            history=history,
            changes=state.changes + jnp.where(verdict.changed, 1.0, 0.0),
            restarts=state.restarts,
            **consistency.update(state, verdict, (order, signs), sample, periods),
        )
        fresh = self.begin(jnp.where(jnp.abs(history.last) < HUGE, history.last, 0.0))
        return consistency.restarted(new, fresh, state, variances)

    @entry
    def estimate(self, state: OnlineState) -> tuple[Float[Array, " p"], Float[Array, "p p"]]:
        """Return the last good change of θ and its covariance, in the physics' own parametrisation.

        Args:
            state: the filter's state from `begin` or `update`.
        """
        scales, d = jnp.asarray(self.scales, state.x.dtype), len(state.x)
        covariance = state.covariance[d:, d:]
        if state.mixture is not None:
            covariance = multiple_model.covariance(state.mixture, self._models(), state.joint)
            covariance = covariance + state.excitation.bias(self.tuning)
        return scales * state.trusted, scales[:, None] * covariance * scales

    @entry
    def model(self, state: OnlineState) -> AbstractVectorField:
        """Return the field at the last good estimate, with its disturbance."""
        theta, unravel = ravel_parameters(self.field)
        return unravel((theta + jnp.asarray(self.scales, theta.dtype) * state.trusted).astype(theta.dtype))

    @entry
    def intervals(self, state: OnlineState, level: float = 0.95) -> dict[str, Interval]:
        """Return parameters and disturbance with their intervals in physical units; see `hybrid_jax.intervals`.

        Args:
            state: the filter's state from `begin` or `update`.
            level: probability that an interval contains the value, between 0 and 1.
        """
        return intervals(self.model(state), self.estimate(state)[1], level)

    @entry
    def flags(self, state: OnlineState) -> Flags:
        """Report problems with samples, parameters and model, and detected changes.

        Args:
            state: the filter's state, or several, stacked along leading axes.
        """
        return flags_of(state, self.tuning)

    def _variances(self, x) -> Float[Array, " d"]:
        return jnp.broadcast_to(jnp.square(jnp.asarray(self.noise, x.dtype)), x.shape)

    def _varies(self) -> np.ndarray:
        """Return whether each parameter is a disturbance."""
        return np.array([name.startswith(DISTURBANCE) for name in self.names])

    def _models(self) -> ModelSet:
        return model_set(self.hypotheses, len(self.names), self.dt)

    def _filter_model(self, sample: Sample, each: Each) -> FilterModel:
        x, unit = sample.x, state_space(self.field, len(sample.x)).normalise
        added = self.dt * jnp.broadcast_to(jnp.square(jnp.asarray(self.process, x.dtype)), x.shape)
        return FilterModel(self._rates(sample.u), unit, self._variances(x), added, self.dt, self.tuning, each)

    def _rates(self, u) -> Field:
        start, unravel = ravel_parameters(self.field)
        return lambda x, theta: unravel((start + jnp.asarray(self.scales, x.dtype) * theta).astype(start.dtype))(x, u)

    def _filtered(
        self, state: OnlineState, model: FilterModel, sample: Sample
    ) -> tuple[Belief, Excitation, Array, Correction]:
        """Update the filter of all parameters along excited directions; also return the Jacobian of the next x."""
        d, tuning, ones, excited = len(state.x), self.tuning, jnp.ones_like(state.theta), state.excitation
        walk, periods = tuning.drift * jnp.exp(state.log_walk), self.dt / tuning.pace
        diffusion = periods * sample.elapsed * jnp.square(walk)
        diffusion = diffusion + state.reset * jnp.maximum(1 - jnp.sum(jnp.square(state.root[d:]), axis=1), 0.0)
        varies, share = (jnp.asarray(np.where(self._varies(), *each), ones.dtype) for each in ((1, 0), (TAKEN, 1)))
        # The disturbance absorbs directions that are not estimated. Hypotheses compete by likelihood, so they need all
        # of the uncertainty.
        alone = tuning.excitation and self._varies().any() and not self.hypotheses
        part = excited.estimated(share) if alone else None
        belief, slope = kalman.predict(state.joint, model, model.field, None, diffusion, sample.acted, part)
        predicted = kalman.reset_state(kalman.limit_covariance(belief, ones), sample, sample.restart, model.variances)
        belief, correction = kalman.correct(predicted, sample, model)
        if tuning.excitation:
            # Each alarm after the first in 10 s counts as a step of a random walk by the prior, as in a beginning gust.
            steps = jnp.sqrt(jnp.maximum(state.alarms - 1, 0.0) / MEMORY)
            breeze = jnp.maximum(jnp.minimum(steps, tuning.drift * tuning.gusts), BREEZE)
            walk = jnp.maximum(walk, breeze * varies)
            excited = excitation.after_sample(excited, slope, correction, sample, walk, share, periods, tuning)
            belief, correction = excitation.consider(predicted, belief, correction, excited, share)
        return kalman.triangular(belief, d), excited, slope, correction

    def _log_walk(self, state: OnlineState, sample: Sample, alarmed: Bool[Array, ""]) -> Float[Array, " p"]:
        """Update the log-scale of the random walk: of disturbances or, without one, of all parameters unless reset."""
        varies, tuning = self._varies(), self.tuning
        pulled = state.test.pulled / EAGER - 1
        rise = jnp.where(pulled > 0, RISE * jnp.minimum(pulled, 4.0), -FALL)
        rise = self.dt / tuning.pace * jnp.where(sample.measured, rise, 0.0)
        walk = jnp.clip(state.log_walk + rise + jnp.where(alarmed & (pulled > 0), 1.0, 0.0), 0, math.log(tuning.gusts))
        return jnp.asarray(varies, walk.dtype) * walk if varies.any() else jnp.where(alarmed, 0.0, walk)
