"""Export a trained model to StableHLO files, CasADi functions and C: python -m experiments.export --help"""

from dataclasses import astuple, dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Float

from experiments.paper.conditions import Noise
from experiments.runner import command
from experiments.runner.options import NotNegative, Positive, check_numbers
from hybrid_jax import AbstractVectorField, Model, OnlineAdaptation, checks, load, rotation
from hybrid_jax.dynamics.base import state_space
from hybrid_jax.dynamics.rigid_body import RIGID_BODY_SPACE
from hybrid_jax.estimation.least_squares import ravel_parameters
from hybrid_jax.estimation.uncertainty import named_parameters
from hybrid_jax.export import (
    casadi_function,
    casadi_step,
    export_adaptation_c,
    export_c,
    export_program,
)
from hybrid_jax.export.program import sizes_of, vehicle_in
from hybrid_jax.io.datasets import load_dataset
from hybrid_jax.networks import smoothed
from hybrid_jax.state import INPUT_SIZE, STATE_SIZE

NAME = "export"
COUNT = 10_000  # states over which a smooth model is compared
PARTS = (3, 4, 3, 3)  # position, quaternion, velocity and body rates of a state
# Of a rigid body, as in docs/howto/online.md; the noise is that of motion capture and a gyroscope.
PROCESS = (0.0, 0.0, 0.003, 0.005)
PRIOR, DISTURBANCE = 0.3, (3.0, 3.0, 3.0, 5.0, 5.0, 5.0)


@dataclass(frozen=True)
class Adaptation:
    """The filter that --c writes as well, if the physics of the model has parameters; see docs/howto/online.md."""

    period: Positive | None = None
    """Time between two samples [s]; by default the length of a step."""
    noise: tuple[Positive, ...] = ()
    """Standard deviation of what is measured: position [m], quaternion, velocity [m/s] and body rates [rad/s], by
    default 0.001 0.002 0.02 0.02; or one number for all states, or one for each. A system other than a rigid body has
    no default, and no filter without it."""
    process: tuple[NotNegative, ...] = ()
    """What the model leaves out of the derivatives of these states, as white noise [1/sqrt(s)]; by default
    0 0 0.003 0.005 for a rigid body, else 0."""
    prior: tuple[str, ...] = ()
    """By how much each parameter may change, as a standard deviation (of a rigid body mostly of its logarithm): one
    number for all, or words such as Ix=0.3 k=0.2; 0.3 where nothing is said."""
    disturbance: tuple[NotNegative, ...] = ()
    """By how much a constant disturbance of a rigid body may change, likewise: three accelerations [m/s^2] and three
    angular ones [rad/s^2], by default 3 3 3 5 5 5, or one number for all; 0: there is none."""


@dataclass(frozen=True)
class Config:
    """Write the field ẋ = f(x, u) of a model, and a step x⁺ = F(x, u) of it, for programs outside this library.

    field.npz and step.npz: StableHLO, which hybrid_jax.export.load_program reads, or JAX alone. With --casadi also
    field.casadi and step.casadi, which casadi.Function.load reads. With --c a header and a source in C99, for a flight
    controller, and if the physics has parameters NAME_adaptation.h and NAME_adaptation.c: a filter that adapts them
    while the system runs (--adaptation.*).
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
    adaptation: Adaptation = field(default_factory=Adaptation)
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
    sizes: dict[str, Any] = {"state_size": config.state_size, "input_size": config.input_size}
    options: dict[str, Any] = sizes | {"smooth": config.smooth}
    written: list[Path] = []
    if config.c is None and config.adaptation != Adaptation():
        raise ValueError("--adaptation needs --c: it is written as C alone")
    if config.c is not None:
        online = _adaptation(config, model.field, dt)
        checks.writable_folder("--c", config.c)
        written += export_c(config.c, model.field, dt, name=config.name, double=config.double, **options)
        if isinstance(online, str):
            said.append(f"no filter is written: {online}")
        else:
            name = f"{config.name}_adaptation"
            written += export_adaptation_c(config.c, online, name=name, double=config.double, **sizes)
            said.append(f"{name} adapts {', '.join(online.names)}, with a sample every {online.dt:g} s")
    if config.c is None or config.out is not None:
        written += _programs(config, model, dt, config.out or Path("runs/export"), options)
    print(*written, *said, sep="\n")


def _adaptation(config: Config, field: AbstractVectorField, dt: float) -> OnlineAdaptation | str:
    """The filter, or why there is none; ValueError for options that do not fit the model."""
    options, rigid = config.adaptation, state_space(field) == RIGID_BODY_SPACE
    check_numbers("--adaptation.", options)
    try:
        ravel_parameters(field)
    except ValueError as error:  # it has no parameters
        if options != Adaptation():
            raise
        return str(error)
    d = sizes_of(field, config.state_size, config.input_size)[0]
    default = options.noise or (astuple(Noise()) if rigid else ())
    if not default:
        return "--adaptation.noise must say how exactly the states are measured"
    noise, process = (
        _of_states("noise", default, d),
        _of_states("process", options.process or PROCESS * rigid or (0,), d),
    )
    if options.disturbance and not rigid:
        raise ValueError("--adaptation.disturbance is that of a rigid body, and the model is none")
    disturbance = options.disturbance or DISTURBANCE * rigid
    if len(disturbance) not in (0, 1, 6):
        raise ValueError(f"--adaptation.disturbance must be 1 or 6 numbers, got {len(disturbance)}")
    beyond = disturbance if any(disturbance) else 0.0
    field = field if config.smooth is None else smoothed(field, config.smooth)
    prior = _prior(options.prior, field)
    return OnlineAdaptation(field, options.period or dt, noise, prior, beyond, process=process)


def _of_states(name: str, numbers: tuple[float, ...], d: int) -> tuple[float, ...]:
    """A number for each of d states, or one for all."""
    if len(numbers) in (1, d):
        return numbers
    if d == STATE_SIZE and len(numbers) == len(PARTS):
        return tuple(np.repeat(numbers, PARTS).tolist())
    expected = f"1, {len(PARTS)} or {d}" if d == STATE_SIZE else f"1 or {d}"
    raise ValueError(f"--adaptation.{name} must be {expected} numbers, got {len(numbers)}")


def _prior(words: tuple[str, ...], field: AbstractVectorField) -> float | dict[str, float]:
    """The standard deviation of each parameter; ValueError for a word that is not NAME=NUMBER."""
    try:
        if len(words) == 1 and "=" not in words[0]:
            return float(words[0])
        named = {name: float(value) for name, value in (word.split("=") for word in words)}
    except ValueError:
        got = " ".join(words)
        raise ValueError(f"--adaptation.prior must be a number, or words such as Ix=0.3, got {got}") from None
    groups = {name.partition("[")[0] for name in named_parameters(field)} - {"disturbance"}
    return dict.fromkeys(groups, PRIOR) | named


def _programs(config: Config, model: Model, dt: float, out: Path, own: dict[str, Any]) -> list[Path]:
    """Write those of StableHLO and CasADi."""
    checks.writable_folder("--out", out)
    options = own | {"batched": config.batched, "platforms": config.platforms, "about": model.about}
    written = [out / "field.npz", out / "step.npz"]
    export_program(written[0], model.field, **options)
    export_program(written[1], model.field, dt, **options)
    if config.casadi:
        functions = casadi_function(model.field, **own), casadi_step(model.field, dt, **own)
        for path, function in zip([path.with_suffix(".casadi") for path in written], functions, strict=True):
            function.save(str(path))
            written.append(path)
    return written


def _change(config: Config, field: AbstractVectorField, beta: float) -> str:
    """The largest difference in ẋ between the smooth field and the field, as a line."""
    where = "the box of states" if config.data is None else str(config.data)
    x, u = _box(field, config) if config.data is None else _states(config.data)
    columns = jnp.asarray(x.T), jnp.asarray(u.T)
    before, after = (np.asarray(eqx.filter_jit(one.infer_batch)(*columns)) for one in (field, smoothed(field, beta)))
    off = np.abs(after - before).max(axis=1)
    entry = int(off.argmax())
    named = state_space(field, len(off)).names[entry]
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
