"""Plan the experiment that determines two parameters best, inside limits."""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import hybrid_jax as hj


class Cart(hj.AbstractVectorField):  # x = [place, speed], u = [force]
    mass: jax.Array
    friction: jax.Array

    def __call__(self, x, u):
        return jnp.stack([x[1], (u[0] - self.friction * x[1]) / self.mass])


cart = Cart(jnp.array(0.5), jnp.array(0.2))
limits = hj.InputBounds(
    (-1.0,),
    (1.0,),
    start=(0.0, 0.0),
    state_low=(-1.0, -2.0),
    state_high=(1.0, 2.0),
)
plan = hj.excitation(
    cart,
    None,
    limits,
    jax.random.key(0),
    noise=[1e-3, 1e-2],
    seconds=4.0,
    dt=0.02,
    steps=50,
)
print(
    {name: f"± {error:.2g}" for name, error in plan.standard_errors.items()}
)

time = 0.02 * np.arange(len(plan.inputs))
states = hj.rollout(cart, jnp.zeros(2), plan.inputs, 0.02)
plt.rc("axes.spines", top=False, right=False)
figure, (above, below) = plt.subplots(
    2, 1, figsize=(4.2, 2.8), layout="constrained", sharex=True
)
above.step(time, plan.inputs[:, 0], color="#0072B2", where="post")
above.set_ylabel("force [N]")
below.plot(time, states[:, 0], color="#0072B2")
below.axhspan(-1, 1, color="0.93")
below.set(ylabel="position [m]\n(grey: allowed)", xlabel="time [s]")
plt.savefig("informative.png", dpi=110)
