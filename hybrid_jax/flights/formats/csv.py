"""Flight-log CSV, plain or gzip: t, then the state, then the rotor speeds, one row per sample; SI units.

The header names the columns. Their order is free, and other columns are ignored.
"""

import contextlib
import io
import json
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO

import numpy as np
from jaxtyping import Float

from hybrid_jax.flights.attitude import rates_between
from hybrid_jax.flights.formats.raw import opened, readable
from hybrid_jax.flights.log import COLUMNS, FlightLog, require_possible
from hybrid_jax.state import BODY_RATES, QUATERNION, input_names
from hybrid_jax.vehicle import FEWEST_ROTORS, MOST_ROTORS

BLOCK = 1 << 22  # characters read at once
LISTS = "a list in a cell: write each of its numbers in a column of its own"
MAX_ROW_LENGTH = 1 << 16
FURTHER = input_names(MOST_ROTORS)[FEWEST_ROTORS:]
MAX_ROWS = 4_000_000  # 0.6 GB of numbers; eleven hours at 100 Hz


def read_csv(path: str | Path, *, max_rows: int = MAX_ROWS) -> FlightLog:
    """Read one flight.

    Raises:
        ValueError: file, row (the first line is row 1), field and what to do, in one line.
    """
    return flight_log(path, read_table(path, COLUMNS[:-1], max_rows=max_rows, further=FURTHER))


def flight_log(path: str | Path, table: Float[np.ndarray, "n c"]) -> FlightLog:
    """Check the table of a file, in the order of `COLUMNS`, of any rotors; row i + 2 of the file holds table[i]."""
    parts = table[:, 0], table[:, 1:14], table[:, 14:]
    require_possible(*parts, path, "row", 2)
    log = FlightLog(*parts, str(path))
    _refuse_degrees(log)
    return log


def read_table(
    path: str | Path,
    columns: Sequence[str],
    *,
    delimiter: str = ",",
    decimal: str = ".",
    max_rows: int = MAX_ROWS,
    further: Sequence[str] = (),
) -> Float[np.ndarray, "n c"]:
    """Read the named columns of a CSV file with a header, in the given order; all numbers must be finite.

    Args:
        further: columns that are read, too, up to the last of them that the file has.

    Raises:
        ValueError: file, row, field and what to do, in one line.
    """
    try:
        with readable(path) as file:
            text = io.TextIOWrapper(file, encoding="utf-8-sig")
            parts = list(_parts(path, text, [columns, further], delimiter, decimal, max_rows))
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: is not text; export the log as CSV in UTF-8") from error
    return np.concatenate(parts)


def notes_on_end(path: str | Path) -> tuple[str, ...]:
    """A note if no line break ends the last row of a file that was read: a program that writes rows ends each."""
    with opened(path) as file:
        file.seek(-1, io.SEEK_END)
        ended = file.read(1) in b"\r\n"
    note = "no line break ends the last row, so its last number may be cut off: cut the row out, or end it with one"
    return () if ended else (note,)


def _parts(
    path, text: IO[str], asked, delimiter: str, decimal: str, max_rows: int
) -> Iterator[Float[np.ndarray, "n c"]]:
    header = text.readline(MAX_ROW_LENGTH).replace('"', "")  # R and others put names in quotes, or all cells
    names = [name.strip() for name in header.split(delimiter)]
    columns, further = asked
    columns = [*columns, *further[: max((i + 1 for i, name in enumerate(further) if name in names), default=0)]]
    for name in columns:
        if names.count(name) != 1:
            raise ValueError(_header_complaint(path, name, names, header, delimiter))
    picked, row = [names.index(name) for name in columns], 2
    while block := text.read(BLOCK):
        block += text.readline(MAX_ROW_LENGTH)
        block = block.replace('"', "")
        lines = (block.replace(decimal, ".") if decimal != "." else block).split("\n")
        if not lines[-1]:
            lines.pop()
        elif len(lines[-1]) >= MAX_ROW_LENGTH:
            last = row + len(lines) - 1
            raise ValueError(f"{path}: row {last}: is too long for a row of numbers; is this a CSV file?")
        if row - 2 + len(lines) > max_rows:
            raise ValueError(f"{path}: row {max_rows + 2}: more than {max_rows} rows; split the file by flight")
        yield _numbers(path, lines, row, names, picked, delimiter)
        row += len(lines)
    if row == 2:
        raise ValueError(f"{path}: row 2: there are no samples below the header; record or export the flight again")


def _header_complaint(path, name: str, names: list[str], header: str, delimiter: str) -> str:
    if not header.strip():
        return f"{path}: row 1: the file is empty or has no header; export the log again"
    if name in names:
        return f"{path}: row 1, field {name}: stands {names.count(name)} times in the header; rename all but one"
    for other in (";", "\t", ","):
        if len(names) == 1 and other != delimiter and header.count(other) > 2:
            advice = f"set format = {{delimiter = {json.dumps(other)}}} in a column map, columns=…"
            return f"{path}: row 1: the fields are separated by {other!r}, not {delimiter!r}; {advice}"
    named = [each for each in names if each]  # a table's index has no name
    found = ", ".join(named[:20])[:200].encode("unicode_escape").decode()
    return f"{path}: row 1, field {name}: no such column among {found}; rename a column or use a column map"


def _numbers(path, lines: list[str], row: int, names, picked, delimiter: str) -> Float[np.ndarray, "n c"]:
    """Parse the picked cells of some lines, the first of which is the given row."""
    commas = len(names) - 1
    for at, line in enumerate(lines):
        if line.count(delimiter) != commas:
            found = f"{line.count(delimiter) + 1} fields" if line.strip() else "a blank line"
            mend = LISTS if "[" in line else "repair or cut the row out"
            raise ValueError(f"{path}: row {row + at}: {found}, the header has {commas + 1}; {mend}")
    with contextlib.suppress(ValueError):
        table = np.loadtxt(lines, delimiter=delimiter, usecols=picked, comments=None, ndmin=2)
        if table.shape == (len(lines), len(picked)) and np.isfinite(table).all():
            return table
    raise ValueError(f"{path}: {_bad_cell(lines, row, names, picked, delimiter)}")


def _bad_cell(lines, row, names, picked, delimiter) -> str:
    for at, line in enumerate(lines):
        cells = line.split(delimiter)
        for column in picked:
            cell = cells[column].strip()
            with contextlib.suppress(ValueError):
                if np.isfinite(np.loadtxt([cell or "-"], delimiter=delimiter, comments=None)).all():
                    continue
            if re.fullmatch(r"[+-]?\d+,\d+([eE][+-]?\d+)?", cell):
                advice = 'set format = {delimiter = ";", decimal = ","} in a column map, columns=…'
                return f"row {row + at}, field {names[column]}: {cell[:40]!r} has a decimal comma; {advice}"
            if re.match(r"\d{4}-\d\d-\d\d", cell) or cell.startswith("["):
                kind = LISTS if cell.startswith("[") else "a date: write the time in seconds"
                return f"row {row + at}, field {names[column]}: {cell[:40]!r} is {kind}"
            found = f"{cell[:40]!r} is not a finite number" if cell else "the cell is empty"
            return f"row {row + at}, field {names[column]}: {found}; cut the row out (it becomes a gap) or repair it"
    return f"rows {row} to {row + len(lines) - 1}: cannot be read as numbers; export the log again"


def _refuse_degrees(log: FlightLog) -> None:
    """Refuse body rates that are about 180/π times those of the attitude."""
    if len(log) < 3:
        return
    log = log[:100_000]  # enough to decide, without a copy of a long log
    turned = np.linalg.norm(rates_between(log.t, log.x[:, QUATERNION]), axis=1)
    stated = np.linalg.norm(log.x[:-1, BODY_RATES], axis=1)
    # Medians are robust to noise and lost samples.
    if np.median(turned) > 0.02 and 30 < np.median(stated) / np.median(turned) < 110:
        raise ValueError(
            f"{log.name}: row {int(stated.argmax()) + 2}, field wx wy wz: body rates (here {stated.max():.4g}) are 57 "
            "times those of the attitude: degrees per second; convert them to rad/s or declare the unit in a column map"
        )
