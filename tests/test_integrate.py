"""Laws of trajectories under held inputs, in double precision."""

from functools import partial

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from choices import slow
from pendulum import pendulum

from hybrid_jax import IRIS, Hybrid, residual_network, rigid_body
from hybrid_jax.integrate import RK4, SOLVERS, integrate, rollout, rollout_batch
from hybrid_jax.metrics import predict
from hybrid_jax.training.loss import rollout_minibatch

pytestmark = pytest.mark.usefixtures("double_precision")  # laws hold to round-off

DT = 0.2
START = np.array([0.5, -1.0])
TORQUES = np.array([[3.0], [-40.0], [0.0], [25.0], [25.0]])  # jumps that a stage in the wrong interval would feel
FIELD = {"length": 0.7, "damping": 0.3}
# Without a state of its own, with a stage kept for the next step, and implicit.
IMPLICIT = diffrax.Kvaerno3(root_finder=diffrax.VeryChord(rtol=1e-10, atol=1e-10))
ODE_SOLVERS = (
    *("Euler", "Heun", "Midpoint", "Ralston", "Bosh3", "Tsit5", "Dopri5", "Dopri8", "ReversibleHeun"),
    *("ImplicitEuler", "Kvaerno3", "Kvaerno4", "Kvaerno5"),
)
OTHER_SOLVERS = ("EulerHeun", "ItoMilstein", "SEA", "SemiImplicitEuler", "KenCarp3", "ALIGN", "LeapfrogMidpoint")
STEPPERS = (RK4(), diffrax.Tsit5(), IMPLICIT)


@pytest.fixture(scope="module")
def reference(double_precision):
    """An adaptive solve of each interval by itself, good to 1e-12."""
    field = pendulum(**FIELD)

    @jax.jit
    def interval(x, held):
        term = diffrax.ODETerm(lambda t, x, held: field(x, held))
        size = diffrax.PIDController(rtol=1e-13, atol=1e-13)
        span, ends = (0.0, DT, 0.01), diffrax.SaveAt(t1=True)
        return diffrax.diffeqsolve(term, diffrax.Dopri8(), *span, x, held, stepsize_controller=size, saveat=ends).ys[0]

    x, path = jnp.asarray(START), []
    for held in jnp.asarray(TORQUES):
        x = interval(x, held)
        path.append(np.asarray(x))
    return np.array(path)


@eqx.filter_jit
def path_of(solver=None, substeps=1, torques=TORQUES, dt=DT):
    of = partial(integrate, substeps=substeps) if substeps > 1 else rollout
    return of(pendulum(**FIELD), jnp.asarray(START), jnp.asarray(torques), dt, solver)


@pytest.mark.parametrize(("name", "order"), [*zip(SOLVERS, (4, 2, 2, 5, 5), strict=True)])
def test_order_of_convergence_of_every_named_solver(name, order, reference):
    finer = np.array([4, 8, 16])
    paths = [path_of(SOLVERS[name], torques=np.repeat(TORQUES, n, axis=0), dt=DT / n)[n - 1 :: n] for n in finer]
    slope = -np.polyfit(np.log(finer), np.log([np.abs(path - reference).max() for path in paths]), 1)[0]
    # Higher orders still show at these steps; a lower one would fail by nearly 1.
    assert order - 0.3 < slope < order + 0.6


@pytest.mark.parametrize("name", ODE_SOLVERS)
def test_every_ode_solver_of_diffrax_converges_without_options(name, reference):
    coarse, fine = (np.abs(path_of(getattr(diffrax, name)(), n) - reference).max() for n in (16, 32))
    # First order halves the error, until the root finder's tolerance of 1e-10 shows.
    assert fine < max(0.6 * coarse, 1e-8)
    assert fine < 1  # of 8


@pytest.mark.parametrize("name", OTHER_SOLVERS)
def test_a_solver_for_other_equations_is_refused(name):
    with pytest.raises(ValueError, match=f"solver must be a one-step method for ODEs of one term, got {name}"):
        path_of(getattr(diffrax, name)())
    with pytest.raises(ValueError, match=r"one of diffrax or of hybrid_jax\.SOLVERS, got 'rk4'"):
        path_of("rk4")


@pytest.mark.parametrize("solver", STEPPERS, ids=lambda value: type(value).__name__)
def test_a_program_does_not_grow_with_its_substeps(solver):
    def size(substeps):
        traced = jax.make_jaxpr(lambda x0: integrate(pendulum(**FIELD), x0, jnp.asarray(TORQUES), DT, solver, substeps))
        return len(str(traced(jnp.asarray(START))).splitlines())

    assert abs(size(100) - size(2)) < 0.1 * size(1)  # lines are broken where names happen to be longer


@pytest.mark.parametrize("solver", [RK4(), *slow(*STEPPERS[1:])], ids=lambda value: type(value).__name__)
def test_substeps_and_their_gradient_are_those_of_steps_by_hand(solver):
    def by_hand(field):
        term, begin, end = diffrax.ODETerm(lambda t, x, held: field(x, held)), jnp.zeros(()), jnp.asarray(DT / 3)
        x = jnp.asarray(START)
        for held in jnp.asarray(TORQUES[:2]):
            state = solver.init(term, begin, end, x, held)
            for _ in range(3):
                x, _, _, state, _ = solver.step(term, begin, end, x, held, state, made_jump=False)
        return x.sum()

    def looped(field):
        return integrate(field, jnp.asarray(START), jnp.asarray(TORQUES[:2]), DT, solver, 3)[-1].sum()

    found, expected = (eqx.filter_jit(eqx.filter_value_and_grad(last))(pendulum(**FIELD)) for last in (looped, by_hand))
    np.testing.assert_allclose(*map(jax.tree.leaves, (found, expected)), rtol=1e-12)  # order of sums


def test_a_batch_is_a_loop_of_rollouts():
    x0, u = (jnp.asarray(np.random.default_rng(0).normal(size=size)) for size in ((4, 2), (4, 6, 1)))
    field = Hybrid(pendulum(), residual_network(2, 1, jax.random.key(0), hidden=5))
    together = rollout_batch(field, x0, u, DT)
    for i in range(4):
        np.testing.assert_allclose(together[i], rollout(field, x0[i], u[i], DT), rtol=0, atol=1e-13)  # order of sums
    # A field to which the batch means nothing is the same in training, features first.
    trained = rollout_minibatch(field.physics, x0.T, jnp.moveaxis(u, 0, -1), DT, RK4())
    alone = rollout_batch(field.physics, x0, u, DT)
    np.testing.assert_allclose(jnp.moveaxis(trained, -1, 0), alone, rtol=0, atol=1e-13)


def test_a_second_prediction_compiles_nothing():
    compiled = []

    def listen(name, seconds, **about):
        if name.endswith("backend_compile_duration"):
            compiled.append(about.get("fun_name"))

    def predict(length, seed):
        x0, u = (np.random.default_rng(seed).normal(size=shape) for shape in ((3, 2), (3, 4, 1)))
        return rollout_batch(pendulum(length), x0, u, DT), rollout(pendulum(length), x0[0], u[0], DT)

    predict(1.0, 0)
    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        many, one = predict(2.0, 1)
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
    assert not compiled
    np.testing.assert_allclose(many[0], one, rtol=1e-6)


def test_an_attitude_stays_one_however_long_it_turns():
    """RK4 shrinks the quaternion of a body that spins, to nothing after some thousand steps."""
    x0, u = np.eye(13)[3], np.tile(IRIS.hover_speed * np.array([1.0, 1.0, 0.9, 0.9]), (3000, 1))
    body = rigid_body(IRIS)
    flown = rollout(body, x0, u, 0.01)
    assert np.abs(flown[-1, 10:]).max() > 10  # rad/s
    np.testing.assert_allclose(np.linalg.norm(flown[:, 3:7], axis=1), 1, atol=1e-12)
    for many in (rollout_batch, predict):
        np.testing.assert_allclose(many(body, x0[None], u[None], 0.01)[0, :500], flown[:500], rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(rollout(body, x0, u[:500], 0.01), flown[:500], rtol=1e-6, atol=1e-6)


LAGGED = [np.random.default_rng(0).normal(size=size).astype(np.float32) for size in ((24, 1), (24, 10, 1))]


@pytest.mark.parametrize("name", ["ImplicitEuler", "Kvaerno5", *slow("Kvaerno3")])
def test_an_implicit_solver_solves_its_equations_or_says_that_it_did_not(name):
    """A state that follows the sine of a slow one, from a start beside it; a lag of 1 ms; one without a step."""

    def rolled(rate):
        def field(x, u):
            return jnp.stack([u[0] - 0.3 * x[0] - 0.1 * x[1] ** 2, rate * (jnp.sin(x[0]) - x[1])])

        return rollout(field, jnp.array([0.3, 0.3015]), jnp.full((2, 1), 0.1), 0.1, getattr(diffrax, name)())[-1]

    for rate in (3.6e4, 1e9):
        np.testing.assert_allclose(rolled(rate), (0.3002, 0.2957), atol=1e-3)
    beside = rollout_batch(lambda x, u: 1e4 * (jnp.sin(u) - x), *LAGGED, 0.1, getattr(diffrax, name)())
    assert jnp.isfinite(beside).all()
    at_rest = rollout_batch(lambda x, u: 1e3 * (u - x), *LAGGED, 0.01, getattr(diffrax, name)())
    assert jnp.isfinite(at_rest).all()  # the slope is there a difference of large numbers
    grown = rollout(lambda x, u: 1e3 + x**2, jnp.zeros(1), jnp.zeros((2, 1)), 0.1, getattr(diffrax, name)())
    assert jnp.isnan(grown).all()
