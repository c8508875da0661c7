"""A CSV log is read to the last digit, or refused in one line that says file, row, field and what to do."""

import gzip
import tracemalloc

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from surface import outcome, refusal

from hybrid_jax.flights.formats.csv import read_csv
from hybrid_jax.flights.load import read_log, read_recording
from hybrid_jax.flights.log import COLUMNS, FlightLog

HEADER = ",".join(COLUMNS)
FUZZ = settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def rows_of(log):
    return [",".join(map(repr, row)) for row in np.column_stack([log.t, log.x, log.u]).tolist()]


@pytest.fixture
def written(tmp_path):
    def write(text, name="flight.csv", packed=False):
        path = tmp_path / name
        content = text if isinstance(text, bytes) else text.encode()
        path.write_bytes(gzip.compress(content) if packed else content)
        return path

    return write


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_a_log_is_read_to_the_last_digit(flight, written, packed, end):
    log = read_csv(written(end.join([HEADER, *rows_of(flight)]), packed=packed))
    for name in ("t", "x", "u"):
        np.testing.assert_allclose(getattr(log, name), getattr(flight, name), rtol=0, atol=1e-15)


def test_quotes_around_names_and_cells_are_passed_over(flight, written):
    """As R's write.csv and pandas' QUOTE_ALL write them."""
    header = ",".join(f'"{name}"' for name in COLUMNS)
    quoted = [",".join(f'"{cell}"' for cell in row.split(",")) for row in rows_of(flight)]
    for rows in (rows_of(flight), quoted):
        np.testing.assert_allclose(read_csv(written("\n".join([header, *rows]) + "\n")).x, flight.x, rtol=0, atol=1e-15)


@pytest.mark.parametrize("packed", [False, True])
def test_a_file_that_ends_within_a_row_has_a_note(flight, written, packed):
    whole = "\r\n".join([HEADER, *rows_of(flight[:20])]) + "\r\n"
    for cut, notes in ((0, 0), (4, 1)):
        path = written(whole[: len(whole) - cut], packed=packed)
        for recording in (read_log(path).recording, read_recording(path)):
            assert sum("its last number may be cut off" in note for note in recording.notes) == notes


def test_columns_may_have_any_order(flight, written):
    rows = [",".join([*reversed(row.split(",")), "armed"]) for row in rows_of(flight)]
    header = ",".join([*reversed(COLUMNS), "mode"])
    np.testing.assert_allclose(read_csv(written("\n".join([header, *rows]) + "\n")).x, flight.x, rtol=0, atol=1e-15)


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
        (changed(40, "vy", "nan"), ("row 40", "field vy", "'nan'")),
        (changed(40, "vy", ""), ("row 40", "field vy", "empty")),
        (changed(41, "u3", "12 rpm"), ("row 41", "field u3", "'12 rpm'")),
        (changed(42, "t", "0.0"), ("row 42", "field t", "goes back")),
        (changed(43, "u1", "-900"), ("row 43", "field u1", "negative")),
        (lambda rows: [HEADER, *rows[:9], rows[9] + ",1", *rows[10:]], ("row 11", "19 fields", "18")),
        (lambda rows: [HEADER, *rows[:9], "", *rows[9:]], ("row 11", "blank")),
        (lambda rows: [HEADER, *rows[:5], "0.05,0,0,0,0,0,0,0,0,0,0,0,0,0,9,9,9,9"], ("row 7", "qw", "norm is 0")),
        (lambda rows: [HEADER], ("row 2", "no samples")),
        (lambda rows: [], ("row 1", "empty")),
        (lambda rows: [HEADER, "1" * 5_000_000], ("row 2", "too long for a row")),
    ],
)
def test_a_bad_log_is_refused_with_file_row_and_field(flight, written, lines, words):
    path = written("\n".join(lines(rows_of(flight))))
    refusal(lambda: read_csv(path), path, *words)


def test_degrees_per_second_are_refused(flight, written):
    degrees = flight.x.copy()
    degrees[:, 10:] *= 180 / np.pi
    path = written("\n".join([HEADER, *rows_of(FlightLog(flight.t, degrees, flight.u))]))
    row = int(np.linalg.norm(degrees[:-1, 10:], axis=1).argmax()) + 2
    refusal(lambda: read_csv(path), path, f"row {row},", "wx wy wz", "rad/s")


def test_damaged_files_are_refused(flight, written, tmp_path):
    packed = gzip.compress("\n".join([HEADER, *rows_of(flight)]).encode())
    refusal(lambda: read_csv(written(packed[: len(packed) // 2], "a.gz")), "a.gz", "truncated")
    refusal(lambda: read_csv(written(packed[:500] + b"\0" * 400 + packed[900:], "b.gz")), "b.gz")
    refusal(lambda: read_csv(written(b"\xff\xfe\0\1", "c.csv")), "c.csv", "not text")
    refusal(lambda: read_csv(tmp_path / "none.csv"), "none.csv", "no such file")
    refusal(lambda: read_csv(tmp_path), "cannot be read")


def test_too_many_rows_are_refused(flight, written):
    path = written("\n".join([HEADER, *rows_of(flight)]))
    assert len(read_csv(path, max_rows=len(flight))) == len(flight)
    refusal(lambda: read_csv(path, max_rows=len(flight) - 1), path, f"row {len(flight) + 1}", "split the file")


def read_or_refused(path):
    found = outcome(read_csv, path, naming=str(path))
    assert found is None or found.name == str(path)


@FUZZ
@given(st.one_of(st.binary(max_size=300), st.binary(max_size=300).map(lambda tail: f"{HEADER}\n".encode() + tail)))
def test_any_bytes_are_read_or_refused(written, content):
    read_or_refused(written(content))
    read_or_refused(written(b"\x1f\x8b" + content, "flight.csv.gz"))


CELLS = st.one_of(
    st.floats().map(repr), st.text(max_size=5), st.sampled_from(["0", "1", "", "1e999", "0x1", "1_0", "-"])
)


@FUZZ
@given(st.integers(0, 4), st.integers(0, 17), CELLS)
def test_any_cell_is_read_or_refused(written, flight, row, column, cell):
    rows = [line.split(",") for line in rows_of(flight[:5])]
    rows[row][column] = cell
    read_or_refused(written("\n".join([HEADER, *map(",".join, rows)]).encode("utf-8", "replace")))


def test_memory_is_bounded_by_the_numbers_kept(flight, written):
    """Text is held a block at a time; at the worst, more rows take twice their numbers, while parts are joined."""
    rows = [row.split(",", 1)[1] for row in rows_of(flight)] * 42

    def peak(count):
        path = written("\n".join([HEADER, *(f"{i / 100:.2f},{row}" for i, row in enumerate(rows[:count]))]))
        tracemalloc.start()
        assert len(read_csv(path)) == count
        found = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return found

    numbers = 25_000 * len(COLUMNS) * 8
    assert peak(50_000) - peak(25_000) < 2.2 * numbers
