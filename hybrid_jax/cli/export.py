"""The verb `hybrid-jax export`: write a model as C, CasADi functions or StableHLO."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import equinox as eqx
import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
import tyro
from matplotlib.figure import Figure

from hybrid_jax import checks
from hybrid_jax.cli import page
from hybrid_jax.cli.command import step
from hybrid_jax.cli.help import RARE
from hybrid_jax.dynamics.actuators import Actuated
from hybrid_jax.dynamics.base import AbstractVectorField, state_space
from hybrid_jax.dynamics.disturbance import disturbance_of
from hybrid_jax.dynamics.rigid_body import RIGID_BODY_SPACE, vehicle_in
from hybrid_jax.estimation.least_squares import ravel_parameters
from hybrid_jax.export import casadi_function, export_adaptation_c, export_c, export_program
from hybrid_jax.export.program import sizes_of
from hybrid_jax.identification.learning import without_past
from hybrid_jax.integrate import rollout_batch
from hybrid_jax.io.models import load
from hybrid_jax.networks import smoothed
from hybrid_jax.networks.standardise import motion_of
from hybrid_jax.online import OnlineAdaptation
from hybrid_jax.vehicle import BODY_RATES, SENSOR_NOISE, STATE_SIZE, VELOCITY

__all__ = ["Options", "run"]
RESPONSE, FASTER = 0.2, 1.05  # of the figure: seconds, and factor on the speed of the first rotor
UNITS = "velocity [m/s]", "body rates [rad/s]"
PARTS = (3, 4, 3, 3)  # position, quaternion, velocity and body rates of a state
PROCESS = (0.0, 0.0, 0.003, 0.005)  # of a rigid body, as in docs/howto/online.md
FORCE, TORQUE = 3.0, 5.0  # standard deviations of a disturbance: m/s² and rad/s²
STATES = "x: position [m], quaternion w x y z, velocity [m/s], body rates [rad/s]; u: rotor speeds [rad/s]."
PAST = (
    "The model predicts its errors from earlier ones. Its state ends with {} filtered errors, which are 0 at first. "
    "You should then pass on what `observe` returns after each sample, for the state before, u and the sample."
)


@dataclass(frozen=True)
class Options:
    """Write a model's field ẋ = f(x, u), and a step x⁺ = F(x, u) of it, for other programs.

    A model with a past also gets `observe`, which returns the state after each sample, for you to pass on.

    c: NAME.h and NAME.c in C99, for a flight controller; and NAME_adaptation.h and NAME_adaptation.c, a filter that
    adapts the parameters of the physics in flight, if it has any. casadi: field.casadi and step.casadi for
    casadi.Function.load. stablehlo: field.npz and step.npz for hybrid_jax.export.load_program or JAX.
    """

    model: Annotated[Path, tyro.conf.Positional]
    """Model that `hybrid-jax fit` or `adapt` wrote. It may also be from an experiment, or from hybrid_jax.save."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder for the files."""
    to: tuple[Literal["c", "casadi", "stablehlo"], ...] = ("c",)
    """What to write, by default c. For example c,casadi."""
    name: str = "model"
    """Name of the C files and prefix of functions."""
    double: bool = False
    """C in double precision."""
    smooth: float | None = None
    """Replace ReLU by ½ (z + √(z² + 1/β²)) with this β. You should do so for solvers of optimal control problems, which
    converge with 5 but mostly not with 30: see docs/howto/solvers.md. The page shows how much ẋ changes."""
    dt: float | None = None
    """Length of a step [s]. By default the sample interval of the training flights."""
    out: Path = Path("runs/export")
    """Folder for report.html and report.json."""
    noise: Annotated[tuple[float, ...], RARE, tyro.conf.arg(name="noise-std")] = ()
    """Filter: standard deviation of the measurements: position [m], quaternion, velocity [m/s] and body rates
    [rad/s], by default 0.001 0.002 0.02 0.02; or one number for all states, or one for each. For other systems than a
    rigid body there is no default, and no filter without it. For other settings of the filter see docs/howto/c.md."""
    state_size: Annotated[int | None, RARE] = None
    """Size of x, if the model is not of a rigid body."""
    input_size: Annotated[int | None, RARE] = None
    """Size of u, if the model is not of a rigid body."""


def run(options: Options) -> int:
    model = load(options.model)
    field, dt = model.field, model.about.get("dt") if options.dt is None else options.dt
    if dt is None:
        raise ValueError(f"--dt is needed: {options.model} does not contain the sample interval of its flights")
    checks.positive(f"{options.model}: dt" if options.dt is None else "--dt", dt, "a positive number of seconds")
    if options.noise and "c" not in options.to:
        raise ValueError("--noise-std needs --to c: the filter is only written as C")
    if options.smooth is not None:
        checks.positive("--smooth", options.smooth)
    d, m = sizes_of(field, options.state_size, options.input_size)
    sizes: dict[str, Any] = {"state_size": d, "input_size": m}
    own: dict[str, Any] = sizes | {"smooth": options.smooth}
    alone, measured = without_past(field), d - field.hidden  # what the filter adapts
    learned: dict[str, Any] = {"state_size": measured, "input_size": m}
    programs = [("field", "f", None, {}), ("step", "F", dt, {})]
    programs += [("observe", "F", dt, {"observe": True})] * (alone is not field)
    meaning = [PAST.format(field.hidden)] * (alone is not field)
    adaptation = _filter(options, alone, dt, measured) if "c" in options.to else ""
    written: list[Path] = []
    with step(f"writing {', '.join(options.to)}"):
        if "c" in options.to:
            written += export_c(options.output, field, dt, name=options.name, double=options.double, **own)
        if isinstance(adaptation, OnlineAdaptation):
            name = f"{options.name}_adaptation"
            written += export_adaptation_c(options.output, adaptation, name=name, double=options.double, **learned)
            groups = ", ".join(dict.fromkeys(each.partition("[")[0] for each in adaptation.names))
            of = ", of the model without its past" * (alone is not field)
            meaning.append(f"{name} adapts {groups}{of}, with a sample every {adaptation.dt:g} s.")
        elif adaptation:
            meaning.append(f"No filter is written: {adaptation}.")
        for kind, letter, length, more in programs:
            if "stablehlo" in options.to:
                written.append(options.output / f"{kind}.npz")
                export_program(written[-1], field, length, about=model.about, **own, **more)
            if "casadi" in options.to:
                options.output.mkdir(parents=True, exist_ok=True)
                written.append(options.output / f"{kind}.casadi")
                casadi_function(field, length, name=letter, **own, **more).save(str(written[-1]))
    if options.smooth is not None:
        meaning.append(_change(alone, options.smooth))
    record = {"files": list(map(str, written)), "dt": dt}
    page.write(options.out, "export", _page(options, field, dt, written, meaning), record)
    return 0


def _page(
    options: Options, field: AbstractVectorField, dt: float, written: Sequence[Path], meaning: Sequence[str]
) -> page.Page:
    rigid = state_space(without_past(field)) == RIGID_BODY_SPACE and not isinstance(field, Actuated)
    rows = [(str(path), f"{path.stat().st_size / 1024:.0f} KB") for path in written]
    compiled = f"gcc -std=c99 -O2 -I{options.output} main.c {options.output / options.name}.c -lm"
    todo = [f"Compile it with yours: {compiled}. docs/howto/c.md has a program."] if "c" in options.to else []
    return page.Page(
        f"Which files run {options.model.name} elsewhere?",
        f"{len(written)} files in {options.output}: ẋ = f(x, u), and a step of {dt:g} s.",
        page.Table("Files", ("file", "size"), rows),
        _response(field, dt),
        [*([STATES] if rigid else []), *meaning],
        todo or ["docs/howto/export.md explains how to read them."],
    )


@mpl.rc_context(page.STYLE)
def _response(field: AbstractVectorField, dt: float) -> list[tuple[str, Figure]]:
    """Plot the response of a multirotor to a faster rotor, to compare with the files."""
    if (vehicle := vehicle_in(field)) is None or isinstance(field, Actuated):
        return []
    steps = max(2, round(RESPONSE / dt))
    x = jnp.zeros((1, STATE_SIZE + field.hidden)).at[0, jnp.array([2, 3])].set(1.0)
    u = jnp.full((1, steps, vehicle.rotors), vehicle.hover_speed).at[..., 0].multiply(FASTER)
    states = np.concatenate([x, rollout_batch(field, x, u, dt)[0]])
    figure = Figure(figsize=(6.0, 2.6), layout="constrained")
    for panel, part, name in zip(figure.subplots(1, 2), (VELOCITY, BODY_RATES), UNITS, strict=True):
        panel.plot(dt * np.arange(steps + 1), states[:, part], label=("x", "y", "z"))
        panel.set(xlabel="time [s]", ylabel=name)
        panel.legend()
    start = f"From rest at 1 m with {vehicle.hover_speed:.4g} rad/s, and the first rotor {FASTER - 1:.0%} faster"
    return [(f"{start}: the result of step", figure)]


def _filter(options: Options, field: AbstractVectorField, dt: float, d: int) -> OnlineAdaptation | str:
    """Make the filter, or return why there is none; ValueError if the noise does not match the model."""
    rigid = state_space(field) == RIGID_BODY_SPACE and d == STATE_SIZE
    try:
        ravel_parameters(field)
    except ValueError as error:  # it has no parameters
        if options.noise:
            raise
        return str(error)
    if not (noise := options.noise or SENSOR_NOISE * rigid):
        return "--noise-std must be given, because it has no default for this system"
    known = {1: 1, d: 1} | ({len(PARTS): PARTS} if d == STATE_SIZE else {})  # repeats of each number
    if len(noise) not in known:
        expected = f"1, {len(PARTS)} or {d}" if d == STATE_SIZE else f"1 or {d}"
        raise ValueError(f"--noise-std must be {expected} numbers, got {len(noise)}")
    field = field if options.smooth is None else smoothed(field, options.smooth)
    beyond, process = 0.0, 0.0
    if rigid:  # an adapted model may have a disturbance of some states only
        own = getattr(disturbance_of(field), "indices", None) or range(VELOCITY.start, STATE_SIZE)
        beyond = tuple(TORQUE if i >= BODY_RATES.start else FORCE for i in own)
        process = np.repeat(PROCESS, PARTS)
    noise = np.repeat(noise, known[len(noise)])
    return OnlineAdaptation(field, dt, noise, disturbance=beyond, process=process)


def _change(field: AbstractVectorField, beta: float) -> str:
    """Describe the largest difference in ẋ between the smooth field and the field."""
    if (motion := motion_of(field)) is None:
        return "The effect of smoothing on ẋ is unknown: the model has no training windows."
    columns = jnp.asarray(motion.x0.T), jnp.asarray(motion.u[:, 0].T)
    before, after = (np.asarray(eqx.filter_jit(one.infer_batch)(*columns)) for one in (field, smoothed(field, beta)))
    off = np.abs(after - before).max(axis=1)
    entry = int(off.argmax())
    change, rms = f"ẋ changes by at most {off[entry]:.2g}, in entry {entry}", np.sqrt(np.mean(np.square(before[entry])))
    return f"With smooth {beta:g}, {change}, whose RMS is {rms:.2g}, at {len(motion)} training states."
