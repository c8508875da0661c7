"""One source of numbers: the Vehicle."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from mujoco import mjx
from smoke import script

from experiments.flying.images import picture
from hybrid_jax.sim import check_versions
from hybrid_jax.sim.forces import parameters_of
from hybrid_jax.sim.scene import build_model, traced_model
from hybrid_jax.vehicle import IRIS

OTHER = replace(
    IRIS, mass=2.0, inertia=(0.04, 0.02, 0.05), thrust_coefficient=1e-5, torque_coefficient=3e-6, gravity=9.7
)


def test_the_compiled_model_carries_the_vehicles_numbers_and_no_others():
    model = build_model(OTHER)
    np.testing.assert_allclose(model.body_mass, [0, OTHER.mass])
    np.testing.assert_allclose(model.body_inertia[1], OTHER.inertia)
    np.testing.assert_allclose(model.opt.gravity, [0, 0, -OTHER.gravity])
    np.testing.assert_allclose(model.site_pos[:, :2], OTHER.rotor_positions)
    np.testing.assert_allclose(model.actuator_gainprm[:, 0], OTHER.thrust_coefficient)
    np.testing.assert_allclose(model.actuator_gear[:, 5], 0.3 * np.array(OTHER.spin))
    assert model.nv == 6
    assert not model.geom_contype.any()
    assert not model.geom_conaffinity.any()
    # Not one force of MuJoCo's own: air, joints.
    assert model.opt.density == model.opt.viscosity == 0
    assert not model.dof_damping.any()
    assert not model.dof_armature.any()


def test_traced_parameters_replace_every_number_that_differs_between_two_vehicles():
    built = mjx.put_model(build_model(OTHER))
    replaced = traced_model(parameters_of(OTHER))
    # MuJoCo derives these for constraints, limits and the camera; a free body's acceleration does not read them.
    unused = ("invweight0", "acc0", "M0", "stat", "geom_", "cam_", "light_", "mesh_", "bvh", "names", "qpos0")
    for path, leaf in jax.tree_util.tree_leaves_with_path(built):
        name = jax.tree_util.keystr(path)
        if not any(word in name for word in unused):
            other = dict(jax.tree_util.tree_leaves_with_path(replaced))[path]
            np.testing.assert_allclose(leaf, other, rtol=1e-12, err_msg=name)


@pytest.mark.parametrize(("mujoco", "mjx"), [("4.0.0", "3.17.0"), ("3.17.0", "not installed"), ("3.16.2", "3.16.2")])
def test_other_versions_are_refused_with_the_command_that_mends_it(mujoco, mjx):
    check_versions({"mujoco": "3.17.0", "mujoco-mjx": "3.17.5"})
    with pytest.raises(ImportError, match=r"pip install .*mujoco==3\.17") as refusal:
        check_versions({"mujoco": mujoco, "mujoco-mjx": mjx})
    assert "\n" not in str(refusal.value)


@pytest.mark.slow
def test_importing_the_simulator_prints_nothing():
    assert not script("-c", "import hybrid_jax.sim.flight")


@pytest.mark.slow
def test_a_picture_is_drawn_or_the_missing_library_named(tmp_path):
    file = tmp_path / "vehicle.png"
    try:
        picture(file)
    except ValueError as error:
        assert "libosmesa6" in str(error)  # noqa: PT017 - machines without a renderer take this branch
    else:
        assert file.read_bytes().startswith(b"\x89PNG")


def test_no_renderer_is_one_line_that_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "none such")
    with pytest.raises(ValueError, match="libosmesa6 or libegl1") as refusal:
        picture(tmp_path / "vehicle.png")
    assert "\n" not in str(refusal.value)
    with pytest.raises(ValueError, match=r"\.png"):
        picture(tmp_path / "vehicle.jpg")
