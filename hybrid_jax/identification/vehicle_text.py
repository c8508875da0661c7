"""Write an initial vehicle file: estimates from logs, and advice on what to measure for the rest."""

import json

import numpy as np

from hybrid_jax.dynamics.terms import OF_VELOCITY
from hybrid_jax.dynamics.vehicle_file import LEARN
from hybrid_jax.identification.estimates import GRAVITY, Estimate

ARM, MASS = 0.1, 1.0  # m and kg, where they were not given
TOP = 1000.0  # rad/s at full command if speeds are unknown: only thrust matters


def vehicle_text(found: Estimate, name: str, mass: float | None, arm: float | None) -> str:
    """Return the text of a TOML file; unidentified numbers are placeholders with a comment."""
    own_mass, own_arm = mass or MASS, arm or ARM
    angles = -np.pi / 4 - 2 * np.pi * np.arange(len(found.hover)) / len(found.hover)
    places = found.positions(own_arm) if found.placed else own_arm * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    thrust = level = own_mass * GRAVITY / float((found.hover**2).sum())  # N per squared motor
    if found.curve is not None:  # its slope at hover
        thrust = own_mass * float(found.curve[1] / (2 * found.hover.mean()) + found.curve[2])
    top = TOP if found.commands else 1.2 * found.largest
    k = level / top**2 if found.commands else thrust
    unit, motors = "of full command" if found.commands else "rad/s", ", ".join(f"{each:.3g}" for each in found.hover)
    volts = f"{found.voltage:.3g} V" if np.isfinite(found.voltage) else "unknown voltage"
    flown = f"{found.seconds:.0f} s of flight"
    at_top = (
        "PLACEHOLDER at full command: only thrust matters" if found.commands else "1.2 times the largest in the logs"
    )
    weighed = "as given" if mass else "PLACEHOLDER: weigh it; thrust and inertia grow with it"
    length = "arm as given" if arm else f"arm {ARM:g} m is a PLACEHOLDER: measure it; inertia grows with it"
    of_log = "in the order of the log's motors"
    order = f"{of_log}, from roll and pitch" if found.placed else f"PLACEHOLDER, {of_log}"
    pairs = ", ".join(f"[{x:.4g}, {y:.4g}]" for x, y in places + 0.0)
    learn = [name for name in LEARN if found.moves or name not in OF_VELOCITY]
    inertia, torque, spin, why = _turning(found, thrust, places)
    return f"""\
# Written from logs by hybrid-jax inspect. Numbers with a # are explained; those marked
# PLACEHOLDER are not identifiable from logs: measure them.
learn = {json.dumps(learn)}

[vehicle]
name = "{name}"
mass = {own_mass:g}  # kg; {weighed}
inertia = [{", ".join(f"{each:.4g}" for each in inertia)}]  # kg m²; {why[0]}
torque_coefficient = {torque * k:.3g}  # N m/(rad/s)²; {why[1]}
spin = {spin}  # {why[2]}
thrust_coefficient = {k:.4g}  # N/(rad/s)²; hover with motors at {motors} {unit} at {volts}, {flown}
rotor_positions = [{pairs}]  # m; {order}; {length}
max_rotor_speed = {top:.4g}  # rad/s; {at_top}
{_terms(found, places)}{_actuator(found, own_mass, thrust) if found.commands else ""}"""


def _terms(found: Estimate, places: np.ndarray) -> str:
    if not found.placed:
        return ""
    x, y = found.hover**2 @ places / (found.hover**2).sum()
    lag = f"motor_time_constant = {found.lag:.3g}  # s; of the speeds to the thrust\n" if not found.commands else ""
    centre = f"[{x:.4g}, {y:.4g}]  # m; the centre of thrust in hover, of equal rotors"
    return f"\n[terms]\ncentre_of_mass = {centre}\n{lag}"


def _actuator(found: Estimate, mass: float, thrust: float) -> str:
    curve, told = [0.0, 0.0, thrust], "hover only, assuming that thrust is proportional to the squared command"
    if found.curve is not None:
        curve, told = mass * found.curve, "the accelerometer"
    lines = [
        f'gives = "thrust"  # of a rotor [N], of the command from 0 to 1; from {told}',
        f"curve = [{', '.join(f'{each:.5g}' for each in curve)}]",
    ]
    if found.placed and found.lag:
        lines += [f"time_constants = {found.lag:.3g}  # s; the one that explains roll and pitch best"]
    if np.isfinite(found.voltage):
        lines += [
            f"nominal_voltage = {found.voltage:.4g}  # V in hover",
            "# voltage_exponent = 1.0  # if commands are PWM",
        ]
    return "\n".join(["\n[actuator]", *lines, ""])


def _turning(found: Estimate, thrust: float, places: np.ndarray):
    """Return inertia, reaction torque over thrust, spin, and a comment on each."""
    why = f"correlation of roll, pitch, yaw {', '.join(f'{each:.2f}' for each in found.correlations)}"
    if not found.placed:
        ix = 0.4 * thrust * float((found.hover**2).sum()) / GRAVITY * float(np.linalg.norm(places[0])) ** 2
        hardly = f"PLACEHOLDER: roll and pitch hardly follow the motors ({why}); shake roll and pitch in flight"
        spin = [1 if i % 2 else -1 for i in range(len(places))]
        return (ix, ix, 2 * ix), 0.01, spin, (hardly, "PLACEHOLDER", "PLACEHOLDER")
    ix, iy = found.inertia(thrust, places)
    sure = "" if found.correlations[2] > 0.3 else "; PLACEHOLDER: yaw hardly moves, check it"
    torque = (ix + iy) * float(np.abs(found.effect[2]).mean()) / thrust
    told = f"{why}; Iz = Ix + Iy, as for a flat body", f"with that Iz{sure}"
    return (ix, iy, ix + iy), torque, found.spin(), (*told, f"sign of each rotor's reaction torque about z, up{sure}")
