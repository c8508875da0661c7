"""Recorded flights: read logs, check them, clean them and cut them into training windows.

    vehicle = hj.load_vehicle("vehicle.toml")
    windows = hj.load_windows("flights/", vehicle, steps=10)  # a log of any format per flight

You can also take each step yourself. Split by flight before cutting: windows of one flight share samples and wind.

    train, test = hold_out(load_logs("flights/"), ["flight_07"])
    windows = cut_windows(train, steps=10)
"""

from hybrid_jax.flights.checks.cleaning import Cleaning, clean
from hybrid_jax.flights.checks.consistency import Check, check_log
from hybrid_jax.flights.checks.suitability import check_recording
from hybrid_jax.flights.conversion import to_flight
from hybrid_jax.flights.load import find_logs, load_log, load_logs, read_recording
from hybrid_jax.flights.log import FlightLog
from hybrid_jax.flights.recording import Recording, Signal
from hybrid_jax.flights.windows import FlightErrors, cut_windows, flight_errors, folds, hold_out, load_windows

__all__ = ["Check", "Cleaning", "FlightErrors", "FlightLog", "Recording", "Signal"]
__all__ += ["check_log", "check_recording", "clean", "cut_windows", "find_logs", "flight_errors", "folds", "hold_out"]
__all__ += ["load_log", "load_logs", "load_windows", "read_recording", "to_flight"]
