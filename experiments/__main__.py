"""What there is to run: python -m experiments."""

import ast
from pathlib import Path


def main() -> None:
    """Print a line for each program: its command, and what it is."""
    folder = Path(__file__).parent
    programs = [path for path in folder.glob("*.py") if not path.stem.startswith("_")] + [*folder.glob("*/__main__.py")]
    for path in sorted(programs):
        name = ".".join(path.relative_to(folder).with_suffix("").parts).removesuffix(".__main__")
        said = ast.get_docstring(ast.parse(path.read_text())) or ""
        print(f"{name:<22}{said.splitlines()[0].partition(': python -m')[0].rstrip('.')}")
    print("\npython -m experiments.NAME --help says more. Your own logs: hybrid-jax --help.")


if __name__ == "__main__":
    main()
