"""report.md: a page that a reader who has not seen the paper understands."""

from collections.abc import Mapping, Sequence
from typing import Any

from experiments.paper.rows import NAMES, RIVALS, Row
from experiments.paper.summary import by_domain
from experiments.reporting.report_tables import Table, over_seeds

_PAPER = "Osaka, Takeishi, Yairi, *Domain Adaptation with Hybrid Modeling for Learning Dynamical Systems*, ACML 2025"
_QUESTIONS = {
    "param_shift": "A quadrotor's moments of inertia Ix and Iy have changed (Sec. 4.4 of the paper).",
    "external_force": "A wind now pushes the quadrotor: a steady force and a slow sine (Sec. 4.5 of the paper).",
    "comparison": "Two changes of a quadrotor, other moments of inertia and a wind, and several ways to adapt to each, "
    "tested on windows of 0.1 s (Sec. 4.7 and Table 2 of the paper, and rivals that it does not have).",
}
_MODELS = {
    "hybrid": "rigid-body physics f_p(x, u; θ_p) plus a small network f_d(x, u; θ_d), both trained",
    "no_physics": "the same network alone",
    "physics_only": "the rigid-body physics alone, its θ_p trained",
    "expert_augmentation": "the hybrid of before the change, its θ_p told by an encoder from the flight's last states "
    "and inputs; the encoder learned on rollouts with drawn θ_p (Wehenkel et al., 2023)",
    "theta_p_only": "the hybrid of before the change, of which only θ_p goes on training, by Adam",
    "theta_d_only": "the hybrid of before the change, of which only the network goes on training, by Adam",
    "last_layer": "the hybrid of before the change, of which only the network's last layer is fitted anew, by ridge "
    "regression in closed form, as in Neural-Fly",
    "least_squares": "the hybrid of before the change, of which only θ_p is fitted anew, by nonlinear least squares "
    "(Levenberg–Marquardt)",
    "constant_disturbance": "the hybrid of before the change, of which only θ_p and, beside it, six accelerations that "
    "do not change are fitted, by nonlinear least squares",
    "linear_residual": "the hybrid of before the change as it is, plus a linear map fitted to what it leaves over",
}
_MODES = {
    "fine_tuned": "trained on plenty of flight from before the change, then on N trajectories from after it",
    "target_only": "trained on the N trajectories from after the change only",
    "source_only": "trained on flight from before the change only",
}


def page(
    tables: Sequence[Table],
    experiment: str,
    rows: Sequence[Row],
    figures: Mapping[str, str],
    environment: Mapping[str, Any],
    config: str,
    notes: Sequence[str],
) -> str:
    """The Markdown of a report; `config` is JSON text, `figures` maps a relative path to a caption."""
    head = "\n\n".join([f"# {experiment}", *_what_was_run(experiment, rows), _measures(tables, rows)])
    return sections(head, tables, figures, notes, environment, config)


def sections(
    head: str,
    tables: Sequence[Table],
    figures: Mapping[str, str],
    notes: Sequence[str],
    environment: Mapping[str, Any],
    config: str,
) -> str:
    """A page of Markdown: its head, tables, figures, notes, where it was made and how."""
    parts = [head]
    for table in tables:
        parts += [f"## {_plain(table.title)}", _table(table)]
    if figures:
        captions = {path: _plain(caption) for path, caption in figures.items()}
        parts += ["## Figures", *(f"![{caption}]({path})\n\n*{caption}*" for path, caption in captions.items())]
    parts += ["## Notes", "\n".join(f"- {_plain(note)}" for note in notes)] if notes else []
    parts += ["## Where and how long", _table(_environment(environment))]
    parts += ["## Configuration", f"```json\n{config}\n```"]
    return "\n\n".join(parts) + "\n"


def _what_was_run(experiment: str, rows: Sequence[Row]) -> list[str]:
    question = f"{_QUESTIONS.get(experiment, '')} How well can a model that learned on flights from before the change "
    question += "predict flights after it, given a little new flight? The question and the protocol are those of "
    sizes = ", ".join(str(n) for n in sorted({row.n_train for row in rows} - {0})) or "none"
    domains = list(by_domain(rows))
    where = f" in each of {len(domains)} targets ({', '.join(NAMES[domain] for domain in domains)})"
    of = f"N of {sizes} target trajectories, {over_seeds(rows)} each{where if len(domains) > 1 else ''}"
    seen = {row.model for row in rows}, {row.mode for row in rows}
    names = [f"- **{NAMES[name]}**: {_MODELS[name]}" for name in _MODELS if name in seen[0]]
    names += [f"- **{NAMES[name]}**: {_MODES[name]}" for name in _MODES if name in seen[1]]
    return [f"{question.strip()} {_PAPER}.", f"{len(rows)} trained models: {of}.", "\n".join(names)]


def _measures(tables: Sequence[Table], rows: Sequence[Row]) -> str:
    """What the tables' letters mean."""
    error = (
        "L^T_MSE = (1/T) Σ_t ‖x_t − x̂_t‖² is the error on test flights from after the change, "
        "x̂ integrated from the window's first state with the recorded rotor speeds"
    )
    if not any("ρ" in table.title for table in tables):
        return f"{error}."
    rivals = ", or of the source-only hybrid for a method that adapts it" if {r.model for r in rows} & {*RIVALS} else ""
    gain = f"where L^S is the same error of the source-only model of the same seed{rivals}"
    return f"{error}; ρ = (L^S − L^T) / L^S, {gain}."


def _environment(environment: Mapping[str, Any]) -> Table:
    """Nested mappings as lines of a dotted name and a value."""
    return Table("", ("", ""), list(_flat(environment)))


def _flat(mapping: Mapping[str, Any], prefix: str = ""):
    for name, value in mapping.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{name}, ")
        else:
            shown = ", ".join(str(item) for item in value) if isinstance(value, list) else str(value)
            yield f"{prefix}{name}" + (" [s]" if prefix == "seconds, " else ""), shown


def _table(table: Table) -> str:
    lines = [table.header, ["---"] * len(table.header), *table.lines]
    return "\n".join(f"| {' | '.join(_plain(cell) for cell in line)} |" for line in lines)


def _plain(text: str) -> str:
    """Text that neither ends a table's cell nor a line."""
    return " ".join(text.replace("|", "\\|").split())
