"""Export a trained model to StableHLO files and CasADi functions: python -m experiments.export --help"""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from experiments.runner import command
from hybrid_jax import checks, load
from hybrid_jax.export import casadi_function, casadi_step, export_field, export_step
from hybrid_jax.state import INPUT_SIZE, STATE_SIZE

NAME = "export"


@dataclass(frozen=True)
class Config:
    """Write the field ẋ = f(x, u) of a model, and a step x⁺ = F(x, u) of it, for programs outside this library.

    field.npz and step.npz: StableHLO, which hybrid_jax.export.load_program reads, or JAX alone. With --casadi also
    field.casadi and step.casadi, which casadi.Function.load reads.
    """

    model: Annotated[Path, tyro.conf.Positional]
    """A file that an experiment wrote into its folder `models`, or hybrid_jax.save."""
    out: Path = Path("runs/export")
    """Folder for the files."""
    dt: float | None = None
    """Length of a step [s]; by default that of the flights that the model was trained on."""
    batched: bool = False
    """The programs take x (b, 13) and u (b, 4), for any b, instead of x (13,) and u (4,)."""
    platforms: tuple[Literal["cpu", "cuda", "rocm", "tpu"], ...] = ("cpu",)
    """Platforms to compile for."""
    casadi: bool = False
    """Write CasADi functions as well."""
    state_size: int = STATE_SIZE
    """Size of x, for a model of another system."""
    input_size: int = INPUT_SIZE
    """Size of u, likewise."""


def export(config: Config) -> None:
    model = load(config.model)
    dt = model.about.get("dt") if config.dt is None else config.dt
    if dt is None:
        raise ValueError(f"--dt is needed: {config.model} does not say how long the steps of its flights were")
    checks.positive(f"{config.model}: dt" if config.dt is None else "--dt", dt, "a positive number of seconds")
    checks.writable_folder("--out", config.out)
    sizes: dict[str, Any] = {"state_size": config.state_size, "input_size": config.input_size}
    options = sizes | {"batched": config.batched, "platforms": config.platforms, "about": model.about}
    written = [config.out / "field.npz", config.out / "step.npz"]
    export_field(written[0], model.field, **options)
    export_step(written[1], model.field, dt, **options)
    if config.casadi:
        functions = casadi_function(model.field, **sizes), casadi_step(model.field, dt, **sizes)
        for path, function in zip([path.with_suffix(".casadi") for path in written], functions, strict=True):
            function.save(str(path))
            written.append(path)
    print(*written, sep="\n")


main = partial(command.call, NAME, Config, export)

if __name__ == "__main__":
    main()
