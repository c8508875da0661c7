"""Imports point down only, between the packages of the library and from the programs to the library."""

import ast
import re
from functools import cache
from graphlib import TopologicalSorter

from smoke import ROOT, script

# Modules and packages of the library, from the bottom: each may import what stands before it.
ORDER = (
    *("_version", "rotation", "batches", "runtime", "checks", "vehicle", "state_space", "records"),
    *("trajectories", "status", "dynamics", "implicit_solvers", "integrate", "networks"),
    *("codegen", "kernels", "metrics", "io", "estimation", "training", "adaptation", "online", "sweep"),
    *("sim", "flights", "control", "export", "planning", "identification", "cli", "__main__"),
)
# These serve any field, whatever trained it: no learning, no reporting, and none of them knows another.
SERVICES = {"sim", "flights", "control", "export"}
LEARNING = {"networks", "estimation", "training", "adaptation", "online", "sweep"}


def imported(path):
    """The project's modules that a file imports, anywhere in it."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return {name for name in found if (ROOT / name.replace(".", "/")).with_suffix(".py").exists()}


@cache
def modules(package):
    """Dotted name → imported modules, for every module of a package but those that only export."""
    files = sorted(path for path in (ROOT / package).rglob("*.py") if path.name != "__init__.py")
    return {".".join(path.relative_to(ROOT).with_suffix("").parts): imported(path) for path in files}


def room(name):
    return name.split(".")[1]


def test_every_package_has_its_place_and_imports_point_down():
    for name, needed in ((name, needed) for name, every in modules("hybrid_jax").items() for needed in every):
        assert needed.startswith("hybrid_jax."), f"{name} imports {needed}"
        assert ORDER.index(room(needed)) <= ORDER.index(room(name)), f"{name} imports {needed}"
    assert {room(name) for name in modules("hybrid_jax")} == set(ORDER)


def test_a_service_knows_no_learning_and_no_other_service_and_benchmarks_need_the_library_alone():
    for name in (name for name in modules("hybrid_jax") if room(name) in SERVICES):
        rooms = {room(needed) for needed in modules("hybrid_jax")[name]} - {room(name)}
        assert not rooms & (SERVICES | LEARNING), f"{name} imports {rooms}"
    for name, every in modules("benchmarks").items():
        assert all(needed.startswith(("hybrid_jax.", "benchmarks.")) for needed in every), name


def test_the_library_needs_no_package_of_the_programs_and_names_are_imported_when_they_are_used():
    """Those are extras, one of which `cli` needs. MuJoCo is installed with the library, and imported by `sim` alone."""
    allowed = {"sim": {"mujoco"}, "cli": {"matplotlib", "tyro"}}
    for path in (ROOT / "hybrid_jax").rglob("*.py"):
        needed = set(re.findall(r"^ *(?:import|from) (filelock|matplotlib|tyro|mujoco)\b", path.read_text(), re.M))
        assert needed <= allowed.get(path.parent.name, set()), path
    # So a program's own answer to Ctrl-C, which follows this import, is soon there.
    loaded = "print({'jax', 'importlib.metadata'} & sys.modules.keys() or 'nothing')"
    done = script("-c", f"import sys, hybrid_jax; {loaded}; hybrid_jax.rollout; print('jax' in sys.modules)").split()
    assert done == ["nothing", "True"]


def test_there_is_no_cycle_among_imports_that_the_test_sees():
    everything = {**modules("hybrid_jax"), **modules("experiments"), **modules("benchmarks")}
    list(TopologicalSorter(everything).static_order())
    # A parser that finds nothing would let everything pass.
    assert "hybrid_jax.dynamics.base" in modules("hybrid_jax")["hybrid_jax.dynamics.rigid_body"]
    assert "hybrid_jax.sim.scene" in modules("experiments")["experiments.flying.images"]
    assert "hybrid_jax.training.fitting" in modules("experiments")["experiments.paper.conditions"]
