"""Weight errors by what slowly logged commands may have done between two samples.

A command is the line between its samples plus a Brownian bridge (Karhunen–Loève series over an interval of T seconds)

    B(s) = √T L Σⱼ ξⱼ √2 sin(jπ s) / (jπ),   ξⱼ ~ N(0, 1),   L Lᵀ = cov(changes) / T,   0 ≤ s ≤ 1

Predictions use the line; the bridge adds a covariance B Bᵀ, B = ∂ŷ/∂ξ, to the errors (generalised least squares).
Fitted ξ would bias the inertias, since smaller ones need smaller ξ.
"""

import numpy as np
from jaxtyping import Bool, Float, Int

from hybrid_jax.flights.recording import Signal

SLOW = 0.03  # s between samples above which commands are unknown in between
MODES = 2  # terms of the series, with three quarters of the variance
ITERATIONS = 10  # of the noise
REACH = 0.1  # s before a window in which commands still affect it


def is_slow(signal: Signal) -> bool:
    return len(signal) > 2 and signal.interval > SLOW


def count(signal: Signal, length: float) -> int:
    """Return how many intervals between samples affect a window of this length [s]; 0 for fast commands."""
    return int(np.ceil((length + REACH) / signal.interval)) + 1 if is_slow(signal) else 0


def root(signals: list[Signal]) -> Float[np.ndarray, "m m"]:
    """Return L of the slow signals [1/√s]; 0 if there are none."""
    m = signals[0].values.shape[1]
    slow = [each for each in signals if is_slow(each)]
    steps = [np.diff(each.values, axis=0) / np.sqrt(np.diff(each.t))[:, None] for each in slow]
    if not steps:
        return np.zeros((m, m))
    changes = np.concatenate(steps)
    value, vector = np.linalg.eigh(changes.T @ changes / len(changes))
    return vector * np.sqrt(np.maximum(value, 0.0))


def whitened(
    r: Float[np.ndarray, "n r"],
    effects: Float[np.ndarray, "n r u"],
    there: Bool[np.ndarray, "n r"],
    channel: Int[np.ndarray, " r"],
) -> tuple[Float[np.ndarray, " c"], Float[np.ndarray, "n r r"]]:
    """Return the noise of each channel without the bridges, and the whitening W of each window: Wᵀ W = (1 + B Bᵀ)⁻¹.

    Errors `r` and B = `effects` are in units of the noise, which is found by expectation maximisation.
    """
    noise = np.ones(channel.max() + 1)
    precision, counts = _precision(effects, noise[channel]), np.bincount(channel, there.sum(axis=0))
    for _ in range(ITERATIONS):
        unit = noise[channel]
        left = (precision @ (r / unit)[..., None])[..., 0] ** 2 + 1 - np.diagonal(precision, axis1=1, axis2=2)
        noise = np.sqrt(np.bincount(channel, (left * unit**2 * there).sum(axis=0)) / counts)
        precision = _precision(effects, noise[channel])
    return noise, np.linalg.cholesky(precision).swapaxes(1, 2)


def _precision(b: Float[np.ndarray, "n r u"], unit: Float[np.ndarray, " r"]) -> Float[np.ndarray, "n r r"]:
    scaled = b / unit[:, None]
    return np.linalg.inv(np.eye(len(unit)) + scaled @ scaled.swapaxes(1, 2))


def spans(signal: Signal, begin: Float[np.ndarray, " n"], end: Float[np.ndarray, " n"], most: int):
    """Return the last intervals between samples from each begin to its end [s] (n, most, 2); none for a fast signal."""
    if not is_slow(signal):
        return np.zeros((len(end), most, 2))
    last = np.searchsorted(signal.t, end)[:, None] - np.arange(most)
    return signal.t[np.clip(last[..., None] - [1, 0], 0, len(signal) - 1)] - begin[:, None, None]


def bridges(
    spans: Float[np.ndarray, "n i 2"], edges: Float[np.ndarray, " k"], root: Float[np.ndarray, "m w"]
) -> Float[np.ndarray, "n j k-1 m"]:
    """Return the mean over each interval between `edges` [s] of every term of the bridges over spans."""
    begin, length = spans[..., :1], np.diff(spans)
    s = np.clip((edges - begin) / np.where(length > 0, length, 1.0), 0.0, 1.0)
    waves = np.pi * np.arange(1, MODES + 1)
    area = np.sqrt(2) * length[..., None] ** 1.5 * (1 - np.cos(waves * s[..., None])) / waves**2
    means = np.diff(area, axis=2) / np.diff(edges)[:, None]
    return np.einsum("nikj,mw->nijwkm", means, root).reshape(len(spans), -1, len(edges) - 1, len(root))
