"""The ratios of all benchmarks over the commits at which they were measured: a file of one JSON object per line."""

import json
import subprocess
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from benchmarks.timing import PACKAGES
from hybrid_jax.io.datasets import versions
from hybrid_jax.io.files import json_value, write_atomic
from hybrid_jax.runtime import hardware

COLUMNS = 3  # panels beside each other
Entry = Mapping[str, Any]  # date, commit, versions, hardware, and ratios by name: value, at_most, at_least


def append(file: Path, ratios: Mapping[str, Mapping[str, Any]]) -> list[Entry]:
    """Add what was measured now to the file, and return all entries, the oldest first.

    Raises:
        ValueError: a line of the file is not an entry.
    """
    entry = {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "commit": commit(),
        "versions": versions(*PACKAGES),
        "hardware": hardware(),
        "ratios": ratios,
    }
    entries = [*(read(file) if file.exists() else []), json_value(entry)]
    write_atomic(file, "".join(json.dumps(each, ensure_ascii=False) + "\n" for each in entries))
    return entries


def read(file: Path) -> list[Entry]:
    """All entries of a file; ValueError names the line that is none."""
    entries = []
    for number, line in enumerate(file.read_text().splitlines(), 1):
        try:
            entry = json.loads(line)
            entries.append({"commit": entry["commit"], "ratios": dict(entry["ratios"])} | entry)
        except (ValueError, KeyError, TypeError) as error:
            expected = f"expected an entry that --history wrote, got {line[:40]!r}"
            raise ValueError(f"{file}, line {number}: {expected}") from error
    return entries


def commit() -> str:
    """The commit of the checkout, with a + if files differ from it; "unknown" outside of a checkout."""
    described = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty=+", "--exclude=*"]
    try:
        return subprocess.run(described, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def figure(entries: Sequence[Entry]) -> Figure:
    """A panel for each ratio: its value over the entries, and the bounds to reach. Processors differ in colour."""
    names = list(dict.fromkeys(name for entry in entries for name in entry["ratios"]))
    processors = list(dict.fromkeys(entry["hardware"]["cpu"] for entry in entries))
    rows = max(1, -(-len(names) // COLUMNS))
    drawn = Figure(figsize=(4.2 * COLUMNS, 2.2 * rows + 0.8), layout="constrained")
    panels = np.ravel(drawn.subplots(rows, COLUMNS, squeeze=False))
    ticks = list(range(len(entries)))
    for panel, name in zip(panels, names, strict=False):
        for i, processor in enumerate(processors):
            own = [k for k in ticks if entries[k]["hardware"]["cpu"] == processor and name in entries[k]["ratios"]]
            panel.plot(own, [entries[k]["ratios"][name]["value"] for k in own], "o-", color=f"C{i}", label=processor)
        last = next(entry["ratios"][name] for entry in reversed(entries) if name in entry["ratios"])
        for bound in ("at_most", "at_least"):
            if last[bound] is not None:
                panel.axhline(last[bound], color="0.5", linestyle="--", label="to reach")
        panel.set_title("\n".join(_lines(name)), fontsize=8)
        panel.set_xticks(ticks, [entry["commit"] for entry in entries], rotation=90, fontsize=7)
        panel.set_ylim(0, 1.1 * panel.get_ylim()[1])
    for panel in panels[len(names) :]:
        panel.set_axis_off()
    found = [zip(*panel.get_legend_handles_labels(), strict=True) for panel in panels]
    handles = {label: handle for pairs in found for handle, label in pairs}
    drawn.legend(handles.values(), handles, loc="outside lower center", ncols=3, fontsize=8)
    return drawn


def _lines(name: str, width: int = 52) -> list[str]:
    """A name in lines short enough for the head of a panel."""
    lines = [""]
    for word in name.split():
        lines = [*lines, word] if len(lines[-1]) + len(word) > width else [*lines[:-1], f"{lines[-1]} {word}".strip()]
    return lines
