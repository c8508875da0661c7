"""Messages of the library in the words of a command: what it calls an argument, the command calls an option."""

import re

READ_LOGS = ("inspect", "fit", "identify", "adapt", "check", "replay", "real_flight")  # commands with these options
_SAME = ("columns", "polynomial", "topics", "motor_order", "dt", "delay")
FLAGS = {name: f"--{name.replace('_', '-')}" for name in _SAME} | {"failed": "--anyway"}
_KEYS = ("columns", "polynomial")  # words of column maps as well: options only before a value
_NAMED, _FREE = "|".join(FLAGS), "|".join(name for name in FLAGS if name not in _KEYS)
_VALUE = r"\([^)]*\)|\{[^}]*\}|\"[^\"]*\"|[^\s,;:)]+"


def in_flags(command: str, message: str) -> str:
    """A message in which `argument=value` and `argument must …` name the options of a command, if it has such."""
    if command not in READ_LOGS:
        return message
    message = re.sub(rf"\b({_NAMED})=({_VALUE})", lambda found: _option(FLAGS[found[1]], found[2]), message)
    return re.sub(rf"\b({_FREE})(?=: | must | needs )", lambda found: FLAGS[found[1]], message)


def _option(flag: str, value: str) -> str:
    """An option with its value, as it is typed."""
    if value in ("True", '"warn"'):
        return flag
    pairs = re.sub(r"\"([^\"]*)\": *", r"\1=", value)
    typed = re.sub(r"[(){}\"]", "", pairs).replace(", ", "," if value.startswith("(") else " ").rstrip(",…")
    return f"{flag} {typed}".rstrip()
