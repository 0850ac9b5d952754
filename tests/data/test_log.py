"""Log and Trajectory keep their arrays and refuse others; time stamps of logs of any length."""

import os
import re
import tempfile
from dataclasses import FrozenInstanceError, replace
from pathlib import Path

import numpy as np
import pytest
from helpers.synthetic import sine_log

from robotid.base.exceptions import DataError
from robotid.data import log as log_module
from robotid.data.log import Log, Trajectory, blocks_of, map_stamps, median_step

T = 1000.0 + np.arange(500) / 100  # 5 s at 100 Hz
PHASE = T[:, None] * [2.0, 3.0]


def make_log(**changes):
    a = -np.sin(PHASE) * [4.0, 9.0]
    return sine_log(500, 100, **({"a": a, "path": "somewhere/run3.csv"} | changes))


def make_trajectory(**changes):
    log = make_log()
    fields = {name: getattr(log, name) for name in ("t", "q", "v", "a", "tau", "joints")}
    fields |= {"rate": 100.0, "segment": np.repeat([0, 1], 250)}
    return Trajectory(**(fields | changes))


def spoil(array, at, value):
    array = array.copy()
    array[at] = value
    return array


def test_arrays_cannot_be_changed():
    q = np.zeros((500, 2))
    log, motion = make_log(q=q), make_trajectory()
    q[0, 0] = 7.0
    assert log.q[0, 0] == 0.0
    arrays = [getattr(x, name) for x in (log, motion) for name in ("t", "q", "v", "a", "tau")]
    for array in (*arrays, motion.segment):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1
    with pytest.raises(FrozenInstanceError):
        log.path = "other.csv"
    assert np.shares_memory(replace(log, path=Path("b.csv")).q, log.q)
    some = Log(t=[0, 1, 2], q=[[0], [1], [2]], tau=[[3], [4], [5]], joints=["elbow"])
    assert (some.q.dtype, some.joints, some.v, some.notes) == (np.float64, ("elbow",), None, ())


ONE = np.ones(500, bool)
LOG = make_log()
#: Faults of a log, and fragments of the error.
FAULTS = [
    (dict(t=spoil(T, 406, T[404])), "run3.csv: t must increase, but t[406] = 1004.040 s follows "
     "t[405] = 1004.050 s; sort the rows, or correct the recording"),
    (dict(t=spoil(T, 406, T[405])), "t[406] = 1004.050 s is a duplicate time stamp, the same as "
     "t[405]; keep one row of each stamp"),
    (dict(t=spoil(T, 1, T[0] - 1e-7)), "t[1] = 999.9999999 s follows t[0] = 1000.000 s"),
    (dict(t=spoil(T, 17, np.nan)), "run3.csv: time is NaN at row 17; remove such rows or correct"),
    (dict(t=T[:, None]), "run3.csv: t has shape (500, 1), expected (N,)"),
    *[({name: spoil(getattr(LOG, name), (34, 1), value)},
       f"run3.csv: {column}_elbow is {word} at row 34 (t = 1000.34 s); remove such rows or correct")
      for name, column in (("q", "q"), ("v", "dq"), ("a", "ddq"), ("tau", "tau"))
      for value, word in ((np.nan, "NaN"), (-np.inf, "-inf"))],
    (dict(q_ref=spoil(LOG.q, (7, 1), np.nan)), "qref_elbow is NaN at row 7"),
    (dict(q_ref=LOG.q[:, :1]), "qref has shape (500, 1), expected (500, 2)"),
    (dict(tau=np.zeros((500, 3))), "run3.csv: tau has shape (500, 3), expected (500, 2): a row for "
     "each time stamp, a column for each of the joints shoulder, elbow"),
    (dict(contacts={"mx": ONE, "fz": np.ones((500, 2), bool)}), "'fz' of contacts has shape (500, "
     "2), expected (500,)"),
    (dict(wrenches={"mx": ONE, "fz": np.zeros(499)}), "'fz' of wrenches has shape (499,)"),
    (dict(t=T[:1], **{x: getattr(LOG, x)[:1] for x in ("q", "v", "a", "tau")}), "run3.csv has 1 "
     "rows, expected at least 2; record longer"),
    (dict(joints=("elbow", "elbow")), "joints contains elbow twice; name each joint once"),
    (dict(gain_factors=[[1.0, 2.0], [0.0, 1.0]]), "gain_factors is [[1.0, 2.0], [0.0, 1.0]], exp"),
    (dict(joints="ab"), "joints is 'ab', expected at least one name in a tuple"),
    (dict(joints=()), "joints is (), expected at least one name in a tuple"),
    (dict(has_torque=False), "has_torque is False, but tau is not 0; leave has_torque out, or"),
    (dict(has_torque=False, tau=spoil(np.zeros((500, 2)), (3, 1), 1.0)), "but tau is not 0"),
]  # fmt: skip


@pytest.mark.parametrize(("changes", "fragment"), FAULTS)
def test_faults_of_a_log_are_named(changes, fragment):
    with pytest.raises(DataError, match=re.escape(fragment)):
        make_log(**changes)


@pytest.mark.parametrize(
    ("changes", "fragment"),
    [
        *[({name: np.zeros((500, 1))}, f"trajectory: {name} has shape (500, 1), expected")
          for name in ("q", "v", "a", "tau")],
        *[({name: spoil(LOG.q, (3, 0), np.nan)}, f"trajectory: {name}_shoulder is NaN at row 3")
          for name in ("q", "v", "a", "tau")],
        ({"segment": np.zeros(500)}, "segment is float64 of shape (500,), expected integers of"),
        ({"segment": np.zeros(499, int)}, "segment is int64 of shape (499,), expected integers of"),
        *[({"rate": rate}, f"trajectory: rate is {rate}, expected more than 0 or None")
          for rate in (0.0, -1.0, np.inf, np.nan)],
        ({"direction": np.zeros(500)}, "trajectory: direction has shape (500,), expected (500, c)"),
        ({"direction": np.zeros((499, 6))}, "trajectory: direction has shape (499, 6), expected"),
        ({"direction": np.full((500, 6), np.nan)}, "trajectory: direction 0 is NaN at row 0"),
    ],
)  # fmt: skip
def test_faults_of_a_trajectory_are_named(changes, fragment):
    with pytest.raises(DataError, match=re.escape(fragment)):
        make_trajectory(**changes)


def test_window_includes_both_ends_on_the_logs_own_clock():
    log = make_log(notes=("kept",))
    cut = log.window(1001.0, 1002.0)
    assert (cut.t[0], cut.t[-1], len(cut.t)) == (1001.0, 1002.0, 101)
    assert (cut.path, cut.notes, cut.joints) == (log.path, log.notes, log.joints)
    assert len(log.window(start=1004.0).t) == 100
    assert len(log.window(end=1000.5).t) == 51
    assert len(log.window().t) == 500
    for start, end, rows in ((1020.0, 1030.0, 0), (1003.0, 1002.0, 0), (1001.0, 1001.001, 1)):
        with pytest.raises(DataError, match=rf"{rows} rows lie .*; the log spans 1000 s to"):
            log.window(start, end)
    with pytest.raises(DataError, match=r"joint 'elbow2' is not in run3.csv; joints: .* Did you"):
        log.select(["elbow2"])


def test_windows_selections_and_signs_are_of_all_signals(rng):
    t, arrays = 3.0 + np.arange(6) / 10, rng.standard_normal((7, 6, 3))
    names = ("q", "tau", "v", "a", "q_ref", "v_ref", "tau_ref")
    log = Log(
        t, **dict(zip(names, arrays, strict=True)), joints=("a", "b", "c"),
        contacts={"foot": t > 3.25, "hand": t < 3.15}, wrenches={"fz foot": t**2},
        gain_factors=[[1.0, 2.0, 3.0], [1.0, 1.0, 0.5]],
    )  # fmt: skip
    part, some = log.window(3.1, 3.4), log.select(["c", "a"])
    turned = log.turned(np.array([1.0, -1.0, -1.0]))
    for name, values in zip(names, arrays, strict=True):
        np.testing.assert_array_equal(getattr(part, name), values[1:5])
        np.testing.assert_array_equal(getattr(some, name), values[:, [2, 0]])
        np.testing.assert_array_equal(getattr(turned, name), values * [1.0, -1.0, -1.0])
    assert part.contacts["foot"].tolist() == [False, False, True, True]
    assert part.contacts["hand"].tolist() == [True, False, False, False]
    np.testing.assert_array_equal(part.wrenches["fz foot"], t[1:5] ** 2)
    assert some.joints == ("c", "a")
    assert some.gain_factors.tolist() == [[3.0, 1.0], [0.5, 1.0]]
    assert part.gain_factors.tolist() == [[1.0, 2.0, 3.0], [1.0, 1.0, 0.5]]


def test_some_samples_of_a_trajectory_cannot_be_changed_either_and_keep_nothing_of_the_whole():
    memory, direction = np.arange(1000.0).reshape(500, 2), np.ones((500, 3))
    whole = make_trajectory(memory=memory, direction=direction)
    whole.derived["inertial rows"] = "of all"
    rows = {"part": slice(7, 20), "every": slice(None, None, 9), "at": np.array([3, 400])}
    for some, own in zip(
        [whole.at(slice(7, 20)), whole.every(9), whole.at(rows["at"])], rows.values(), strict=True
    ):
        assert some.derived == {}
        for name in ("t", "q", "v", "a", "tau", "segment", "direction", "memory"):
            found = getattr(some, name)
            np.testing.assert_array_equal(found, getattr(whole, name)[own])
            with pytest.raises(ValueError, match="read-only"):
                found[0] = 1
    assert (whole.at(slice(7, 20)).rate, whole.every(9).rate) == (100.0, None)
    other = whole.with_states(None)
    assert (other.memory, other.derived, whole.memory is memory) == (None, whole.derived, True)


def test_squares_of_a_trajectory_are_of_torque_speed_and_acceleration_in_this_order(rng):
    q, v, a, tau = rng.standard_normal((4, 9, 2)) * [[[1.0]], [[2.0]], [[3.0]], [[5.0]]]
    t, segment = 4.0 + np.arange(9) / 50, np.repeat([0, 1], [4, 5])
    motion = Trajectory(t=t, q=q, v=v, a=a, tau=tau, joints=("a", "b"), rate=50.0, segment=segment)
    np.testing.assert_allclose(motion.squares, [(x**2).sum(axis=0) for x in (tau, v, a)])
    thin = motion.every(2)
    np.testing.assert_allclose(thin.squares, [(x[::2] ** 2).sum(axis=0) for x in (tau, v, a)])
    assert (thin.rate, motion.every(1)) == (None, motion)


@pytest.mark.parametrize("scale", [1e-300, 1e-12])
def test_time_stamps_of_no_clock_are_refused(scale):
    t = scale * np.arange(5) / 100
    with pytest.raises(DataError, match=r"5 rows lie within .* expected at least 1e-12") as caught:
        Log(t=t, q=np.zeros((5, 1)), tau=np.zeros((5, 1)), joints=("a",))
    said = str(caught.value)
    assert f"within {scale / 25:.3g} s, so the mean time step is {scale / 100:.3g} s" in said
    assert caught.value.code == "time_unit"


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
    monkeypatch.setattr(log_module, "_BLOCK", 4)
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
