"""Conditions of a sweep's runs: models by seed, hyper-parameters by size (paper, App. A), and measurement noise."""

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from experiments.paper.config import HELD_BACK, AllPatience, AllRates, Config, Encoding, Stopping, column
from experiments.paper.expert_augmentation import expert_augmented
from hybrid_jax import rotation
from hybrid_jax.dynamics import AbstractVectorField, Hybrid, trainable
from hybrid_jax.dynamics.rigid_body import LEARNED, RigidBody, perturbed
from hybrid_jax.integrate import SOLVERS
from hybrid_jax.io.datasets import Dataset
from hybrid_jax.networks.mlp import InputScaling
from hybrid_jax.networks.views import multirotor_network
from hybrid_jax.runtime import FASTEST_COMPILE, jit_with
from hybrid_jax.sim.flight import permutation
from hybrid_jax.sweep.lanes import count, lane, stack
from hybrid_jax.training import Settings, fitting
from hybrid_jax.training.fitting import FitState, RunConfig, make_run_config
from hybrid_jax.training.loss import REGULARISERS
from hybrid_jax.trajectories import Trajectories
from hybrid_jax.vehicle import QUATERNION, SENSOR_NOISE, Vehicle

FORCES = 6  # v̇ and ω̇ are the last outputs of every residual network
FORCED = {"wrench": "accelerations", "rotors": "rotors"}  # outputs of `multirotor_network` that are forces
PHYSICS, NETWORK, SUBSET, PRETRAINING, ADAPTATION, ENCODER, AUGMENTATION = range(7)  # purposes of a seed's keys


def settings(config: Config) -> Settings:
    return Settings(config.batch_size, REGULARISERS.get(config.regulariser), SOLVERS[config.solver])


def fresh_fields(model: str, vehicle: Vehicle, config: Config) -> AbstractVectorField:
    """Return untrained models of all seeds, stacked; a seed gives all models the same physics and network."""
    # In tenths of the hover speed, from hover: of the magnitude of the other inputs.
    hover = InputScaling(vehicle.hover_speed, vehicle.hover_speed / 10)
    network = {
        "inputs": config.residual_inputs,
        "outputs": FORCED.get(config.residual_outputs, config.residual_outputs),
        "hidden": config.hidden,
        "norm": config.norm,
        "activation": config.activation,
        "scaling": hover if config.inputs == "hover" else InputScaling(),
        "linear": config.residual_linear,
    }
    guess = config.guess if config.perturbed_by is None else config.perturbed_by
    forced = config.residual_outputs in FORCED
    hybrid = jax.device_get(_fresh_hybrids(vehicle, guess, forced, network, np.arange(config.seeds)))
    return {"hybrid": hybrid, "no_physics": hybrid.residual, "physics_only": hybrid.physics}[model]


@jit_with(FASTEST_COMPILE)
def _fresh_hybrids(
    vehicle: Vehicle, guess: tuple[float, float] | float, forced: bool, options: Mapping[str, Any], seeds: np.ndarray
) -> Hybrid:
    def build(seed):
        if isinstance(guess, tuple):
            physics = perturbed(vehicle, _key(seed, PHYSICS), low=guess[0], high=guess[1])
        else:
            signs = jax.random.rademacher(_key(seed, PHYSICS), (len(LEARNED),), float)
            physics = RigidBody(dict(zip(LEARNED, np.log(1 + guess) * signs, strict=True)), vehicle)
        return Hybrid(replace(physics, wrench=forced), multirotor_network(vehicle, _key(seed, NETWORK), **options))

    return eqx.filter_vmap(build)(seeds)


def pretraining(
    model: str, fields: AbstractVectorField, config: Config, factor: float = 1.0
) -> tuple[FitState, RunConfig]:
    """Return one run per seed, from the seeds' fields, on all source trajectories, with all rates times a factor."""
    rule = config.patience.hybrid_pretraining
    if model == "no_physics":
        rule = cast(AllPatience, config.patience).no_physics_pretraining
    rates = config.rates.physics, config.rates.pretraining
    plan = _plan(model, config, rates, rule, np.arange(config.source_train), config.source_train)
    plan = replace(plan, rates=jax.tree.map(lambda rate: factor * rate, plan.rates))
    return _starts(fields, np.arange(config.seeds), PRETRAINING), stack([plan] * config.seeds)


def adaptation(
    model: str, mode: str, fields: AbstractVectorField, config: Config, sizes: Sequence[int]
) -> tuple[FitState, RunConfig]:
    """Return one run for each size, draw and seed, in this order; the subsets of a seed are nested."""
    one, drawn = lane(fields, 0), subsets(config)

    def plan(size: int, subset: np.ndarray) -> RunConfig:
        rates, rule = _adaptation_rule(model, mode, size, config)
        if config.validation != "own":
            return _plan(model, config, rates, rule, subset, size)
        train, own = held_back(subset[:size])
        return replace(_plan(model, config, rates, rule, train, len(train)), validate_on=jnp.asarray(own, jnp.int32))

    plans = [_with_offset(plan(size, subset), one, config) for size in sizes for subset in drawn]
    seeds = np.tile(np.arange(config.seeds), config.draws * len(sizes))
    return _starts(lane(fields, seeds), seeds, ADAPTATION), stack(plans)


def augmentation(
    experts: AbstractVectorField, past: Trajectories, encoding: Encoding, config: Config
) -> tuple[FitState, RunConfig]:
    """Return one run per seed of Expert Augmentation's encoder, which reads the first part of source windows."""

    def build(expert, seed):
        key = _key(seed, ENCODER)
        return expert_augmented(expert, past, key, box=encoding.box, hidden=encoding.hidden)

    seeds, size = np.arange(config.seeds), 2 * config.source_train
    learners = jax.device_get(eqx.filter_jit(eqx.filter_vmap(build))(experts, seeds))
    rule, cap = encoding.stopping, min(encoding.max_epochs, config.max_epochs)
    plan = make_run_config(encoding.rate, np.arange(size), size, rule.minimum, rule.patience, cap, encoding.weight)
    return _starts(learners, seeds, AUGMENTATION), stack([plan] * config.seeds)


def subsets(config: Config) -> Int[np.ndarray, "runs pool"]:
    """Return the target trajectories' indices in the pool for each draw and seed, in this order."""
    if config.draw == "random":
        keys = [_key(seed, SUBSET) for seed in range(config.seeds)]
        keys = [jax.random.fold_in(key, draw) if draw else key for draw in range(config.draws) for key in keys]
        return stack([permutation(key, config.pooled()) for key in keys])
    return np.repeat(np.arange(config.pooled()).reshape(config.draws, -1), config.seeds, axis=0)


def held_back(subset: Int[np.ndarray, "*runs n"]) -> tuple[Int[np.ndarray, "*runs m"], Int[np.ndarray, "*runs v"]]:
    """Split target trajectories for training and, the last fifth, for early stopping."""
    own = max(subset.shape[-1] // HELD_BACK, 1)
    return subset[..., :-own], subset[..., -own:]


def _adaptation_rule(model: str, mode: str, size: int, config: Config) -> tuple[tuple[float, float], Stopping]:
    rates, patience, i = config.rates, config.patience, column(size)
    if model == "no_physics":
        others = cast(AllRates, rates)
        rate = others.no_physics_target_only if mode == "target_only" else others.no_physics[i]
        return (0.0, rate), cast(AllPatience, patience).no_physics
    physics = rates.physics_fine_tuning if mode == "fine_tuned" else rates.physics
    return (physics, rates.hybrid[i]), Stopping(patience.hybrid_minimum[i], patience.hybrid_patience[i])


def _plan(
    model: str, config: Config, rates: tuple[Any, Any], rule: Stopping, subset: np.ndarray, size: int
) -> RunConfig:
    of_model = {"hybrid": Hybrid(*rates), "no_physics": rates[1], "physics_only": rates[0]}[model]
    weight, cap = config.regulariser_weight, config.max_epochs
    return make_run_config(of_model, subset, size, rule.minimum, rule.patience, cap, weight)


def _with_offset(plan: RunConfig, field: AbstractVectorField, config: Config) -> RunConfig:
    """Return the plan with --rates.offset for v̇ and ω̇ in the network's output bias, if given."""
    offset = config.rates.offset
    if offset is None:
        return plan
    learned = eqx.filter(field, trainable(field))
    each = jax.tree.map(lambda rate, part: jax.tree.map(lambda _: rate, part), plan.rates, learned)

    def rate(path, old, part):
        if jax.tree_util.keystr(path[-1:], simple=True) != "bias_out" or part.shape[-1] < FORCES:  # of a rotor's thrust
            return old
        others = part.shape[-1] - FORCES
        return np.concatenate([np.full(others, old), np.full(FORCES, offset)]).astype(np.float32)

    return replace(plan, rates=jax.tree_util.tree_map_with_path(rate, each, learned))


def _starts(fields: AbstractVectorField, seeds: np.ndarray, purpose: int) -> FitState:
    assert count(fields) == len(seeds)
    return jax.device_get(_begun(fields, seeds, purpose))


@jit_with(FASTEST_COMPILE)
def _begun(fields: AbstractVectorField, seeds: Int[np.ndarray, " n"], purpose: int) -> FitState:
    return eqx.filter_vmap(lambda field, seed: fitting.start(field, _key(seed, purpose)))(fields, seeds)


def _key(seed, purpose: int) -> PRNGKeyArray:
    return jax.random.fold_in(jax.random.key(seed), purpose)


def sensor_noise(level: float) -> Float[np.ndarray, "13"]:
    """Return the size of white noise on each entry of a sample; 1 is typical of motion capture and a gyroscope."""
    return level * np.repeat(SENSOR_NOISE, [3, 4, 3, 3])


def measure(
    x: Float[Array, "*n 13"], noise: Float[Array | np.ndarray, "13"], key: PRNGKeyArray
) -> Float[Array, "*n 13"]:
    """Add white noise to the states and normalise quaternions."""
    noisy = x + jnp.asarray(noise, x.dtype) * jax.random.normal(key, x.shape, x.dtype)
    return noisy.at[..., QUATERNION].set(rotation.normalise(noisy[..., QUATERNION]))


def measured(dataset: Dataset, level: float, seed: int) -> Dataset:
    if not level:
        return dataset
    noise, splits = sensor_noise(level), dict(dataset.splits)
    for name, windows in dataset.splits.items():
        if not name.startswith("test"):
            start_key, key = jax.random.split(jax.random.fold_in(jax.random.key(seed), zlib.crc32(name.encode())))
            x0 = np.array(measure(jnp.asarray(windows.x0), noise, start_key))
            x = np.asarray(measure(jnp.asarray(windows.x), noise, key))
            # Windows that touch share the sample between them.
            touching = 1 + np.flatnonzero((windows.x0[1:] == windows.x[:-1, -1]).all(axis=1))
            x0[touching] = x[touching - 1, -1]
            splits[name] = Trajectories(x0, windows.u, x, windows.dt)
    return Dataset(splits, {**dataset.metadata, "noise": level})
