"""How an `OnlineAdaptation` is tuned."""

from dataclasses import dataclass

from hybrid_jax import checks


@dataclass(frozen=True)
class Tuning:
    """How fast an `OnlineAdaptation` forgets, and what it calls a change.

    The values were tuned by hand on simulated flights of a quadrotor at 100 Hz, of other seeds than those of the report
    on online adaptation. They count in standard deviations of the prior and of the noise, so that they carry over to
    other systems once `prior`, `noise` and `process` are right. If you change anything, begin with `alarm` (missed
    changes against false alarms), `drift` and `caution` (intervals that are too narrow), and with the times, in
    proportion, if your system is much slower or sampled much less often.

    Attributes:
        drift: random walk of a parameter, as a share of its prior standard deviation [1/√s].
        forgetting: random walk: how much faster a parameter walks for each unit of its squared test beyond `eager`.
        eager: random walk: squared test, χ² of one degree, from which a parameter walks faster.
        spans: change test: time constants of its two sums [s].
        alarm: change test: value that gives an alarm, of a standard normal number if nothing has changed.
        pause: change test: least time between two alarms [s].
        window: guard: time constant of the mean normalised innovation squared, NIS [s].
        reject: guard: mean NIS from which the filter is not believed.
        clip: guard: standard deviations at which an innovation is cut off, so that an outlier does little.
        gap: guard: after so long without a sample the state is taken from the next one [s].
        frozen: guard: equal samples in a row from which a sensor counts as frozen.
        bound: guard: prior standard deviations that a parameter may move.
        excitation: guard: information of a sample, in units of the prior, below which a direction of θ is not
            learned; 0 to learn all.
        memory: guard: time constant of that information [s].
        trial: guard: time constant of the count of alarms [s]; a parameter at its bound counts as 2.5 a second.
        alarms: guard: count from which the filter is not believed, until it has fallen to half of twice as many.
        caution: guard: share of what uncertain parameters do to a step that counts as noise, for its nonlinearity.
        floor: hypotheses: how many times less likely, as a logarithm, one can become than the likeliest.
        least: hypotheses: weight, relative to the largest, up to which one is left out of the estimate.
        change: hypotheses: how much less likely, as a logarithm, each is after an alarm than what was before.
        settle: hypotheses: least time between two alarms of their mixture [s].
        hold: hypotheses: least time from one opening of the filter of all parameters until they open it again [s].

    Raises:
        ValueError: a number that is negative, or zero where it must be positive.
    """

    drift: float = 0.002
    forgetting: float = 30.0
    eager: float = 6.0
    spans: tuple[float, float] = (0.05, 0.5)
    alarm: float = 5.0
    pause: float = 0.1
    window: float = 0.2
    reject: float = 6.0
    clip: float = 5.0
    gap: float = 0.1
    frozen: int = 3
    bound: float = 4.0
    excitation: float = 0.05
    memory: float = 2.0
    trial: float = 10.0
    alarms: float = 5.0
    caution: float = 1.5
    floor: float = 25.0
    least: float = 1e-3
    change: float = 4.0
    settle: float = 0.3
    hold: float = 0.6

    def __post_init__(self):
        for name in (
            "drift",
            "forgetting",
            "eager",
            "caution",
            "excitation",
            "pause",
            "least",
            "change",
            "settle",
            "hold",
        ):
            checks.not_negative(name, getattr(self, name))
        for name in ("window", "memory", "trial", "alarms", "alarm", "reject", "clip", "gap", "bound", "floor"):
            checks.positive(name, getattr(self, name))
        checks.count("frozen", self.frozen)
