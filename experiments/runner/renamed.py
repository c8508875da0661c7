"""Old names of options, accepted for one version."""

import sys
from collections.abc import Mapping, Sequence


def renamed_options(arguments: Sequence[str], names: Mapping[str, str]) -> list[str]:
    """Command-line arguments with old names of options replaced, and one line on stderr for each that was used.

    Args:
        names: old → new name, as in `--old-name`. The forms `--old_name`, `--old-name=value` and, for a flag,
            `--no-old-name` are replaced too.
    """
    names = {**names, **{f"--no-{old[2:]}": f"--no-{new[2:]}" for old, new in names.items()}}
    found = []
    for argument in arguments:
        name, equals, value = argument.partition("=")
        new = names.get(name.replace("_", "-")) if name.startswith("--") else None
        if new:
            print(f"{name} is now {new}; the old name will be removed in the next version", file=sys.stderr)
        found.append(f"{new}{equals}{value}" if new else argument)
    return found
