"""Which planted mistakes the checks of logs find, and how often they are wrong: python -m benchmarks.log_mistakes

Prints the table of docs/howto/logs.md. Each mistake is made in every simulated flight, with the noise of sensors; it is
found if a check fails or warns, or reading refuses the log, and says the words that name it.

With folders as arguments, it counts instead the checks that fail on the sound logs in them, each at the rate of its
slowest signal and while it flies, against the nearest vehicle.toml above the log, and by the nearest map.toml, if any.
"""

import sys
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import jax
import numpy as np
import tyro

from hybrid_jax.cli.command import exit_codes, parsed
from hybrid_jax.flights import FlightLog, Recording, check_recording, find_logs, read_recording
from hybrid_jax.flights.attitude import BODIES, WORLDS, quaternion_of, rotation_of
from hybrid_jax.flights.checks.cleaning import in_flight
from hybrid_jax.flights.checks.consistency import FAILS, UNKNOWN, WARNS, Check, check_log
from hybrid_jax.flights.conversion import flight_at
from hybrid_jax.flights.formats.raw import Samples, record
from hybrid_jax.sim.domain import EXTERNAL_FORCE, PARAMETER_SHIFT, SOURCE, Domain
from hybrid_jax.sim.flight import DT, gone_wrong, random_flights
from hybrid_jax.vehicle import IRIS, load_vehicle

FLIGHTS, SECONDS = 20, 20.0
NOISE = np.repeat([1e-3, 1e-3, 0.02, 0.02], [3, 4, 3, 3])  # m, 1, m/s, rad/s
Parts = dict[str, np.ndarray]


def parts_of(log: FlightLog) -> Parts:
    return {"t": log.t, "p": log.x[:, :3], "q": log.x[:, 3:7], "v": log.x[:, 7:10], "w": log.x[:, 10:], "u": log.u}


def later(name: str, rows: int) -> Callable[[Parts], Parts]:
    """A quantity that comes late, or others that do for a negative number of rows."""
    own, others = (slice(None, -rows), slice(rows, None)) if rows > 0 else (slice(-rows, None), slice(None, rows))
    return lambda log: {key: value[own if key == name else others] for key, value in log.items()}


def held(names: str, rows: int) -> Callable[[Parts], Parts]:
    kept = lambda n: np.arange(n) // rows * rows  # noqa: E731
    return lambda log: log | {name: log[name][kept(len(log["t"]))] for name in names}


def drawn(log: Parts) -> Parts:
    t = log["t"]
    return log | {name: np.stack([np.interp(t, t[::4], c) for c in log[name][::4].T], axis=1) for name in "pv"}


def turned(log: Parts):
    return rotation_of(log["q"])


def as_ned(log: Parts) -> Parts:
    q = quaternion_of(turned(log).from_matrix(WORLDS["NED"] @ turned(log).as_matrix() @ BODIES["FRD"]))
    return {"t": log["t"], "p": log["p"] @ WORLDS["NED"], "q": q, "v": log["v"] @ WORLDS["NED"], "u": log["u"]} | {
        "w": log["w"] @ BODIES["FRD"]
    }


def about_z(angle, q):
    turn = rotation_of(np.eye(4)[:1]).from_rotvec(np.multiply.outer(angle, [0.0, 0.0, 1.0]))
    return quaternion_of(turn * rotation_of(q))


def clockwise(q):
    return about_z(-2 * rotation_of(q).as_euler("ZYX")[:, 0], q)


def columns(name: str, change) -> Callable[[Parts], Parts]:
    return lambda log: log | {name: change(log[name])}


UP, SIDE = [1, 1, -1], [-1, 1, 1]
# Kind → mistake → what it does to a log, and the words that name it.
MISTAKES: dict[str, dict[str, tuple[Callable[[Parts], Parts], str]]] = {
    "sign": {
        "vz": (columns("v", lambda v: v * UP), "vz and pz have opposite signs"),
        "vx": (columns("v", lambda v: v * SIDE), "vx and px have opposite signs"),
        "gyro z": (columns("w", lambda w: w * UP), "wz has the wrong sign"),
        "gyro": (columns("w", lambda w: -w), "opposite sign"),
        "qy": (columns("q", lambda q: q * [1, 1, -1, 1]), "qy has the wrong sign"),
        "height down": (lambda log: log | {name: log[name] * UP for name in "pv"}, "height is counted downwards"),
    },
    "axis, order": {
        "x and y of position": (columns("p", lambda p: p[:, [1, 0, 2]]), "exchanged"),
        "x and y of the gyro": (columns("w", lambda w: w[:, [1, 0, 2]]), "x and y of the body rates"),
        "y of the world": (lambda log: log | {name: log[name] * [1, -1, 1] for name in "pv"}, "left-handed: flip"),
        "x, y of the world": (lambda log: log | {name: log[name][:, [1, 0, 2]] for name in "pv"}, "left-handed: exch"),
        "motors 2 0 3 1": (columns("u", lambda u: u[:, [2, 0, 3, 1]]), "motor_order=(1, 3, 0, 2)"),
        "two motors": (columns("u", lambda u: u[:, [1, 0, 2, 3]]), "motor_order=(1, 0, 2, 3)"),
        "xyzw read as wxyz": (columns("q", lambda q: np.roll(q, -1, axis=1)), "(x, y, z, w), read as"),
        "wxyz read as xyzw": (columns("q", lambda q: np.roll(q, 1, axis=1)), "declare wxyz"),
        "yaw clockwise": (columns("q", clockwise), "counted clockwise"),
        "yaw from y": (columns("q", lambda q: about_z(-np.pi / 2, q)), "off by 90°"),
        "yaw backwards": (columns("q", lambda q: about_z(np.pi, q)), "off by 180°"),
        "world to body": (columns("q", lambda q: q * [1, -1, -1, -1]), "conjugate"),
    },
    "frame": {
        "NED and FRD": (as_ned, 'world = "NED" and body = "FRD"'),
        "velocity in the body": (lambda log: log | {"v": turned(log).inv().apply(log["v"])}, "body frame (FLU)"),
        "velocity in the world": (lambda log: log | {"v": turned(log).apply(log["v"])}, "in the world, read as"),
        "velocity NED": (columns("v", lambda v: v @ WORLDS["NED"]), "velocity is NED"),
        "gyro FRD": (columns("w", lambda w: w @ BODIES["FRD"]), "FRD"),
        "gyro in the world": (lambda log: log | {"w": turned(log).apply(log["w"])}, "world frame"),
    },
    "unit": {
        "position mm": (columns("p", lambda p: 1e3 * p), "position is in mm"),
        "velocity cm/s": (columns("v", lambda v: 1e2 * v), "velocity is in cm/s"),
        "velocity km/h": (columns("v", lambda v: 3.6 * v), "velocity is in km/h"),
        "position feet": (columns("p", lambda p: p / 0.3048), "position is in feet"),
        "gyro deg/s": (columns("w", np.rad2deg), "degrees per second"),
        "gyro declared deg/s": (columns("w", np.deg2rad), "declare rad/s"),
        "rotors rpm": (columns("u", lambda u: u * 30 / np.pi), "rpm"),
        "PWM as speeds": (columns("u", lambda u: 1000 + u / 1.1), "PWM in µs"),
        "percent as speeds": (columns("u", lambda u: u / 11), "percent of a command"),
        "rotors rad/s as rpm": (columns("u", lambda u: u * np.pi / 30), "read as rpm"),
        "commands as speeds": (columns("u", lambda u: u / 1100), "command"),
        "time ms": (columns("t", lambda t: 1e3 * t), "in ms"),
    },
    "time": {
        "velocity 0.1 s late": (later("v", 10), "0.1 s late"),
        "gyro 0.2 s late": (later("w", 20), "0.2 s late"),
        "motors 50 ms early": (later("u", -5), "ms later"),
        "clock twice as fast": (columns("t", lambda t: t / 2), "times the second"),
        "clock set back": (columns("t", lambda t: np.where(t > t[-1] / 2, t - t[-1] / 4, t)), "goes back"),
        "rows shuffled": (columns("t", lambda t: np.random.default_rng(0).permutation(t)), "sort them by time"),
        "six digits": (columns("t", lambda t: np.round(t + 12345.0)), "too few digits"),
        "16 bits of ms": (columns("t", lambda t: (t + 60) % 65.536), "16 bits of ms"),
    },
    "rate": {
        "33 Hz, repeated": (held("pqv", 3), "33.3 Hz"),
        "rotors 20 Hz, repeated": (held("u", 5), "motors 20 Hz"),
        "25 Hz, lines": (drawn, "25 Hz"),
        "one gap of most of it": (columns("t", lambda t: np.where(t > t[-1] / 2, t + 100, t)), "most of the log"),
    },
    "motors, limits": {
        "one twice": (columns("u", lambda u: u[:, [0, 0, 2, 3]]), "equal in every sample"),
        "one not logged": (columns("u", lambda u: u * [1, 0, 1, 1]), "u1 never changes"),
        "another instance": (columns("u", lambda u: 0 * u), "another topic, instance"),
        "gyro clipped": (columns("w", lambda w: np.clip(w, *np.quantile(w, [0.02, 0.98], axis=0))), "saturates"),
        "beyond the largest": (columns("u", lambda u: u + 800 * (u > np.quantile(u, 0.99))), "max_rotor_speed"),
    },
}  # fmt: skip


def sound_logs(domain: Domain, seed: int) -> list[FlightLog]:
    found, rng = random_flights(domain, FLIGHTS, SECONDS, jax.random.key(seed)), np.random.default_rng(seed)
    logs = []
    for i in np.flatnonzero(~gone_wrong(found.states)):
        x, u = np.array(found.states[i], float), np.array(found.inputs[i], float)
        x += NOISE * rng.normal(size=x.shape)
        x[:, 3:7] /= np.linalg.norm(x[:, 3:7], axis=1, keepdims=True)
        u = np.maximum(np.concatenate([u, u[-1:]]) + rng.normal(size=(len(x), 4)), 0.0)
        logs.append(FlightLog(DT * np.arange(len(x)), x, u))
    return logs


def recording_of(log: Parts) -> Recording:
    """What a reader of CSV makes of such columns."""
    names = {"p": "position", "q": "attitude", "v": "velocity", "w": "rates", "u": "rotor_speed"}
    samples = {name: Samples(log["t"], log[key], f"columns of {name}") for key, name in names.items()}
    return record("flight", samples, facts={"format": "CSV"})


def said(log: Parts) -> list[tuple[str, str]]:
    """Verdict and suggestion of every check that does not pass; or why the log is refused."""
    try:
        recording = recording_of(log)
        whole = FlightLog(log["t"], np.concatenate([log[name] for name in "pqvw"], axis=1), log["u"])
        found = [*check_recording(recording, IRIS, DT), *check_log(whole, IRIS)]
    except ValueError as error:
        return [(FAILS, str(error))]
    return [(check.verdict, f"{check.name}: {check.suggestion}") for check in found if check.verdict in (FAILS, WARNS)]


# Checks whose failure says what a log holds: nothing that flew, too little, or not the whole of it.
CONTENT = ("whole file", "airframe", "motors turn", "quantities", "repeated samples", "time on the ground")


def checks_of(path: Path, top: Path) -> tuple[list[Check], str]:
    """All checks of a log, and why there are none that compare its signals; empty if there are."""
    above = [each for each in path.parents if each.is_relative_to(top)]
    vehicle, columns = (
        next((each / name for each in above if (each / name).is_file()), None) for name in ("vehicle.toml", "map.toml")
    )
    vehicle = None if vehicle is None else load_vehicle(vehicle)
    try:
        raw = read_recording(path, columns=columns)
    except ValueError as error:
        return [], str(error)
    slowest = max((each.interval for name, each in raw.signals.items() if name != "voltage"), default=1.0)
    found = check_recording(raw, vehicle, slowest)
    try:
        log, _ = in_flight(flight_at(raw, slowest, (0.0, 1.0)))
        return [*found, *check_log(log, vehicle)], ""
    except ValueError as error:
        return found, str(error)


def logs_below(folder: Path) -> Iterator[Path]:
    logs, left = find_logs(folder)
    yield from logs
    for each in (path for path in left if path.is_dir()):
        yield from logs_below(each)


def count_alarms(folder: Path) -> int:
    """Print how many checks fail on the sound logs of a folder, and which; return their number."""
    run, warning, lines, alone = 0, Counter(), [], Counter()
    paths = [*logs_below(folder)]
    for path in paths:
        checks, why = checks_of(path, folder)
        judged = [check for check in checks if check.name not in CONTENT and check.verdict != UNKNOWN]
        run += len(judged)
        warning.update(check.name for check in judged if check.verdict == WARNS)
        lines += [f"  {path.name}: {c.name} {c.value:.3g}: {c.suggestion}" for c in judged if c.verdict == FAILS]
        alone.update([why.removeprefix(f"{path}: ").split(";")[0]] if why else [])
    alarms = len(lines)
    counted = f"{len(paths)} logs, {run} checks, {alarms} fail ({100 * alarms / max(run, 1):.2f} %)"
    lines += [f"  warnings: {dict(warning)}", *(f"  {n} not compared: {why}" for why, n in alone.items())]
    print(f"{folder}: {counted}", *lines, sep="\n", flush=True)
    return alarms


@dataclass(frozen=True)
class Options:
    """Count the checks that fail on sound logs; without a folder, plant mistakes in simulated flights and name them."""

    folders: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """Logs, also in folders below, in which nothing is wrong."""


def matrix() -> int:
    sound = {
        domain.name: sound_logs(domain, seed) for seed, domain in enumerate((SOURCE, PARAMETER_SHIFT, EXTERNAL_FORCE))
    }
    for name, logs in sound.items():
        alarms = [line for log in logs for verdict, line in said(parts_of(log)) if verdict == FAILS]
        warned = sum(any(verdict == WARNS for verdict, _ in said(parts_of(log))) for log in logs)
        print(f"{name}: {len(logs)} sound logs, {len(alarms)} checks fail, {warned} logs with a warning", *alarms[:3])
    print("\n| kind | mistake | found | says |\n|---|---|---|---|")
    least, logs = 1.0, sound[SOURCE.name]
    for kind, mistakes in MISTAKES.items():
        for mistake, (make, words) in mistakes.items():
            lines = [[line for _, line in said(make(parts_of(log)))] for log in logs]
            share = float(np.mean([any(words in line for line in each) for each in lines]))
            least = min(least, share)
            print(f"| {kind} | {mistake} | {100 * share:.0f} % | {words} |", flush=True)
            if share < 0.95:
                print("     ", lines[0][:3], file=sys.stderr)
    return 0 if least >= 0.95 else 1


if __name__ == "__main__":
    with exit_codes("benchmarks.log_mistakes", "", "interrupted"):
        given = parsed(Options, "python -m benchmarks.log_mistakes", None).folders
        sys.exit(int(sum(map(count_alarms, given)) > 0) if given else matrix())
