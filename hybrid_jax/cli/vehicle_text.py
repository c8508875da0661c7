"""Write an initial vehicle file: estimates from logs, and advice on what to measure for the rest."""

import json

import numpy as np

from hybrid_jax.cli.estimates import GRAVITY, Estimate

ARM, MASS = 0.1, 1.0  # m and kg, where they were not given
LEARN, OF_VELOCITY = ("Ix", "Iy", "Iz", "k_rotors", "rate_damping"), ("drag", "aerodynamic_moment")
WEIGH = "PLACEHOLDER: weigh it; thrust and inertia grow with it"
TOP = 1000.0  # rad/s at full command if speeds are unknown: only thrust matters


def vehicle_text(found: Estimate, name: str, mass: float | None, arm: float | None) -> str:
    """Return the text of a TOML file; unidentified numbers are placeholders with a comment."""
    own_mass, own_arm = mass or MASS, arm or ARM
    angles = -np.pi / 4 - 2 * np.pi * np.arange(len(found.hover)) / len(found.hover)
    places = found.positions(own_arm) if found.placed else own_arm * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    pairs = ", ".join(f"[{x:.4g}, {y:.4g}]" for x, y in places + 0.0)
    thrust = level = own_mass * GRAVITY / float((found.hover**2).sum())  # N per squared motor
    if found.curve is not None:  # its slope at hover
        thrust = own_mass * float(found.curve[1] / (2 * found.hover.mean()) + found.curve[2])
    top = TOP if found.commands else 1.2 * found.largest
    k = level / top**2 if found.commands else thrust
    unit, motors = "of full command" if found.commands else "rad/s", ", ".join(f"{each:.3g}" for each in found.hover)
    volts = f" at {found.voltage:.3g} V" if np.isfinite(found.voltage) else ", voltage unknown"
    hover = f"hover with motors at {motors} {unit}{volts}, {found.seconds:.0f} s of flight"
    lines = [
        "# Written from logs by hybrid-jax inspect. Numbers with a # are explained; those marked",
        "# PLACEHOLDER are not identifiable from logs: measure them.",
        f"learn = {json.dumps([*LEARN, *(OF_VELOCITY if found.moves else ())])}",
        "",
        "[vehicle]",
        f'name = "{name}"',
        f"mass = {own_mass:g}  # kg; {'as given' if mass else WEIGH}",
        *_turning(found, thrust, places, k, top),
        f"thrust_coefficient = {k:.4g}  # N/(rad/s)²; {hover}",
        f"rotor_positions = [{pairs}]  # m; {_where(found, arm)}",
        f"max_rotor_speed = {top:.4g}  # rad/s; "
        + (
            "PLACEHOLDER at full command: only thrust matters"
            if found.commands
            else "1.2 times the largest in the logs"
        ),
    ]
    if found.placed:
        x, y = found.centre(places)
        lines += [
            "",
            "[terms]",
            f"centre_of_mass = [{x:.4g}, {y:.4g}]  # m; the centre of thrust in hover, of equal rotors",
        ]
    if not found.commands:
        lines += [f"motor_time_constant = {found.lag:.3g}  # s; of the speeds to the thrust"] if found.placed else []
        return "\n".join(lines) + "\n"
    return "\n".join([*lines, "", "[actuator]", *_actuator(found, own_mass, thrust)]) + "\n"


def _turning(found: Estimate, thrust: float, places: np.ndarray, k: float, top: float) -> list[str]:
    """Return inertia, reaction torque and spin."""
    spin, why = (
        found.spin(),
        f"correlation of roll, pitch, yaw {', '.join(f'{each:.2f}' for each in found.correlations)}",
    )
    if not found.placed:
        arm = float(np.linalg.norm(places[0]))
        inertia = 0.4 * thrust * float((found.hover**2).sum()) / GRAVITY * arm**2
        spin = [1 if i % 2 else -1 for i in range(len(places))]
        told = f"PLACEHOLDER: roll and pitch hardly follow the motors ({why}); shake roll and pitch in flight"
        return [
            f"inertia = [{inertia:.3g}, {inertia:.3g}, {2 * inertia:.3g}]  # kg m²; {told}",
            f"torque_coefficient = {0.01 * k:.3g}  # N m/(rad/s)²; PLACEHOLDER",
            f"spin = {spin}  # PLACEHOLDER",
        ]
    ix, iy = found.inertia(thrust, places)
    torque = (ix + iy) * float(np.abs(found.effect[2]).mean()) * k / thrust
    sure = "" if found.correlations[2] > 0.3 else "; PLACEHOLDER: yaw hardly moves, check it"
    return [
        f"inertia = [{ix:.4g}, {iy:.4g}, {ix + iy:.4g}]  # kg m²; {why}; Iz = Ix + Iy, as for a flat body",
        f"torque_coefficient = {torque:.3g}  # N m/(rad/s)²; with that Iz{sure}",
        f"spin = {spin}  # sign of each rotor's reaction torque about z, up{sure}",
    ]


def _where(found: Estimate, arm: float | None) -> str:
    order = "in the order of the log's motors"
    length = "arm as given" if arm else f"arm {ARM:g} m is a PLACEHOLDER: measure it; inertia grows with it"
    return f"{order}, from roll and pitch; {length}" if found.placed else f"PLACEHOLDER, {order}; {length}"


def _actuator(found: Estimate, mass: float, thrust: float) -> list[str]:
    curve, told = (
        np.array([0.0, 0.0, thrust]),
        "from hover only, assuming that thrust is proportional to the squared command",
    )
    if found.curve is not None:
        curve, told = mass * found.curve, "from the accelerometer"
    lines = [f'gives = "thrust"  # of a rotor [N], of the command from 0 to 1; {told}',
             f"curve = [{', '.join(f'{each:.5g}' for each in curve)}]"]  # fmt: skip
    if found.placed and found.lag:
        lines.append(f"time_constants = {found.lag:.3g}  # s; the one that explains roll and pitch best")
    if np.isfinite(found.voltage):
        lines += [
            f"nominal_voltage = {found.voltage:.4g}  # V in hover",
            "# voltage_exponent = 1.0  # if commands are PWM",
        ]
    return lines
