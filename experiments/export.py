"""Export a trained model to StableHLO files, CasADi functions and C: python -m experiments.export --help"""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Float

from experiments.runner import command
from hybrid_jax import AbstractVectorField, Model, checks, load, rotation
from hybrid_jax.dynamics.base import infer_batch
from hybrid_jax.export import casadi_function, casadi_step, export_c, export_field, export_step
from hybrid_jax.export.program import vehicle_in
from hybrid_jax.io.datasets import load_dataset
from hybrid_jax.networks import smoothed
from hybrid_jax.state import INPUT_SIZE, STATE_NAMES, STATE_SIZE

NAME = "export"
COUNT = 10_000  # states over which a smooth model is compared


@dataclass(frozen=True)
class Config:
    """Write the field ẋ = f(x, u) of a model, and a step x⁺ = F(x, u) of it, for programs outside this library.

    field.npz and step.npz: StableHLO, which hybrid_jax.export.load_program reads, or JAX alone. With --casadi also
    field.casadi and step.casadi, which casadi.Function.load reads. With --c a header and a source in C99, for a flight
    controller.
    """

    model: Annotated[Path, tyro.conf.Positional]
    """A file that an experiment wrote into its folder `models`, or hybrid_jax.save."""
    out: Path | None = None
    """Folder for the files of StableHLO and CasADi; by default runs/export, or, with --c, neither is written."""
    c: Path | None = None
    """Folder for NAME.h and NAME.c."""
    name: str = "model"
    """Name of the C files, and prefix of their functions."""
    double: bool = False
    """C in double precision."""
    smooth: float | None = None
    """Put ½ (z + √(z² + 1/β²)) with this β in the place of ReLU, as solvers of optimal control problems need it, and
    say how much ẋ changes. With 5 they converge where with 30 they mostly do not: see docs/howto/solvers.md."""
    data: Path | None = None
    """Data set over whose states and inputs the change is looked at; by default a box of states of a multirotor."""
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
    said = []
    if config.smooth is not None:
        checks.positive("--smooth", config.smooth)
        said = [_change(config, model.field, config.smooth)]
    sizes: dict[str, Any] = {"state_size": config.state_size, "input_size": config.input_size, "smooth": config.smooth}
    written: list[Path] = []
    if config.c is not None:
        checks.writable_folder("--c", config.c)
        written += export_c(config.c, model.field, dt, name=config.name, double=config.double, **sizes)
    if config.c is None or config.out is not None:
        written += _programs(config, model, dt, config.out or Path("runs/export"), sizes)
    print(*written, *said, sep="\n")


def _programs(config: Config, model: Model, dt: float, out: Path, sizes: dict[str, Any]) -> list[Path]:
    """Write those of StableHLO and CasADi."""
    checks.writable_folder("--out", out)
    options = sizes | {"batched": config.batched, "platforms": config.platforms, "about": model.about}
    written = [out / "field.npz", out / "step.npz"]
    export_field(written[0], model.field, **options)
    export_step(written[1], model.field, dt, **options)
    if config.casadi:
        functions = casadi_function(model.field, **sizes), casadi_step(model.field, dt, **sizes)
        for path, function in zip([path.with_suffix(".casadi") for path in written], functions, strict=True):
            function.save(str(path))
            written.append(path)
    return written


def _change(config: Config, field: AbstractVectorField, beta: float) -> str:
    """The largest difference in ẋ between the smooth field and the field, as a line."""
    where = "the box of states" if config.data is None else str(config.data)
    x, u = _box(field, config) if config.data is None else _states(config.data)
    columns = jnp.asarray(x.T), jnp.asarray(u.T)
    before, after = (np.asarray(eqx.filter_jit(infer_batch)(one, *columns)) for one in (field, smoothed(field, beta)))
    off = np.abs(after - before).max(axis=1)
    entry = int(off.argmax())
    named = STATE_NAMES[entry] if len(off) == STATE_SIZE else f"x[{entry}]"
    size = np.sqrt(np.mean(np.square(before[entry])))
    return f"smooth {beta:g}: ẋ differs by at most {off[entry]:.2g}, in {named}, of RMS {size:.2g}; {len(x)} of {where}"


def _states(path: Path) -> tuple[Float[np.ndarray, "n d"], Float[np.ndarray, "n m"]]:
    """Those at the start of the windows of a data set."""
    splits = load_dataset(path).splits.values()
    return np.concatenate([one.x0 for one in splits])[:COUNT], np.concatenate([one.u[:, 0] for one in splits])[:COUNT]


def _box(field: AbstractVectorField, config: Config) -> tuple[Float[np.ndarray, "n d"], Float[np.ndarray, "n m"]]:
    """States within 2 m of a place at 1.5 m, tilted by up to 45°, at any yaw, at up to 3 m/s and 3 rad/s for each axis,
    and rotor speeds of 0.7 … 1.3 times that of hover."""
    vehicle = vehicle_in(field)
    if (config.state_size, config.input_size) != (STATE_SIZE, INPUT_SIZE) or vehicle is None:
        raise ValueError("--data is needed with --smooth: the model is not of a multirotor whose states are known")
    rng = np.random.default_rng(0)
    tilt, axis, yaw = rng.uniform(0, np.pi / 4, COUNT), *rng.uniform(0, 2 * np.pi, (2, COUNT))
    lean = np.stack([np.cos(tilt / 2), *(np.sin(tilt / 2) * part for part in (np.cos(axis), np.sin(axis))), 0 * tilt])
    turn = np.stack([np.cos(yaw / 2), 0 * yaw, 0 * yaw, np.sin(yaw / 2)])
    q = np.asarray(rotation.multiply(jnp.asarray(turn), jnp.asarray(lean))).T
    position = rng.uniform(-1, 1, (COUNT, 3)) * [2, 2, 1.5] + [0, 0, 1.5]
    x = np.concatenate([position, q, rng.uniform(-3, 3, (COUNT, 6))], axis=1).astype(np.float32)
    return x, (vehicle.hover_speed * rng.uniform(0.7, 1.3, (COUNT, INPUT_SIZE))).astype(np.float32)


main = partial(command.call, NAME, Config, export)

if __name__ == "__main__":
    main()
