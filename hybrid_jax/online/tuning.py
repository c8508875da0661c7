"""How an `OnlineAdaptation` is tuned."""

import dataclasses
from dataclasses import dataclass

from hybrid_jax import checks

# Times in seconds, for `Tuning.pace` 1.
SPANS = (0.05, 0.5)  # of the two sums of the change test
PAUSE, SETTLE, HOLD = 0.1, 0.3, 0.6  # least time from an alarm to the next, of a mixture, and to an unexplained one
WINDOW, TRIAL, MEMORY = 0.2, 10.0, 2.0  # of the mean NIS, of the count of alarms, of what samples tell
SLOWEST = 0.05  # period up to which a pace of 1 is right


@dataclass(frozen=True)
class Tuning:
    """How fast an `OnlineAdaptation` forgets, and what it calls a change.

    The values were tuned by hand on simulated flights of a quadrotor at 100 Hz, of other seeds than those of the report
    on online adaptation. They count in standard deviations of the prior and of the noise, so that they carry over to
    other systems once `prior`, `noise` and `process` are right. If you change anything, begin with `alarm` (missed
    changes against false alarms), `drift` and `caution` (intervals that are too narrow), and with `pace` if your system
    is much slower or sampled much less often.

    Attributes:
        pace: factor on all times of the filter but `gap`; 0 for 1, or the period over 0.05 s if that is more.
        drift: random walk of a parameter, as a share of its prior standard deviation [1/√s, for a pace of 1].
        gusts: how many times as fast a disturbance may walk while it is pulled to one side, as in gusts.
        alarm: value of the change test that gives an alarm, of a standard normal number if nothing has changed.
        reject: mean normalised innovation squared, NIS, from which the filter is not believed.
        alarms: count of alarms in 10 s from which it is not believed, until it has fallen to half of twice as many.
        clip: standard deviations at which an innovation is cut off, so that an outlier does little.
        gap: after so long without a sample the state is taken from the next one [s]; 0 for 0.1 s times the pace.
        frozen: equal samples in a row from which a sensor counts as frozen.
        bound: prior standard deviations that a parameter may move.
        excitation: information of a sample, in units of the prior, below which a direction of θ is not learned; 0 to
            learn all.
        caution: share of what uncertain parameters do to a step that counts as noise, for its nonlinearity.

    Raises:
        ValueError: a number that is negative, or zero where it must be positive.
    """

    pace: float = 0.0
    drift: float = 0.002
    gusts: float = 500.0
    alarm: float = 5.0
    reject: float = 6.0
    alarms: float = 5.0
    clip: float = 5.0
    gap: float = 0.0
    frozen: int = 3
    bound: float = 4.0
    excitation: float = 0.05
    caution: float = 1.5

    def __post_init__(self):
        for name in ("pace", "drift", "gap", "excitation", "caution"):
            checks.not_negative(name, getattr(self, name))
        for name in ("gusts", "alarm", "reject", "alarms", "clip", "bound"):
            checks.positive(name, getattr(self, name))
        checks.count("frozen", self.frozen)

    def at(self, dt: float) -> "Tuning":
        """With a pace and a gap for samples every dt [s].

        Args:
            dt: time between two samples [s].
        """
        pace = self.pace or max(1.0, dt / SLOWEST)
        return dataclasses.replace(self, pace=pace, gap=self.gap or 0.1 * pace)
