"""The controller's problem in CasADi, solved to convergence by IPOPT with box constraints on the rotor speeds."""

import casadi as ca
import numpy as np

from hybrid_jax.control.controller import Controller


def product(a, b):
    """a ⊗ b."""
    return ca.vertcat(a[0] * b[0] - ca.dot(a[1:], b[1:]), a[0] * b[1:] + b[0] * a[1:] + ca.cross(a[1:], b[1:]))


def rigid_body(vehicle):
    """ẋ of a rigid body carried by four rotors, as a CasADi function."""
    x, u = ca.SX.sym("x", 13), ca.SX.sym("u", 4)
    q, v, w = x[3:7], x[7:10], x[10:13]
    thrust = vehicle.thrust_coefficient * u**2
    px, py = np.array(vehicle.rotor_positions).T
    reaction = vehicle.torque_coefficient * ca.dot(np.array(vehicle.spin), u**2)
    torque = ca.vertcat(ca.dot(py, thrust), -ca.dot(px, thrust), reaction)
    lift = product(product(q, ca.vertcat(0, 0, 0, ca.sum1(thrust))), ca.vertcat(q[0], -q[1:]))[1:]
    inertia = np.array(vehicle.inertia)
    spin_up = (torque - ca.cross(w, inertia * w)) / inertia
    acceleration = lift / vehicle.mass - ca.DM([0, 0, vehicle.gravity])
    return ca.Function("f", [x, u], [ca.vertcat(v, 0.5 * product(q, ca.vertcat(0, w)), acceleration, spin_up)])


def one_step(vehicle, dt):
    f = rigid_body(vehicle)
    x, u = ca.SX.sym("x", 13), ca.SX.sym("u", 4)
    k1 = f(x, u)
    k2 = f(x + dt / 2 * k1, u)
    k3 = f(x + dt / 2 * k2, u)
    k4 = f(x + dt * k3, u)
    end = x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    end[3:7] = end[3:7] / ca.norm_2(end[3:7])
    return ca.Function("step", [x, u], [end])


def deviations(reference, x, weights):
    """Weighted deviations, for attitude errors strictly between 0 and π."""
    error = product(ca.vertcat(reference[3], -reference[4:7]), x[3:7])
    error = ca.if_else(error[0] < 0, -error, error)
    sine = ca.sqrt(ca.sumsqr(error[1:]) + 1e-16)
    turn = 2 * ca.atan2(sine, error[0]) / sine * error[1:]
    scale = ca.DM([weights.tilt, weights.tilt, weights.yaw])
    away = x - reference
    return ca.vertcat(
        weights.position * away[:3], scale * turn, weights.velocity * away[7:10], weights.body_rates * away[10:]
    )


def best_cost(controller: Controller, reference, x0) -> tuple[float, np.ndarray]:
    """The least cost of a plan from x0, and its rotor speeds (t, 4) [rad/s], by multiple shooting."""
    vehicle, weights, n = controller.vehicle, controller.weights, controller.steps
    half = (vehicle.max_rotor_speed - controller.min_speed) / 2
    x, share = ca.SX.sym("x", 13, n), ca.SX.sym("s", 4, n)
    speeds = controller.min_speed + half * (1 + share)
    step = one_step(vehicle, controller.interval)
    cost, gaps, start = 0, [], ca.DM(x0)
    for k in range(n):
        gaps.append(x[:, k] - step(start, speeds[:, k]))
        start = x[:, k]
        factor = weights.terminal if k == n - 1 else 1.0
        cost += ca.sumsqr(factor * deviations(ca.DM(reference[k]), start, weights))
        cost += ca.sumsqr(weights.change * (share[:, k] - share[:, k - 1])) if k else 0
    problem = {"x": ca.veccat(x, share), "f": cost, "g": ca.vertcat(*gaps)}
    solver = ca.nlpsol("solver", "ipopt", problem, {"print_time": False, "ipopt": {"print_level": 0, "sb": "yes"}})
    size = x.numel()
    bounds = np.concatenate([np.full(size, np.inf), np.ones(share.numel())])
    guess = np.concatenate([np.tile(x0, n), np.full(share.numel(), vehicle.hover_speed / half - 1)])
    found = solver(x0=guess, lbx=-bounds, ubx=bounds, lbg=0, ubg=0)
    assert solver.stats()["success"], solver.stats()["return_status"]
    return float(found["f"]), controller.min_speed + half * (1 + np.array(found["x"][size:]).reshape(-1, 4))
