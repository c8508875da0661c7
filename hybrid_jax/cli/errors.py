"""Tables and figures of prediction errors and parameters, for the verbs."""

from collections.abc import Mapping

import matplotlib as mpl
import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from hybrid_jax.adaptation import Adaptation
from hybrid_jax.cli.page import STYLE, Table
from hybrid_jax.identification.learning import UNITS

BASELINE = (
    "RMSE is the root mean square of the prediction error. Frozen rates are a baseline: the thrust of the motors acts, "
    "and body rates stay constant."
)
LINES = {  # colour and dashes of a model, the same on every page
    "thrust, rates frozen": ("0.6", "--"),
    "no forces": ("0.6", ":"),
    "before": ("0.45", "--"),
    "adapted": ("#CC79A7", "-"),
    "physics": ("#009E73", "-"),
    "physics with its past": ("#009E73", "--"),
    "hybrid": ("#0072B2", "-"),
    "hybrid with its past": ("#0072B2", "--"),
}


def texts(values: Float[np.ndarray, " 4"]) -> list[str]:
    """Format numbers with their UNITS, which a page keeps on one line."""
    return [f"{value:.3g}\N{NO-BREAK SPACE}{unit}" for value, unit in zip(values, UNITS.values(), strict=True)]


@mpl.rc_context(STYLE)
def figure(errors: Mapping[str, Float[np.ndarray, "flights t 4"]], dt: float) -> Figure:
    """Plot the RMSE against prediction time, with a panel per unit and a line per model."""
    drawn = Figure(figsize=(6.0, 4.8), layout="constrained")
    panels = drawn.subplots(2, 2, sharex=True)
    for i, (panel, (name, unit)) in enumerate(zip(panels.flat, UNITS.items(), strict=True)):
        for label, found in errors.items():
            mean = np.sqrt(np.mean(np.square(found[..., i]), axis=0))
            colour, dashes = LINES.get(label, ("#0072B2", "-"))
            panel.plot(dt * np.arange(1, len(mean) + 1), mean, dashes, color=colour, label=label)
        panel.set(title=name.replace("_", " "), ylabel=f"RMSE [{unit}]", ylim=(0, None))
    for panel in panels[-1]:
        panel.set_xlabel("time since the prediction began [s]")
    drawn.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return drawn


def parameter_table(found: Adaptation) -> Table:
    lines = [(name, str(one)) for name, one in found.parameters.items()]
    return Table(f"Parameters ({found.level:.0%} intervals)", ("parameter", "value"), lines)


def unknown(found: Adaptation) -> list[str]:
    """Return a sentence on the parameters that the flights do not identify, if there are any."""
    names = [name for name, one in found.parameters.items() if one.high == np.inf]
    return [f"The flights do not identify {', '.join(names)}: other values fit as well."] if names else []
