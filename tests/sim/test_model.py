"""One source of numbers: the Vehicle."""

import pytest
from smoke import script

from experiments.flying.images import picture
from hybrid_jax.sim import check_versions


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
