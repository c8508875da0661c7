"""Adapt while it runs: an extended Kalman filter of state, θ_p and a constant disturbance, one sample at a time.

The state of the filter is z = [x, θ]: the state x of the system, which the one-step predictions need without noise,
and θ, all parameters of the physics and the disturbance. Samples enter one number after the other, so that an update
needs no matrix inverse (Bierman, "Factorization methods for discrete sequential estimation", 1977, ch. V.2).

- Test for a change: if noise and model are right, the corrections of a parameter are uncorrelated; if it has changed,
  they pull to one side. Their exponentially weighted sum over its standard deviation is the test (the idea of the local
  approach: Benveniste, Basseville, Moustakides, "The asymptotic local approach to change detection and model
  validation", 1987). It also sees changes without a steady push, such as of an inertia. An alarm opens the covariance.
- Forgetting: θ is a slow random walk, and the disturbance, such as a gust, walks faster while it is pulled. Parameters
  of a vehicle are constant between two changes; they do so only where no disturbance is estimated.
- Consistency: while the mean of the normalised innovations squared (NIS) is far too large, what the filter says is not
  used (Bar-Shalom, Li, Kirubarajan, "Estimation with applications to tracking and navigation", 2001, ch. 5.4), and the
  last good estimate is.
"""

from collections.abc import Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hybrid_jax import checks
from hybrid_jax.adaptation.least_squares import ravel_parameters
from hybrid_jax.adaptation.online_state import DISTURBANCE, Flags, Numbers, OnlineState, Tuning, named_priors
from hybrid_jax.adaptation.uncertainty import Interval, intervals
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.dynamics.disturbance import physics_of, with_disturbance
from hybrid_jax.dynamics.estimator import AbstractEstimator
from hybrid_jax.dynamics.rigid_body import moves_a_rigid_body
from hybrid_jax.integrate import rk4_step
from hybrid_jax.rotation import normalise
from hybrid_jax.state import QUATERNION

HUGE = 1e15  # a number beyond it, or NaN, was not measured
FASTEST = 3.0  # share of its prior standard deviation that a parameter may walk in a second
UNEXCITED = 0.5  # share of its variance without data, above which the data have said nothing on a parameter


class OnlineAdaptation(AbstractEstimator):
    """Recursive estimator of the parameters of any field, and of a constant disturbance, with their covariance.

        filter = hj.OnlineAdaptation(field, dt=0.01, noise=0.02, disturbance=1.0)
        state = filter.begin(x)
        state = filter.update(state, x, u)  # at each sample; then filter.model(state), filter.intervals(state)

    Pure: its methods compile and map over stacked states, and do not raise for bad samples; see `flags`.

    Attributes:
        field: its physics is adapted from the values that it has; a network beside it stays as it is.
        dt: time between two samples [s].
        noise: standard deviation of what is measured of each state.
        prior: standard deviation of each parameter before and after a change, in the physics' own parametrisation (for
            a rigid body: logarithms), one number for all or by name: of one entry, efficiency[0], or of all of an
            array, efficiency.
        disturbance: standard deviation of the constant part of ẋ at each disturbed state; 0 for none.
        indices: of the disturbed states; by default v̇ and ω̇ of a rigid body.
        process: standard deviation of what the model leaves out of ẋ, as white noise, of each state [1/√s].
        initial: share of the prior that is uncertain at the start, before a change.

    Raises:
        ValueError: a number out of range, an unknown name, or physics without parameters.
    """

    field: AbstractVectorField
    dt: float = eqx.field(static=True)
    noise: tuple[float, ...] = eqx.field(static=True)  # one for each state, or one for all
    process: tuple[float, ...] = eqx.field(static=True)
    names: tuple[str, ...] = eqx.field(static=True)  # of the parameters, in the order of θ
    scales: tuple[float, ...] = eqx.field(static=True)  # the prior standard deviation of each
    initial: float = eqx.field(static=True)
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
        tuning: Tuning | None = None,
    ):
        checks.positive("dt", dt, "a positive number of seconds")
        for name, numbers, check in (("noise", noise, checks.positive), ("process", process, checks.not_negative)):
            for number in np.ravel(numbers):
                check(name, number)
        if not 0 < initial <= 1:
            raise ValueError(f"initial must be a share above 0 and at most 1, got {initial}")
        if np.any(disturbance):
            if indices is None and not moves_a_rigid_body(physics_of(field)):
                raise ValueError("indices must say which states are disturbed, as the system is no rigid body")
            field = with_disturbance(field, indices)
        self.field, self.dt, self.initial = field, float(dt), float(initial)
        self.noise, self.process = (tuple(np.ravel(numbers).tolist()) for numbers in (noise, process))
        self.names, self.scales = named_priors(field, prior, disturbance)
        self.tuning = Tuning() if tuning is None else tuning

    def begin(self, x: Float[Array, " d"]) -> OnlineState:
        """Before the first sample x, at the field's own parameters."""
        x = jnp.asarray(x, float)
        p, none = ravel_parameters(self.field)[0].size, jnp.zeros_like(x)
        zero, start = jnp.zeros((), x.dtype), jnp.full(p, self.initial**2, x.dtype)
        covariance = jnp.diag(jnp.concatenate([self._variances(x), start]))
        theta, sums, long = jnp.zeros(p, x.dtype), jnp.zeros((2, p), x.dtype), zero + 1e3
        return OnlineState(
            x, theta, covariance, theta, start, sums, sums, zero + 1, long, zero, x, none, none, zero, zero
        )

    def update(
        self, state: OnlineState, x: Float[Array, " d"], u: Float[Array, " m"], elapsed: Float[Array, ""] | float = 1.0
    ) -> OnlineState:
        """After one period.

        Args:
            x: the new sample; NaN where nothing was measured.
            u: the mean input over the period, as it acted: delayed and lagged, not as it was commanded.
            elapsed: periods since the last update. Over more than one nothing is learned of the input, and the state is
                taken from the sample.
        """
        tuning, d = self.tuning, len(state.x)
        x = self._same_hemisphere(jnp.asarray(x, state.x.dtype), state.x)
        equal = jnp.where(x == state.last, state.equal + 1, 0.0)
        seen = (jnp.abs(x) < HUGE) & (equal == 0)
        # Sums in place of `all` and `any`, which the export to C does not know.
        acted = (jnp.sum(jnp.where(jnp.abs(u) < HUGE, 0.0, 1.0)) == 0) & (elapsed < 1.5)
        any_seen = jnp.sum(jnp.where(seen, 1.0, 0.0)) > 0
        waited = state.silent + self.dt * (elapsed - 1)
        silent = jnp.where(any_seen, self.dt * (elapsed - 1), waited + self.dt)
        anew = any_seen & (~acted | (waited > tuning.gap))

        z, covariance, free = self._predict(state, u, acted, elapsed)
        z, covariance = self._from_sample(anew, seen, x, z, covariance)
        before = z[d:]
        z, covariance, white, variance = self._correct(z, covariance, x, seen & ~anew)
        pull, spread, alarm = self._test(state, z[d:] - before, variance, any_seen & ~anew)

        theta = jnp.clip(z[d:], -tuning.bound, tuning.bound)
        z = jnp.concatenate([self._unit(z[:d]), theta])
        share = jnp.sum(jnp.square(white)) / jnp.maximum(jnp.sum(jnp.where(seen, 1.0, 0.0)), 1.0)
        weight = jnp.where(any_seen & ~anew, -jnp.expm1(-self.dt / tuning.window), 0.0)
        nis = state.nis + weight * (share - state.nis)
        # The state, too, has followed the wrong model since the change.
        z, covariance = self._from_sample(alarm, seen, x, z, covariance)
        open_up = jnp.concatenate([jnp.zeros(d, x.dtype), jnp.where(alarm, jnp.ones_like(theta), 0.0)])
        covariance, free = covariance + jnp.diag(open_up), jnp.where(alarm, jnp.ones_like(free), free)
        believed = nis < tuning.reject
        new = OnlineState(
            z[:d],
            theta,
            covariance,
            jnp.where(believed, theta, state.trusted),
            free,
            pull,
            spread,
            nis,
            jnp.where(alarm, 0.0, state.quiet + self.dt * elapsed),
            silent,
            jnp.where(jnp.abs(x) < HUGE, x, state.last),
            equal,
            jnp.where(seen, 0.0, 1.0),
            state.changes + jnp.where(alarm, 1.0, 0.0),
            state.restarts,
        )
        return self._sound(new, state)

    def model(self, state: OnlineState) -> AbstractVectorField:
        """The field at the last good estimate, with its disturbance."""
        theta, unravel = ravel_parameters(self.field)
        return unravel((theta + jnp.asarray(self.scales, theta.dtype) * state.trusted).astype(theta.dtype))

    def intervals(self, state: OnlineState, level: float = 0.95) -> dict[str, Interval]:
        """Parameters and disturbance with their intervals, in physical units; see `hybrid_jax.intervals`."""
        scales, d = jnp.asarray(self.scales, state.x.dtype), state.x.shape[-1]
        return intervals(self.model(state), scales[:, None] * state.covariance[d:, d:] * scales, level)

    def flags(self, state: OnlineState) -> Flags:
        """What is wrong with samples, parameters and model, or was found."""
        tuning, d = self.tuning, state.x.shape[-1]
        return Flags(
            missing=state.unseen > 0,
            frozen=state.equal >= tuning.frozen,
            gap=state.silent > tuning.gap,
            changed=state.quiet < 1,
            inconsistent=state.nis >= tuning.reject,
            unexcited=jnp.diagonal(state.covariance, axis1=-2, axis2=-1)[..., d:] > UNEXCITED * state.free,
            at_bound=jnp.abs(state.theta) >= tuning.bound,
        )

    def _variances(self, x) -> Float[Array, " d"]:
        return jnp.broadcast_to(jnp.square(jnp.asarray(self.noise, x.dtype)), x.shape)

    def _same_hemisphere(self, x, like):
        """The sample with the sign of its quaternion that is nearer."""
        if not moves_a_rigid_body(self.field):
            return x
        other = jnp.sum(x[QUATERNION] * like[QUATERNION]) < 0
        return x.at[QUATERNION].set(jnp.where(other, -x[QUATERNION], x[QUATERNION]))

    def _unit(self, x):
        return x.at[QUATERNION].set(normalise(x[QUATERNION])) if moves_a_rigid_body(self.field) else x

    def _predict(self, state: OnlineState, u, acted, elapsed):
        """Mean and covariance before the sample, and the variances without data."""
        tuning, d, p = self.tuning, len(state.x), len(state.theta)
        start, unravel = ravel_parameters(self.field)
        scales = jnp.asarray(self.scales, state.x.dtype)
        held = jnp.where(jnp.abs(u) < HUGE, u, 0.0)

        def ahead(z):
            field = unravel((start + scales * z[d:]).astype(start.dtype))
            return self._unit(rk4_step(field, z[:d], held, self.dt))

        z = jnp.concatenate([state.x, state.theta])
        moved, push = jax.linearize(ahead, z)
        slope = jax.vmap(push, out_axes=1)(jnp.eye(d + p, dtype=z.dtype))  # of the new x by z
        top = slope @ state.covariance
        inner = top @ slope.T
        covariance = jnp.block([[inner, top[:, d:]], [top[:, d:].T, state.covariance[d:, d:]]])
        covariance = jnp.where(acted, (covariance + covariance.T) / 2, state.covariance)
        pulled = jnp.max(_squares(state.pull, state.spread), axis=0)
        varies = np.array([name.startswith(DISTURBANCE) for name in self.names])
        forgotten = np.where(varies | ~varies.any(), tuning.forgetting, 0.0)
        faster = 1 + jnp.asarray(forgotten, z.dtype) * jnp.maximum(pulled - tuning.eager, 0.0)
        walked = self.dt * elapsed * jnp.square(jnp.minimum(tuning.drift * faster, FASTEST))
        noise = self.dt * jnp.broadcast_to(jnp.square(jnp.asarray(self.process, z.dtype)), (d,))
        # While θ is uncertain, products of its errors, which the linear filter leaves out, move the state as well.
        by_theta = slope[:, d:]
        noise = noise + tuning.caution**2 * jnp.sum((by_theta @ state.covariance[d:, d:]) * by_theta, axis=1)
        covariance = covariance + jnp.diag(jnp.concatenate([noise, walked]))
        # No parameter becomes less certain than the prior, also if nothing excites it for long.
        variance = _diagonal(covariance)[d:]
        shrink = jnp.concatenate([jnp.ones(d, z.dtype), jnp.sqrt(1 / jnp.maximum(variance, 1.0))])
        free = jnp.minimum(state.free + walked, 1.0)
        z = jnp.where(acted, jnp.concatenate([moved, state.theta]), z)
        return z, shrink[:, None] * covariance * shrink, free

    def _from_sample(self, anew, seen, x, z, covariance):
        """The state as the sample has it, if `anew`; θ stays."""
        d, p = len(x), len(z) - len(x)
        kept = jnp.concatenate([jnp.full(d, jnp.where(anew, 0.0, 1.0), z.dtype), jnp.ones(p, z.dtype)])
        variance = jnp.where(seen, self._variances(x), 1e4 * self._variances(x))
        added = jnp.concatenate([jnp.where(anew, variance, 0.0), jnp.zeros(p, z.dtype)])
        z = jnp.concatenate([jnp.where(anew & seen, x, z[:d]), z[d:]])
        return z, kept[:, None] * covariance * kept + jnp.diag(added)

    def _correct(self, z, covariance, x, seen):
        """With one measured number after the other.

        Also the innovations over their standard deviations, and the variance of what they were to correct of θ.
        """
        noise, white, clip = self._variances(x), [], self.tuning.clip
        variance = jnp.zeros(len(z) - len(x), z.dtype)
        for i in range(len(x)):
            column = covariance[:, i]
            size = jnp.sqrt(column[i] + noise[i])
            error = jnp.where(seen[i], jnp.clip((x[i] - z[i]) / size, -clip, clip), 0.0)
            gain = jnp.where(seen[i], column / size, 0.0)
            z = z + gain * error
            covariance = covariance - gain[:, None] * gain
            variance = variance + jnp.square(gain[len(x) :])
            white.append(error)
        return z, covariance, jnp.stack(white), variance

    def _test(self, state: OnlineState, correction, variance, measured):
        """The sums of the test with another correction of θ, and whether it says that θ has changed."""
        spans = jnp.asarray(self.tuning.spans, correction.dtype)[:, None]
        kept = jnp.where(measured, jnp.exp(-self.dt / spans), 1.0)
        pull = kept * state.pull + jnp.where(measured, correction, 0.0)
        spread = kept**2 * state.spread + jnp.where(measured, variance, 0.0)
        pulled = jnp.max(_squares(pull, spread)) > self.tuning.alarm**2
        alarm = pulled & (state.quiet > self.tuning.pause)
        return jnp.where(alarm, 0.0, pull), jnp.where(alarm, 0.0, spread), alarm

    def _sound(self, new: OnlineState, old: OnlineState) -> OnlineState:
        """The new state, or a beginning at the last good θ if a number of it is not finite."""
        total = sum(jnp.sum(jnp.abs(part)) for part in (new.covariance, new.x, new.theta, new.nis))
        sound = (total < HUGE) & (jnp.min(_diagonal(new.covariance)) > 0)
        x, ones = jnp.where(jnp.abs(new.last) < HUGE, new.last, 0.0), jnp.ones_like(old.theta)
        covariance = jnp.diag(jnp.concatenate([self._variances(x), ones]))
        values = old.trusted, old.trusted, covariance, ones, old.changes, old.restarts + 1
        again = eqx.tree_at(
            lambda s: (s.theta, s.trusted, s.covariance, s.free, s.changes, s.restarts), self.begin(x), values
        )
        return jax.tree.map(lambda a, b: jnp.where(sound, a, b), new, again)


def _diagonal(matrix):
    """As jnp.diagonal, by operations that the export to C knows."""
    return matrix.ravel()[:: len(matrix) + 1]


def _squares(pull, spread):
    """The squared test of each parameter, of one degree of freedom."""
    return jnp.square(pull) / jnp.where(spread > 0, spread, 1.0)
