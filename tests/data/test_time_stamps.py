"""Time stamps of logs of any length, in a temporary file."""

import os
import tempfile

import numpy as np
import pytest

from robotid.base.exceptions import DataError
from robotid.data import log
from robotid.data.log import blocks_of, map_stamps, median_step


def test_time_stamps_are_checked_where_blocks_meet():
    t = np.arange(10.0)
    with pytest.raises(DataError, match=r"t\[5\] = 4.500 s follows t\[4\] = 5.000 s"):
        map_stamps([t[1:6], t[5:] - 0.5], "log")
    with pytest.raises(DataError, match="time is NaN at row 7"):
        map_stamps([t[:5], np.where(t[5:] == 7.0, np.nan, t[5:])], "log")


@pytest.mark.parametrize("count", [2, 3, 9, 10, 300_001])
def test_the_median_step_is_exact(rng, count):
    t = 1.7e9 + np.cumsum(
        rng.choice([0.001, 0.002, 0.0011, 3.0], count) * rng.uniform(1, 1.1, count)
    )
    stamps = map_stamps(np.array_split(t, 3), "log")
    np.testing.assert_array_equal(stamps, t)
    assert median_step(stamps) == np.median(np.diff(t))
    if count > 9:
        assert median_step(stamps[4:-3]) == np.median(np.diff(t[4:-3]))


def test_blocks_share_the_stamp_where_they_meet(monkeypatch):
    monkeypatch.setattr(log, "_BLOCK", 4)
    t = np.arange(10.0) ** 2
    assert [(row, block.tolist()) for row, block in blocks_of(t)] == [
        (0, t[:5].tolist()),
        (4, t[4:9].tolist()),
        (8, t[8:].tolist()),
    ]
    assert median_step(t) == np.median(np.diff(t))  # sorted in a file, as of a long log


def test_no_file_is_left_and_none_is_open(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    before = len(os.listdir("/proc/self/fd"))
    stamps = map_stamps([np.arange(1e6)], "log")
    assert stamps[-1] == 1e6 - 1
    assert not stamps.flags.writeable
    assert median_step(stamps) == 1.0
    assert list(tmp_path.iterdir()) == []
    del stamps
    assert len(os.listdir("/proc/self/fd")) <= before
    with pytest.raises(DataError):
        map_stamps([np.array([1.0, 0.0])], "log")
    assert list(tmp_path.iterdir()) == []
