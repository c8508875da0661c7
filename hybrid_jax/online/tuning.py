"""How an `OnlineAdaptation` is tuned."""

from dataclasses import dataclass

from hybrid_jax import checks


@dataclass(frozen=True)
class Tuning:
    """How fast an `OnlineAdaptation` forgets, and what it calls a change. ValueError for numbers that are negative."""

    drift: float = 0.002  # random walk of a parameter, as a share of its prior standard deviation, 1/√s
    forgetting: float = 30.0  # how much faster a parameter walks for each unit of its squared test beyond `eager`
    eager: float = 6.0  # of a χ² of one degree
    window: float = 0.2  # time constant of the mean NIS [s]
    spans: tuple[float, float] = (0.05, 0.5)  # time constants of the two sums of the test [s]
    alarm: float = 5.0  # of the test, a normal number if nothing has changed
    caution: float = 1.5  # share of what uncertain parameters do to a step that counts as noise, for its nonlinearity
    pause: float = 0.1  # least time between two alarms [s]
    reject: float = 6.0  # mean NIS from which the filter is not believed
    clip: float = 5.0  # standard deviations at which an innovation is cut off, so that an outlier does little
    gap: float = 0.1  # after so long without a sample the state is taken from the next one [s]
    frozen: int = 3  # equal samples in a row from which a sensor counts as frozen
    bound: float = 4.0  # prior standard deviations that a parameter may move
    floor: float = 25.0  # how many times less likely, as a logarithm, a hypothesis can become
    least: float = 1e-3  # weight of a hypothesis, relative to the largest, up to which it is left out
    change: float = 4.0  # how much less likely each cause is after an alarm than what was before, likewise
    settle: float = 0.3  # least time between two alarms of the causes [s]
    hold: float = 0.6  # least time from one opening of the filter of all parameters until causes open it again [s]

    def __post_init__(self):
        for name in ("drift", "forgetting", "eager", "caution", "pause", "least", "change", "settle", "hold"):
            checks.not_negative(name, getattr(self, name))
        for name in ("window", "alarm", "reject", "clip", "gap", "bound", "floor"):
            checks.positive(name, getattr(self, name))
        checks.count("frozen", self.frozen)
