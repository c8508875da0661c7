"""The C of a filter passes faults under sanitizers: no report, always finite, and it ends where JAX does."""

import subprocess
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiled import needs_compiler
from jax.flatten_util import ravel_pytree
from test_excited_directions import DT, HOVER, NOISE, SECOND, Climb
from test_online import watch

import hybrid_jax as hj
from hybrid_jax.export import export_adaptation_c

pytestmark = needs_compiler
HYPOTHESES = hj.Hypothesis("gain", {"gain": 0.2}), hj.Hypothesis("wind", {"disturbance[0]": 3.0})
STEPS, FAULT = 24 * SECOND, slice(12 * SECOND, None)
MAIN = """
#include "adaptation.h"
#include <stdio.h>
static float one[%d], two[%d], given[3];
int main(void) {
    float *now = one, *next = two;
    if (fread(given, sizeof(float), 1, stdin) != 1) return 2;
    adaptation_begin(given, now);
    while (fread(given, sizeof(float), 3, stdin) == 3) {
        adaptation_update(now, given, given + 1, given[2], next);
        fwrite(next, sizeof(one), 1, stdout);
        now = next;
        next = now == one ? two : one;
    }
    return 0;
}
"""


def spoiled(column, numbers, part=FAULT):
    def spoil(flight):
        flight[part, column] = numbers(flight[part, column]) if callable(numbers) else numbers

    return spoil


FAULTS = {
    "none": lambda flight: None,
    "missing": spoiled(0, np.nan, slice(1200, 1400)),
    "infinite": spoiled(0, -np.inf, slice(1200, 1400)),
    "jumps": spoiled(0, 1e38, slice(1200, 1400, 7)),
    "input unknown": spoiled(1, np.nan, slice(1200, 1400)),
    "input jumps": spoiled(1, 3e38, slice(1200, 1400, 7)),
    "frozen": spoiled(0, lambda x: x[0], slice(1200, 1400)),
    "late": spoiled(2, 1e30, slice(1200, 1210)),
    "at once": spoiled(2, 0.0, slice(1200, 1400)),
    "sign": spoiled(0, lambda x: -x),
    "unit": spoiled(0, lambda x: 57.3 * x),
    "exchanged rotors": spoiled(1, lambda u: 2 * HOVER - u),
}


def flight():
    rng, v, rows = np.random.default_rng(0), 0.0, []
    for i in range(STEPS):
        u = HOVER - 4 * (v + NOISE * rng.normal() - np.sin(5 * DT * i))
        v += DT * (u - HOVER)
        rows.append((v + NOISE * rng.normal(), u, 1.0))
    return np.array(rows, np.float32)


@cache
def filter_of(named):
    hypotheses = HYPOTHESES if named else ()
    options = {"disturbance": 3.0, "indices": (0,), "process": 0.005, "hypotheses": hypotheses}
    return hj.OnlineAdaptation(Climb(jnp.array(1.0)), DT, NOISE, 0.2, **options)


@pytest.fixture(scope="module", params=[False, pytest.param(True, marks=pytest.mark.slow)], ids=["alone", "hypotheses"])
def program(request, tmp_path_factory):
    """Whether the filter has hypotheses, and its C with a main function, under sanitizers."""
    folder, adaptation = tmp_path_factory.mktemp("filter"), filter_of(request.param)
    source = export_adaptation_c(folder, adaptation, state_size=1, input_size=1)[1]
    size = ravel_pytree(adaptation.begin(jnp.zeros(1)))[0].size
    (folder / "main.c").write_text(MAIN % (size, size))
    flags = ("-std=c99", "-g", "-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
    subprocess.run(["gcc", *flags, folder / "main.c", source, "-o", folder / "main", "-lm"], check=True)
    return request.param, folder / "main"


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_ends_as_in_jax(name, program):
    named, main = program
    given = flight()
    FAULTS[name](given)
    sent = np.zeros(1, np.float32).tobytes() + given.tobytes()
    done = subprocess.run([main], input=sent, capture_output=True, check=False, timeout=60)
    assert done.returncode == 0, done.stderr[:2000].decode()
    assert not done.stderr
    adaptation = filter_of(named)
    expected = watch(adaptation, *map(jnp.asarray, (given[:, :1], given[:, 1:2], given[:, 2])))
    unravel = ravel_pytree(adaptation.begin(jnp.zeros(1)))[1]
    found = jax.vmap(unravel)(jnp.asarray(np.frombuffer(done.stdout, np.float32).reshape(STEPS, -1)))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found))
    wrong = np.asarray(adaptation.flags(found).inconsistent)
    assert (wrong == np.asarray(adaptation.flags(expected).inconsistent)).mean() > 0.99
    assert wrong[-1] == (name in ("sign", "unit", "exchanged rotors"))
    np.testing.assert_allclose(found.trusted[-1], expected.trusted[-1], atol=0.02)
