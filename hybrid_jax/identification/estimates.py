"""Estimate hover, thrust, rotor positions, spin, lag and trim of a vehicle from its logs, and write a vehicle file.

Angular acceleration is regressed on the squared motors, both band-passed: ω̇ = B s, s = w², τ ẇ = u − w. The signs of
B's columns give each rotor's position and spin; the lag is the τ that explains roll and pitch best.
"""

import json
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.signal import lfilter

from hybrid_jax.dynamics.terms import OF_VELOCITY
from hybrid_jax.dynamics.vehicle_file import LEARN
from hybrid_jax.flights.attitude import interpolate, mean_of_held
from hybrid_jax.flights.checks.airborne import airborne, within
from hybrid_jax.flights.checks.cleaning import TIME_CONSTANTS
from hybrid_jax.flights.checks.mistakes import band_passed
from hybrid_jax.flights.checks.motor_response import FAST
from hybrid_jax.flights.conversion import motors_of
from hybrid_jax.flights.log import runs_of
from hybrid_jax.flights.recording import Recording, Signal

FASTEST, LONGEST = 0.002, 60.0  # s: shortest interval, and how much of each log is used
GRAVITY, HOVER = 9.81, 0.5  # m/s²; in hover, the specific force differs by less from gravity
FLYING = 0.3  # share of the motors' 0.9-quantile below which a vehicle is on the ground
SLOW = 1.0  # s; slower trends are removed. It is longer than the lag, which would not be visible otherwise
EXPLAINED = 0.3  # correlation of roll and pitch with the regression above which it counts
FOLLOWS = 0.5  # correlation of thrust with the motors above which it determines their lag
LEAST_SPREAD = 0.3  # m/s², of the specific force, to fit a thrust curve
ARM, MASS = 0.1, 1.0  # m and kg, if not given
TOP = 1000.0  # rad/s at full command if speeds are unknown: only thrust matters


class Estimate(NamedTuple):
    """Estimates for a vehicle with n rotors."""

    commands: bool  # whether motors are commands from 0 to 1, else speeds [rad/s]
    largest: float  # motor value in the logs
    hover: Float[np.ndarray, " n"]  # RMS value of each motor in hover
    voltage: float  # in hover [V]; NaN if unknown
    effect: Float[np.ndarray, "3 n"]  # B, the angular acceleration per squared motor [rad/s² / motor²]
    correlations: Float[np.ndarray, " 3"]  # of roll, pitch and yaw with the regression
    lag: float  # time constant τ [s]
    curve: Float[np.ndarray, " 3"] | None  # c0, c1, c2: specific force of one rotor [m/s²] over its command
    seconds: float  # time in flight
    moves: bool  # whether a log has the velocity, which drag requires

    @property
    def placed(self) -> bool:
        """Whether roll and pitch follow the motors well enough to locate the rotors."""
        return bool(self.correlations[:2].min() > EXPLAINED)

    def positions(self, arm: float) -> Float[np.ndarray, "n 2"]:
        """Return (x, y) of each rotor at a distance `arm` [m], evenly spaced, with a rotor or a gap in front."""
        count, found = len(self.hover), np.arctan2(self.effect[0], -self.effect[1])
        rank = np.argsort(np.argsort(found))
        grids = [2 * np.pi * (rank + shift / 2) / count - np.pi for shift in range(2 * count)]
        angles = max(grids, key=lambda grid: np.cos(found - grid).sum())
        return arm * np.stack([np.cos(angles), np.sin(angles)], axis=1)

    def spin(self) -> list[int]:
        """Return the sign of each rotor's reaction torque; neighbours differ if the number of rotors is even."""
        turns = self.effect[2]
        if len(turns) % 2 == 0:
            places = self.positions(1.0)
            pattern = 1 - 2 * (np.argsort(np.argsort(np.arctan2(places[:, 1], places[:, 0]))) % 2)
            turns = pattern * (pattern @ turns)
        return [1 if each > 0 else -1 for each in turns]

    def inertia(self, thrust: float, places: Float[np.ndarray, "n 2"]) -> tuple[float, float]:
        """Return Ix and Iy [kg m²] for a thrust [N] per squared motor and the rotors' positions [m]."""
        roll, pitch = self.effect[0], -self.effect[1]
        y, x = places[:, 1], places[:, 0]
        return float(thrust * (y @ roll) / (roll @ roll)), float(thrust * (x @ pitch) / (pitch @ pitch))


def estimate(recordings: Sequence[Recording]) -> Estimate:
    """Estimate from all logs with motors; raise ValueError if none is in flight. Rotation needs body rates."""
    usable = [each for each in recordings if each.rotors]
    if not (pieces := [piece for each in usable if each.rotors == usable[0].rotors for piece in _pieces(each)]):
        raise ValueError("vehicle file: no log has motors in flight; hybrid-jax inspect says what you should log")
    pieces = [piece for piece in pieces if piece.commands == pieces[0].commands]
    fits = {lag: _regress(pieces, lag) for lag in TIME_CONSTANTS}
    heave = {lag: found for lag in TIME_CONSTANTS if (found := _curve(pieces, lag)) is not None}
    # Thrust determines the lag better than roll and pitch, which the controller couples to the motors.
    scores = {lag: correlation for lag, (_, correlation) in heave.items()}
    if min(scores.values(), default=0.0) < FOLLOWS:
        scores = {lag: float(correlations[:2].sum()) for lag, (_, correlations) in fits.items()}
    lag = max(scores, key=scores.__getitem__)
    u, force = np.concatenate([piece.u for piece in pieces]), np.concatenate([piece.force for piece in pieces])
    mean = u.mean(axis=1)
    flies = mean > FLYING * np.quantile(mean, 0.9)
    hovers = hovers if (hovers := (np.abs(force - GRAVITY) < HOVER) & flies).any() else flies
    volts = np.concatenate([piece.volts for piece in pieces])[hovers]
    return Estimate(
        pieces[0].commands,
        float(u.max()),
        np.sqrt((u[hovers] ** 2).mean(axis=0)),
        float(np.nanmean(volts)) if np.isfinite(volts).any() else np.nan,
        *fits[lag],
        lag,
        heave[lag][0] if lag in heave else None,
        sum(len(piece.u) * piece.dt for piece in pieces),
        any({"velocity", "body_velocity", "position"} & each.signals.keys() for each in usable),
    )


class _Piece(NamedTuple):
    """Evenly spaced samples in flight without gaps."""

    dt: float
    u: Float[np.ndarray, "m n"]
    omega: Float[np.ndarray, "m 3"]
    force: Float[np.ndarray, " m"]  # along z; not a number if unknown
    volts: Float[np.ndarray, " m"]
    commands: bool


def _pieces(recording: Recording) -> list[_Piece]:
    """Split a log at gaps, without the time on the ground."""
    motors = motors_of(recording)
    still = Signal(motors.t, np.zeros((len(motors), 3)), ("x", "y", "z"), "no body rates")
    rates = recording.signals.get("rates", still)
    dt = max(rates.interval, motors.interval, FASTEST)
    first, last = max(rates.t[0], motors.t[0]), min(rates.t[-1], motors.t[-1])
    middle = max(first, (first + last - LONGEST) / 2)
    t = np.arange(middle, min(last, middle + LONGEST), dt)
    if len(t) < 2:
        return []
    u, omega = mean_of_held(t, motors.t, motors.values), interpolate(t, rates.t, rates.values)
    force, volts = (_column(recording, *each, t) for each in (("specific_force", "z"), ("voltage", "battery")))
    commands = motors is not recording.signals.get("rotor_speed")
    # On the ground an accelerometer measures gravity whatever the motors do.
    flying = within(t, airborne(recording, "command" if commands else "rotor_speed"))
    flying &= ~within(t, [*motors.gaps(), *rates.gaps()])
    parts = [part for part in runs_of(flying) if (part.stop - part.start) * dt > 2 * SLOW]
    return [_Piece(dt, u[part], omega[part], force[part], volts[part], commands) for part in parts]


def _column(recording: Recording, name: str, axis: str, t: np.ndarray) -> np.ndarray:
    signal = recording.signals.get(name)
    if signal is None or axis not in signal.axes or len(signal) < 2:
        return np.full(len(t), np.nan)
    return np.interp(t, signal.t, signal.values[:, signal.axes.index(axis)])


def _lagged(piece: _Piece, lag: float) -> Float[np.ndarray, "m n"]:
    """Apply a first-order lag to the motors."""
    kept = np.exp(-piece.dt / lag) if lag else 0.0
    return lfilter([1 - kept], [1.0, -kept], piece.u, axis=0, zi=kept * piece.u[:1])[0]


def _regress(pieces: Sequence[_Piece], lag: float) -> tuple[Float[np.ndarray, "3 n"], Float[np.ndarray, " 3"]]:
    """Return B and the correlations of ω̇ about each axis with B s."""
    rows = []
    for piece in pieces:
        both = np.concatenate([np.diff(piece.omega, axis=0) / piece.dt, (_lagged(piece, lag) ** 2)[:-1]], axis=1)
        rows.append(band_passed(both, *(max(1, round(span / piece.dt)) for span in (FAST, SLOW))))
    turned, squares = np.split(np.concatenate(rows), [3], axis=1)
    effect = np.linalg.lstsq(squares, turned, rcond=1e-6)[0].T
    explained = squares @ effect.T
    size = np.sqrt((explained**2).sum(axis=0) * (turned**2).sum(axis=0))
    return effect, (explained * turned).sum(axis=0) / np.maximum(size, 1e-12)


def _curve(pieces: Sequence[_Piece], lag: float) -> tuple[Float[np.ndarray, " 3"], float] | None:
    """Fit one rotor's specific force along z to its motor (for speeds, c2 only); None if it hardly varies."""
    lagged = np.concatenate([_lagged(piece, lag) for piece in pieces])
    force = np.concatenate([piece.force for piece in pieces])
    known = np.isfinite(force)
    if known.sum() < 100 or force[known].std() < LEAST_SPREAD:
        return None
    powers = np.stack([(lagged[known] ** power).sum(axis=1) for power in range(3)], axis=1)
    powers *= [pieces[0].commands, pieces[0].commands, True]
    curve = np.linalg.lstsq(powers, force[known], rcond=None)[0]
    if curve[1] + 2 * curve[2] * np.quantile(lagged[known], 0.01) <= 0:
        return None  # it would fall: the commands cover too small a range
    return curve, float(np.corrcoef(powers @ curve, force[known])[0, 1])


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
    at_top = "PLACEHOLDER: only thrust matters" if found.commands else "1.2 times the largest in the logs"
    weighed = "as given" if mass else "PLACEHOLDER: weigh it; thrust and inertia grow with it"
    length = "arm as given" if arm else f"arm {ARM:g} m is a PLACEHOLDER: measure it; inertia grows with it"
    of_log = "in the order of the log's motors"
    order = f"{of_log}, from roll and pitch" if found.placed else f"PLACEHOLDER, {of_log}"
    pairs = ", ".join(f"[{x:.4g}, {y:.4g}]" for x, y in places + 0.0)
    learn = [name for name in LEARN if found.moves or name not in OF_VELOCITY]
    inertia, torque, spin, why = _turning(found, thrust, places)
    return f"""\
# Written from logs by hybrid-jax inspect. You should measure the numbers that are marked
# PLACEHOLDER: logs do not identify them.
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
    curve, origin = [0.0, 0.0, thrust], "hover only, assuming that thrust is proportional to the squared command"
    if found.curve is not None:
        curve, origin = mass * found.curve, "the accelerometer"
    gives = f'gives = "thrust"  # of a rotor [N], of the command from 0 to 1; from {origin}'
    lines = [gives, f"curve = [{', '.join(f'{each:.5g}' for each in curve)}]"]
    if found.placed and found.lag:
        lines += [f"time_constants = {found.lag:.3g}  # s; the one that explains roll and pitch best"]
    if np.isfinite(found.voltage):
        lines += [f"nominal_voltage = {found.voltage:.4g}  # V in hover", "# voltage_exponent = 1.0  # for PWM"]
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
    known = f"{why}; Iz = Ix + Iy, as for a flat body", f"with that Iz{sure}"
    return (ix, iy, ix + iy), torque, found.spin(), (*known, f"sign of each rotor's reaction torque about z, up{sure}")
