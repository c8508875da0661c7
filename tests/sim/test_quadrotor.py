"""Laws of the true vehicle's dynamics."""

import diffrax
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from systems import ODD

from hybrid_jax import IRIS, rigid_body
from hybrid_jax.rotation import conjugate, rotate
from hybrid_jax.rotation import derivative as quaternion_derivative
from hybrid_jax.sim.domain import Quadrotor
from hybrid_jax.sim.forces import drag, ground_effect, parameters_of, wind
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


def at_rest(altitude=5.0):
    return jnp.zeros(13).at[2].set(altitude).at[3].set(1.0)


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
    x0 = at_rest(0.35).at[7:13].set(jnp.array([2.0, -1.0, 0.4, 0.5, -0.8, 1.5]))
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
