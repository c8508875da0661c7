"""Systems of a user's own, on a circle, on a grid and with a wrapper: the laws of any_system.py."""

import pytest
from any_system import *  # noqa: F403
from any_system import adapted_by_all

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module", params=["circle", "ring_dense", "ring_convolution", "wrapper"])
def adapted(request):
    return adapted_by_all(request.param)
