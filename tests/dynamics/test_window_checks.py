"""Laws of the checks of windows."""

import re
import warnings
from dataclasses import replace

import numpy as np
import pytest
from systems import SYSTEMS

from hybrid_jax.dynamics.window_checks import check_windows

# States that are the rate of another one.
RATES = {"pendulum": {1: "x[0]"}, "circle": {1: "angle"}, "car": {5: "x[2]"}, "ring_convolution": {}}
RATES["multirotor"] = {7: "position[0]", 8: "position[1]", 9: "position[2]", 10: "attitude[0]", 12: "attitude[2]"}


@pytest.mark.parametrize("name", RATES)
def test_a_rate_in_another_unit_than_its_state_is_said_and_no_right_one(name):
    system = SYSTEMS[name]()
    with warnings.catch_warnings(action="error"):
        for windows in (system.train, system.target, system.test):
            check_windows(system.model, windows)
    for state, of in RATES[name].items():
        for unit in (180 / np.pi, 0.1):
            factor = np.ones(system.test.x0.shape[1], np.float32)
            factor[state] = unit
            wrong = replace(system.test, x0=system.test.x0 * factor, x=system.test.x * factor)
            said = rf"windows: x\[{state}\] is (\S+) times the rate of {re.escape(of)}: check their units, and dt"
            with pytest.warns(UserWarning, match=said) as caught:
                check_windows(system.model, wrong)
            assert float(re.findall(said, str(caught[0].message))[0]) == pytest.approx(unit, rel=0.02)
