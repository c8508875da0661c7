"""Peak memory of fits to long records: python -m benchmarks.memory [SAMPLES], by default a million."""

import resource
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np

import hybrid_jax as hj
from hybrid_jax.batches import in_chunks
from hybrid_jax.dynamics.outputs import StateSpaceModel
from hybrid_jax.estimation import fit_records
from hybrid_jax.records import Record

STEPS, DT, LIMIT = 10, 0.01, 4.0  # intervals of a window; their length [s]; GiB


class Oscillator(hj.AbstractVectorField):
    """ÿ = −stiffness y − friction ẏ + u; only y is measured."""

    stiffness: jax.Array
    friction: jax.Array

    def __call__(self, x, u):
        return jnp.stack([x[1], u[0] - self.stiffness * x[0] - self.friction * x[1]])


def body(change: float) -> hj.RigidBody:
    return hj.RigidBody({name: jnp.full((), change, jnp.float32) for name in ("Ix", "Iy", "k")}, hj.IRIS)


def windows(n: int) -> hj.Trajectories:
    """Simulated windows of a quadrotor, with noise."""
    rng = np.random.default_rng(0)
    x0 = 0.3 * rng.standard_normal((n, 13), dtype=np.float32)
    x0[:, 3] += 3
    x0[:, 3:7] /= np.linalg.norm(x0[:, 3:7], axis=1, keepdims=True)
    u = np.float32(hj.IRIS.hover_speed) * (1 + 0.1 * rng.standard_normal((n, STEPS, 4), dtype=np.float32))
    moved = jax.jit(lambda w: in_chunks(lambda part: hj.rollout_batch(body(0.1), part[0], part[1], DT), w, 1000))
    x = np.array(moved((x0, u)))
    x += 0.001 * rng.standard_normal(x.shape, dtype=np.float32)
    return hj.Trajectories(x0, u, x, DT)


def record(n: int) -> Record:
    rng, t = np.random.default_rng(0), DT * np.arange(n)
    u = np.repeat(rng.standard_normal(-(-n // 50)), 50)[:n]
    x = hj.rollout(oscillator(4.0, 0.3), jnp.zeros(2), u[:, None], DT)
    return Record.of(u=(t, u), y=(t + DT, np.asarray(x)[:, 0] + 0.01 * rng.standard_normal(n)))


def oscillator(stiffness: float, friction: float) -> Oscillator:
    return Oscillator(jnp.array(stiffness), jnp.array(friction))


def model() -> StateSpaceModel:
    return StateSpaceModel(oscillator(3.8, 0.25), ("u",), {"y": lambda x, u: x[0]}, (0.0, 0.0), (np.inf, np.inf))


WORK = {
    "fit_least_squares": lambda n: hj.fit_least_squares(body(0.0), windows(n)).mse,
    "covariance_of": lambda n: hj.covariance_of(body(0.1), windows(n)),
    "fit_records, one record": lambda n: fit_records(model(), [record(n)], dt=DT).errors["y"],
}


def main() -> None:
    if {"-h", "--help"} & {*sys.argv[1:]}:
        sys.exit(print(__doc__))
    n, names = int(float(sys.argv[1])) if sys.argv[1:] else 10**6, sys.argv[2:]
    if names:
        hj.runtime.configure()
        jax.block_until_ready(WORK[names[0]](n))
        print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20)
        return
    for name in WORK:
        command = [sys.executable, "-m", "benchmarks.memory", str(n), name]
        found = float(subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()[-1])
        print(f"| {name} | {n:,} | {found:.2f} GiB |", flush=True)


if __name__ == "__main__":
    main()
