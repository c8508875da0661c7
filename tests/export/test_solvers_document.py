"""What docs/howto/solvers.md shows is what happens."""

import re

import pytest
from smoke import ROOT, script

pytest.importorskip("casadi")
(PROGRAM,) = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "howto" / "solvers.md").read_text(), flags=re.DOTALL)


@pytest.mark.slow
def test_the_example_solves_its_problem(tmp_path):
    said = script("-c", f"import sys\nsys.path.insert(0, {str(ROOT)!r})\n{PROGRAM}", cwd=tmp_path)
    assert "Solve_Succeeded" in said
