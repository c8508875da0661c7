"""Compare independent records of one motion in a log, and suggest the common mistake that explains a disagreement."""

import math
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from jaxtyping import Float

from hybrid_jax.flights.attitude import rotation_of
from hybrid_jax.flights.checks import mistakes
from hybrid_jax.flights.checks.airborne import flying_intervals, on_ground
from hybrid_jax.flights.checks.mistakes import NOTHING, UP, Pairs, Vectors, middle, moving_mean
from hybrid_jax.flights.checks.motor_response import respond
from hybrid_jax.flights.log import FlightLog, gaps, repeats
from hybrid_jax.vehicle import QUATERNION, STATE_NAMES, VELOCITY, Vehicle, input_names

OK, WARNS, FAILS, UNKNOWN = "ok", "warns", "fails", "unknown"
GROUND = "cut it out: in_flight=True"
MORE_FLIGHT = "check on a flight with more motion"
CLOCK = "the time is in ms, µs or ns: declare its unit"
UNUSUAL = "no common mistake explains it: check sensors, time stamps and columns"
CHANGED = "or the vehicle has changed (wind, load, damage): adapt"
RATES = "q̇ against ω"
THRUST = "v̇ against thrust along body z"
RATIO, ORDER = "specific force over thrust per mass", "motor order against roll and pitch"
SPIN, GYRO = "spin against yaw", "lag of the gyro behind the motors"
NEED_VEHICLE = (RATIO, ORDER, SPIN, GYRO)  # checks that are not run without one
MAX_SAMPLES = 100_000  # the middle of longer logs is checked

LONGEST_INTERVAL = 0.5  # s; slower logs are implausible
# Relative errors: 0 for equal records, 1 for uncorrelated ones, √2 for opposite ones.
KINEMATICS_LIMIT = 0.5
THRUST_LIMIT = 0.6
AXIS_LIMIT = 0.8  # of a single axis, where noise is a larger share
FEWEST = 20  # intervals to compare
# s of moving average on both sides of an equation. A longer one is tried if no mistake explains a difference.
SPANS = (0.05, 0.2, 0.8)
GAIN_LIMIT = 1.25  # of one record regressed on the other
THRUST_RATIO_LIMIT = 1.25
ORDER_LIMIT = 0.4  # correlation
YAW_LIMIT = 0.3  # correlation: rotor torque about z is small, and two wrong signs of four leave half of it
OPPOSED = -0.1  # correlation
IMPROVES = 0.7  # share of the difference of two records that may remain when a mistake is undone
POSSIBLE = 2.5  # factor by which a load or damage may change thrust per mass, either way
NOISE = 0.2  # share of the least motion below which two records count as equal
CLEAR = 1.0  # multiple of the least motion needed to check a single axis
AT_LIMIT = 10  # an extreme value of at least so many samples, and times as frequent as usual, is saturation
FATAL_LAG = 40.0  # ms
SAMPLED = (-1.0, -0.4)  # intervals by which the gyro leads motors sampled at the start of each: half of one
LAG = "motor_time_constant"  # its name in the vehicle file
LEAST_MOTION = {"velocity": 0.05, "rates": 0.03, "acceleration": 0.2}  # RMS in m/s, rad/s, m/s²


@dataclass(frozen=True)
class Check:
    """The result of one check.

    Attributes:
        name: name of the check, for example the two records compared.
        value: the result in `unit`; NaN if the verdict is "unknown".
        unit: unit of value and limit, for example "s" or "relative error".
        limit: the maximum of the value, or for correlations the minimum.
        verdict: "ok", "warns", "fails" or "unknown".
        suggestion: what you should correct, if anything; for example the sign of an axis.
    """

    name: str
    value: float
    unit: str
    limit: float
    verdict: str
    suggestion: str


def check_log(log: FlightLog, vehicle: Vehicle | None = None) -> list[Check]:
    """Check whether a log is consistent with itself and, if you give one, with its vehicle.

    Args:
        log: the flight, which should contain manoeuvres.
        vehicle: constants to compare the motion with.

    Raises:
        ValueError: if there are fewer than two samples, or the number of motors is not the vehicle's.
    """
    if vehicle is not None and log.u.shape[1] != vehicle.rotors:
        found = f"{log.name}: has {log.u.shape[1]} motors, {vehicle.name} has {vehicle.rotors}"
        raise ValueError(f"{found}; log all of them, or name the motors of its rotors: motor_order=…")
    skip = max(0, (len(log) - MAX_SAMPLES) // 2)
    log = log[skip : skip + MAX_SAMPLES]
    lost, stale = float(gaps(log).mean()), float(repeats(log).mean())
    split = "windows stop at each; resample=… with longest_gap=… bridges short ones"
    moved = _compare(log, "dp/dt against v", mistakes.velocities(log), LEAST_MOTION["velocity"])
    pushed = mistakes.accelerations(log)
    if moved.verdict == OK:
        pushed.pop(mistakes.BODY)  # dp/dt contradicts it
    return [
        _at_most("interval between samples", log.dt, "s", LONGEST_INTERVAL, CLOCK),
        _at_most("gaps", lost, "share of intervals", 0.01, split),
        _at_most("repeated samples", stale, "share of samples", 0.01, split),
        moved,
        _compare(log, RATES, mistakes.rates(log), LEAST_MOTION["rates"]),
        _compare(log, THRUST, pushed, LEAST_MOTION["acceleration"]),
        _at_most("time on the ground", float(on_ground(log).mean()), "share of samples", 0.01, GROUND),
        _columns(log),
        *([_thrust(log, vehicle), *_motors(log, vehicle)] if vehicle is not None else []),
    ]


def _at_most(name: str, value: float, unit: str, limit: float, suggestion: str) -> Check:
    return judged(name, value, unit, limit, suggestion if value > limit else "")


def judged(name: str, value: float, unit: str, limit: float, advice: str) -> Check:
    """Make a check that fails if there is advice."""
    return Check(name, float(value), unit, limit, *((FAILS, advice) if advice else (OK, NOTHING)))


def _thrust(log: FlightLog, vehicle: Vehicle) -> Check:
    """Compare the mean specific force along body z in flight with k Σu² / m."""
    flying = flying_intervals(log)
    thrust = vehicle.thrust_coefficient / vehicle.mass * (log.u[:-1] ** 2).sum(axis=1)[flying]
    specific = np.diff(log.x[:, VELOCITY], axis=0) / np.diff(log.t)[:, None] + [0, 0, vehicle.gravity]
    along = (specific * middle(rotation_of(log.x[:, QUATERNION]).apply(UP))).sum(axis=1)[flying]
    if not len(thrust) or thrust.mean() <= 0:
        still = "the vehicle stays on the ground: check a log in flight"
        return Check(RATIO, math.nan, "ratio", THRUST_RATIO_LIMIT, UNKNOWN, still)
    ratio = float(along.mean() / thrust.mean())
    possible = 1 / POSSIBLE < ratio < POSSIBLE
    advice = f"multiply thrust_coefficient by {ratio:.3g}, or divide mass by it, whichever is less certain"
    advice += f"; {CHANGED}" * possible
    units = {"rpm": np.pi / 30, "rev/s": 2 * np.pi, "deg/s": np.pi / 180, "rad/s, read as rpm": 30 / np.pi}
    if ratio <= 0:
        advice = "body z points down: correct the frames first"
    elif found := [unit for unit, factor in units.items() if 0.7 < ratio / factor**2 < 1.4]:
        advice = f"rotor speeds are in {found[0]}: declare it"
    elif log.u.max() < 0.02 * vehicle.hover_speed:
        advice = "rotor speeds are normalised commands: give the polynomial that maps them to rad/s"
    fits = 1 / THRUST_RATIO_LIMIT <= ratio <= THRUST_RATIO_LIMIT
    check = judged(RATIO, ratio, "ratio", THRUST_RATIO_LIMIT, "" if fits else advice)
    return replace(check, verdict=WARNS) if CHANGED in check.suggestion else check


def _columns(log: FlightLog) -> Check:
    """Find motors recorded twice, columns that never change and gyros that saturate."""
    values = np.hstack([log.x[:, VELOCITY.start :], log.u]).T
    names = (*STATE_NAMES[VELOCITY.start :], *input_names(log.u.shape[1]))
    columns: dict[str, np.ndarray] = dict(zip(names, values, strict=True))
    moving = [name for name, values in columns.items() if (values != values[0]).any()]
    kinds = {name[0] for name in moving}  # v, w, u: a vehicle at rest does not change any of a kind
    alike = [(a, b) for a, b in combinations(moving, 2) if a[0] == b[0] == "u" and (columns[a] == columns[b]).all()]
    problems = [f"{a} and {b} are equal in every sample" for a, b in alike]
    problems += [f"{name} never changes" for name in columns if name[0] in kinds and name not in moving]
    for name in (name for name in moving if name[0] == "w"):
        values, usual = columns[name], AT_LIMIT * len(log) / len(np.unique(columns[name]))
        at_an_end = max((values == values.max()).sum(), (values == values.min()).sum())
        problems += [f"{name} saturates: widen its range"] * bool(at_an_end > max(AT_LIMIT, usual))
    advice = f"{'; '.join(problems)}: log what was measured, or name its columns"
    return _at_most("columns", float(len(problems)), "suspect", 0.0, advice)


def _motors(log: FlightLog, vehicle: Vehicle) -> list[Check]:
    found, limit = respond(log, vehicle), 1000 * log.dt
    if found is None or sum(found.correlations[:2]) < 2 * ORDER_LIMIT:
        value = math.nan if found is None else min(found.correlations[:2])
        correlated = (ORDER, value, "correlation", ORDER_LIMIT), (SPIN, math.nan, "correlation", 0.0)
        return [Check(*each, UNKNOWN, MORE_FLIGHT) for each in (*correlated, (GYRO, math.nan, "ms", limit))]
    columns = " ".join(f"u{motor}" for motor in found.order)
    rotors = " ".join(map(str, range(vehicle.rotors)))
    ordered = found.order == tuple(range(vehicle.rotors))
    advice = f"reorder the motors: the vehicle's rotors {rotors} are {columns}: motor_order={found.order}"
    lag, late = 1000 * found.lag, found.lag > 0
    shift = f"shift the motors {abs(lag):.1f} ms {'later' if late else 'earlier'}: delay={found.lag:.4f}"
    shift += f', or learn "{LAG}" if they are commands' if late else ""
    lagging = _at_most(GYRO, abs(lag), "ms", limit, shift)
    # A lag of some samples makes predictions worse, but learned parameters are still right.
    lagging = replace(lagging, verdict=WARNS) if limit < abs(lag) <= FATAL_LAG else lagging
    if SAMPLED[0] < found.lag / log.dt < SAMPLED[1]:
        sampled = f"motors are samples, not held or means over the interval, and change by {100 * found.change:.0f} %"
        sampled += " in it, which hides their lag and falsifies inertia: log commands or means,"
        sampled += f" or take means of two: delay={found.lag:.4f}"
        lagging = replace(lagging, verdict=WARNS, suggestion=sampled)
    return [
        judged(ORDER, min(found.as_is[:2]), "correlation", ORDER_LIMIT, "" if ordered else advice),
        _spin(log, vehicle, found.yaw_sign * found.correlations[2]),
        replace(lagging, value=lag),
    ]


def _spin(log: FlightLog, vehicle: Vehicle, yaw: float) -> Check:
    if abs(sum(vehicle.spin)) > 1:
        turning = FAILS, "the vehicle would turn in hover: half of its rotors must spin each way"
    elif yaw >= OPPOSED:
        turning = (OK, NOTHING) if yaw > YAW_LIMIT else (UNKNOWN, MORE_FLIGHT)
    else:
        # If Ix = Iy, roll and pitch do not affect yaw. The difference of two estimates may be all there is.
        ix, _, iz = vehicle.inertia
        even = respond(log, replace(vehicle, inertia=(ix, ix, iz)))
        sure = even is not None and even.yaw_sign * even.correlations[2] < OPPOSED
        hangs = "opposed only with the vehicle's Iy − Ix: check its inertia, which may be estimated, then its spins"
        turning = (FAILS, "flip the sign of every spin of the vehicle") if sure else (WARNS, hangs)
    return Check(SPIN, yaw, "correlation", YAW_LIMIT, *turning)


def _compare(log: FlightLog, name: str, pairs: Pairs, least: float) -> Check:
    """Compare two records in flight over growing spans; return the result of the shortest if nothing explains any."""
    check = shortest = _compare_means(log, name, pairs, least, SPANS[0])
    for span in SPANS[1:]:
        check = _compare_means(log, name, pairs, least, span) if UNUSUAL in check.suggestion else check
    return shortest if UNUSUAL in check.suggestion else check


def _compare_means(log: FlightLog, name: str, pairs: Pairs, least: float, span: float) -> Check:
    """Compare two records with each mistake undone, per axis for kinematics; v̇ includes wind and drag."""
    sound, limit = flying_intervals(log), THRUST_LIMIT if name == THRUST else KINEMATICS_LIMIT
    width = min(max(1, round(span / log.dt)), len(sound))
    whole = moving_mean(sound[:, None].astype(float), width)[:, 0] > 1 - 1e-9
    pairs = {name: (moving_mean(a, width)[whole], moving_mean(b, width)[whole]) for name, (a, b) in pairs.items()}
    a, b = pairs[NOTHING]
    if len(a) < FEWEST or max(_size(a), _size(b)) < least:
        return Check(name, math.nan, "relative error", limit, UNKNOWN, MORE_FLIGHT)
    value, advice = _relative_error(a, b), _nearer(pairs, limit, least)
    doubtful = (not advice and name == THRUST) or ((" s late" in advice or " s early" in advice) and value <= limit)
    # A wrong heading or a mirrored world shows in no other check, so these only warn.
    doubtful |= mistakes.HEADING in advice or mistakes.HANDED in advice
    advice = advice or (UNUSUAL if value > limit else "")
    if name == THRUST and advice == UNUSUAL:
        advice = f"{UNUSUAL}; {CHANGED}"
    elif name != THRUST:
        advice = advice or _apart(a, b, least)
    check = judged(name, value, "relative error", limit, advice)
    return replace(check, verdict=WARNS) if advice and doubtful else check


def _nearer(pairs: Pairs, limit: float, least: float) -> str:
    """Return the mistake that, if undone, makes the records agree best; "" if no mistake does."""
    left = {mistake: a - b for mistake, (a, b) in pairs.items()}
    own = left[NOTHING]
    # Any improvement counts if two differ by more than noise: an axis with little motion contributes little.
    most = IMPROVES * _size(own)
    nearer = [name for name, other in left.items() if _size(own - other) > NOISE * least and _size(other) < most]
    best = min(nearer, key=lambda name: _size(left[name]), default=NOTHING)
    return best if nearer and _relative_error(*pairs[best]) <= limit else ""


def _apart(a: Vectors, b: Vectors, least: float) -> str:
    """Return what is wrong with one axis, or with the scale of all; "" if nothing is."""
    pairs = {axis: (a[:, [i]], b[:, [i]]) for i, axis in enumerate("xyz")}
    moving = {axis: pair for axis, pair in pairs.items() if max(map(_size, pair)) > CLEAR * least}
    if apart := [axis for axis, pair in moving.items() if _relative_error(*pair) > AXIS_LIMIT]:
        return f"only {' and '.join(apart)}: {UNUSUAL}"
    gain = float((a * b).sum() / (b * b).sum())
    if 1 / GAIN_LIMIT <= gain <= GAIN_LIMIT:
        return ""
    return f"the first is {gain:.2f} times the second: is the time, or one of them, in another unit?"


def _size(values: Float[np.ndarray, "n d"]) -> float:
    return float(np.sqrt((values**2).sum(axis=1).mean()))


def _relative_error(a: Float[np.ndarray, "n d"], b: Float[np.ndarray, "n d"]) -> float:
    return _size(a - b) / float(np.hypot(_size(a), _size(b)))
