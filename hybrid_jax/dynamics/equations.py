"""Equations of motion of a multirotor on the entries of θ_p, x and u, without stacking them; see `rigid_body`."""

from collections.abc import Callable, Container
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from hybrid_jax import rotation
from hybrid_jax.dynamics.terms import OF_AIR, Terms, nominal_values
from hybrid_jax.rotation import Rows
from hybrid_jax.vehicle import BODY_RATES, QUATERNION, VELOCITY, Vehicle

Constants = dict[str, Rows | tuple[float, ...]]  # name → entries: numbers if known, arrays if learned


def derivative(vehicle: Vehicle, terms: Terms, theta: dict[str, Rows], x: Rows, u: Rows) -> Float[Array, " 13 *b"]:
    """Return ẋ of a multirotor with learned parameters θ_p. Terms that are neither learned nor present cost nothing."""
    constants = _loaded(nominal_values(vehicle, terms) | theta)
    q, v, omega = x[QUATERNION], x[VELOCITY], x[BODY_RATES]
    thrust, torque = _wrench(vehicle, constants, u)
    gravity = jnp.reshape(jnp.array([0.0, 0.0, -vehicle.gravity], jnp.result_type(thrust)), (3,) + (1,) * thrust.ndim)
    attitude = rotation.matrix(q)
    acceleration = (thrust / constants["mass"][0]) * jnp.stack([row[2] for row in attitude]) + gravity
    velocity = [dot(column, v) for column in zip(*attitude, strict=True)]
    air = velocity
    if is_present(wind := constants["wind"]):
        relative = [part - one for part, one in zip(v, wind, strict=True)]
        air = [dot(column, relative) for column in zip(*attitude, strict=True)]
    force = _specific_force(constants, air, torque)
    for name, at_hubs in (("rotor_drag", _rotor_drag), ("translational_lift", _translational_lift)):
        if is_present(constants[name]):
            of_rotors, moment = at_hubs(vehicle, constants, air, omega, u)
            force = [one + part / constants["mass"][0] for one, part in zip(force, of_rotors, strict=True)]
            torque = [one + part for one, part in zip(torque, moment, strict=True)]
    faster = _velocity_error(constants, velocity, force)
    turning = rotation.derivative(q, omega)
    if is_present(moment := constants["aerodynamic_moment"]):
        torque = [part + dot(moment[3 * i : 3 * i + 3], air) for i, part in enumerate(torque)]
    if is_present(damping := constants["rate_damping"]):
        torque = [part - one * rate for part, one, rate in zip(torque, damping, omega, strict=True)]
    inertia = [constants[name][0] for name in ("Ix", "Iy", "Iz")]
    position = jnp.stack(v)
    if is_present(faster):
        position = position + in_world(attitude, faster)
    if is_present(force):
        acceleration = acceleration + in_world(attitude, force)
    return jnp.concatenate([position, turning, acceleration, _euler(inertia, torque, omega)])


def _loaded(constants: Constants) -> Constants:
    """Return the constants with the mass and the centre of mass of a load added."""
    changed: dict[str, Any] = {}
    if is_present(ratio := constants["mass_ratio"], absent=1.0):
        changed["mass"] = (ratio[0] * constants["mass"][0],)
    if is_present(shift := constants["centre_shift"]):
        pairs = zip(constants["centre_of_mass"], shift, strict=True)
        changed["centre_of_mass"] = tuple(one + other for one, other in pairs)
    return constants | changed


def _wrench(vehicle: Vehicle, constants: Constants, u: Rows):
    """Return the total thrust [N] and torque [N m] of the rotors about the centre of mass."""
    squares, efficiency = [speed * speed for speed in u], constants["efficiency"]
    if is_present(efficiency, absent=1.0):
        squares = [share * square for share, square in zip(efficiency, squares, strict=True)]
    (k,), of_rotors, gain = constants["k"], constants["k_rotors"], constants["torque_gain"]
    if isinstance(of_rotors[0], int | float):
        loads = squares
    else:
        k, loads = 1.0, [one * square for one, square in zip(of_rotors, squares, strict=True)]
    total = sum(loads[1:], loads[0])
    x, y = (dot(arms, loads) for arms in zip(*vehicle.rotor_positions, strict=True))
    if is_present(constants["centre_of_mass"]):
        x, y = (moment - offset * total for moment, offset in zip((x, y), constants["centre_of_mass"], strict=True))
    reaction = constants["torque_coefficient"][0]
    if is_present(factor := constants["reaction_torque"], absent=1.0):
        reaction = factor[0] * reaction
    torque = [k * y, -k * x, reaction * dot(vehicle.spin, squares)]
    if is_present(gain, absent=1.0):
        torque = [factor * part for factor, part in zip(gain, torque, strict=True)]
    return k * total, torque


def _specific_force(constants: Constants, air, torque):
    """Return the specific force without thrust [m/s², body]: drag, and a cable that torque balances."""
    drag, pull, (mass,) = constants["drag"], constants["cable_pull"], constants["mass"]
    x, y, z = 0.0, 0.0, 0.0
    if is_present(drag):
        x, y, z = (-(factor / mass) * part for factor, part in zip(drag, air, strict=True))
    if is_present(added := constants["added_drag"]):
        x, y, z = (one - factor * part for one, factor, part in zip((x, y, z), added, air, strict=True))
    if is_present(pull):
        x, y = x + pull[0] / mass * torque[1], y - pull[1] / mass * torque[0]
    return [x, y, z]


def _rotor_drag(vehicle: Vehicle, constants: Constants, air, omega: Rows, u: Rows):
    """Return the force [N] and torque [N m] of the rotors' drag −u_i H (Rᵀv + ω × r_i), at each hub r_i."""
    (hx, hy, hz), (vx, vy, vz), (wx, wy, wz) = constants["rotor_drag"], air, omega
    xs, ys = _hubs(vehicle, constants)
    total, x, y = sum(u[1:], u[0]), dot(xs, u), dot(ys, u)  # moments of the rotors' speeds
    xx, yy, xy = (dot([a * b for a, b in zip(*pair, strict=True)], u) for pair in ((xs, xs), (ys, ys), (xs, ys)))
    across, along = vx * y - wz * yy, vy * x + wz * xx
    inflow = vz * y + wx * yy - wy * xy, vz * x + wx * xy - wy * xx
    force = [-hx * (total * vx - wz * y), -hy * (total * vy + wz * x), -hz * (total * vz + wx * y - wy * x)]
    return force, [-hz * inflow[0], hz * inflow[1], hx * across - hy * along]


def _translational_lift(vehicle: Vehicle, constants: Constants, air, omega: Rows, u: Rows):
    """Return the force [N] and torque [N m] of L/n times the squared speed along x and y of each of n hubs."""
    xs, ys = _hubs(vehicle, constants)
    share = constants["translational_lift"][0] / vehicle.rotors
    squares = [(air[0] - omega[2] * y) ** 2 + (air[1] + omega[2] * x) ** 2 for x, y in zip(xs, ys, strict=True)]
    return [0.0, 0.0, share * sum(squares[1:], squares[0])], [share * dot(ys, squares), -share * dot(xs, squares), 0.0]


def _hubs(vehicle: Vehicle, constants: Constants):
    """Return the x and the y of each rotor from the centre of mass [m]."""
    centre = constants["centre_of_mass"]
    return ([place[i] - centre[i] for place in vehicle.rotor_positions] for i in range(2))


def _velocity_error(constants: Constants, velocity, force):
    """Return ṗ minus the estimated velocity [m/s, body frame]."""
    gain, lag = constants["velocity_gain"], constants["velocity_lag"]
    x, y, z = 0.0, 0.0, 0.0
    if is_present(gain, absent=1.0):
        x, y, z = ((factor - 1.0) * part for factor, part in zip(gain, velocity, strict=True))
    if is_present(lag):
        x, y = x + lag[0] * force[0], y + lag[0] * force[1]
    return [x, y, z]


def _euler(inertia, torque, omega: Rows) -> Float[Array, " 3 *b"]:
    """Return ω̇ = J⁻¹ (τ − ω × J ω) for J = diag(Ix, Iy, Iz)."""
    (ix, iy, iz), (tx, ty, tz), (wx, wy, wz) = inertia, torque, omega
    rows = (tx - (iz - iy) * wy * wz) / ix, (ty - (ix - iz) * wz * wx) / iy, (tz - (iy - ix) * wx * wy) / iz
    return jnp.stack(rows)


def in_world(attitude, parts) -> Float[Array, " 3 *b"]:
    """Rotate a body vector into the world frame; entries that are not given are zero."""
    return jnp.stack([dot(row[: len(parts)], parts) for row in attitude])


def dot(a, b) -> Array:
    first, *others = (left * right for left, right in zip(a, b, strict=True))
    return sum(others, first)


def feels_wind(vehicle: Vehicle, terms: Terms, learned: Container[str]) -> bool:
    """Whether any term depends on the velocity through the air; otherwise no data tell of a wind."""
    known = nominal_values(vehicle, terms)
    return any(name in learned or is_present(known[name]) for name in OF_AIR)


def is_present(term, absent: float = 0.0) -> bool:
    """Whether a term is learned or has an effect."""
    return any(not isinstance(number, int | float) or number != absent for number in term)


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def evaluate_columns(of_rows: Callable, theta: PyTree, x: Float[Array, "13 b"], u: Float[Array, "rotors b"]):
    """Evaluate `of_rows(theta, x, u)` on a minibatch; the derivative sums over it once per scalar parameter."""
    return of_rows(theta, tuple(x), tuple(u))


def _columns_backward(of_rows, saved, d_derivative: Float[Array, "13 b"]):
    theta, x, u = saved
    own = jax.tree.map(lambda parameter: jnp.broadcast_to(parameter, x.shape[1:]), theta)  # one for each column
    d_own, d_x, d_u = jax.vjp(of_rows, own, tuple(x), tuple(u))[1](d_derivative)
    leaves, structure = jax.tree.flatten(d_own)
    if leaves:
        leaves = tuple(jnp.stack(leaves) @ jnp.ones(x.shape[1:], leaves[0].dtype))
    return jax.tree.unflatten(structure, leaves), jnp.stack(d_x), jnp.stack(d_u)


evaluate_columns.defvjp(lambda f, theta, x, u: (f(theta, tuple(x), tuple(u)), (theta, x, u)), _columns_backward)
