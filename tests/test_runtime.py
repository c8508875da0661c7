"""How a process is set up; laws of compiled programs, optimised as users have them."""

import os
import re
import subprocess
import sys
import time

import pytest
from smoke import ROOT, script

from hybrid_jax import runtime
from hybrid_jax.runtime import EXTRA, FLAGS, PROGRAMS, WHOLE_LOOPS

pytestmark = pytest.mark.slow  # each test starts processes

CONFIGURED = """
import sys
from pathlib import Path
import jax
from hybrid_jax.runtime import configure, cores
configure(*map(Path, sys.argv[1:]))
"""
PROGRAM = f"""{CONFIGURED}
events = []
jax.monitoring.register_event_listener(lambda name, **_: events.append(name))
jax.jit(lambda x: x @ x.T)(jax.numpy.ones((5, 5)))
assert len(jax.devices()) == cores()
print(events.count("/jax/compilation_cache/cache_hits"), events.count("/jax/compilation_cache/cache_misses"))
"""
FIT = """
import hybrid_jax as hj
network = hj.residual_network(13, 4, jax.random.key(0), hidden=2, norm="none")
x0, u = jax.numpy.zeros((9, 13)).at[:, 3].set(1.0), jax.numpy.full((9, 2, 4), 600.0)
hj.fit_least_squares(hj.Hybrid(hj.rigid_body(hj.IRIS), network), hj.Trajectories(x0, u, x0[:, None].repeat(2, 1), 0.01))
print(events"""
FITTED = PROGRAM.replace("print(events", FIT, 1)
LOOP = f"""{CONFIGURED}
loop = jax.jit(lambda x: jax.lax.scan(lambda x, _: (x - x[::-1] ** 3, None), x, length=10)[0])
product = jax.jit(lambda x: x @ x.T).lower(jax.numpy.ones((5, 5))).as_text()
kernels = loop.lower(jax.numpy.ones((13, 100))).compile().as_text().count("xla_cpu_small_call")
print(kernels, product.count("precision = [HIGHEST, HIGHEST]"))
"""
LATE = """
import warnings
import jax
from hybrid_jax.runtime import configure
devices = len(jax.devices())
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    configure()
assert "JAX has already started" in str(caught[-1].message)
print(devices == len(jax.devices()), jax.config.jax_persistent_cache_min_compile_time_secs == 0)
"""
FORK = """
import os, warnings
import jax.numpy as jnp
import hybrid_jax as hj
warnings.simplefilter("ignore")
given = (lambda x, u: -x), jnp.zeros(2), jnp.zeros((3, 1)), 0.1
hj.rollout(*given)
for call in (lambda: hj.rollout(*given), lambda: hj.Model(given[0]).predict(*given[1:])):
    if os.fork() == 0:
        try:
            call()
        except RuntimeError as error:
            os._exit(7 * ("forked" in str(error) and "spawn" in str(error)))
        os._exit(1)
    print(os.waitstatus_to_exitcode(os.wait()[1]))
"""
IMPORTS = f"""
import importlib, pkgutil
import benchmarks, experiments, hybrid_jax
packages = (benchmarks, experiments, hybrid_jax)
found = [module for package in packages for module in pkgutil.walk_packages(package.__path__, package.__name__ + ".")]
names = [module.name for module in found if not module.name.endswith(("__main__", "torch_rivals"))]
for name in names:
    importlib.import_module(name)
{CONFIGURED}
assert len(jax.devices()) == cores()
print(len(names))
"""


def printed(program, *cache, **more):
    own = {name: value for name, value in os.environ.items() if name != PROGRAMS}  # not the cache of all tests
    return [int(number) for number in script("-c", program, *cache, env=own | more).split()]


def test_no_module_makes_an_array_when_it_is_imported_and_after_jax_has_begun_what_can_be_set_is_set(tmp_path):
    assert printed(IMPORTS, tmp_path)[0] > 100  # or the number of cores would be fixed before configure sets it
    assert script("-c", LATE, env=os.environ | {"XDG_CACHE_HOME": str(tmp_path)}).split() == ["True", "True"]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="the system has no fork")
def test_a_fork_of_a_process_that_used_jax_is_refused_where_it_would_wait_for_ever():
    assert printed(FORK) == [7, 7]


def test_a_small_loop_is_one_kernel_unless_the_user_has_flags_of_his_own_and_products_are_precise(tmp_path):
    assert printed(LOOP, tmp_path) == [1, 1]
    assert printed(LOOP, tmp_path, **{FLAGS: f"{EXTRA}=xla_cpu_small_while_loop_byte_threshold=1"}) == [0, 1]


def test_programs_are_found_again_wherever_their_cache_was_moved(tmp_path):
    hits, compiled = printed(FITTED, tmp_path / "here")
    assert compiled > 0
    (tmp_path / "here").rename(tmp_path / "there")
    assert printed(FITTED, tmp_path / "there") == [hits + compiled, 0]


def test_programs_that_a_kill_left_half_written_are_replaced(tmp_path):
    user = {"HOME": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path)}
    _, compiled = printed(PROGRAM, **user)
    whole, empty = sorted(tmp_path.rglob("*-cache"), key=lambda path: path.stat().st_size)[-2:]
    os.truncate(whole, whole.stat().st_size - 1)
    os.truncate(empty, 0)
    assert printed(PROGRAM, **user) == [compiled - 2, 2]
    assert printed(PROGRAM, **user) == [compiled, 0]
    assert list(tmp_path.rglob("hybrid_jax/programs/*-cache"))


def test_programs_used_longest_ago_make_room_but_not_in_a_folder_that_the_user_named(tmp_path, monkeypatch):
    monkeypatch.setattr(runtime, "MOST", 4)
    for age, name in enumerate(("new-cache", "used-cache", "old-cache")):
        (tmp_path / name).write_bytes(b"--")
        os.utime(tmp_path / name, (time.time() - 60 * age, 0))
    os.utime(tmp_path / "used-cache", (time.time(), time.time() - runtime.UNUSED - 60))
    runtime._delete_stale(tmp_path)
    assert {path.name for path in tmp_path.glob("*-cache")} == {"new-cache", "used-cache"}
    monkeypatch.setattr(runtime, "UNUSED", -1)
    runtime._delete_stale(tmp_path)
    assert not list(tmp_path.glob("*-cache"))
    for name in ("theirs-cache", "notes.txt"):
        (tmp_path / name).write_bytes(b"")
        os.utime(tmp_path / name, (0, 0))
    (tmp_path / "folder-cache").mkdir()
    printed(PROGRAM, tmp_path)
    assert {"theirs-cache", "notes.txt", "folder-cache"} <= {path.name for path in tmp_path.iterdir()}


# Ctrl-C while the first module of a program loads.
INTERRUPTED = """
import os, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
sys.argv[0] = "-m"
class Interrupt:
    def find_spec(self, name, *_):
        if name == "{module}":
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Interrupt())
{program}
"""


@pytest.mark.parametrize(
    ("module", "program"),
    [("hybrid_jax.cli.command", "from hybrid_jax.cli import main; main()"), ("jax", "import experiments.param_shift")],
)
def test_an_interrupt_while_modules_load_is_told_in_a_line(module, program):
    code = INTERRUPTED.format(module=module, program=program)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 130
    assert done.stdout == ""
    assert re.fullmatch(r"(hybrid-jax: )?interrupted.*\n", done.stderr)


# Those of rounding and of the derivative written by hand, which fusing kernels may change.
SWEEP = ["a_lane_is_the_same_run_alone", "a_lane_is_a_run_by_the_plain_function", "every_lane_comes_to_its_own_end"]
SWEEP += ["lanes_that_share_a_chunk_are_the_same_runs", "a_diverged_lane_changes_no_bit_of_another"]
NETWORK = (
    "the_derivative_written_by_hand_is_that_of_the_plain_formula",
    "what_few_samples_use_is_the_same_network_with_the_same_slopes_and_so_is_its_file",
)
LAWS = [f"tests/sweep/test_sweep.py::test_{law}" for law in SWEEP]
LAWS += [f"tests/networks/test_residual.py::test_{law}" for law in NETWORK]


def test_they_hold():
    script("-m", "pytest", "-n", "0", "-p", "no:cacheprovider", *LAWS, env=os.environ | {FLAGS: WHOLE_LOOPS})
