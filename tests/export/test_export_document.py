"""What docs/howto/export.md shows is what happens; a program is read without the library."""

import re

import pytest
from smoke import ROOT, script

WITH, WITHOUT = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "howto" / "export.md").read_text(), flags=re.DOTALL)


def said(code, folder):
    return script("-c", f"import sys\nsys.path.insert(0, {str(ROOT)!r})\n{code}", cwd=folder)


@pytest.mark.slow
def test_the_examples_run_and_the_two_forms_agree(tmp_path):
    of_the_first = said(WITH, tmp_path)
    assert "F:(x[13],u[4])->(xnext[13])" in of_the_first
    assert float(of_the_first.split()[-1]) < 1e-5  # single precision of states of size 1
    assert (tmp_path / "step.casadi").exists()
    assert "float32[13]" in said(f"sys.modules['hybrid_jax'] = None\n{WITHOUT}", tmp_path)
