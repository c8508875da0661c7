"""report.md: a page that a reader who has not seen the paper understands."""

from collections.abc import Mapping, Sequence
from typing import Any

from hybrid_jax.report_tables import Table
from hybrid_jax.rows import NAMES, Row

_PAPER = "Osaka, Takeishi, Yairi, *Domain Adaptation with Hybrid Modeling for Learning Dynamical Systems*, ACML 2025"
_QUESTIONS = {
    "param_shift": "A quadrotor's moments of inertia Ix and Iy have changed (Sec. 4.4 of the paper).",
    "external_force": "A wind now pushes the quadrotor: a steady force and a slow sine (Sec. 4.5 of the paper).",
}
_MODELS = {
    "hybrid": "rigid-body physics f_p(x, u; θ_p) plus a small network f_d(x, u; θ_d), both trained",
    "no_physics": "the same network alone",
    "physics_only": "the rigid-body physics alone, its θ_p trained",
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
    parts = [f"# {experiment}", *_what_was_run(experiment, rows)]
    for table in tables:
        parts += [f"## {_plain(table.title)}", _table(table)]
    if figures:
        captions = {path: _plain(caption) for path, caption in figures.items()}
        parts += ["## Figures", *(f"![{caption}]({path})\n\n*{caption}*" for path, caption in captions.items())]
    parts += ["## Notes", "\n".join(f"- {_plain(note)}" for note in notes)]
    parts += ["## Where and how long", _table(_environment(environment))]
    parts += ["## Configuration", f"```json\n{config}\n```"]
    return "\n\n".join(parts) + "\n"


def _what_was_run(experiment: str, rows: Sequence[Row]) -> list[str]:
    question = f"{_QUESTIONS.get(experiment, '')} How well can a model that learned on flights from before the change "
    question += "predict flights after it, given a little new flight? The question and the protocol are those of "
    sizes = ", ".join(str(n) for n in sorted({row.n_train for row in rows} - {0})) or "none"
    run = f"{len(rows)} trained models: N of {sizes} target trajectories, {len({row.seed for row in rows})} seeds each."
    seen = {row.model for row in rows}, {row.mode for row in rows}
    names = [f"- **{NAMES[name]}**: {_MODELS[name]}" for name in _MODELS if name in seen[0]]
    names += [f"- **{NAMES[name]}**: {_MODES[name]}" for name in _MODES if name in seen[1]]
    measure = (
        "L^T_MSE = (1/T) Σ_t ‖x_t − x̂_t‖² is the error on test flights from after the change, "
        "x̂ integrated from the window's first state with the recorded rotor speeds; "
        "ρ = (L^S − L^T) / L^S, where L^S is the same error of the source-only model of the same seed."
    )
    return [f"{question.strip()} {_PAPER}.", run, "\n".join(names), measure]


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
