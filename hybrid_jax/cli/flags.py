"""Messages of the library in the words of a command: what it calls an argument, the command calls an option."""

import re
from collections.abc import Mapping

# Command → argument → option. Those of the pages on logs are options of real_flight, which trains on the logs.
_CLEANING = ("in_flight", "resample", "longest_gap", "low_pass", "align", "delay")
_LOGS = {name: f"--{name.replace('_', '-')}" for name in ("columns", "polynomial", "topics", "motor_order", "dt")}
_TOOL = _LOGS | {"failed": "--anyway"}  # which cuts and resamples flights by itself
_LOGS |= {name: f"--cleaning.{name.replace('_', '-')}" for name in _CLEANING} | {"failed": "--anyway"}
FLAGS: Mapping[str, Mapping[str, str]] = {
    "real_flight": _LOGS | {"dt": "--cleaning.resample"},
    **dict.fromkeys(("inspect", "fit", "identify", "adapt", "check", "replay"), _TOOL),
}
_KEYS = ("columns", "polynomial")  # words of column maps as well: options only before a value
_VALUE = r"\([^)]*\)|\{[^}]*\}|\"[^\"]*\"|[^\s,;:)]+"


def in_flags(command: str, message: str) -> str:
    """A message in which `argument=value` and `argument must …` name the options of a command, if it has such."""
    flags = FLAGS.get(command, {})
    if not flags:
        return message
    named, free = "|".join(flags), "|".join(name for name in flags if name not in _KEYS)
    message = re.sub(rf"\b({named})=({_VALUE})", lambda found: _option(flags[found[1]], found[2]), message)
    return re.sub(rf"\b({free})(?=: | must | needs )", lambda found: flags[found[1]], message)


def _option(flag: str, value: str) -> str:
    """An option with its value, as it is typed."""
    if value in ("True", '"warn"'):
        return flag
    pairs = re.sub(r"\"([^\"]*)\": *", r"\1=", value)
    typed = re.sub(r"[(){}\"]", "", pairs).replace(", ", "," if value.startswith("(") else " ").rstrip(",…")
    return f"{flag} {typed}".rstrip()
