"""What learns while a system runs: the protocol between sensors, model and controller."""

from abc import abstractmethod
from typing import Any

import equinox as eqx
from jaxtyping import Array, Float

from hybrid_jax.dynamics.base import AbstractVectorField


class AbstractEstimator(eqx.Module):
    """What learns in flight, between sensors and controller."""

    @abstractmethod
    def begin(self, x: Float[Array, " d"]) -> Any:
        """The state of the estimator before the first sample x."""

    @abstractmethod
    def update(self, state: Any, x: Float[Array, " d"], u: Float[Array, " m"]) -> Any:
        """After a period in which the input was u on average, and which ended with the sample x.

        Args:
            state: of the estimator, as `begin` and `update` return it.
        """

    @abstractmethod
    def model(self, state: Any) -> AbstractVectorField:
        """The prediction model of the controller.

        Args:
            state: of the estimator, as `begin` and `update` return it.
        """

    def command(self, state: Any, x: Float[Array, " d"], u: Float[Array, " m"]) -> Float[Array, " m"]:
        """The input to command where the controller asks for u at the state x; by default that.

        Args:
            state: of the estimator, as `begin` and `update` return it.
        """
        return u

    def effective(self, state: Any, u: Float[Array, " m"]) -> Float[Array, " m"]:
        """The input at which the model moves as the system does at u; by default that. It undoes `command`.

        Args:
            state: of the estimator, as `begin` and `update` return it.
        """
        return u
