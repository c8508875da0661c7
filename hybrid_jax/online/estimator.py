"""Adapt while it runs: extended Kalman filters of state, θ_p and a constant disturbance, one sample at a time.

The state of the filter is z = [x, θ]: the state x of the system, which the one-step predictions need without noise,
and θ, all parameters of the physics and the disturbance.

- A test of the innovations finds a change (`change_test`). An alarm opens the covariance.
- Forgetting: θ is a slow random walk, and the disturbance, such as a gust, walks faster while it is pulled. Parameters
  of a vehicle are constant between two changes; they do so only where no disturbance is estimated, or beside
  hypotheses, as the filter of all parameters then matters where the model is wrong in a way that none explains.
- Hypotheses: with these, filters of a few parameters compete with that of all (`multiple_model`).
- Consistency: while the mean of the normalised innovations squared (NIS) is far too large, what the filter says is not
  used (Bar-Shalom, Li, Kirubarajan, "Estimation with applications to tracking and navigation", 2001, ch. 5.4), and the
  last good estimate is.
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
from hybrid_jax.online import change_test, kalman, multiple_model
from hybrid_jax.online.change_test import ChangeTest
from hybrid_jax.online.hypotheses import Hypothesis, ModelSet, Subspace, model_set, subspace_of
from hybrid_jax.online.kalman import Belief, Correction, Each, FilterModel
from hybrid_jax.online.multiple_model import Verdict
from hybrid_jax.online.samples import HUGE, Sample, SampleHistory, classify
from hybrid_jax.online.state import DISTURBANCE, Flags, Numbers, OnlineState, check_sizes, named_priors
from hybrid_jax.online.tuning import Tuning
from hybrid_jax.state_space import StateSpace

FASTEST = 3.0  # share of its prior standard deviation that a parameter may walk in a second
Judged = tuple[ChangeTest, Bool[Array, ""], Verdict]
UNEXCITED = 0.5  # share of its variance without data, above which the data have said nothing on a parameter


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
            covariance=jnp.diag(jnp.concatenate([variances, start])),
            free=start,
            test=change_test.started(p, x.dtype),
            mixture=mixture,
            trusted=theta,
            nis=zero + 1,
            history=SampleHistory(x, none, zero, none),
            changes=zero,
            restarts=zero,
        )

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
        belief, free = self._predicted(state, model, sample)
        belief, correction = kalman.correct(belief, sample, model)
        judged = self._judged(state, model, sample, belief, correction)
        return self._sound(self._merged(state, belief, free, judged, sample, history), state)

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

    def model(self, state: OnlineState) -> AbstractVectorField:
        """The field at the last good estimate, with its disturbance."""
        theta, unravel = ravel_parameters(self.field)
        return unravel((theta + jnp.asarray(self.scales, theta.dtype) * state.trusted).astype(theta.dtype))

    def intervals(self, state: OnlineState, level: float = 0.95) -> dict[str, Interval]:
        """Parameters and disturbance with their intervals, in physical units; see `hybrid_jax.intervals`.

        Args:
            state: of the filter, as `begin` and `update` return it.
            level: probability that an interval holds the value, between 0 and 1.
        """
        return intervals(self.model(state), self.estimate(state)[1], level)

    def flags(self, state: OnlineState) -> Flags:
        """What is wrong with samples, parameters and model, or was found.

        Args:
            state: of the filter, or states of several, stacked along leading axes.
        """
        tuning, d = self.tuning, state.x.shape[-1]
        variance, free, test = jnp.diagonal(state.covariance, axis1=-2, axis2=-1)[..., d:], state.free, state.test
        if state.mixture is not None:
            test = state.mixture.test
        return Flags(
            missing=state.history.unseen > 0,
            frozen=state.history.equal >= tuning.frozen,
            gap=state.history.silent > tuning.gap,
            changed=test.quiet < 1,
            inconsistent=state.nis >= tuning.reject,
            unexcited=variance > UNEXCITED * free,
            at_bound=jnp.abs(state.trusted) >= tuning.bound,
        )

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

    def _predicted(self, state: OnlineState, model: FilterModel, sample: Sample) -> tuple[Belief, Float[Array, " p"]]:
        """The filter of all parameters before the sample, and the variances without data."""
        tuning, ones = self.tuning, jnp.ones_like(state.theta)
        pulled = jnp.max(state.test.squares, axis=0)
        varies = np.array([name.startswith(DISTURBANCE) for name in self.names])
        all_vary = bool(self.hypotheses) or not varies.any()
        forgotten = np.where(varies | all_vary, tuning.forgetting, 0.0)
        faster = 1 + jnp.asarray(forgotten, ones.dtype) * jnp.maximum(pulled - tuning.eager, 0.0)
        diffusion = self.dt * sample.elapsed * jnp.square(jnp.minimum(tuning.drift * faster, FASTEST))
        belief = kalman.predict(state.joint, model, model.field, None, diffusion, sample.acted)
        belief, free = kalman.limit_covariance(belief, ones), jnp.minimum(state.free + diffusion, 1.0)
        return kalman.reset_state(belief, sample, sample.restart, model.variances), free

    def _judged(
        self, state: OnlineState, model: FilterModel, sample: Sample, belief: Belief, correction: Correction
    ) -> Judged:
        """The test of the filter of all parameters, whether that filter opens to its prior, and what is believed."""
        tuning, (white, gains, _) = self.tuning, correction
        test, opens = change_test.after_sample(state.test, white, gains, sample, self.dt, tuning, tuning.pause)
        if state.mixture is None:
            return test, opens, Verdict(None, belief.z[len(state.x) :], jnp.square(white), opens, opens)
        verdict = multiple_model.update(state.mixture, self._models(), model, sample, belief, correction)
        unexplained = verdict.unexplained & (test.quiet > tuning.hold)
        return change_test.reset(test, unexplained, 0.0), opens | unexplained, verdict

    def _merged(
        self, state: OnlineState, belief: Belief, free: Array, judged: Judged, sample: Sample, history: SampleHistory
    ) -> OnlineState:
        """The next state: opened to the prior after a change, and believed if it is consistent."""
        test, opens, verdict = judged
        # The state, too, has followed the wrong model since the change.
        belief = kalman.reset_state(belief, sample, opens, self._variances(state.x))
        d, ones = len(state.x), jnp.ones_like(state.theta)
        opened = jnp.concatenate([jnp.zeros(d, state.x.dtype), jnp.where(opens, ones, 0.0)])
        nis = self._mean_square(state.nis, verdict.squares, sample)
        return OnlineState(
            x=belief.z[:d],
            theta=belief.z[d:],
            covariance=belief.covariance + jnp.diag(opened),
            free=jnp.where(opens, ones, free),
            test=test,
            mixture=verdict.mixture,
            trusted=jnp.where(nis < self.tuning.reject, verdict.theta, state.trusted),
            nis=nis,
            history=history,
            changes=state.changes + jnp.where(verdict.changed, 1.0, 0.0),
            restarts=state.restarts,
        )

    def _mean_square(self, nis, squares, sample: Sample):
        """The mean NIS with another sample."""
        share = jnp.sum(squares) / jnp.maximum(jnp.sum(jnp.where(sample.seen, 1.0, 0.0)), 1.0)
        return nis + jnp.where(sample.measured, -jnp.expm1(-self.dt / self.tuning.window), 0.0) * (share - nis)

    def _models(self) -> ModelSet:
        return model_set(self.hypotheses, len(self.names), self.dt)

    def _sound(self, new: OnlineState, old: OnlineState) -> OnlineState:
        """The new state, or a beginning at the last good θ if a number of it is not finite."""
        parts = [new.covariance, new.x, new.theta, new.nis]
        if new.mixture is not None:
            parts += [new.mixture.z, new.mixture.covariance, new.mixture.log_weights]
        total = sum(jnp.sum(jnp.abs(part)) for part in parts)
        sound = (total < HUGE) & (jnp.min(kalman.diagonal(new.covariance)) > 0)
        x, ones = jnp.where(jnp.abs(new.history.last) < HUGE, new.history.last, 0.0), jnp.ones_like(old.theta)
        covariance = jnp.diag(jnp.concatenate([self._variances(x), ones]))
        values = old.trusted, old.trusted, covariance, ones, old.changes, old.restarts + 1
        again = eqx.tree_at(
            lambda s: (s.theta, s.trusted, s.covariance, s.free, s.changes, s.restarts), self.begin(x), values
        )
        if (mixture := again.mixture) is not None:
            # It is for all parameters now.
            again = eqx.tree_at(lambda s: s.mixture.log_weights, again, mixture.log_weights[::-1])
        return jax.tree.map(lambda a, b: jnp.where(sound, a, b), new, again)
