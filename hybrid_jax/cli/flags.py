"""Translate arguments in the library's messages to options of a command."""

import re

READ_LOGS = ("inspect", "fit", "identify", "adapt", "check", "replay", "real_flight")  # commands with these options
_SAME = ("columns", "polynomial", "topics", "motor_order", "dt", "delay")
FLAGS = {name: f"--{name.replace('_', '-')}" for name in _SAME} | {"failed": "--anyway"}
_KEYS = ("columns", "polynomial")  # words of column maps as well: options only before a value
_NAMED, _FREE = "|".join(FLAGS), "|".join(name for name in FLAGS if name not in _KEYS)
_VALUE = r"\([^)]*\)|\{[^}]*\}|\"[^\"]*\"|[^\s,;:)]+"


def in_flags(command: str, message: str) -> str:
    """Replace `argument=value` and `argument must …` by the options of a command, if it has them."""
    if command not in READ_LOGS:
        return message
    message = re.sub(rf"\b({_NAMED})=({_VALUE})", lambda found: _option(FLAGS[found[1]], found[2]), message)
    return re.sub(rf"\b({_FREE})(?=: | must | needs )", lambda found: FLAGS[found[1]], message)


def _option(flag: str, value: str) -> str:
    """Format an option with its value."""
    if value in ("True", '"warn"'):
        return flag
    pairs = re.sub(r"\"([^\"]*)\": *", r"\1=", value)
    typed = re.sub(r"[(){}\"]", "", pairs).replace(", ", "," if value.startswith("(") else " ").rstrip(",…")
    return f"{flag} {typed}".rstrip()
