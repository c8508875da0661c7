"""The options of all commands that read logs of flights."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True, kw_only=True)
class LogOptions:
    """How the logs of a folder are read."""

    columns: Path | None = None
    """TOML file of the columns, units and frames of CSV logs: see docs/howto/logs.md."""
    topics: tuple[str, ...] = ()
    """Topics of ROS bags, such as odometry=/odom motors=/rotors:data:rpm; also pose, imu, voltage."""
    motor_order: tuple[int, ...] = ()
    """Which motor of the log, from 0, each rotor of the vehicle file is, such as 2,0,3,1."""

    @property
    def reading(self) -> dict[str, Any]:
        """The arguments of the functions of `hybrid_jax.flights.load`; ValueError for topics that are no pairs."""
        for word in self.topics:
            if "=" not in word:
                raise ValueError(f"--topics must be words such as odometry=/odom, got {word!r}")
        topics = dict(word.split("=", 1) for word in self.topics)
        return {"columns": self.columns, "topics": topics, "motor_order": self.motor_order}


@dataclass(frozen=True, kw_only=True)
class SpeedOptions(LogOptions):
    """How the logs of a folder are read, for models whose inputs are rotor speeds."""

    polynomial: tuple[float, ...] = ()
    """For logs of commands without rotor speeds: rotor speed [rad/s] = c0 + c1 command + c2 command² …, the command
    from 0 (stop) to 1 (full). It comes from a test stand, or from two points: 100,1000 if a motor turns with 100 rad/s
    as it starts and with 1100 at the full command. PWM of 1000 … 2000 µs and DShot are turned into 0 … 1 beforehand."""


def require_distinct(flights: Sequence[tuple[str, Any]]) -> None:
    """Refuse a flight that occurs twice, whatever its files are called; `flights` are names and what tells them apart.

    It could be both in training and in a test.
    """
    first: dict[Any, str] = {}
    for name, content in flights:
        if content in first:
            raise ValueError(f"{name}: the same flight as {first[content]}; leave one of the two out")
        first[content] = name
