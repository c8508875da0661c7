"""The figure of a comparison: every seed of every method on one axis of error, a panel for each domain (Table 2)."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from experiments.paper.figures import STYLE, colour
from experiments.paper.rows import NAMES, Row
from experiments.paper.summary import Cell, by_domain, method, ranked
from experiments.reporting.error_panels import Line, add_legend, draw_panel


@mpl.rc_context(STYLE)
def standings(rows: Sequence[Row], title: str, floors: Mapping[str, float] = MappingProxyType({})) -> Figure:
    """The test errors of all seeds of every method and their mean, the smallest mean on top, a panel for each domain.

    Args:
        floors: domain → an error that no model at hand can get below, such as the share of a wind's sine.

    Raises:
        ValueError: no rows.
    """
    if not rows:
        raise ValueError("rows must not be empty: there is nothing to draw")
    panels = {domain: ranked(group) for domain, group in by_domain(rows).items()}
    counts = [len(methods) for methods in panels.values()]
    figure = Figure(figsize=(9, 0.8 + sum(0.9 + 0.3 * count for count in counts)), layout="constrained")
    column = figure.subplots(len(panels), 1, squeeze=False, height_ratios=counts)[:, 0]
    sizes = {row.n_train for row in rows} - {0}
    for axes, (domain, methods) in zip(column, panels.items(), strict=True):
        lines = [_line(cell, group, len(sizes) > 1) for cell, group in methods.items()]
        draw_panel(axes, lines, NAMES[domain].capitalize(), floors.get(domain, 0.0))
    figure.suptitle(title, fontsize=12)
    add_legend(figure, any(row.test_mse is None for row in rows))
    return figure


def _line(cell: Cell, rows: Sequence[Row], several_sizes: bool) -> Line:
    name = f"{method(cell)}, N = {cell[2]}" if several_sizes and cell[2] else method(cell)
    marked = "mean of the adapted hybrid" if cell[:2] == ("hybrid", "fine_tuned") else ""
    return Line(name, np.array([row.error for row in rows]), colour(cell[0]), marked)
