"""A CSV log is read to the last digit, or refused in one line that says file, row, field and what to do."""

import gzip
import tracemalloc

import numpy as np
import pytest
from surface import refusal
from writers import column_map

from hybrid_jax.flights import check_recording, load_log, read_recording
from hybrid_jax.flights.conversion import flight_at
from hybrid_jax.flights.formats.csv import read_table
from hybrid_jax.flights.log import COLUMNS

HEADER = ",".join(COLUMNS)


def rows_of(log):
    return [",".join(map(repr, row)) for row in np.column_stack([log.t, log.x, log.u]).tolist()]


def quoted(line):
    return ",".join(f'"{cell}"' for cell in line.split(","))


def reversed_with(name):
    return lambda line: ",".join([*reversed(line.split(",")), name])


# Header and rows, their ends, and what stands above: numpy.savetxt, MATLAB, Excel, R and pandas write them so.
WRITTEN = {
    "plain": (str, str, "\n", ""),
    "of Windows": (str, str, "\r\n", ""),
    "time for t": (lambda line: f"time{line[1:]}", str, "\n", ""),
    "names in quotes": (quoted, str, "\n", ""),
    "all in quotes": (quoted, quoted, "\n", ""),
    "another order, and a column of text": (reversed_with("mode"), reversed_with("armed"), "\n", ""),
    **{above: (str, str, "\n", above) for above in ("# ", "#", "% ", "# by a logger\n", "sep=,\n", "#a\n# b\n")},
}


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("way", WRITTEN)
def test_a_log_is_read_to_the_last_digit(flight, written, packed, way):
    header, row, end, above = WRITTEN[way]
    log = load_log(written(above + end.join([header(HEADER), *map(row, rows_of(flight))]) + end, packed=packed))
    for name in ("t", "x", "u"):
        np.testing.assert_allclose(getattr(log, name), getattr(flight, name), rtol=0, atol=1e-15)


@pytest.mark.parametrize("packed", [False, True])
def test_a_file_that_ends_within_a_row_has_a_note(flight, written, packed):
    whole = "\r\n".join([HEADER, *rows_of(flight[:20])]) + "\r\n"
    for cut, notes in ((0, 0), (4, 1)):
        path = written(whole[: len(whole) - cut], packed=packed)
        assert sum("its last number may be cut off" in note for note in read_recording(path).notes) == notes


def changed(row, field, cell):
    """Lines in which one cell is another; the header is row 1."""

    def change(rows):
        cells = rows[row - 2].split(",")
        cells[COLUMNS.index(field)] = cell
        return [HEADER, *rows[: row - 2], ",".join(cells), *rows[row - 1 :]]

    return change


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        (lambda rows: [HEADER.replace(",qz", ""), *rows], ("row 1", "field qz", "column map")),
        (lambda rows: [",stamp", "0,1"], ("row 1", "no such column among stamp;")),  # a table with its index
        (lambda rows: [HEADER.replace("vy", "vx"), *rows], ("row 1", "field vx", "2 times")),
        (changed(2, "t", "2026-11-27 12:00:00.5"), ("row 2", "field t", "is a date: write the time in seconds")),
        (changed(2, "vy", "[1 2 3]"), ("row 2", "field vy", "a list in a cell")),
        (changed(41, "u3", "12 rpm"), ("row 41", "field u3", "'12 rpm'")),
        (changed(43, "u1", "-900"), ("sample 41", "field u1", "negative")),
        (lambda rows: [HEADER, *rows[:9], rows[9] + ",1", *rows[10:]], ("row 11", "19 fields", "18")),
        (lambda rows: [HEADER, *rows[:9], "", *rows[9:]], ("row 11", "blank")),
        (lambda rows: [HEADER], ("row 2", "no samples")),
        (lambda rows: [], ("row 1", "empty")),
        (lambda rows: [HEADER, "1" * 5_000_000], ("row 2", "too long for a row")),
    ],
)
def test_a_bad_log_is_refused_with_file_row_and_field(flight, written, lines, words):
    path = written("\n".join(lines(rows_of(flight))))
    refusal(lambda: load_log(path), path, *words)


@pytest.mark.parametrize("cell", ["", "nan", "NaN", "NULL", "-"])
def test_rows_that_tell_nothing_are_gaps(flight, written, cell):
    """A cell without a number, or a motion capture that lost the vehicle: what was measured beside it is kept."""
    rows = [line.split(",") for line in rows_of(flight)]
    for row in rows[300:310]:
        row[COLUMNS.index("vy")] = cell
    for row in rows[500:505]:
        row[COLUMNS.index("px") : COLUMNS.index("vx")] = ["0.0"] * 7
    rows[40][0] = "0.0"  # one time stamp
    raw = read_recording(written("\n".join([HEADER, *map(",".join, rows)]) + "\n"))
    log = flight_at(raw)
    kept = np.delete(np.arange(len(flight)), [*range(300, 310), *range(500, 505), 40])
    np.testing.assert_allclose(log.x, flight.x[kept], atol=1e-12)
    assert len(raw.signals["rates"]) >= len(flight) - 6
    assert any("1190 of 1200 rows contain velocity" in note for note in raw.notes)


def test_joined_tables_of_several_rates_have_the_times_of_each(flight, written):
    """As pandas.merge(how="outer") writes them: attitude in every fourth row, motors in the rows between."""
    rows = [line.split(",") for line in rows_of(flight)]
    for i, row in enumerate(rows):
        for first, last, kept in (("qw", "vx", i % 4 == 0), ("u0", "u3", i % 2 == 1)):
            if not kept:
                begin, end = COLUMNS.index(first), COLUMNS.index(last) + (last == "u3")
                row[begin:end] = [""] * (end - begin)
    raw = read_recording(written("\n".join([HEADER, *map(",".join, rows)]) + "\n"))
    assert {name: len(each) for name, each in raw.signals.items()} == {
        "position": 1200, "attitude": 300, "velocity": 1200, "rates": 1200, "rotor_speed": 600,
    }  # fmt: skip
    (line,) = [c.suggestion for c in check_recording(raw, None, 0.01) if c.name == "slowest signal"]
    assert "attitude 25 Hz, motors 50 Hz" in line
    log = flight_at(raw, 0.02)
    apart = [[*row[:14], *[""] * 4] for row in rows] + [[row[0], *[""] * 13, *row[14:]] for row in rows]
    apart = [",".join(row) for row in sorted(apart, key=lambda row: float(row[0]))]  # two rows at each time
    again = flight_at(read_recording(written("\n".join([HEADER, *apart]))), 0.02)
    np.testing.assert_array_equal(again.x, log.x)
    np.testing.assert_allclose(log.x[:, 7:10], flight.x[1 : 2 * len(log) : 2, 7:10], atol=1e-9)


def test_damaged_files_are_refused_and_memory_is_bounded_by_the_numbers_kept(flight, written, tmp_path):
    packed = gzip.compress("\n".join([HEADER, *rows_of(flight)]).encode())
    refusal(lambda: load_log(written(packed[: len(packed) // 2], "a.csv.gz")), "a.csv.gz", "truncated")
    refusal(lambda: load_log(written(packed[:500] + b"\0" * 400 + packed[900:], "b.csv.gz")), "b.csv.gz")
    refusal(lambda: load_log(written(b"\xff\xfe\0\1", "c.csv")), "c.csv", "not text")
    refusal(lambda: load_log(tmp_path / "none.csv"), "none.csv", "no such file")
    refusal(lambda: load_log(tmp_path), "a folder")
    path = written("\n".join([HEADER, *rows_of(flight)]))
    refusal(lambda: read_table(path, COLUMNS, max_rows=1199), "row 1201", "split the file")
    # Text is held a block at a time; at the worst, more rows take twice their numbers, while parts are joined.
    rows = [row.split(",", 1)[1] for row in rows_of(flight)] * 42

    def peak(count):
        path = written("\n".join([HEADER, *(f"{i / 100:.2f},{row}" for i, row in enumerate(rows[:count]))]))
        tracemalloc.start()
        assert len(read_table(path, COLUMNS)[0]) == count
        found = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return found

    numbers = 25_000 * len(COLUMNS) * 8
    assert peak(50_000) - peak(25_000) < 2.2 * numbers


def test_semicolons_and_decimal_commas_are_said_and_read(flight, tmp_path):
    path = tmp_path / "flight.csv"
    path.write_text("\n".join([HEADER, *rows_of(flight)]).replace(",", ";").replace(".", ","))
    refusal(lambda: read_recording(path), path, "row 1", "separated by ';'", "columns=")
    tables = column_map(time=("t", "s"), velocity=("vx vy vz", "m/s"), motors=("u0 u1 u2 u3", "pwm"))
    (tmp_path / "map.toml").write_text(tables + 'format = {delimiter = ";"}')
    refusal(lambda: read_recording(path, tmp_path / "map.toml"), "row 2, field t", "decimal comma", 'decimal = ","')
    (tmp_path / "map.toml").write_text(tables + 'format = {delimiter = ";", decimal = ","}')
    found = read_recording(path, tmp_path / "map.toml").signals
    assert [*found] == ["velocity", "command"]
    np.testing.assert_allclose(found["velocity"].values, flight.x[:, 7:10], atol=1e-8)
    np.testing.assert_allclose(found["command"].values, np.where(flight.u < 800, flight.u - 1000, 0) / 1000, atol=1e-8)
