"""Imports point down only, and the simulator and learning never meet below the experiments."""

import ast
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FLOORS = (
    "state rotation files hosts runtime normalised_layer",
    "checks",
    "vehicle archive lanes trajectories rows paired flight_rows",
    "vector_field lane_groups datasets summary closed_loop_rows multirotor_terms",
    "rigid_body normalisation rollout environment disturbance",
    "residual",
    "rotors",
    "features multirotor baselines",
    "loss metrics models claims least_squares vehicle_description flight_scores",
    "objective report_tables figures uncertainty linear_adaptation flight_claims",
    "preparation expert_augmentation channels disturbance_fit",
    "training",
    "sweep schedule error_panels report_page flight_figures standings closed_loop_tables flight_tables",
    "report comparison_figures ablations closed_loop_claims closed_loop_figures recorded_flight_figures",
    "closed_loop_paths",
)
FLOOR = {name: floor for floor, names in enumerate(FLOORS) for name in names.split()}
# What each sub-package may import of the core: none of them learns or reports, and none knows another.
NEEDS = {
    "sim": {"state", "rotation", "files", "runtime", "checks", "vehicle", "trajectories", "datasets"},
    "flights": {"state", "vehicle", "trajectories"},
    "control": {"state", "rotation", "checks", "vehicle", "vector_field", "rollout", "disturbance"},  # any field
    "export": {"state", "checks", "archive", "vector_field", "rollout"},  # likewise
}


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


def modules(package):
    """Dotted name → imported modules, for every module of a package."""
    files = sorted((ROOT / package).rglob("*.py"))
    return {".".join(path.relative_to(ROOT).with_suffix("").parts): imported(path) for path in files}


LIBRARY = {name: needs for name, needs in modules("hybrid_jax").items() if not name.endswith("__init__")}
CORE = {name.split(".")[1]: needs for name, needs in LIBRARY.items() if name.count(".") == 1}
INSIDE = {name: needs for name, needs in LIBRARY.items() if name.count(".") == 2}


def test_every_module_has_a_floor():
    assert set(CORE) == set(FLOOR)


@pytest.mark.parametrize("name", sorted(CORE))
def test_imports_point_down(name):
    for needed in CORE[name]:
        assert needed.startswith("hybrid_jax.")
        assert needed.split(".")[1] not in NEEDS
        assert FLOOR[needed.split(".")[1]] < FLOOR[name], f"{name} imports {needed}"


@pytest.mark.parametrize("name", sorted(INSIDE))
def test_a_sub_package_knows_little_of_the_core_and_nothing_of_another(name):
    package = name.split(".")[1]
    for needed in INSIDE[name]:
        assert needed.startswith("hybrid_jax.")
        assert needed.split(".")[1] in NEEDS[package] | {package}, f"{name} imports {needed}"


def test_there_is_no_cycle():
    everything = {**modules("hybrid_jax"), **modules("experiments"), **modules("benchmarks")}
    list(TopologicalSorter(everything).static_order())


def test_the_test_sees_imports():
    """A parser that finds nothing would let everything pass."""
    assert "hybrid_jax.vector_field" in CORE["rigid_body"]
    assert "hybrid_jax.rotation" in CORE["rigid_body"]
    assert "hybrid_jax.sim.model" in INSIDE["hybrid_jax.sim.render"]
    assert "hybrid_jax.training" in modules("experiments")["experiments.conditions"]
