"""A network finds the friction that physics lacks."""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import hybrid_jax as hj


class Oscillator(hj.AbstractVectorField):  # x = [place, speed]
    log_stiffness: jax.Array

    def __call__(self, x, u):
        return jnp.stack([x[1], u[0] - jnp.exp(self.log_stiffness) * x[0]])


def friction(speed):
    return -0.6 * jnp.tanh(speed / 0.3)


def windows(count, seed):
    draw = np.random.default_rng(seed).normal
    x0, u = (
        draw(size=(count, 2)).astype("f4"),
        draw(size=(count, 10, 1)).astype("f4"),
    )
    true = lambda x, u: (
        Oscillator(jnp.log(4.0))(x, u) + jnp.stack([0.0, friction(x[1])])
    )
    return hj.Trajectories(
        x0,
        u,
        hj.rollout_batch(true, x0, u, 0.05, hj.RK4(substeps=5)),
        dt=0.05,
    )


network = hj.residual_network(
    2, 1, jax.random.key(0), hidden=32, norm="none", activation="tanh"
)
model = hj.Hybrid(Oscillator(jnp.log(3.0)), network)
fitted = hj.fit(
    model, windows(300, 0), windows(100, 1), jax.random.key(1), max_epochs=300
).best
print(f"stiffness {jnp.exp(fitted.physics.log_stiffness):.2f}, true 4.00")

speed = jnp.linspace(-2, 2, 200)
learned = jax.vmap(
    lambda v: fitted.residual(jnp.stack([0.0, v]), jnp.zeros(1))[1]
)(speed)
plt.rc("axes.spines", top=False, right=False)
plt.figure(figsize=(4.2, 2.8), layout="constrained")
plt.plot(speed, friction(speed), color="0.6", lw=4, label="true friction")
plt.plot(speed, learned, color="#0072B2", label="learned by the network")
plt.xlabel("speed [m/s]")
plt.ylabel("acceleration [m/s²]")
plt.legend(fontsize=7, loc="upper right", frameon=False)
plt.savefig("friction.png", dpi=110)
