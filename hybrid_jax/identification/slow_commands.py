"""What commands may have done between two samples of a log that holds few of them.

An autopilot sends hundreds of commands in a second, and by default PX4 logs ten of them. Between two samples a command
is then the line between them plus a Brownian bridge: a random walk that is known at both ends. Its covariance is that
of the changes from sample to sample. The bridge is its Karhunen–Loève series

    B(s) = √T L Σⱼ ξⱼ √2 sin(jπ s) / (jπ),   ξⱼ ~ N(0, 1),   L Lᵀ = cov(changes) / T,   0 ≤ s ≤ 1

over an interval of T seconds. Predictions know the line only. What the bridge does to them is an error with a known
covariance, B Bᵀ with B = ∂ŷ/∂ξ, by which the errors of a window are weighted (generalised least squares). Fitted as
unknowns, like an initial state, the ξ would favour vehicles that turn at smaller ξ: inertias come out too small.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hybrid_jax.dynamics.actuators import Numbers
from hybrid_jax.flights.recording import Signal

SLOW = 0.03  # s between samples, from which on commands are unknown in between
MODES = 2  # terms of the series, with three quarters of the variance
ITERATIONS = 10  # of the noise beside the bridges
REACH = 0.1  # s before a window by which commands still matter to it


def is_slow(signal: Signal) -> bool:
    return len(signal) > 2 and signal.interval > SLOW


def count(signal: Signal, length: float) -> int:
    """How many intervals between samples may matter to a window of this length [s]; 0 of fast commands."""
    return int(np.ceil((length + REACH) / signal.interval)) + 1 if is_slow(signal) else 0


def lines(signal: Signal, dt: float) -> tuple[Float[np.ndarray, " s"], Float[np.ndarray, "s m"]]:
    """Times and values of commands that are held; slow ones as the means over steps of dt [s] of lines between them."""
    values = np.asarray(signal.values)
    if not is_slow(signal):
        return signal.t, values
    t = np.arange(signal.t[0], signal.t[-1], dt)
    return t, np.stack([np.interp(t + dt / 2, signal.t, column) for column in values.T], axis=1)


def spans(signal: Signal, end: Float[np.ndarray, " n"], most: int) -> Float[np.ndarray, "n most 2"]:
    """Begin and end [s] of the last intervals between samples before each time; of no length where there are none."""
    if not is_slow(signal):
        return np.repeat(end[:, None, None], most, axis=1) + np.zeros(2)
    last = np.searchsorted(signal.t, end)[:, None] - np.arange(most)
    at = np.clip(last[..., None] - [1, 0], 0, len(signal) - 1)
    return signal.t[at]


def root(signals: list[Signal]) -> Float[np.ndarray, "m m"]:
    """L of the slow signals [1/√s]; 0 if there are none."""
    m = signals[0].values.shape[1]
    slow = [each for each in signals if is_slow(each)]
    steps = [np.diff(each.values, axis=0) / np.sqrt(np.diff(each.t))[:, None] for each in slow]
    if not steps:
        return np.zeros((m, m))
    changes = np.concatenate(steps)
    value, vector = np.linalg.eigh(changes.T @ changes / len(changes))
    return vector * np.sqrt(np.maximum(value, 0.0))


def whitened(errors: dict, slopes: dict, there: dict, scale: dict):
    """The noise of each channel beside what the bridges do, and the whitening W of each window: Wᵀ W = (1 + B Bᵀ)⁻¹.

    Errors and B are in units of the noise there. The noise is found by expectation maximisation (Dempster, Laird and
    Rubin 1977) from the first guess `scale`.

    Args:
        errors: of n windows, (n, t, k) by quantity.
        slopes: ∂ŷ/∂ξ of them, (n, t, k, ξ).
        there: whether something was measured, (n, t).
    """
    sizes = [part.shape[2] for part in errors.values()]
    first = np.cumsum([0, *sizes])
    r = np.concatenate([np.asarray(part).reshape(len(part), -1) for part in errors.values()], axis=1)
    b = np.concatenate([np.asarray(part).reshape(len(r), -1, part.shape[-1]) for part in slopes.values()], axis=1)
    seen = np.concatenate([np.repeat(there[name], k, axis=1) for name, k in zip(errors, sizes, strict=True)], axis=1)
    steps = r.shape[1] // first[-1]
    channel = np.concatenate([np.tile(at + np.arange(k), steps) for at, k in zip(first[:-1], sizes, strict=True)])
    noise = np.concatenate([np.broadcast_to(scale[name], k) for name, k in zip(errors, sizes, strict=True)])
    precision = _precision(b, noise[channel])
    for _ in range(ITERATIONS):
        unit = noise[channel]
        left = (precision @ (r / unit)[..., None])[..., 0] ** 2 + 1 - np.diagonal(precision, axis1=1, axis2=2)
        counts = np.bincount(channel, seen.sum(axis=0))
        noise = np.sqrt(np.bincount(channel, (left * unit**2 * seen).sum(axis=0)) / counts)
        precision = _precision(b, noise[channel])
    return dict(zip(errors, np.split(noise, first[1:-1]), strict=True)), np.linalg.cholesky(precision).swapaxes(1, 2)


def _precision(b: Float[np.ndarray, "n r u"], unit: Float[np.ndarray, " r"]) -> Float[np.ndarray, "n r r"]:
    scaled = b / unit[:, None]
    return np.linalg.inv(np.eye(len(unit)) + scaled @ scaled.swapaxes(1, 2))


def means(
    unknown: Float[Numbers, " i*j*m"],
    spans: Float[Numbers, "i 2"],
    root: Float[Numbers, "m m"],
    edges: Float[Numbers, " k"],
    delay: Array | float = 0.0,
) -> Float[Array, "k-1 m"]:
    """The bridges' means over each interval between `edges` [s], with commands that act `delay` [s] later."""
    begin, length = spans[:, :1], spans[:, 1:] - spans[:, :1]
    s = jnp.clip((edges - delay - begin) / jnp.where(length > 0, length, 1.0), 0.0, 1.0)
    waves = jnp.pi * jnp.arange(1, MODES + 1)
    area = np.sqrt(2) * length[..., None] ** 1.5 * (1 - jnp.cos(waves * s[..., None])) / waves**2
    each = unknown.reshape(len(spans), MODES, len(root)) @ root.T
    return jnp.diff(jnp.einsum("ikj,ijm->km", area, each), axis=0) / jnp.diff(edges)[:, None]
