"""What docs/howto/c.md and export.md show is what happens; a program is read without the library."""

import re
from contextlib import nullcontext

import numpy as np
import pytest
from compiled import C99, needs_compiler, run
from smoke import ROOT, script

import hybrid_jax as hj
from hybrid_jax.cli import main


def programs(page, language="python"):
    text = (ROOT / "docs" / "howto" / page).read_text()
    return re.findall(rf"```{language}\n(.*?)```", text, flags=re.DOTALL)


def said(code, folder):
    return script("-c", f"import sys\nsys.path.insert(0, {str(ROOT)!r})\n{code}", cwd=folder)


@pytest.mark.slow
def test_the_examples_run_and_the_two_forms_agree(tmp_path):
    with_library, without = programs("export.md")
    of_the_first = said(with_library, tmp_path)
    assert "F:(x[13],u[4])->(xnext[13])" in of_the_first
    assert float(of_the_first.split()[-1]) < 1e-5  # single precision of states of size 1
    assert (tmp_path / "step.casadi").exists()
    assert "float32[13]" in said(f"sys.modules['hybrid_jax'] = None\n{without}", tmp_path)


@needs_compiler
def test_the_program_in_c_runs_and_says_what_jax_says(tmp_path, monkeypatch):
    (program,) = (one for one in programs("c.md", "c") if one.startswith("#include"))
    body = hj.rigid_body(hj.IRIS)
    hj.save(tmp_path / "model.npz", body, {"dt": 0.01})
    folders = ["-o", tmp_path / "board", "--out", tmp_path]
    for name in ("command.configure", "answering"):  # devices and signals are those of this process
        monkeypatch.setattr(f"hybrid_jax.cli.{name}", lambda *_, **__: nullcontext())
    with pytest.raises(SystemExit, match="0"):
        main([*map(str, ("export", tmp_path / "model.npz", "--name", "iris", *folders))])
    (tmp_path / "main.c").write_text(program)
    sources = "main.c", "board/iris.c"
    run("gcc", *C99, "-O2", "-Iboard", *sources, "-lm", "-o", "program", cwd=tmp_path)
    printed = run(tmp_path / "program")

    speeds = np.repeat([[650.0], [660.0], [660.0]], 4, axis=1)
    x0 = np.array([0, 0, 1, 1] + [0] * 9, float)
    expected = float(hj.rollout(body, x0, speeds, 0.01)[-1, 9])
    assert float(re.search(r"after 30 ms: vz = (\S+)", printed)[1]) == np.float64(f"{expected:.4f}")
    # dv/du = 2 k u dt / m
    push = 2 * hj.IRIS.thrust_coefficient * 660 * 0.01 / hj.IRIS.mass
    assert abs(float(re.search(r"adds (\S+)", printed)[1]) - 10 * push) < 1e-3 * 10 * push + 5e-6
