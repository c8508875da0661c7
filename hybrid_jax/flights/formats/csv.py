"""Numeric tables in CSV files, plain or gzip, with a header that names the columns in any order."""

import contextlib
import io
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import IO

import numpy as np
from jaxtyping import Float

from hybrid_jax.flights.formats.raw import readable

BLOCK = 1 << 22  # characters read at once
LISTS = "a list in a cell: write each of its numbers in a column of its own"
MAX_ROW_LENGTH = 1 << 16
COMMENT = re.compile("[#%]+ *")
NOTHING = ("", "null", "none", "na", "n/a", "-")  # cells that mean nan
MAX_ROWS = 4_000_000  # 0.6 GB of numbers; eleven hours at 100 Hz
CUT = "no line break ends the last row, so its last number may be cut off: cut the row out, or end it with one"


def read_table(
    path: str | Path, columns: Sequence[str], *, delimiter: str = ",", decimal: str = ".", max_rows: int = MAX_ROWS
) -> tuple[Float[np.ndarray, "n c"], tuple[str, ...]]:
    """Read the named columns of a CSV file in the given order; also return a note if the file was cut off.

    Empty cells are NaN. Lines before the header that begin with #, % or `sep=;` are skipped. The header itself may also
    begin with # or %.
    """
    parts, block = [], ""
    try:
        with readable(path) as file:
            text = io.TextIOWrapper(file, encoding="utf-8-sig")
            names, header, above = _header(text, delimiter)
            for name in columns:
                if names.count(name) != 1:
                    raise ValueError(_header_complaint(name, names, header, delimiter))
            picked, row = [names.index(name) for name in columns], above + 1
            while more := text.read(BLOCK):
                block = more + text.readline(MAX_ROW_LENGTH)
                lines = block.replace('"', "").replace(decimal, ".").split("\n")
                if not lines[-1]:
                    lines.pop()
                elif len(lines[-1]) >= MAX_ROW_LENGTH:
                    last = row + len(lines) - 1
                    raise ValueError(f"row {last}: is too long for a row of numbers; is this a CSV file?")
                if row - above - 1 + len(lines) > max_rows:
                    raise ValueError(f"row {max_rows + 2}: more than {max_rows} rows; split the file by flight")
                parts.append(_numbers(lines, row, names, picked, delimiter))
                row += len(lines)
    except UnicodeDecodeError as error:
        raise ValueError("is not text; export the log as CSV in UTF-8") from error
    if not parts:
        raise ValueError(f"row {row}: there are no samples below the header; record or export the flight again")
    return np.concatenate(parts), () if block.endswith("\n") else (CUT,)


def header_of(path: str | Path) -> list[str]:
    """Return the column names. It raises the errors of `read_table`."""
    with readable(path) as file, contextlib.suppress(UnicodeDecodeError):
        return _header(io.TextIOWrapper(file, encoding="utf-8-sig"), ",")[0]
    return []


def _header(text: IO[str], delimiter: str) -> tuple[list[str], str, int]:
    """Return the column names, the header line and its row."""
    row, line = 1, text.readline(MAX_ROW_LENGTH)
    while (COMMENT.match(line) and delimiter not in line) or line.startswith("sep="):
        row, line = row + 1, text.readline(MAX_ROW_LENGTH)
    line = COMMENT.sub("", line.replace('"', ""))  # R and others put names in quotes, or all cells
    return [name.strip() for name in line.split(delimiter)], line, row


def _header_complaint(name: str, names: list[str], header: str, delimiter: str) -> str:
    if not header.strip():
        return "row 1: the file is empty or has no header; export the log again"
    if name in names:
        return f"row 1, field {name}: occurs {names.count(name)} times in the header; rename all but one"
    for other in (";", "\t", ",", " "):
        if len(names) == 1 and other != delimiter and header.count(other) > 2:
            advice = f"set format = {{delimiter = {json.dumps(other)}}} in a column map, columns=…"
            return f"row 1: the fields are separated by {other!r}, not {delimiter!r}; {advice}"
    named = [each for each in names if each]  # a table's index has no name
    found = ", ".join(named[:20])[:200].encode("unicode_escape").decode()
    return f"row 1, field {name}: no such column among {found}; rename a column, or name it in a column map, columns=…"


def _numbers(lines: list[str], row: int, names, picked, delimiter: str) -> Float[np.ndarray, "n c"]:
    """Parse the picked cells of some lines, which begin at a row."""
    for at, line in enumerate(lines):
        if (count := line.count(delimiter) + 1) != len(names):
            found = f"{count} fields" if line.strip() else "a blank line"
            advice = LISTS if "[" in line else "repair or cut the row out"
            raise ValueError(f"row {row + at}: {found}, the header has {len(names)}; {advice}")
    for convert in (str, lambda line: delimiter.join(map(_or_nan, line.split(delimiter)))):
        with contextlib.suppress(ValueError):
            table = np.loadtxt(list(map(convert, lines)), delimiter=delimiter, usecols=picked, comments=None, ndmin=2)
            if table.shape == (len(lines), len(picked)):
                return table
    for at, line in enumerate(lines):
        cells = line.split(delimiter)
        for column in picked:
            if complaint := _bad_cell(cells[column].strip(), delimiter):
                raise ValueError(f"row {row + at}, field {names[column]}: {complaint}")
    raise ValueError(f"rows {row} to {row + len(lines) - 1}: cannot be read as numbers; export the log again")


def _or_nan(cell: str) -> str:
    return "nan" if cell.strip().lower() in NOTHING else cell


def _bad_cell(cell: str, delimiter: str) -> str:
    """Explain why a cell is not a number and what to do; "" if it is one."""
    with contextlib.suppress(ValueError):
        np.loadtxt([_or_nan(cell)], delimiter=delimiter, comments=None)
        return ""
    if re.fullmatch(r"[+-]?\d+,\d+([eE][+-]?\d+)?", cell):
        advice = 'set format = {delimiter = ";", decimal = ","} in a column map, columns=…'
        return f"{cell[:40]!r} has a decimal comma; {advice}"
    if cell.startswith("["):
        return f"{cell[:40]!r} is {LISTS}"
    if re.match(r"\d{4}-\d\d-\d\d", cell):
        return f"{cell[:40]!r} is a date: write the time in seconds"
    return f"{cell[:40]!r} is not a number; empty the cell (it becomes a gap) or repair it"
