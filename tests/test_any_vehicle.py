"""Vehicles: the laws of any_system.py."""

import pytest
from any_system import *  # noqa: F403
from any_system import adapted_by_all

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module", params=["car", "multirotor"])
def adapted(request):
    return adapted_by_all(request.param)
