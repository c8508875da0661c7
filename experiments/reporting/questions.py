"""Each report's question as its title, with its main table, main figure, and what they mean."""

from typing import NamedTuple


class Asked(NamedTuple):
    """A report's title, what the result means for you, and the unfolded table and figure, by default the first."""

    question: str
    meaning: tuple[str, ...] = ()
    table: str = ""
    figure: str = ""


_PAPER = (
    "Use physics whenever you have some: without it, a hundred trajectories are not enough.",
    "If the change is in the parameters or a steady force, prefer least squares or `hj.adapt` to fine-tuning.",
)
QUESTIONS = {
    "param_shift": Asked("The inertia of a quadrotor changes: how much data does a model need?", _PAPER, "Test error"),
    "external_force": Asked("A side wind sets in: how much data does a model need?", _PAPER, "Test error"),
    "changes": Asked(
        "Which method adapts to one flight of ten seconds?",
        (
            "Start with the defaults of `hj.adapt`; do not fine-tune a network on ten seconds of data.",
            "The flights move. A hover determines too little, and no method can know what changed.",
        ),
    ),
    "coverage": Asked(
        "Do 95 % intervals contain the true value?",
        (
            "Believe an interval of a parameter that is called physical; an effective one has none.",
            "If a parameter is effective, add the forces that your physics lacks, and train physics first.",
        ),
    ),
    "comparison": Asked(
        "Which of ten methods adapts best to a hundred trajectories?",
        ("Fit few parameters if you have little data; a network needs many flights and validation data.",),
    ),
    "ablation": Asked(
        "Which choices of the method matter?",
        (
            "Keep the network from reading the horizontal position and yaw.",
            "Reduce the noise of the flights before the change: nothing else harms as much.",
        ),
        "Error after fine-tuning over",
        "residual.png",
    ),
    "closed_loop": Asked(
        "Does adaptation make a vehicle fly better?",
        ("Yes in a steady wind, with a network that does not read the position; add a disturbance observer.",),
        "side wind (",
        "gap_external_force.png",
    ),
    "online": Asked(
        "The vehicle changes in the air: how soon does it fly well again?",
        (
            "Name the changes that you expect: in our simulator the filter is then nearly as good as knowing them.",
            "Where your model lacks effects of the vehicle, a disturbance observer may fly closer.",
        ),
        "RMSE of the position",
    ),
    "excitation": Asked(
        "How much does a planned flight narrow the intervals?",
        ("Plan the flight before you record it: ten seconds are enough, a hover is not.",),
        "Half-width",
        "intervals.png",
    ),
    "reaction_diffusion": Asked(
        "Can a hybrid learn a partial differential equation from one trajectory?",
        (
            "Yes, if you can say what is missing: for a reaction use a network that reads one point at a time.",
            "Train several random networks and keep the one with the least loss.",
        ),
        "Forecasts",
        "forecasts.png",
    ),
    "worlds": Asked(
        "Is an adapted model ever worse than its source?",
        ("Look at the first rows before you adapt to a hover or to slow flight.",),
    ),
    "real_flight": Asked(
        "How well does a model predict flights that it has not seen?",
        (
            "Compare with the baselines: a model that is no better than frozen body rates has not learned to turn.",
            "Fitted parameters of a real flight predict, but they need not be those of the vehicle.",
        ),
        "Error to expect",
    ),
}
