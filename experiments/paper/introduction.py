"""The introduction of a report for readers who have not seen the paper: the question, the models, the measures."""

from experiments.paper.claims import COMPARISON
from experiments.paper.lanes import BASELINES, by_domain
from experiments.reporting import names
from experiments.reporting.names import label
from experiments.reporting.results import Results
from experiments.reporting.tables import over_seeds

PAPER = "Osaka, Takeishi, Yairi, *Domain Adaptation with Hybrid Modeling for Learning Dynamical Systems*, ACML 2025"
QUESTIONS = {
    "param_shift": "A quadrotor's moments of inertia Ix and Iy have changed (Sec. 4.4 of the paper).",
    "external_force": "A wind now pushes the quadrotor: a steady force and a slow sine (Sec. 4.5 of the paper).",
    COMPARISON: "A quadrotor's moments of inertia have changed, or a wind pushes it; several methods adapt to each, "
    "tested on windows of 0.1 s (Sec. 4.7 and Table 2 of the paper, and baselines that the paper does not have).",
}
ABOUT = {
    names.HYBRID: "rigid-body physics f_p(x, u; θ_p) plus a small network f_d(x, u; θ_d), both trained",
    names.NO_PHYSICS: "the same network alone",
    names.PHYSICS_ONLY: "the rigid-body physics alone, its θ_p trained",
    names.EXPERT_AUGMENTATION: "the source's hybrid; an encoder estimates its θ_p from the flight's last states and "
    "inputs, trained on rollouts with random θ_p (Wehenkel et al., 2023)",
    names.THETA_P_ONLY: "the source's hybrid, of which only θ_p is trained on, by Adam",
    names.THETA_D_ONLY: "the source's hybrid, of which only the network is trained on, by Adam",
    names.LAST_LAYER: "the source's hybrid, of which only the network's last layer is refitted, by ridge regression, "
    "as in Neural-Fly",
    names.LEAST_SQUARES: "the source's hybrid, of which only θ_p is refitted, by nonlinear least squares "
    "(Levenberg–Marquardt)",
    names.CONSTANT_DISTURBANCE: "the source's hybrid, of which θ_p and a constant disturbance (six accelerations) are "
    "fitted by nonlinear least squares",
    names.LINEAR_RESIDUAL: "the source's hybrid, unchanged, plus a linear map fitted to its errors",
    names.FINE_TUNED: "trained on many flights from before the change, then on N trajectories from after it",
    names.TARGET_ONLY: "trained on the N trajectories from after the change only",
    names.SOURCE_ONLY: "trained on flights from before the change only",
}


def introduction(experiment: str, rows: Results) -> str:
    """Title and introduction of a report, Markdown."""
    domains = list(by_domain(rows))
    sizes = ", ".join(str(n) for n in sorted({*rows["n_train"]} - {0})) or "none"
    where = f" in each of {len(domains)} targets ({', '.join(map(label, domains))})" if len(domains) > 1 else ""
    seen = {*rows["model"], *rows["mode"]}
    baselines = ", or of the source-only hybrid for a method that adapts it" if seen & {*BASELINES} else ""
    parts = [
        f"# {experiment}",
        f"{QUESTIONS.get(experiment, '')} How well can a model trained on flights from before the change predict "
        f"flights after it, given a little new flight? Question and protocol are those of {PAPER}.",
        f"{len(rows)} trained models: N of {sizes} target trajectories, {over_seeds(rows)} each{where}.",
        "\n".join(f"- **{label(name)}**: {about}" for name, about in ABOUT.items() if name in seen),
        "L^T_MSE = (1/T) Σ_t ‖x_t − x̂_t‖² is the test MSE on flights from after the change, x̂ integrated from the "
        "window's first state with the recorded rotor speeds; ρ = (L^S − L^T) / L^S, where L^S is the same error of "
        f"the source-only model of the same seed{baselines}.",
    ]
    return "\n\n".join(parts)
