"""Set the scaling of networks from the training windows: inputs to mean 0 and deviation 1, outputs to the RMS of ẋ."""

from dataclasses import replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hybrid_jax.dynamics import AbstractVectorField, batching, unfreeze
from hybrid_jax.dynamics.base import parts_of
from hybrid_jax.dynamics.batching import AbstractBatchNorm, RunningStats
from hybrid_jax.integrate import rollout_batch
from hybrid_jax.networks.grids import GridNetwork
from hybrid_jax.networks.mlp import ResidualNetwork
from hybrid_jax.networks.normalisation import AbstractScaling, Channels, ChannelScaling
from hybrid_jax.trajectories import Trajectories, last_measured

SAMPLES, SMALL = 10_000, 64  # most intervals used, for states of up to 64 numbers; fewer for larger states
KEPT, MOST = 50_000, 100  # most numbers and windows that a network stores
FLOOR = 0.01  # least scale of an input over the size of its mean, and of an output over the size of ẋ


class _Probe(AbstractBatchNorm, AbstractScaling):
    """A scaling that records the moments of the input in training mode and zeroes the output in inference mode."""

    running: RunningStats
    momentum: float = eqx.field(static=True, default=0.0)
    seen: batching.Moments | None = None

    def training_mode(self, seen):
        return _Probe(self.running, seen=seen)

    def concatenate(self, x, u):
        z = jnp.concatenate([x, u])
        if self.seen is None:
            return z
        mean, centred, _ = batching.record_moments(z, self.seen)
        return batching.expand_trailing(mean, centred) + centred

    def outputs(self, y):
        return jnp.zeros_like(y) if self.seen is None else y


def with_motion(field: AbstractVectorField, windows: Trajectories) -> AbstractVectorField:
    """Store some of the training windows in the scaling of each network, for `hj.adapt`."""
    places = np.linspace(0, len(windows) - 1, min(len(windows), max(1, KEPT // windows[0].x.size), MOST)).astype(int)
    if not (networks := _networks(field)):
        return field
    kept = [jax.tree.map(partial(jnp.asarray, dtype=n.weight_in.dtype), windows[places]) for n in networks]
    scalings = [replace(network.scaling, learned_from=own) for network, own in zip(networks, kept, strict=True)]
    return eqx.tree_at(_scalings, field, scalings)


def motion_of(field: AbstractVectorField) -> Trajectories | None:
    """Return the training windows stored by `with_motion`, or None."""
    return next((one.learned_from for one in _scalings(field) if one.learned_from is not None), None)


def with_scaling(field: AbstractVectorField, windows: Trajectories) -> AbstractVectorField:
    """Set each `ChannelScaling` of a field that is not set yet (see `residual_network`) from windows.

    Inputs are scaled to mean 0 and standard deviation 1. Outputs are scaled to the RMS of the derivative that the rest
    of the field lacks, if there is an output for each state or, in a `GridNetwork`, for each component.

    Args:
        field: a field that contains networks. A field without networks is returned unchanged.
        windows: the training windows.
    """
    networks = _networks(field)
    unset = [eqx.tree_equal(network.scaling, ChannelScaling()) for network in networks]
    if not any(unset):
        return field
    x0, u, after = np.asarray(windows.x0), np.asarray(windows.u), last_measured(windows)
    before = np.concatenate([x0[:, None], after[:, :-1]], axis=1)
    samples = before.shape[0] * before.shape[1]
    every = -(-samples // max(1, SAMPLES * SMALL // max(SMALL, before.shape[2])))
    x, u, after = (rows.reshape(samples, rows.shape[-1])[::every] for rows in (before, u, after))  # u may be empty
    zeros = (jnp.zeros(network.weight_in.shape[1], jnp.result_type(x)) for network in networks)
    pairs = zip(networks, zeros, unset, strict=True)
    probes = [_Probe(RunningStats(zero, zero)) if new else network.scaling for network, zero, new in pairs]
    probed = unfreeze(eqx.tree_at(_scalings, field, probes))

    predicted = np.asarray(rollout_batch(probed, x, u[:, None], windows.dt))[:, 0]
    lacking, rate = (np.sqrt(np.mean(np.square(after - start), axis=0)) / windows.dt for start in (predicted, x))
    grids = [part for part in parts_of(field) if isinstance(part, GridNetwork)]
    seen, scalings = iter(_seen(probed, x.T, u.T)), []
    for network, new in zip(networks, unset, strict=True):
        if not new:
            scalings.append(network.scaling)
            continue
        count, *sums = np.asarray(next(seen))
        mean, variance = (part / np.maximum(count, 1) for part in sums)
        scale = _positive(np.sqrt(variance), FLOOR * np.abs(mean))
        scalings.append(ChannelScaling(tuple(mean.tolist()), scale, _output(network, grids, lacking, rate)))
    return eqx.tree_at(_scalings, field, scalings)


@eqx.filter_jit
def _seen(
    probed: AbstractVectorField, x: Float[Array | np.ndarray, "d b"], u: Float[Array | np.ndarray, "m b"]
) -> list[batching.Moments]:
    """Return the moments of each probe's input, in the order of the networks."""
    seen = zip(batching.batch_norms(probed), batching.moments_of(probed, x, u), strict=True)
    return [moments for norm, moments in seen if isinstance(norm, _Probe)]


def _output(network: ResidualNetwork, grids: list[GridNetwork], lacking, rate) -> Channels | None:
    """Return the scale of a network's outputs if it has one for each state or component of a grid; else None."""
    if len(network.bias_out) == len(rate):
        return _positive(lacking, FLOOR * rate)
    if not any(grid.network is network and grid.grid.size == len(rate) for grid in grids):
        return None
    components = (np.reshape(part, (len(network.bias_out), -1)) for part in (lacking, rate))
    missing, whole = (np.sqrt(np.mean(np.square(part), axis=1)) for part in components)
    return _positive(missing, FLOOR * whole)


def _positive(scale: Float[np.ndarray, " d"], floor: Float[np.ndarray, " d"]) -> Channels:
    """Return the scale of each channel, at least its floor; 1 where both are zero or the scale is not finite."""
    scale = np.maximum(scale, floor)
    return tuple(np.where(np.isfinite(scale) & (scale > 0), scale, 1.0).tolist())


def _networks(field: AbstractVectorField) -> list[ResidualNetwork]:
    return [part for part in parts_of(field) if isinstance(part, ResidualNetwork)]


def _scalings(field: AbstractVectorField) -> list[AbstractScaling]:
    return [network.scaling for network in _networks(field)]
