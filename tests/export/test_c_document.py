"""The program in docs/howto/c.md compiles without a warning, and says what JAX says."""

import re
from contextlib import nullcontext

import numpy as np
import pytest
from compiled import C99, needs_compiler, run
from smoke import ROOT

import hybrid_jax as hj
from hybrid_jax.cli import main

(PROGRAM,) = re.findall(r"```c\n(#include.*?)```", (ROOT / "docs" / "howto" / "c.md").read_text(), flags=re.DOTALL)


@needs_compiler
def test_the_program_runs(tmp_path, monkeypatch):
    body = hj.rigid_body(hj.IRIS)
    hj.save(tmp_path / "model.npz", body, {"dt": 0.01})
    folders = ["-o", tmp_path / "board", "--out", tmp_path]
    for name in ("command.configure", "answering"):  # devices and signals are those of this process
        monkeypatch.setattr(f"hybrid_jax.cli.{name}", lambda *_, **__: nullcontext())
    with pytest.raises(SystemExit, match="0"):
        main([*map(str, ("export", tmp_path / "model.npz", "--name", "iris", *folders))])
    (tmp_path / "main.c").write_text(PROGRAM)
    sources = "main.c", "board/iris.c"
    run("gcc", *C99, "-O2", "-Iboard", *sources, "-lm", "-o", "program", cwd=tmp_path)
    said = run(tmp_path / "program")

    speeds = np.repeat([[650.0], [660.0], [660.0]], 4, axis=1)
    x0 = np.array([0, 0, 1, 1] + [0] * 9, float)
    expected = float(hj.rollout(body, x0, speeds, 0.01)[-1, 9])
    assert float(re.search(r"after 30 ms: vz = (\S+)", said)[1]) == np.float64(f"{expected:.4f}")
    # dv/du = 2 k u dt / m
    push = 2 * hj.IRIS.thrust_coefficient * 660 * 0.01 / hj.IRIS.mass
    assert abs(float(re.search(r"adds (\S+)", said)[1]) - 10 * push) < 1e-3 * 10 * push + 5e-6
    assert len(PROGRAM.splitlines()) <= 45
