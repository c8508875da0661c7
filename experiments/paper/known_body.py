"""How often the intervals of θ_p contain the truth for a known rigid body without a network."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray
from rich.console import Console

from experiments.paper.conditions import Noise, measure
from experiments.reporting.results import Results
from experiments.reporting.tables import Table, tabulate
from experiments.runner.progress import Line
from hybrid_jax import rotation
from hybrid_jax.dynamics.base import AbstractVectorField
from hybrid_jax.dynamics.rigid_body import LEARNED, RigidBody, nominal, rigid_body
from hybrid_jax.estimation import covariance_of, fit_least_squares, intervals
from hybrid_jax.integrate import rollout_batch
from hybrid_jax.runtime import FASTEST_COMPILE, jit_with
from hybrid_jax.trajectories import Trajectories
from hybrid_jax.vehicle import IRIS, VELOCITY

DT, STEPS, WINDOWS = 0.01, 10, 100  # s, intervals in a window, windows in a recording
TRUTH = {"Ix": 0.04, "Iy": 0.02, "k": IRIS.thrust_coefficient}  # SI: the paper's changed inertia
DRAG = 0.4  # kg/s, that the model does not know: v̇ −= drag v / m
NOISE_ON = ("targets", "all")  # the start of a window is known exactly, as the fit takes it to be; or measured as well
SPEED = np.array([2.0, 2.0, 2 / 3])  # m/s: standard deviations about hover, here and below
TILT = 0.1  # rad, about each axis, in addition to the lean that balances the drag in steady flight
BODY_RATES = 1.0  # rad/s
ROTOR_SPEED = 40.0  # rad/s, of each rotor, drawn anew in each interval


class Dragged(AbstractVectorField):
    """A rigid body with linear drag: v̇ −= c v / m."""

    body: RigidBody
    drag: Float[Array, ""]  # kg/s

    def __call__(self, x, u):
        return self.body(x, u).at[VELOCITY].add(-self.drag / self.body.vehicle.mass * x[VELOCITY])


def coverage(repeats: int, console: Console) -> Results:
    """Return a row for each parameter with exact physics and with unknown drag, with noise on targets and on all.

    Shares; bias and half-width in % of the truth. A repeat that did not converge is a miss.
    """
    cases = list(itertools.product({"exact physics": 0.0, "unknown drag": DRAG}.items(), NOISE_ON))
    keys, rows = jax.random.split(jax.random.key(0), repeats), []
    with Line("coverage, known body", console) as line:
        for done, ((case, drag), noise_on) in enumerate(cases, 1):
            # One repeat at a time: between two of them interrupts are handled.
            each = [jax.device_get(_repeat(jnp.array(noise_on == "all"), jnp.asarray(drag), key)) for key in keys]
            line.show_parts(done, len(cases))
            found = jax.tree.map(lambda *parts: np.stack(parts), *each)
            share = found["inside"].mean(axis=0)
            columns = {
                "coverage": share,
                "standard_error": np.sqrt(share * (1 - share) / repeats),
                "bias": 100 * found["error"].mean(axis=0),
                "half_width": 100 * found["half_width"].mean(axis=0),
                "converged": np.full(len(LEARNED), found["converged"].mean()),
            }
            rows += [
                {"case": case, "noise_on": noise_on, "parameter": parameter}
                | {name: float(column[i]) for name, column in columns.items()}
                for i, parameter in enumerate(LEARNED)
            ]
    return Results(rows, ("case", "noise_on", "parameter"))


def recording(start_is_measured: Bool[Array, ""], drag: Float[Array, ""], key: PRNGKeyArray) -> Trajectories:
    start_key, input_key, x0_key, x_key = jax.random.split(key, 4)
    x0, noise = starts(start_key), Noise()
    u = IRIS.hover_speed + ROTOR_SPEED * jax.random.normal(input_key, (WINDOWS, STEPS, 4))
    truth = RigidBody({name: jnp.log(TRUTH[name] / value) for name, value in nominal(IRIS).items()}, IRIS)
    x = rollout_batch(Dragged(truth, drag), x0, u, DT)
    start = jnp.where(start_is_measured, measure(x0, noise, x0_key), x0)
    return Trajectories(start, u, measure(x, noise, x_key), DT)


def starts(key: PRNGKeyArray) -> Float[Array, "n 13"]:
    """Draw random states near hover, leaning by c v / (m g) [rad] so that thrust balances drag, as in steady flight."""
    velocity_key, tilt_key, rates_key = jax.random.split(key, 3)
    v = jax.random.normal(velocity_key, (WINDOWS, 3)) * jnp.asarray(SPEED)
    lean = DRAG / (IRIS.mass * IRIS.gravity) * jnp.stack([-v[:, 1], v[:, 0]], axis=1)
    half = (lean + TILT * jax.random.normal(tilt_key, lean.shape)) / 2
    q = rotation.normalise(jnp.pad(half, ((0, 0), (1, 1)), constant_values=((0, 0), (1.0, 0.0))))
    omega = BODY_RATES * jax.random.normal(rates_key, v.shape)
    return jnp.concatenate([jnp.zeros_like(v), q, v, omega], axis=1)


@jit_with(FASTEST_COMPILE)
def _repeat(start_is_measured: Bool[Array, ""], drag: Float[Array, ""], key: PRNGKeyArray) -> dict[str, Array]:
    windows = recording(start_is_measured, drag, key)
    found = fit_least_squares(rigid_body(IRIS), windows)
    around = intervals(found.field, covariance_of(found.field, windows), 0.95)
    value, low, high = (jnp.stack(side) for side in zip(*(around[name] for name in LEARNED), strict=True))
    true = jnp.array([TRUTH[name] for name in LEARNED])
    inside = (low <= true) & (true <= high) & found.converged
    errors = {"error": value / true - 1, "half_width": (high - low) / (2 * true)}
    return errors | {"inside": inside, "converged": found.converged}


def known_body_table(rows: Results) -> Table:
    columns = {
        "coverage [%]": lambda r: f"{100 * r[0]['coverage']:.1f} ± {100 * r[0]['standard_error']:.1f}",
        "bias [%]": lambda r: f"{r[0]['bias']:+.2f}",
        "half-width [%]": lambda r: f"{r[0]['half_width']:.2f}",
        "converged [%]": lambda r: f"{100 * r[0]['converged']:.0f}",
    }
    title = "A known rigid body: does the 95 % interval contain the truth?"
    return tabulate(title, rows.group("case", "noise_on", "parameter"), columns, ("truth", "noise on", "θ_p"))
