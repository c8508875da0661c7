"""The gradient step of `hybrid_jax.training` as a PyTorch user writes it: batch first, autograd, `torch.optim.Adam`.

`torchdiffeq`, the paper's own integrator, solves one interval after another, because its inputs are held; what it calls
rk4 is the 3/8 rule, of the same cost and order as the classical method, which `by_hand` is in a loop.
"""

# PyTorch and torchdiffeq are of the extra `peers`.
# pyright: reportMissingImports=false

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from hybrid_jax.dynamics.composition import Hybrid as OurHybrid
from hybrid_jax.dynamics.rigid_body import LEARNED, nominal
from hybrid_jax.dynamics.rigid_body import RigidBody as OurRigidBody
from hybrid_jax.networks.mlp import ResidualNetwork
from hybrid_jax.networks.normalisation import BatchNorm, Bias, InputScaling
from hybrid_jax.trajectories import Trajectories

CONJUGATE = torch.tensor([1.0, -1.0, -1.0, -1.0])


class RigidBody(nn.Module):
    """f_p as in `hybrid_jax.rigid_body` (paper, Eq. 10), with θ_p as log(value / nominal) in one vector (3,)."""

    def __init__(self, field: OurRigidBody):
        super().__init__()
        vehicle = field.vehicle
        arms = torch.tensor(vehicle.rotor_positions)
        # Σu², Σ y u², −Σ x u², Σ s u²: thrust and torque of the rotors up to coefficients.
        mixer = torch.stack([torch.ones(4), arms[:, 1], -arms[:, 0], torch.tensor(vehicle.spin)], dim=1)
        self.deviations = nn.Parameter(tensor(np.stack([field.deviations[name] for name in LEARNED])))
        self.register_buffer("nominal", torch.tensor([nominal(vehicle)[name] for name in LEARNED]))
        self.register_buffer("mixer", mixer)
        self.register_buffer("iz", torch.tensor(vehicle.inertia[2]))
        self.register_buffer("torque_coefficient", torch.tensor(vehicle.torque_coefficient))
        self.register_buffer("gravity", torch.tensor([0.0, 0.0, -vehicle.gravity]))
        self.mass = vehicle.mass
        self.drag = None
        if "drag" in field.deviations:
            self.drag = nn.Parameter(tensor(field.deviations["drag"]))
            self.register_buffer("nominal_drag", torch.tensor(field.terms.drag))

    def forward(self, x: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
        """ẋ (b, 13) for x (b, 13), u (b, 4)."""
        q, v, omega = x[:, 3:7], x[:, 7:10], x[:, 10:13]
        ix, iy, k = (self.nominal * self.deviations.exp()).unbind()
        inertia = torch.stack([ix, iy, self.iz])
        wrench = (u * u) @ self.mixer * torch.stack([k, k, k, self.torque_coefficient])
        acceleration = wrench[:, :1] / self.mass * body_z(q) + self.gravity
        if self.drag is not None:
            force = (self.nominal_drag + self.drag * -self.mass * self.gravity[2]) * turned(q * CONJUGATE, v)
            acceleration = acceleration - turned(q, force) / self.mass
        turning = (wrench[:, 1:] - torch.linalg.cross(omega, inertia * omega)) / inertia
        return torch.cat([v, quaternion_derivative(q, omega), acceleration, turning], dim=1)


def body_z(q: torch.Tensor) -> torch.Tensor:
    """The direction of thrust (b, 3) in the world frame for q (b, 4)."""
    w, x, y, z = q.unbind(dim=1)
    return torch.stack([2 * (x * z + w * y), 2 * (y * z - w * x), w * w - x * x - y * y + z * z], dim=1)


def turned(q: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
    """Body vectors v (b, 3) in the world frame, by q (b, 4)."""
    w, axis = q[:, :1], q[:, 1:]
    along = 2 * axis * (axis * v).sum(dim=1, keepdim=True)
    return (w * w - (axis * axis).sum(dim=1, keepdim=True)) * v + along + 2 * w * torch.linalg.cross(axis, v)


def quaternion_derivative(q: torch.Tensor, omega: torch.Tensor) -> torch.Tensor:
    """½ q ⊗ [0, ω] (b, 4)."""
    w, axis = q[:, :1], q[:, 1:]
    real = -(axis * omega).sum(dim=1, keepdim=True)
    return 0.5 * torch.cat([real, w * omega + torch.linalg.cross(axis, omega)], dim=1)


class Network(nn.Module):
    """f_d as in `hybrid_jax.networks.mlp`: linear, batch normalisation or a bias, activation, linear.

    Not `BatchNorm1d`, which would move its running statistics at each of the four stages of a step.
    """

    def __init__(self, field: ResidualNetwork):
        super().__init__()
        norm, self.norms = field.norm, isinstance(field.norm, BatchNorm)
        assert isinstance(norm, BatchNorm | Bias)
        assert isinstance(field.scaling, InputScaling)
        self.weight_in, self.shift, self.weight_out, self.bias_out = (
            nn.Parameter(tensor(leaf)) for leaf in (field.weight_in, norm.shift, field.weight_out, field.bias_out)
        )
        self.offset, self.scale = field.scaling.offset, field.scaling.scale
        self.activation = {"relu": functional.relu, "tanh": torch.tanh}[str(field.activation)]
        if isinstance(norm, BatchNorm):
            self.gain = nn.Parameter(tensor(norm.gain))
            self.register_buffer("running_mean", tensor(norm.running.mean))
            self.register_buffer("running_variance", tensor(norm.running.variance))
            self.momentum, self.epsilon = norm.momentum, norm.epsilon

    def hidden(self, x: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
        """The pre-activations (..., 64)."""
        return functional.linear(torch.cat([x, (u - self.offset) / self.scale], dim=-1), self.weight_in)

    def forward(self, x: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
        """ẋ (b, 13), normalised by the minibatch, as in training."""
        hidden = self.hidden(x, u)
        if self.norms:
            hidden = functional.batch_norm(hidden, None, None, self.gain, self.shift, training=True, eps=self.epsilon)
        else:
            hidden = hidden + self.shift
        return functional.linear(self.activation(hidden), self.weight_out, self.bias_out)

    @torch.no_grad()
    def observe(self, x0: torch.Tensor, u: torch.Tensor, predicted: torch.Tensor) -> None:
        """Move the running statistics towards those along the predicted trajectories (b, t, 13)."""
        if not self.norms:
            return
        starts = torch.cat([x0[:, None], predicted[:, :-1]], dim=1)
        variance, mean = torch.var_mean(self.hidden(starts, u), dim=(0, 1), correction=0)
        self.running_mean.lerp_(mean, self.momentum)
        self.running_variance.lerp_(variance, self.momentum)


class Hybrid(nn.Module):
    """ẋ = f_p + f_d from a hybrid of ours."""

    def __init__(self, field: OurHybrid):
        super().__init__()
        assert isinstance(field.physics, OurRigidBody)
        assert isinstance(field.residual, ResidualNetwork)
        self.physics, self.network = RigidBody(field.physics), Network(field.residual)

    def forward(self, x: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
        return self.physics(x, u) + self.network(x, u)


Integrator = Callable[[nn.Module, torch.Tensor, torch.Tensor, float], torch.Tensor]


def by_hand(field: nn.Module, x: torch.Tensor, u: torch.Tensor, dt: float) -> torch.Tensor:
    """The states (b, t, 13) at the end of each interval, by classical RK4, from x (b, 13) under u (b, t, 4)."""
    states = []
    for held in u.unbind(dim=1):
        k1 = field(x, held)
        k2 = field(x + dt / 2 * k1, held)
        k3 = field(x + dt / 2 * k2, held)
        k4 = field(x + dt * k3, held)
        x = x + dt / 6 * (k1 + 2 * (k2 + k3) + k4)
        states.append(x)
    return torch.stack(states, dim=1)


def by_torchdiffeq(field: nn.Module, x: torch.Tensor, u: torch.Tensor, dt: float) -> torch.Tensor:
    """The same by `torchdiffeq.odeint`, one interval after another."""
    from torchdiffeq import odeint

    times, states = torch.tensor([0.0, dt]), []
    for held in u.unbind(dim=1):
        x = odeint(lambda t, x, held=held: field(x, held), x, times, method="rk4")[-1]
        states.append(x)
    return torch.stack(states, dim=1)


class Training:
    """Gradient steps on one minibatch; every call is a step, from where the last one ended.

    Args:
        field: the hybrid to start from.
        rates: of Adam, by part of the hybrid.
        weight: λ of the regulariser.
        windows: the minibatch, in float32.
        backend: of `torch.compile`, which makes one program of the loss and one of its gradient; None: do not compile.
    """

    def __init__(
        self,
        field: OurHybrid,
        rates: Any,
        weight: float,
        windows: Trajectories,
        integrate: Integrator,
        backend: str | None = None,
    ):
        self.field, self.dt, self.weight, self.integrate = Hybrid(field), windows.dt, weight, integrate
        self.windows = tuple(tensor(part) for part in (windows.x0, windows.u, windows.x))
        groups = ((self.field.physics, rates.physics), (self.field.network, rates.residual))
        self.adam = torch.optim.Adam(
            [{"params": list(part.parameters()), "lr": float(rate)} for part, rate in groups], fused=True
        )
        self.loss = self._loss
        if backend is not None:
            self.loss = torch.compile(self._loss, fullgraph=True, dynamic=False, backend=backend)

    def __call__(self) -> torch.Tensor:
        """One step; the loss before it."""
        x0, u, x = self.windows
        self.adam.zero_grad()
        loss, predicted = self.loss(x0, u, x)
        loss.backward()
        self.adam.step()
        self.field.network.observe(x0, u, predicted)
        return loss.detach()

    def _loss(self, x0: torch.Tensor, u: torch.Tensor, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """L of the minibatch (paper, Eq. 6 and 7), and the predicted states."""
        predicted = self.integrate(self.field, x0, u, self.dt)
        physics = self.integrate(self.field.physics, x0, u, self.dt)
        error = (predicted - x).square().sum(dim=2).mean()
        a, b = (functional.normalize(states.flatten(start_dim=1)) for states in (physics, predicted))
        return error + self.weight * 0.5 * (a - b).square().sum(dim=1).mean(), predicted

    def result(self, loss: torch.Tensor) -> dict[str, Any]:
        """What the last step came to: its loss, Adam's first moment by parameter, the running statistics."""
        # Copies: the next step changes these tensors in place.
        moment = {name: np.array(self.adam.state[value]["exp_avg"]) for name, value in self.field.named_parameters()}
        statistics = [np.array(one) for name, one in self.field.network.named_buffers() if name.startswith("running")]
        return {"loss": np.array(loss), "first_moment": moment, "statistics": statistics}


def tensor(array) -> torch.Tensor:
    """An array of ours as a tensor of its own, in float32."""
    return torch.tensor(np.asarray(array, np.float32))
