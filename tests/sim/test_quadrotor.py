"""Laws of the true vehicle's dynamics, and of the forces that the physics model does not know."""

import diffrax
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from systems import ODD

from experiments.flying.changes import gusty_wind
from hybrid_jax import IRIS, rigid_body
from hybrid_jax.rotation import conjugate, from_axis_angle, rotate
from hybrid_jax.rotation import derivative as quaternion_derivative
from hybrid_jax.sim.domain import Quadrotor
from hybrid_jax.sim.forces import drag, ground_effect, parameters_of, rotor_altitudes, thrust_gain, wind
from hybrid_jax.sim.scene import build_model

pytestmark = pytest.mark.usefixtures("double_precision")
ALL = (drag, ground_effect, wind)


def analytic(x, u, vehicle, force, torque):
    """Eq. 10, which tests/dynamics compares with matrices, with a wrench of the world added."""
    turned = rotate(conjugate(x[3:7]), torque) / jnp.array(vehicle.inertia)
    return rigid_body(vehicle, ())(x, u).at[7:10].add(force / vehicle.mass).at[10:].add(turned)


def quadrotor(vehicle, *forces):
    return Quadrotor(parameters_of(vehicle), forces)


def total_wrench(vehicle, x, u, t):
    wrenches = [force(x, u, t, parameters_of(vehicle)) for force in ALL]
    return (sum(part) for part in zip(*wrenches, strict=True))


@pytest.mark.parametrize("vehicle", [IRIS, ODD], ids=["iris", "odd"])
def test_mjx_is_newton_euler_and_c_mujoco(vehicle):
    rng, derivative = np.random.default_rng(7), jax.jit(Quadrotor.derivative)
    x = rng.normal(size=(8, 13)) * np.repeat([1, 1, 4, 3], [3, 4, 3, 3])  # fast, tilted flight above 0.3 m
    x[:, 2] = rng.uniform(0.3, 1.0, 8)
    x[:, 3:7] /= np.linalg.norm(x[:, 3:7], axis=1, keepdims=True)
    states = x, rng.uniform(200, 1000, (8, 4))
    model = build_model(vehicle)
    data = mujoco.MjData(model)
    for x, u in zip(*states, strict=True):
        slope = derivative(quadrotor(vehicle, *ALL), x, u, jnp.asarray(0.7))
        np.testing.assert_array_equal(slope[:3], x[7:10])
        turning = quaternion_derivative(jnp.asarray(x[3:7]), jnp.asarray(x[10:]))
        np.testing.assert_allclose(slope[3:7], turning, atol=1e-15)
        found = slope[7:]
        x, u = jnp.asarray(x), jnp.asarray(u)
        force, torque = total_wrench(vehicle, x, u, jnp.asarray(0.7))
        data.qpos, data.qvel, data.ctrl = x[:7], x[7:], u**2
        data.xfrc_applied[1] = np.concatenate([force, torque])
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(found, analytic(x, u, vehicle, force, torque)[7:], rtol=1e-13, atol=4e-13)
        np.testing.assert_allclose(found, data.qacc, rtol=1e-13, atol=4e-13)


def reference_flight(x0, u, t0, duration):
    """The analytic equations with all forces, integrated to 1e-12."""

    def slope(t, x, _):
        force, torque = total_wrench(IRIS, x, u, t)
        unit = x.at[3:7].set(x[3:7] / jnp.linalg.norm(x[3:7]))
        return analytic(unit, u, IRIS, force, torque).at[3:7].set(quaternion_derivative(x[3:7], x[10:]))

    term, control = diffrax.ODETerm(slope), diffrax.PIDController(rtol=1e-12, atol=1e-12)
    end = t0 + duration
    return diffrax.diffeqsolve(term, diffrax.Dopri8(), t0, end, 0.001, x0, stepsize_controller=control).ys[0]


def test_order_of_convergence_is_four():
    step = jax.jit(Quadrotor.step)
    x0 = hovering(0.35).at[7:13].set(jnp.array([2.0, -1.0, 0.4, 0.5, -0.8, 1.5]))
    u = jnp.array([650.0, 660.0, 655.0, 668.0])
    truth = jax.jit(reference_flight)(x0, u, 0.2, 0.4)
    errors = []
    for count in (10, 20, 40):
        x, dt = x0, 0.4 / count
        for i in range(count):
            x = step(quadrotor(IRIS, *ALL), x, u, jnp.asarray(0.2 + i * dt), dt)
        errors.append(float(jnp.abs(x - truth).max()))
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    np.testing.assert_allclose(orders, 4, atol=0.25)
    assert errors[-1] < 1e-7  # 0.4 s at dt = 0.01


T0 = jnp.asarray(0.0)
U = jnp.array([600.0, 650.0, 700.0, 620.0])


def hovering(altitude, tilt=0.0, axis=(1.0, 0.0, 0.0)):
    attitude = from_axis_angle(jnp.array(axis), jnp.asarray(tilt))
    return jnp.zeros(13).at[2].set(altitude).at[3:7].set(attitude)


@pytest.mark.parametrize(("altitude", "percent"), [(0.1, 11.41), (0.2, 2.63), (0.5, 0.411)])
def test_level_thrust_gains_what_cheeseman_and_bennett_say_and_no_more_below_half_a_radius(altitude, percent):
    wrench = ground_effect(hovering(altitude), U, T0, parameters_of(IRIS))
    free = IRIS.thrust_coefficient * float((U**2).sum())
    assert 100 * float(wrench.force[2]) / free == pytest.approx(percent, abs=0.005)
    np.testing.assert_array_equal(wrench.force[:2], 0)
    radius = jnp.asarray(IRIS.rotor_radius)
    gains = thrust_gain(jnp.array([0.5, 0.25, 0.1, 0.0, -3.0]) * radius, radius)
    np.testing.assert_allclose(gains, 4 / 3)


def test_a_tilted_rotor_has_its_own_altitude_and_its_push_turns_with_the_vehicle():
    tilted = hovering(0.3, tilt=0.5)  # about x: the left rotors (y > 0) rise
    altitudes = rotor_altitudes(tilted, parameters_of(IRIS).rotor_positions)
    np.testing.assert_allclose(altitudes, [0.3 + np.sin(0.5) * y for _, y in IRIS.rotor_positions])
    assert float(ground_effect(tilted, jnp.full(4, 650.0), T0, parameters_of(IRIS)).torque[0]) < -0.01
    u, above = jnp.array([600.0, 800.0, 800.0, 600.0]), (hovering(0.3), hovering(0.3, jnp.pi / 2, (0.0, 0.0, 1.0)))
    straight, turned = (ground_effect(x, u, T0, parameters_of(IRIS)).torque for x in above)
    assert float(jnp.abs(straight[0])) > 1e-2
    np.testing.assert_allclose(turned, [-straight[1], straight[0], straight[2]], atol=1e-15)


@pytest.mark.parametrize(("t", "force"), [(0.0, -4.0), (0.75, -3.0), (2.25, -5.0), (3.75, -3.0)])
def test_wind_blows_along_y_with_a_period_of_three_seconds(t, force):
    found = wind(hovering(1.0), U, jnp.asarray(t), parameters_of(IRIS)).force
    np.testing.assert_allclose(found, [0, force, 0], atol=1e-14)


def test_gusts_come_and_go_about_a_mean():
    times = jnp.linspace(0.0, 2000.0, 40_001)
    blown = jax.vmap(lambda t: gusty_wind(hovering(1.0), U, t, parameters_of(IRIS)).force)(times)
    np.testing.assert_allclose(blown.mean(axis=0), [2.0, -2.5, 0.6], atol=0.01)
    np.testing.assert_allclose(blown.std(axis=0), np.sqrt([0.445, 0.445, 0.065]), rtol=0.02)  # two sines each
