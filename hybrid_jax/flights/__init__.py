"""Recorded flights: read logs, check them, clean them and cut them into training windows.

    windows = hj.load_windows("flights/", hj.load_vehicle("vehicle.toml"), steps=10)  # one CSV or ULog file per flight

Its steps can be taken one by one. Split by flight before cutting, since windows of one flight share samples and wind:

    train, test = hold_out(load_logs("flights/"), ["flight_07"])
    windows = cut_windows(train, steps=10).windows
"""

from hybrid_jax.flights.cleaning import (
    align_motors,
    choose_time_constant,
    delay_motors,
    in_flight,
    lag_motors,
    low_pass,
    resample,
)
from hybrid_jax.flights.column_map import ColumnMap, load_column_map
from hybrid_jax.flights.consistency import Check, check_log
from hybrid_jax.flights.log import FlightLog
from hybrid_jax.flights.scores import FlightErrors, flight_errors
from hybrid_jax.flights.windows import LogWindows, cut_windows, folds, hold_out, load_log, load_logs, load_windows

__all__ = [
    "Check",
    "ColumnMap",
    "FlightErrors",
    "FlightLog",
    "LogWindows",
    "align_motors",
    "check_log",
    "choose_time_constant",
    "cut_windows",
    "delay_motors",
    "flight_errors",
    "folds",
    "hold_out",
    "in_flight",
    "lag_motors",
    "load_column_map",
    "load_log",
    "load_logs",
    "load_windows",
    "low_pass",
    "resample",
]
