"""The protocol of an online estimator, which updates the controller's model while the system runs."""

from abc import abstractmethod
from typing import Any

import equinox as eqx
from jaxtyping import Array, Float

from hybrid_jax.dynamics.base import AbstractVectorField


class AbstractEstimator(eqx.Module):
    """An estimator between sensors and controller that learns while the system runs."""

    @abstractmethod
    def begin(self, x: Float[Array, " d"]) -> Any:
        """Return the state of the estimator before the first sample x."""

    @abstractmethod
    def update(self, state: Any, x: Float[Array, " d"], u: Float[Array, " m"]) -> Any:
        """Return the state of the estimator after one period with mean input u and the sample x at its end.

        Args:
            state: of the estimator, as returned by `begin` and `update`.
        """

    @abstractmethod
    def model(self, state: Any) -> AbstractVectorField:
        """Return the prediction model for the controller.

        Args:
            state: of the estimator, as returned by `begin` and `update`.
        """

    def command(self, state: Any, x: Float[Array, " d"], u: Float[Array, " m"]) -> Float[Array, " m"]:
        """Return the input to command if the controller requests u in the state x; by default u.

        Args:
            state: of the estimator, as returned by `begin` and `update`.
        """
        return u

    def effective(self, state: Any, u: Float[Array, " m"]) -> Float[Array, " m"]:
        """Return the model input with the same effect as the system input u, the inverse of `command`; by default u.

        Args:
            state: of the estimator, as returned by `begin` and `update`.
        """
        return u
