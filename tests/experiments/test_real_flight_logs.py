"""From folders of logs to flights: what is read and cleaned, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
from recorded import CONFIG, DT, LOGS, SAMPLES, write

from experiments.real_flight.logs import load_logs, require_distinct
from hybrid_jax.flights.windows import require_common_interval
from hybrid_jax.vehicle import IRIS


def test_logs_are_read_checked_and_cleaned(tmp_path):
    source = write(tmp_path / "source", LOGS[:2])
    cleaning = replace(CONFIG.cleaning, in_flight=True, resample=0.02, low_pass=20.0, delay=0.02)
    found = load_logs("source", source, IRIS, 0.01, replace(CONFIG, cleaning=cleaning))
    assert [record["flight"] for record in found.records] == ["chirp_run1", "chirp_run2"]
    for record in found.records:
        assert [line.split()[0] for line in record["done"]] == ["0", "resampled", "low-pass", "motors", "rotors"]
        assert record["samples"] == SAMPLES
        assert len(record["checks"]) == 8 + 12
    assert require_common_interval(found.logs) == 0.02


@pytest.mark.parametrize(
    ("times", "message"),
    [
        (lambda t: 2 * t, r"chirp_run2.*0.02 s apart.*dt=0.02"),
        (
            lambda t: t + DT / 3 * (np.arange(SAMPLES) == 10),
            r"chirp_run2.*at 0.09 s is 0.0133\d+ s, the median is 0.01 s; .*dt=0.01",
        ),
    ],
)
def test_uneven_samples_and_different_intervals_are_refused(times, message):
    with pytest.raises(ValueError, match=message):
        require_common_interval([LOGS[0], replace(LOGS[1], t=times(LOGS[1].t))])


def test_hidden_files_and_folders_are_ignored(tmp_path):
    source = write(tmp_path, LOGS[:1])
    (source / "._chirp_run1.csv").write_bytes(b"\x00\x05\x16\x07")  # macOS writes such files on other disks
    (source / "old.csv").mkdir()
    assert len(load_logs("source", source, IRIS, 0.0, CONFIG).logs) == 1


def test_duplicate_flights_are_refused(tmp_path):
    same = replace(LOGS[0], name="/logs/chirp_run9.csv")
    source = load_logs("source", write(tmp_path / "source", LOGS[:2]), IRIS, 0.0, CONFIG)
    twice = load_logs("source", write(tmp_path / "twice", [LOGS[0], same]), IRIS, 0.0, CONFIG)
    test = load_logs("test", write(tmp_path / "test", [same]), IRIS, 0.0, CONFIG)
    turns = replace(CONFIG, folds_by="manoeuvre")
    require_distinct([source], CONFIG)
    require_distinct([source, test], turns)
    both = r"--test .*test/chirp_run9.csv.gz: the same flight as --source .*source/chirp_run1.csv.gz; leave one"
    for config in (CONFIG, replace(turns, target=tmp_path)):
        with pytest.raises(ValueError, match=both):
            require_distinct([source, test], config)
    with pytest.raises(ValueError, match=r"--source .*chirp_run9.*the same flight as --source .*chirp_run1"):
        require_distinct([twice], turns)
