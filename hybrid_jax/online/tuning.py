"""Settings of an `OnlineAdaptation`."""

import dataclasses
from dataclasses import dataclass

from hybrid_jax import checks

# Times in seconds, for `Tuning.pace` 1.
SPANS = (0.05, 0.5)  # of the two sums of the change test
PAUSE, SETTLE, HOLD = 0.1, 0.3, 0.6  # shortest time between alarms, of a mixture, and to an unexplained alarm
WINDOW, TRIAL, MEMORY = 0.2, 10.0, 2.0  # time constants of the mean NIS, the count of alarms, and the information
BURST = 2.0  # alarms in a second (weighted by e⁻ᵗ) from which an estimate is not used, because it is moving
REJECT = 6.0  # mean normalised innovation squared (NIS) from which an estimate is not used
ALARMS = 10.0  # alarms in 10 s from which it is not used, until twice this count has halved
BREEZE = 0.25  # random walk of a disturbance, in its prior [1/√s], above which effects count: gusts of 1/6 of it
TAKEN = 10.0  # weight of a disturbance relative to a parameter, if samples determine only a sum of both
FROZEN = 3  # equal samples in a row that mark a sensor as frozen
BOUND = 4.0  # prior standard deviations that a parameter may move
SLOWEST = 0.05  # period up to which a pace of 1 is right


@dataclass(frozen=True)
class Tuning:
    """How an `OnlineAdaptation` forgets and detects changes.

    The defaults were tuned by hand on simulated flights of a quadrotor at 100 Hz, with other seeds than the report on
    online adaptation. They are in standard deviations of the prior and the noise, so they should suit your system if
    `prior`, `noise` and `process` do. If changes are missed or alarms are false, you should first change `alarm`; if
    intervals are too narrow, raise `drift` and `caution`; if your system is much slower, set `pace`.

    Attributes:
        pace: factor on all times of the filter except `gap`; 0 for the larger of 1 and the period over 0.05 s.
        drift: random walk of a parameter, as a share of its prior standard deviation [1/√s, for a pace of 1].
        gusts: largest factor on the random walk of a disturbance while innovations are biased, for example in gusts.
        alarm: threshold of the change test, which is standard normal without a change.
        clip: standard deviations at which innovations are clipped against outliers.
        gap: time without samples after which the state is reset to the next one [s]; 0 for 0.1 s times the pace.
        excitation: information of a sample, in units of the prior, below which a direction of θ is not estimated; 0 to
            estimate all.
        caution: share of the effect of uncertain parameters on a step that counts as noise, because of nonlinearity.

    Raises:
        ValueError: if a number is negative, or zero although it must be positive.
    """

    pace: float = 0.0
    drift: float = 0.002
    gusts: float = 500.0
    alarm: float = 5.0
    clip: float = 5.0
    gap: float = 0.0
    excitation: float = 0.05
    caution: float = 1.5

    def __post_init__(self):
        for name in ("pace", "drift", "gap", "excitation", "caution"):
            checks.not_negative(name, getattr(self, name))
        for name in ("gusts", "alarm", "clip"):
            checks.positive(name, getattr(self, name))

    def at(self, dt: float) -> "Tuning":
        """Return the settings with pace and gap for samples every dt [s].

        Args:
            dt: time between two samples [s].
        """
        pace = self.pace or max(1.0, dt / SLOWEST)
        return dataclasses.replace(self, pace=pace, gap=self.gap or 0.1 * pace)
