"""List all experiments: python -m experiments."""

import ast
from pathlib import Path

RUN = 'if __name__ == "__main__":'


def main() -> None:
    """Print each program's command and purpose."""
    folder = Path(__file__).parent
    for path in sorted(folder.rglob("*.py")):
        source, name = path.read_text("utf-8"), ".".join(path.relative_to(folder).with_suffix("").parts)
        if RUN not in source or name == "__main__":
            continue
        said = ast.get_docstring(ast.parse(source)) or ""
        print(f"{name.removesuffix('.__main__'):<25}{said.splitlines()[0].partition(': python -m')[0].rstrip('.')}")
    print("\npython -m experiments.NAME --help lists its options. For logs of your own: hybrid-jax --help.")


if __name__ == "__main__":
    main()
