"""Layout of a multirotor's state x (13) and input u (one for each rotor).

x = [p, q, v, ω]: position p [m, world frame, z up]; unit quaternion q = (w, x, y, z), body → world; velocity
v [m/s, world frame]; body rates ω [rad/s, body frame: x forward, y left, z up]. u: the rotor speeds [rad/s].
"""

from jaxtyping import Array, Float

POSITION = slice(0, 3)
QUATERNION = slice(3, 7)
VELOCITY = slice(7, 10)
BODY_RATES = slice(10, 13)

STATE_NAMES = ("px", "py", "pz", "qw", "qx", "qy", "qz", "vx", "vy", "vz", "wx", "wy", "wz")
INPUT_NAMES = ("u0", "u1", "u2", "u3")  # of a quadrotor; see `input_names`
STATE_SIZE = len(STATE_NAMES)
INPUT_SIZE = len(INPUT_NAMES)

# Typical standard deviations of each entry of these four: motion capture [m, of quaternions, m/s], a gyroscope [rad/s].
SENSOR_NOISE = (0.001, 0.002, 0.02, 0.02)

State = Float[Array, "13"]
Input = Float[Array, " rotors"]  # rad/s


def input_names(rotors: int) -> tuple[str, ...]:
    return tuple(f"u{i}" for i in range(rotors))
