"""How long does a gradient step of a field on a grid take, against PyTorch with torchdiffeq, on one core?

The step is that of grids.py. The rival convolves with circular padding and integrates all intervals by one call of
torchdiffeq's rk4, the 3/8 rule, of the same cost and order as ours. Loss and gradient must agree.
"""

# PyTorch is of the extra `peers`.
# pyright: reportMissingImports=false

from functools import partial
from typing import Any

import numpy as np
from rich.markup import escape

from benchmarks.grids import AGREEMENT, DT, PRESETS, RATE, SUBSTEPS, Preset, subject
from benchmarks.peers import installed, keep_to_one_core, skipped
from benchmarks.timing import Call, Findings, Ratio, agree, compiled, in_turns, run, table
from hybrid_jax.training.fitting import gradient_step

RIVAL, TITLE = "PyTorch, torchdiffeq, on a grid", "a step on a grid, one core"


def our_moments(adam: Any) -> dict[str, Any]:
    """Adam's first moment of each parameter of the hybrid."""
    network = adam.mu.residual.network
    moments = {"log_diffusivity": adam.mu.physics.log_diffusivity, "bias_in": network.norm.shift}
    return moments | {name: getattr(network, name) for name in ("weight_in", "weight_out", "bias_out")}


def rival_step(field: Any, windows: Any) -> tuple[Call, dict[str, Any]]:
    """A step of PyTorch from the same parameters, and what the first one came to."""
    import torch
    from torchdiffeq import odeint

    from benchmarks.torch_rivals import GridHybrid, tensor

    torch.set_num_threads(1)
    grid, model = field.physics.grid, GridHybrid(field)
    shape = -1, grid.components, *grid.shape
    x0, x = tensor(windows.x0).reshape(shape), tensor(windows.x).reshape(len(windows), *shape)
    times = DT * torch.arange(windows.horizon + 1)
    adam = torch.optim.Adam(model.parameters(), lr=RATE, fused=True)

    def step() -> torch.Tensor:
        adam.zero_grad()
        states: Any = odeint(model, x0, times, method="rk4", options={"step_size": DT / SUBSTEPS})
        loss = (states[1:].swapaxes(0, 1) - x).square().sum(dim=(2, 3, 4)).mean()
        loss.backward()
        adam.step()
        return loss.detach()

    return step, {"loss": np.array(step()), "first_moment": model.moments(adam)}


def measured(kernel: int, preset: Preset) -> dict[str, Any]:
    field, adam, plan, windows, settings = subject(kernel, preset)
    ours = compiled(partial(gradient_step, settings=settings), field, adam, plan, windows)[0]
    _, our_adam, loss = ours()
    theirs, found = rival_step(field, windows)
    own = {"loss": loss, "first_moment": our_moments(our_adam)}
    difference = agree(f"steps of kernel {kernel}", own, found, AGREEMENT)
    times = in_turns({"ours": ours, RIVAL: theirs}, preset.turns)
    seconds = {name: times.median(name) for name in ("ours", RIVAL)}
    ratio = times.ratio(RIVAL, "ours")
    return {"program": RIVAL, "kernel": kernel, "difference": difference, "seconds": seconds, "times_ours": ratio}


COLUMNS = {
    "kernel": lambda row: str(row["kernel"]),
    "ours [ms]": lambda row: f"{1e3 * row['seconds']['ours']:.1f}",
    "torchdiffeq [ms]": lambda row: f"{1e3 * row['seconds'][RIVAL]:.1f}",
    "× ours": lambda row: f"{row['times_ours']:.1f}",
    "differs by": lambda row: f"{row['difference']:.0e}",
}


def measure(preset: Preset) -> Findings:
    """A pointwise network and a convolution, if the rival is here."""
    if not installed("torch", "torchdiffeq"):
        row = skipped(RIVAL)
        return Findings([row], [table(TITLE, [row], {row["rival"]: lambda row: escape(row["skipped"])})])
    rows = [measured(kernel, preset) for kernel in preset.kernels]
    ratios = [Ratio(f"{RIVAL} / ours, kernel {row['kernel']}", row["times_ours"]) for row in rows]
    return Findings(rows, [table(TITLE, rows, COLUMNS)], ratios)


if __name__ == "__main__":
    keep_to_one_core()
    run("grid_peers", __doc__, PRESETS, measure)
