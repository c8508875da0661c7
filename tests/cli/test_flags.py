"""Messages of the library name arguments; the commands that print them name their options."""

import pytest

from hybrid_jax.cli.flags import in_flags

SAID = {
    "the motors are u3 u0 u1 u2: motor_order=(3, 0, 1, 2)": "the motors are u3 u0 u1 u2: --motor-order 3,0,1,2",
    "a: motor_order must be of 0, 1": "a: --motor-order must be of 0, 1",
    "name those of its rotors: motor_order=…": "name those of its rotors: --motor-order",
    'name them: topics={"motors": "/TOPIC:FIELD:UNIT"}': "name them: --topics motors=/TOPIC:FIELD:UNIT",
    "topics: motors must be TOPIC:FIELD:UNIT": "--topics: motors must be TOPIC:FIELD:UNIT",
    'name the columns in a column map: columns="MAP.toml"': "name the columns in a column map: --columns MAP.toml",
    "columns: u0 never changes": "columns: u0 never changes",  # the name of a check
    "v.toml: [motors]: polynomial must be numbers": "v.toml: [motors]: polynomial must be numbers",  # a key
    "polynomial=(c0, c1, …) maps them": "--polynomial c0,c1 maps them",
    "11.9 ms later: delay=0.0119, or learn": "11.9 ms later: --delay 0.0119, or learn",
    'use what is whole: failed="warn"': "use what is whole: --anyway",
    "resample all logs with dt=0.02": "resample all logs with --dt 0.02",
}


@pytest.mark.parametrize(("said", "printed"), SAID.items(), ids=SAID)
def test_arguments_become_options(said, printed):
    assert in_flags("real_flight", said) == printed
    assert in_flags("external_force", said) == said  # which reads no logs
