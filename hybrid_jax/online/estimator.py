"""Adapt while it runs: extended Kalman filters of state, θ_p and a constant disturbance, one sample at a time.

The state of the filter is z = [x, θ]: the state x of the system, which the one-step predictions need without noise,
and θ, all parameters of the physics and the disturbance.

- A test of the innovations finds a change (`change_test`). An alarm opens the covariance.
- Forgetting: θ is a slow random walk, and the disturbance, such as a gust, walks faster while it is pulled. Parameters
  of a vehicle are constant between two changes; they do so only where no disturbance is estimated, or beside
  hypotheses, as the filter of all parameters then matters where the model is wrong in a way that none explains.
- Hypotheses: with these, filters of a few parameters compete with that of all (`multiple_model`).
- Excitation: what samples do not tell stays as it is, with its variance (`excitation`).
- Consistency: what the filter says is not used while it cannot be true (`consistency`), and the last good estimate is.
"""

from collections.abc import Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hybrid_jax import checks
from hybrid_jax.dynamics.base import AbstractVectorField, state_space
from hybrid_jax.dynamics.disturbance import disturbance_of, physics_of, with_disturbance
from hybrid_jax.dynamics.estimator import AbstractEstimator
from hybrid_jax.estimation.least_squares import ravel_parameters
from hybrid_jax.estimation.uncertainty import Interval, intervals
from hybrid_jax.integrate import check_callable
from hybrid_jax.online import change_test, consistency, excitation, kalman, multiple_model
from hybrid_jax.online.change_test import ChangeTest
from hybrid_jax.online.excitation import Filtered
from hybrid_jax.online.hypotheses import Hypothesis, ModelSet, Subspace, model_set, subspace_of
from hybrid_jax.online.kalman import Belief, Each, FilterModel
from hybrid_jax.online.multiple_model import Verdict
from hybrid_jax.online.samples import HUGE, Sample, SampleHistory, classify
from hybrid_jax.online.state import DISTURBANCE, Flags, Numbers, OnlineState, check_sizes, flags_of, named_priors
from hybrid_jax.online.tuning import Tuning
from hybrid_jax.runtime import entry
from hybrid_jax.state_space import StateSpace

FASTEST = 3.0  # share of its prior standard deviation that a parameter may walk in a second
Judged = tuple[ChangeTest, Bool[Array, ""], Verdict]


class OnlineAdaptation(AbstractEstimator):
    """Recursive estimator of the parameters of any field, and of a constant disturbance, with their covariance.

        filter = hj.OnlineAdaptation(field, dt=0.01, noise=0.02, disturbance=1.0)
        state = filter.begin(x)
        state = filter.update(state, x, u)  # at each sample; then filter.model(state), filter.intervals(state)

    Pure: its methods compile and map over stacked states. They refuse samples of another shape; numbers that are bad
    raise nothing, see `flags`.

    Attributes:
        field: its physics is adapted from the values that it has; a network beside it stays as it is.
        dt: time between two samples [s].
        noise: standard deviation of what is measured of each state.
        prior: standard deviation of each parameter before and after a change, in the physics' own parametrisation (for
            a rigid body: logarithms), one number for all or by name: of one entry, efficiency[0], or of all of an
            array, efficiency. Zero holds a parameter.
        disturbance: standard deviation of the constant part of ẋ at each disturbed state; 0 for none.
        indices: of the disturbed states; by default those that the field has, or that its state space says.
        process: standard deviation of what the model leaves out of ẋ, as white noise, of each state [1/√s].
        initial: share of the prior that is uncertain at the start, before a change.
        hypotheses: of which one may hold at a time, each on a change of a few parameters, found by how well it
            explains the samples. With hypotheses the model stays the field's own until a change is found.
        tuning: how fast it forgets, and what it calls a change.
        names: of the parameters, in the order of θ.
        scales: the prior standard deviation of each, in that order.

    Raises:
        ValueError: a number out of range, an unknown name, or physics without parameters.
    """

    field: AbstractVectorField
    dt: float = eqx.field(static=True)
    noise: tuple[float, ...] = eqx.field(static=True)
    process: tuple[float, ...] = eqx.field(static=True)
    names: tuple[str, ...] = eqx.field(static=True)
    scales: tuple[float, ...] = eqx.field(static=True)
    initial: float = eqx.field(static=True)
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
        initial: float = 1.0,
        hypotheses: tuple[Hypothesis, ...] = (),
        tuning: Tuning | None = None,
    ):
        checks.positive("dt", dt, "a positive number of seconds")
        for name, numbers, check in (("noise", noise, checks.positive), ("process", process, checks.not_negative)):
            for number in np.ravel(numbers):
                check(name, number)
        if not 0 < (checks.real(initial) or 0) <= 1:
            raise ValueError(f"initial must be a share above 0 and at most 1, got {checks.short_repr(initial)}")
        check_callable(field)
        self.tuning = Tuning() if tuning is None else tuning
        checks.instance("tuning", self.tuning, Tuning)
        indices = None if indices is None else checks.places("indices", indices)
        if np.any(disturbance):
            known = disturbance_of(field) is not None or state_space(physics_of(field)).disturbed is not None
            if indices is None and not known:
                raise ValueError("indices must say which states are disturbed, as the field's state space does not")
            field = with_disturbance(field, indices)
        self.field, self.dt, self.initial = field, float(dt), float(initial)
        self.noise, self.process = (tuple(np.ravel(numbers).tolist()) for numbers in (noise, process))
        self.names, self.scales = named_priors(field, prior, disturbance)
        given = checks.list_of("hypotheses", hypotheses, Hypothesis)
        self.hypotheses = tuple(subspace_of(hypothesis, self.names, self.scales) for hypothesis in given)

    @entry
    def begin(self, x: Float[Array, " d"]) -> OnlineState:
        """Before the first sample x, at the field's own parameters."""
        x, indices = jnp.asarray(x, float), getattr(disturbance_of(self.field), "indices", None)
        check_sizes(x, {"noise": self.noise, "process": self.process}, indices)
        p, none = ravel_parameters(self.field)[0].size, jnp.zeros_like(x)
        zero, theta, start = jnp.zeros((), x.dtype), jnp.zeros(p, x.dtype), jnp.full(p, self.initial**2, x.dtype)
        variances, mixture = self._variances(x), None
        if self.hypotheses:
            mixture = multiple_model.initial(self._models(), x, variances, self.tuning.floor)
        return OnlineState(
            x=x,
            theta=theta,
            root=kalman.diagonal_root(variances, start),
            excitation=excitation.begun(len(x), p, x.dtype),
            test=change_test.started(p, x.dtype),
            mixture=mixture,
            trusted=theta,
            settled=theta,
            doubt=zero,
            nis=zero + 1,
            history=SampleHistory(x, none, zero, none),
            changes=zero,
            restarts=zero,
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
        """After one period.

        Args:
            x: the new sample; NaN where nothing was measured.
            u: the mean input over the period, as it acted: delayed and lagged, not as it was commanded.
            elapsed: periods since the last update. Over more than one nothing is learned of the input, and the state is
                taken from the sample.
            each: turns a function of the filter of one hypothesis into one of arrays of all.
        """
        checks.not_negative("elapsed", elapsed)
        x, u = jnp.asarray(x, state.x.dtype), jnp.asarray(u, state.x.dtype)
        if x.shape != state.x.shape:
            raise ValueError(f"x must be one sample {state.x.shape}, as the state is, got shape {x.shape}")
        x = self._space(x).nearest(x, state.x)
        sample, history = classify(x, u, elapsed, state.history, self.dt, self.tuning.gap)
        model = self._filter_model(sample, each)
        filtered = self._filtered(state, model, sample)
        judged = self._judged(state, model, sample, filtered)
        begun = self.begin(jnp.where(jnp.abs(history.last) < HUGE, history.last, 0.0))
        begun = consistency.again(begun, state, model.variances)
        return consistency.sound(self._merged(state, filtered, judged, sample, history), begun)

    @entry
    def estimate(self, state: OnlineState) -> tuple[Float[Array, " p"], Float[Array, "p p"]]:
        """The last good θ as a change of the field's own, and its covariance, in the physics' own parametrisation.

        Args:
            state: of the filter, as `begin` and `update` return it.
        """
        scales, d = jnp.asarray(self.scales, state.x.dtype), len(state.x)
        covariance = state.covariance[d:, d:]
        if state.mixture is not None:
            joint, tuning = state.joint, self.tuning
            covariance = multiple_model.covariance(state.mixture, self._models(), joint, tuning.least)
        return scales * state.trusted, scales[:, None] * covariance * scales

    @entry
    def model(self, state: OnlineState) -> AbstractVectorField:
        """The field at the last good estimate, with its disturbance."""
        theta, unravel = ravel_parameters(self.field)
        return unravel((theta + jnp.asarray(self.scales, theta.dtype) * state.trusted).astype(theta.dtype))

    @entry
    def intervals(self, state: OnlineState, level: float = 0.95) -> dict[str, Interval]:
        """Parameters and disturbance with their intervals, in physical units; see `hybrid_jax.intervals`.

        Args:
            state: of the filter, as `begin` and `update` return it.
            level: probability that an interval holds the value, between 0 and 1.
        """
        return intervals(self.model(state), self.estimate(state)[1], level)

    @entry
    def flags(self, state: OnlineState) -> Flags:
        """What is wrong with samples, parameters and model, or was found.

        Args:
            state: of the filter, or states of several, stacked along leading axes.
        """
        return flags_of(state, self.tuning)

    def _variances(self, x) -> Float[Array, " d"]:
        return jnp.broadcast_to(jnp.square(jnp.asarray(self.noise, x.dtype)), x.shape)

    def _space(self, x) -> StateSpace:
        return state_space(self.field, len(x))

    def _rates(self, u):
        """ẋ as a function of x and θ."""
        start, unravel = ravel_parameters(self.field)

        def rates(x, theta):
            moved = start + jnp.asarray(self.scales, x.dtype) * theta
            return unravel(moved.astype(start.dtype))(x, u)

        return rates

    def _filter_model(self, sample: Sample, each: Each) -> FilterModel:
        x = sample.x
        added = self.dt * jnp.broadcast_to(jnp.square(jnp.asarray(self.process, x.dtype)), x.shape)
        rates, unit = self._rates(sample.u), self._space(x).normalise
        return FilterModel(rates, unit, self._variances(x), added, self.dt, self.tuning, each)

    def _predicted(self, state: OnlineState, model: FilterModel, sample: Sample) -> tuple[Belief, Array]:
        """The filter of all parameters before the sample, and the Jacobian of its x."""
        tuning, ones = self.tuning, jnp.ones_like(state.theta)
        pulled = jnp.max(state.test.squares, axis=0)
        varies = np.array([name.startswith(DISTURBANCE) for name in self.names])
        all_vary = bool(self.hypotheses) or not varies.any()
        forgotten = np.where(varies | all_vary, tuning.forgetting, 0.0)
        faster = 1 + jnp.asarray(forgotten, ones.dtype) * jnp.maximum(pulled - tuning.eager, 0.0)
        diffusion = self.dt * sample.elapsed * jnp.square(jnp.minimum(tuning.drift * faster, FASTEST))
        belief, slope = kalman.predict(state.joint, model, model.field, None, diffusion, sample.acted)
        belief = kalman.limit_covariance(belief, ones)
        return kalman.reset_state(belief, sample, sample.restart, model.variances), slope

    def _filtered(self, state: OnlineState, model: FilterModel, sample: Sample) -> Filtered:
        """The filter of all parameters after the sample, which moves what the samples tell."""
        predicted, slope = self._predicted(state, model, sample)
        belief, correction = kalman.correct(predicted, sample, model)
        told, gains = state.excitation, correction.gains[:, len(state.x) :]
        if self.tuning.excitation:
            told = excitation.after_sample(told, slope, correction, sample, self.dt, self.tuning)
            belief, gains = excitation.consider(predicted, belief, correction, told.considered())
        return Filtered(kalman.triangular(belief, len(state.x)), told, correction, gains)

    def _judged(self, state: OnlineState, model: FilterModel, sample: Sample, filtered: Filtered) -> Judged:
        """The test of the filter of all parameters, whether that filter opens to its prior, and what is believed."""
        (belief, _, correction, gains), tuning = filtered, self.tuning
        white = correction.white
        test, opens = change_test.after_sample(state.test, white, gains, sample, self.dt, tuning, tuning.pause)
        if state.mixture is None:
            return test, opens, Verdict(None, belief.z[len(state.x) :], jnp.square(white), opens, opens)
        verdict = multiple_model.update(state.mixture, self._models(), model, sample, belief, correction, gains)
        unexplained = verdict.unexplained & (test.quiet > tuning.hold)
        return change_test.reset(test, unexplained, 0.0), opens | unexplained, verdict

    def _merged(
        self, state: OnlineState, filtered: Filtered, judged: Judged, sample: Sample, history: SampleHistory
    ) -> OnlineState:
        """The next state: opened to the prior after a change, and believed if it is consistent."""
        (test, opens, verdict), d, variances = judged, len(state.x), self._variances(state.x)
        # The state, too, has followed the wrong model since the change.
        belief = kalman.reset_state(filtered.belief, sample, opens, variances)
        fresh = kalman.diagonal_root(variances, jnp.ones_like(state.theta))
        nis = consistency.mean_square(state.nis, verdict.squares, sample, self.dt / self.tuning.window)
        doubt = consistency.alarms(state.doubt, verdict, sample, self.dt, self.tuning)
        believed = jnp.where(nis < self.tuning.reject, verdict.theta, state.trusted)
        trusted = jnp.where(doubt < self.tuning.alarms, believed, state.settled)
        return OnlineState(
            x=belief.z[:d],
            theta=belief.z[d:],
            root=jnp.concatenate([belief.root[:d], jnp.where(opens, fresh, belief.root)[d:]]),
            excitation=filtered.excitation,
            test=test,
            mixture=verdict.mixture,
            trusted=trusted,
            settled=jnp.where(doubt < consistency.SETTLED, trusted, state.settled),
            doubt=doubt,
            nis=nis,
            history=history,
            changes=state.changes + jnp.where(verdict.changed, 1.0, 0.0),
            restarts=state.restarts,
        )

    def _models(self) -> ModelSet:
        return model_set(self.hypotheses, len(self.names), self.dt)
