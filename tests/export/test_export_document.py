"""What docs/howto/export.md and solvers.md show is what happens; a program is read without the library."""

import re

import pytest
from smoke import ROOT, script

pytestmark = pytest.mark.slow


def programs(page):
    return re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "howto" / page).read_text(), flags=re.DOTALL)


def said(code, folder):
    return script("-c", f"import sys\nsys.path.insert(0, {str(ROOT)!r})\n{code}", cwd=folder)


def test_the_examples_run_and_the_two_forms_agree(tmp_path):
    with_library, without = programs("export.md")
    of_the_first = said(with_library, tmp_path)
    assert "F:(x[13],u[4])->(xnext[13])" in of_the_first
    assert float(of_the_first.split()[-1]) < 1e-5  # single precision of states of size 1
    assert (tmp_path / "step.casadi").exists()
    assert "float32[13]" in said(f"sys.modules['hybrid_jax'] = None\n{without}", tmp_path)


def test_the_example_solves_its_problem(tmp_path):
    pytest.importorskip("casadi")
    (program,) = programs("solvers.md")
    assert "Solve_Succeeded" in said(program, tmp_path)
