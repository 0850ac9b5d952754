"""Log files are read whole and right, or refused by name."""

import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from robotid.base.exceptions import DataError, MissingDependencyError, SettingsError
from robotid.data.base_motion import BaseColumns
from robotid.data.files import csv_files
from robotid.data.files.read import lay_out, read_log, write_log
from robotid.data.files.table import Place
from robotid.data.log import Log
from robotid.data.signal_settings import LogSource, LogUnits

JOINTS = ("shoulder", "elbow")
FOLDERS = (os.environ.get("ROBOTID_DATA"), Path(__file__).resolve().parents[4] / "shared" / "data")
BOTH = pytest.mark.parametrize("suffix", [".csv", ".parquet"])


CURE = (
    ". A payload of known mass determines unknown gains: robotid payload URDF LOADED --reference "
    "BARE --mass KG --gains"
)


def refused(text, kind=DataError):
    return pytest.raises(kind, match="^" + re.escape(text) + "$")


def make_log(**changes):
    t = np.arange(300) / 100
    phase = t[:, None] * [2.0, 3.0]
    fields = {
        "t": t,
        "q": np.sin(phase),
        "v": np.cos(phase) * [2.0, 3.0],
        "a": -np.sin(phase) * [4.0, 9.0],
        "tau": 10 * np.cos(phase),
        "joints": JOINTS,
    }
    return Log(**(fields | changes))


def make_table(**changes):
    """The columns of a small log by standard name; None takes one out."""
    log = make_log()
    table = {"time": log.t}
    for kind, values in (("q", log.q), ("tau", log.tau)):
        table |= {f"{kind}_{joint}": values[:, j] for j, joint in enumerate(JOINTS)}
    return {name: values for name, values in (table | changes).items() if values is not None}


def save(path, table, separator=","):
    if path.suffix == ".parquet":
        pq.write_table(pa.table(table), path)
        return path
    rows = zip(*(np.asarray(values).tolist() for values in table.values()), strict=True)
    lines = [separator.join(table), *(separator.join(map(str, row)) for row in rows)]
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.fixture(params=[".csv", ".parquet"])
def run(request, tmp_path):
    """A function that writes a table to run.csv or run.parquet."""
    return lambda table: save(tmp_path / f"run{request.param}", table)


@pytest.fixture
def text(tmp_path):
    """A function that writes text to run.csv."""

    def write(content):
        path = tmp_path / "run.csv"
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return path

    return write


# --- the columns ----------------------------------------------------------------------------------


def test_standard_columns_are_read(run):
    path = run(make_table())
    log = read_log(path, JOINTS)
    truth = make_log()
    for name in ("t", "q", "tau"):
        np.testing.assert_array_equal(getattr(log, name), getattr(truth, name))
    assert (log.v, log.a, log.notes) == (None, None, ())
    assert (log.joints, log.path) == (JOINTS, str(path))


def test_columns_come_in_the_order_of_the_joints_not_of_the_file(run):
    table = dict(reversed(make_table().items()))
    log = read_log(run(table), ("elbow", "shoulder"))
    np.testing.assert_array_equal(log.q, make_log().q[:, ::-1])
    np.testing.assert_array_equal(log.tau, make_log().tau[:, ::-1])


@pytest.mark.parametrize(
    ("q", "dq", "ddq", "tau"),
    [
        ("q_", "dq_", "ddq_", "tau_"),
        ("position_", "velocity_", "acceleration_", "effort_"),
        ("q_", "qd_", "qdd_", "torque_"),
    ],
)
@pytest.mark.parametrize("clock", ["time", "t"])
def test_aliases_are_read(run, q, dq, ddq, tau, clock):
    truth = make_log()
    table = {clock: truth.t}
    for prefix, values in ((q, truth.q), (dq, truth.v), (ddq, truth.a), (tau, truth.tau)):
        table |= {prefix + joint: values[:, j] for j, joint in enumerate(JOINTS)}
    log = read_log(run(table), JOINTS)
    for name in ("t", "q", "v", "a", "tau"):
        np.testing.assert_array_equal(getattr(log, name), getattr(truth, name))


def test_two_names_of_one_quantity_are_refused(run):
    path = run(make_table(position_elbow=np.zeros(300)))
    with refused(
        f"{path.name} has 'q_elbow' and 'position_elbow', two names of the same quantity; remove "
        'one, or state in the job file columns = { q_elbow = "q_elbow" }'
    ):
        read_log(path, JOINTS)
    log = read_log(path, JOINTS, columns={"q_elbow": "position_elbow"})
    np.testing.assert_array_equal(log.q[:, 1], 0.0)
    assert log.notes == ("columns ignored: q_elbow",)
    path = run(make_table(t=np.arange(300)))
    with pytest.raises(DataError, match="has 'time' and 't', two names of the same quantity"):
        read_log(path, JOINTS)


def test_missing_column_is_named_with_those_of_its_kind(run):
    path = run(make_table(tau_elbow=None))
    with refused(
        f"{path.name} has no column 'tau_elbow'; torque or current columns found: tau_shoulder. "
        'If elbow, which moves in the log, has no drive, state passive = ["elbow"] in the job '
        "file; else record its torque"
    ):
        read_log(path, JOINTS)
    path = run({k: v for k, v in make_table().items() if not k.startswith("q_")})
    with refused(
        f"{path.name} has no columns 'q_shoulder', 'q_elbow'; position columns found: none. Record "
        "the position of each joint"
    ):
        read_log(path, JOINTS)


def test_misspelt_column_is_suggested(run):
    path = run(make_table(q_elbow=None, q_elbow2=np.zeros(300)))
    with pytest.raises(DataError, match=r'\nq_elbow = "q_elbow2"  # by order$'):
        read_log(path, JOINTS)
    log = read_log(path, JOINTS, columns={"q_elbow": "q_elbow2"})
    np.testing.assert_array_equal(log.q[:, 1], 0.0)


def test_the_column_of_another_joint_is_not_suggested(run):
    zeros = np.zeros(3)
    path = run({"time": np.arange(3), "q_joint_1": zeros, "q_joint_2": zeros, "tau_joint_1": zeros})
    with refused(
        f"{path.name} has no column 'tau_joint_2'; torque or current columns found: "
        "tau_joint_1. If joint_2 was at rest, lock it at its position, "
        "as --lock joint_2=0, or locked = { joint_2 = 0 } in the job file"
    ):
        read_log(path, ["joint_1", "joint_2"])


def test_missing_time_lists_all_columns(run):
    path = run(make_table(time=None, Clock=np.arange(300.0)))
    with refused(
        f"{path.name} has no column 'time'; columns found: q_shoulder, q_elbow, "
        "tau_shoulder, tau_elbow, Clock. Rename it, or state in the job file: columns = { time = "
        '"NAME" }, or without time stamps the rate of the rows [Hz]: log = { rate = 100 }'
    ):
        read_log(path, JOINTS)


def test_columns_must_name_what_is_read(run):
    path = run(make_table())
    with pytest.raises(SettingsError) as caught:
        read_log(path, JOINTS, columns={"tau_elbw": "tau_elbow"})
    assert str(caught.value) == (
        "columns: 'tau_elbw' is not a standard name of a column, as 'time' or "
        "'tau_shoulder'. Did you mean 'tau_elbow'?"
    )
    with pytest.raises(DataError) as caught:
        read_log(path, JOINTS, columns={"tau_elbow": "tau_elbo"})
    assert str(caught.value).startswith(
        f"{path.name} has no column 'tau_elbo', which is stated for 'tau_elbow' in columns; columns"
    )
    assert str(caught.value).endswith("Did you mean 'tau_elbow'?")


def test_columns_may_swap_but_not_share(run):
    path = run(make_table())
    log = read_log(path, JOINTS, columns={"q_elbow": "q_shoulder", "q_shoulder": "q_elbow"})
    np.testing.assert_array_equal(log.q, make_log().q[:, ::-1])
    with refused(
        f"{path.name}: tau_elbow are read twice; correct columns in the job file",
        SettingsError,
    ):
        read_log(path, JOINTS, columns={"tau_shoulder": "tau_elbow", "tau_elbow": "tau_elbow"})


def test_a_column_given_to_one_quantity_is_no_alias_of_another(run):
    path = run(make_table(q_shoulder=None, position_elbow=np.zeros(300)))
    log = read_log(path, JOINTS, columns={"q_shoulder": "position_elbow"})
    np.testing.assert_array_equal(log.q[:, 0], 0.0)
    np.testing.assert_array_equal(log.q[:, 1], make_log().q[:, 1])


def test_extra_columns_are_named_once(run):
    table = make_table(tau_wrist=np.zeros(300), voltage=np.zeros(300))
    log = read_log(run(table), JOINTS)
    assert log.notes == ("columns ignored: tau_wrist, voltage",)


def test_velocity_of_some_joints_only_is_noted(run):
    table = make_table(dq_elbow=make_log().v[:, 1], qdd_shoulder=make_log().a[:, 0])
    log = read_log(run(table), JOINTS)
    assert (log.v, log.a) == (None, None)
    assert log.notes == (
        "dq_elbow ignored: shoulder have no velocity",
        "qdd_shoulder ignored: elbow have no acceleration",
    )
    assert read_log(run(table), ["elbow"]).v.shape == (300, 1)


@pytest.mark.parametrize("joints", [(), "elbow", ("elbow", 3), 5])
def test_joints_must_be_a_list_of_names(run, joints):
    shown = "5, a int" if joints == 5 else repr(joints)
    with refused(f"joints is {shown}, wanted a list of at least one name", SettingsError):
        read_log(run(make_table()), joints)


def test_a_joint_named_twice_is_refused(run):
    with pytest.raises(
        SettingsError, match=r"joints has elbow more than once; name each joint once"
    ):
        read_log(run(make_table()), ["elbow", "elbow"])


# --- torque from current --------------------------------------------------------------------------


@pytest.mark.parametrize("prefix", ["current_", "i_"])
def test_current_times_gain_is_torque(run, prefix):
    path = run(make_table(tau_elbow=None, **{prefix + "elbow": np.full(300, 2.0)}))
    log = read_log(path, JOINTS, gains={"elbow": -8.7})
    np.testing.assert_array_equal(log.tau[:, 1], -17.4)
    np.testing.assert_array_equal(log.tau[:, 0], make_log().tau[:, 0])
    assert log.notes == ()


def test_current_without_gain_is_refused(run):
    path = run(make_table(tau_elbow=None, i_elbow=np.ones(300)))
    with refused(
        f"{path.name}: joint 'elbow' has the current 'i_elbow' but no gain; state it in N m/A: "
        "--gain elbow=..., or in the job file [torque] gains = { elbow = ... }" + CURE
    ):
        read_log(path, JOINTS)


def test_joints_without_gain_and_those_without_torque_are_all_named_at_once(run):
    one = np.arange(3.0)
    names = ["q_a", "q_b", "q_finger", "i_a", "i_b", "q_c", "tau_c"]
    path = run({"time": one, **dict.fromkeys(names, one)})
    with refused(
        f"{path.name}: joints a, b have currents but no gain; state it in N m/A: "
        "--gain a=... --gain b=..., or in the job file [torque] gains = { a = ..., b = ... }. "
        "No torque of finger was found; if at rest, lock them at their positions, as "
        "with --lock finger=0" + CURE
    ):
        read_log(path, ("a", "b", "c", "finger"))


def test_gain_decides_between_current_and_torque(run):
    path = run(make_table(current_elbow=np.full(300, 2.0)))
    log = read_log(path, JOINTS, gains={"elbow": 10.0})
    np.testing.assert_array_equal(log.tau[:, 1], 20.0)
    assert log.notes == ("tau_elbow ignored: current_elbow is read (a gain)",)
    log = read_log(path, JOINTS)
    np.testing.assert_array_equal(log.tau, make_log().tau)
    assert log.notes == ("current_elbow ignored: tau_elbow is read (no gain)",)


def test_gain_without_current_is_noted(run):
    log = read_log(run(make_table()), JOINTS, gains={"elbow": 10.0})
    np.testing.assert_array_equal(log.tau, make_log().tau)
    assert log.notes == ("the gain of 'elbow' is not used: tau_elbow is a torque",)


def test_gain_of_a_joint_that_is_not_read_is_refused(run):
    path = run(make_table())
    with refused(
        f"{path.name}: a gain is given for 'elbo', which is not among the joints read: "
        "shoulder, elbow. Did you mean 'elbow'?",
        SettingsError,
    ):
        read_log(path, JOINTS, gains={"elbo": 10.0})


@pytest.mark.parametrize("gain", [0.0, np.nan, np.inf])
def test_gain_must_be_a_number(run, gain):
    with refused(f"gain of 'elbow' is {gain}, wanted a number other than 0", SettingsError):
        read_log(run(make_table()), JOINTS, gains={"elbow": gain})


# --- units and window -----------------------------------------------------------------------------


def test_stated_units_become_si(run):
    truth = make_log()
    degrees = {
        "time": truth.t * 1e3,
        "q_shoulder": np.degrees(truth.q[:, 0]),
        "q_elbow": truth.q[:, 1],  # [m]
        "dq_shoulder": np.degrees(truth.v[:, 0]),
        "dq_elbow": truth.v[:, 1],
        "ddq_shoulder": np.degrees(truth.a[:, 0]),
        "ddq_elbow": truth.a[:, 1],
    }
    path = run(make_table(**degrees))
    with pytest.raises(DataError, match="looks like milliseconds"):
        read_log(path, JOINTS)
    with pytest.raises(DataError, match="looks like degrees"):
        read_log(path, JOINTS, units=LogUnits(time="ms"))
    log = read_log(
        path, JOINTS, units=LogUnits("ms", "deg"), prismatic=["elbow", "torso"], start=1, end=2
    )
    np.testing.assert_allclose(log.t, truth.t[100:201], rtol=1e-15)
    for name in ("q", "v", "a"):
        np.testing.assert_allclose(getattr(log, name), getattr(truth, name)[100:201], rtol=1e-14)
        np.testing.assert_array_equal(getattr(log, name)[:, 1], getattr(truth, name)[100:201, 1])


@pytest.mark.parametrize(("name", "value", "message"), [
    ("time", 2.02, r"t\[203\] = 2\.020 s is a duplicate time stamp, the same as t\[202\]"),
    ("time", 2.01, r"t\[203\] = 2\.010 s follows t\[202\] = 2\.020 s"),
    ("q_elbow", np.nan, "q_elbow is NaN at row 203"),
])  # fmt: skip
def test_rows_of_a_part_are_named_by_their_number_in_the_file(name, value, message):
    layout, _ = lay_out(pd.DataFrame(make_table()), JOINTS)
    part = {key: values[200:210].copy() for key, values in make_table().items()}
    part[name][3] = value
    with pytest.raises(DataError, match=message):
        layout.to_log(part, 200)


def test_percentages_become_positions_between_their_ends(run):
    truth = make_log()
    share = (truth.q[:, 1] + 0.5) / 2.5  # from -0.5 to 2 rad
    table = {"q_elbow": 100 * share, "dq_elbow": truth.v[:, 1] / 0.025}
    units = LogUnits(angle="deg", percent={"elbow": [-0.5, 2.0], "another": [0, 1]})
    table |= {"q_shoulder": np.degrees(truth.q[:, 0]), "dq_shoulder": np.degrees(truth.v[:, 0])}
    log = read_log(run(make_table(**table)), JOINTS[:2], units=units)
    np.testing.assert_allclose(log.q, truth.q[:, :2], atol=1e-12)
    np.testing.assert_allclose(log.v, truth.v[:, :2], atol=1e-12)


def test_commands_in_percent_have_the_ends_of_positions(run):
    truth, ends = make_log(), {"shoulder": (-2.0, 3.0), "elbow": (-0.5, 2.0)}
    table, sent = {}, truth.q[::-1, :2]  # other values than those of the positions
    for j, (joint, (low, high)) in enumerate(ends.items()):
        for kind, x in (("q", truth.q[:, j]), ("qref", sent[:, j])):
            table[f"{kind}_{joint}"] = 100 * (x - low) / (high - low)
        for kind, x in (("dq", truth.v[:, j]), ("dqref", truth.v[::-1, j])):
            table[f"{kind}_{joint}"] = 100 * x / (high - low)
    units = LogUnits(percent={joint: list(own) for joint, own in ends.items()})
    log = read_log(run(make_table(**table)), JOINTS[:2], units=units, needs="commands")
    np.testing.assert_allclose(log.q, truth.q[:, :2], atol=1e-12)
    np.testing.assert_allclose(log.q_ref, sent, atol=1e-12)
    np.testing.assert_allclose(log.v_ref, truth.v[::-1, :2], atol=1e-12)


@pytest.mark.parametrize("ends", [[0.1], [0.3, 0.3], ["a", 1.0], 5.0, [0.0, np.inf]])
def test_a_percentage_needs_two_different_ends(ends):
    with pytest.raises(SettingsError, match=r"percent of jaw is .* wanted two different"):
        LogUnits(percent={"jaw": ends})


def test_joints_that_slide_may_go_far(run):
    path = run(make_table(q_elbow=make_log().q[:, 1] * 20))
    assert np.abs(read_log(path, JOINTS, prismatic=["elbow"]).q).max() > 19
    with pytest.raises(DataError, match="q_elbow reaches 20, which looks like degrees"):
        read_log(path, JOINTS)


def test_window_is_read_alone(run):
    assert len(read_log(run(make_table()), JOINTS, start=1.0).t) == 200
    assert len(read_log(run(make_table()), JOINTS, end=1.0).t) == 101
    with pytest.raises(DataError, match=r"the log spans 0 s to 2\.99 s"):
        read_log(run(make_table()), JOINTS, start=5.0)


# --- values ---------------------------------------------------------------------------------------


def test_nan_is_refused_by_row_and_column(run):
    tau = make_table()["tau_elbow"].copy()
    tau[34] = np.nan
    path = run(make_table(tau_elbow=tau))
    with refused(
        f"{path.name}: tau_elbow is NaN at row 34 (t = 0.34 s); remove the row or correct the "
        "recording"
    ):
        read_log(path, JOINTS)


def test_nan_in_a_column_that_is_not_read_does_not_matter(run):
    log = read_log(run(make_table(tau_wrist=np.full(300, np.nan))), JOINTS)
    assert np.isfinite(log.tau).all()


def test_null_is_refused_as_nan(tmp_path):
    for values in ([1.0, None, 3.0], [1, None, 3]):
        table = {"t": [0.0, 0.1, 0.2], "q_a": [0, 1, 2], "tau_a": values}
        path = save(tmp_path / "run.parquet", table)
        with pytest.raises(DataError, match=r"^run\.parquet: tau_a is NaN at row 1 \(t = 0\.1 s\)"):
            read_log(path, ["a"])


def test_whole_numbers_and_single_precision_are_read(tmp_path):
    table = {"t": pa.array([0, 1, 2], pa.int32()), "q_a": pa.array([0.5, 1, 2], pa.float32())}
    path = save(tmp_path / "run.parquet", table | {"tau_a": pa.array([1, 2, 3], pa.uint8())})
    log = read_log(path, ["a"], units=LogUnits(time="s"))
    np.testing.assert_array_equal(log.q[:, 0], [0.5, 1, 2])
    assert log.t.dtype == log.q.dtype == log.tau.dtype == np.float64


def test_parquet_columns_that_are_no_numbers_are_refused(tmp_path):
    stamps = pa.array([0, 1, 2], pa.timestamp("ns"))
    path = save(tmp_path / "run.parquet", {"time": stamps, "q_a": [0, 1, 2], "tau_a": [0, 1, 2]})
    with refused("run.parquet: time contains timestamp[ns], wanted numbers; convert it"):
        read_log(path, ["a"])


def test_fewer_than_two_rows_are_refused(run):
    path = run({"t": [0.0], "q_a": [0.0], "tau_a": [0.0]})
    with refused(f"{path.name} has 1 rows, wanted at least 2; record longer"):
        read_log(path, ["a"])
    np.savez(path.with_name("none.npz"), time=np.zeros(0), q_a=np.zeros(0), tau_a=np.zeros(0))
    with refused("none.npz has columns but no rows; record at least 2"):
        read_log(path.with_name("none.npz"), ["a"])


# --- CSV text -------------------------------------------------------------------------------------

HEADER = "time,q_a,tau_a\n"
ROWS = "0.0,1.0,2.0\n0.1,1.5,2.5\n"


@pytest.mark.parametrize(
    "content",
    [
        HEADER + ROWS,
        ("\ufeff" + HEADER + ROWS),
        (HEADER + ROWS).replace("\n", "\r\n"),
        (HEADER + ROWS).rstrip("\n"),
        HEADER + ROWS + "\n  \n",
        (HEADER + ROWS).replace(",", ";"),
        (HEADER + ROWS).replace(",", "\t"),
        (HEADER + ROWS).replace(",", " , "),
        "# " + HEADER + ROWS,
        'mode,time,q_a,"tau_a"\n"a, b",0.0,1.0,2.0\n#c,0.1,"1.5",2.5\n',
    ],
)
def test_csv_dialects(text, content):
    log = read_log(text(content), ["a"])
    np.testing.assert_array_equal(log.t, [0.0, 0.1])
    np.testing.assert_array_equal(log.q, [[1.0], [1.5]])
    np.testing.assert_array_equal(log.tau, [[2.0], [2.5]])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "run.csv is empty; its first line must name the columns"),
        ("\n" + HEADER + ROWS, "run.csv is empty; its first line must name the columns"),
        (HEADER, "run.csv has a header but no rows; record at least 2"),
        (HEADER + "\n", "run.csv has a header but no rows; record at least 2"),
        (
            ROWS,
            "run.csv has no header. State the names of its 3 columns in the job file, and the rate "
            'of its rows if none of them is the time. An example:\n[log]\nnames = ["time", "q_1", '
            '"tau_1"]',
        ),
        (
            "time,q_a,q_a,tau_a\n0,1,2,3\n1,1,2,3\n",
            "run.csv has more than one column q_a; rename or remove one",
        ),
        (
            HEADER + ROWS + "0.2,1.",
            "run.csv: line 4 has 2 cells, the header has 3; correct it",
        ),
        (
            HEADER + "0.0,1.0,2.0,9.0\n" + ROWS,
            "run.csv: line 2 has 4 cells, the header has 3; correct it",
        ),
        (
            HEADER + ROWS + "0.2,abc,3.0\n",
            "run.csv: q_a is 'abc' at row 2, wanted a number; remove the row or correct the "
            "recording",
        ),
        (
            HEADER + ROWS + "0.2,1.0,\n",
            "run.csv: tau_a is empty at row 2, wanted a number; remove the row or correct the "
            "recording",
        ),
        (
            "time;q_a;tau_a\n0,0;1,0;2,0\n",
            "run.csv: time is '0,0' at row 0, wanted a number; write decimals with a point; remove "
            "the row or correct the recording",
        ),
    ],
)
def test_csv_that_cannot_be_read_says_why(text, content, message):
    with refused(message):
        read_log(text(content), ["a"])


@pytest.mark.parametrize("content", [(HEADER + ROWS).encode("utf-16"), HEADER.encode() + b"\xe9\n"])
def test_csv_that_is_not_utf8_is_refused(text, content):
    with pytest.raises(DataError, match=r"^run\.csv is not UTF-8 text: .*; save it as UTF-8$"):
        read_log(text(content), ["a"])


# --- files ----------------------------------------------------------------------------------------


def test_other_suffixes_are_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "run.xlsx").touch()
    known = ".csv, .dat, .txt, .parquet, .npz, .h5, .hdf5, .mat"
    for path in (tmp_path / "run.xlsx", "run.xlsx"):
        with refused(
            f"run.xlsx: the suffix is '.xlsx', wanted a log file of type {known}, .mcap, .db3 or "
            ".bag, or the folder of a ROS 2 bag or of a LeRobot dataset; convert it"
        ):
            read_log(path, ["a"])
    written = ".csv, .parquet, .npz, .h5, .hdf5 or .mat"
    for name, suffix in (("run", ""), ("run.mcap", ".mcap")):
        with refused(f"{name}: logs are written as {written} files, not {suffix!r}"):
            write_log(make_log(), tmp_path / name)
    assert [path.name for path in tmp_path.iterdir()] == ["run.xlsx"]


def test_capital_suffix_is_read(tmp_path):
    path = save(tmp_path / "run.csv", make_table()).rename(tmp_path / "RUN.CSV")
    assert len(read_log(path, JOINTS).t) == 300


@BOTH
def test_missing_file_is_named(tmp_path, suffix):
    path = tmp_path / f"run{suffix}"
    with refused(f"there is no log file {str(path)!r}"):
        read_log(path, ["a"])


def test_broken_parquet_is_refused(tmp_path):
    path = tmp_path / "run.parquet"
    path.write_bytes(b"PAR1 not really")
    with pytest.raises(
        DataError, match=r"^run\.parquet: broken Parquet file \(.*\); export it again$"
    ):
        read_log(path, ["a"])


def test_parquet_without_pyarrow_says_how_to_install_it(tmp_path, monkeypatch):
    path = save(tmp_path / "run.parquet", make_table())
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    how = (
        "needs pyarrow, which is not installed: pip install '.[parquet]' in a checkout of robotid, "
        "or pip install 'robotid[parquet]' where an index has it"
    )
    with refused(f"reading Parquet {how}", MissingDependencyError):
        read_log(path, JOINTS)
    with refused(f"writing Parquet {how}", MissingDependencyError):
        write_log(make_log(), tmp_path / "new.parquet")


def test_import_does_not_load_pyarrow():
    code = "import sys, robotid, robotid.data.files.read; sys.exit('pyarrow' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


# --- writing --------------------------------------------------------------------------------------


@BOTH
def test_round_trip_is_exact_to_the_last_bit(tmp_path, suffix):
    rng = np.random.default_rng(0)
    tau = rng.standard_normal((5000, 2)) * 10.0 ** rng.integers(-300, 29, (5000, 2))
    tau[:5, 0] = [-0.0, 5e-324, 9.999999999999999e29, 0.1 + 0.2, 1e22]
    log = Log(
        t=1.7e9 + np.cumsum(rng.uniform(1e-4, 1e-2, 5000)),
        q=rng.standard_normal((5000, 2)),
        v=rng.standard_normal((5000, 2)),
        a=rng.standard_normal((5000, 2)),
        tau=tau,
        joints=("arm, left", 'the "elbow"'),
    )
    write_log(log, tmp_path / f"run{suffix}")
    back = read_log(tmp_path / f"run{suffix}", log.joints)
    for name in ("t", "q", "v", "a", "tau"):
        assert getattr(back, name).tobytes() == getattr(log, name).tobytes()
    assert back.notes == ()


@BOTH
def test_written_columns_have_standard_names(tmp_path, suffix):
    path = tmp_path / f"run{suffix}"
    write_log(make_log(a=None), path)
    names = path.read_text().split("\n")[0].split(",") if suffix == ".csv" else None
    names = names or pq.read_schema(path).names
    assert names == [
        "time", "q_shoulder", "q_elbow", "dq_shoulder", "dq_elbow", "tau_shoulder", "tau_elbow",
    ]  # fmt: skip
    assert read_log(path, JOINTS).a is None


@BOTH
def test_writing_replaces_a_file_at_once_or_not_at_all(tmp_path, suffix, monkeypatch):
    path = tmp_path / f"run{suffix}"
    write_log(make_log(), path)
    before = path.read_bytes()

    def fail(*_):
        raise OSError("disk full")

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", fail)
        with pytest.raises(OSError, match="disk full"):
            write_log(make_log(v=None), path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]
    write_log(make_log(v=None), path)
    assert read_log(path, JOINTS).v is None
    assert list(tmp_path.iterdir()) == [path]


# --- real recordings ------------------------------------------------------------------------------

DATA = next((Path(folder) for folder in FOLDERS if folder and Path(folder).is_dir()), Path("none"))
RECORDINGS = sorted(p for p in DATA.glob("*/*.parquet") if p.stem != "motor_side")
PRISMATIC = ("torso_lift_joint",)
each = pytest.mark.parametrize("path", RECORDINGS or [None], ids=lambda p: p.stem if p else "none")
real = pytest.mark.usefixtures("recordings")  # which skips, or fails in CI, if there are none


def read_real(path):
    names = pq.read_schema(path).names
    joints = [name[2:] for name in names if name.startswith("q_")]
    gains = {joint: 10.0 for joint in joints if f"current_{joint}" in names}
    return read_log(path, joints, gains=gains, prismatic=PRISMATIC)


@real
@each
def test_real_recordings_are_not_refused_and_survive_csv(path, tmp_path):
    log = read_real(path)
    log = log.window(log.t[0], log.t[0] + 5.0)
    write_log(log, tmp_path / "run.csv")
    back = read_log(tmp_path / "run.csv", log.joints, prismatic=PRISMATIC)
    for name in ("t", "q", "tau"):
        np.testing.assert_array_equal(getattr(back, name), getattr(log, name))


@real
@each
def test_real_recordings_in_other_units_are_refused(path, tmp_path):
    log = read_real(path)

    def reread(**changes):
        write_log(replace(log, **changes), tmp_path / "run.parquet")
        return read_log(tmp_path / "run.parquet", log.joints, prismatic=PRISMATIC)

    turns = np.array([joint not in PRISMATIC for joint in log.joints])
    degrees = np.where(turns, 180 / np.pi, 1.0)
    with pytest.raises(DataError, match=r"(looks like degrees|the time looks like|milliseconds)"):
        reread(t=log.t * 1e3)
    with pytest.raises(DataError, match="looks like degrees"):
        reread(q=log.q * degrees, v=None if log.v is None else log.v * degrees)
    if log.v is not None:
        with pytest.raises(DataError, match="the velocity looks like degrees"):
            reread(v=log.v * degrees)
        with pytest.raises(DataError, match="opposite sign"):
            reread(v=-log.v)


def test_columns_of_another_rate_are_named_with_their_share():
    t = np.arange(40) / 100
    held = np.where(np.arange(40) % 4, np.nan, t)
    wanted = BaseColumns(True, wrenches=("fz f", "mx f"))
    pose = {f"base_{x}": 0.0 * t for x in ("x", "y", "z", "qx", "qy", "qz")} | {"base_qw": t**0}
    table = {"time": t, "q_a": t, "wrench_fz_f": held, "wrench_mx_f": t} | pose
    words = r"75% of the rows have no value of {}, as of another rate .*; interpolate at the time"
    with pytest.raises(DataError, match=words.format("wrench_fz_f")):
        read_log(pd.DataFrame(table), ["a"], base=wanted)
    with pytest.raises(DataError, match=words.format("base_x")):
        read_log(pd.DataFrame(table | {"base_x": held, "wrench_fz_f": t}), ["a"], base=wanted)
    whole = read_log(pd.DataFrame(table | {"wrench_fz_f": t}), ["a"], base=wanted)
    np.testing.assert_array_equal(whole.wrenches["fz f"], t)


def test_faults_of_a_base_and_of_cells_of_a_foot_are_named(tmp_path):
    t = 2.0 + np.arange(90) / 100
    wanted = BaseColumns(True, wrenches=("fz f",))
    ends = ("x", "y", "z", "roll", "pitch", "yaw")
    table = {"time": t, "q_a": t, "wrench_fz_f": t} | {f"base_{x}": 0.1 * t for x in ends}

    def refused(words, **changes):
        frame = {x: y for x, y in (table | changes).items() if y is not None}
        with pytest.raises(DataError, match=words):
            read_log(pd.DataFrame(frame), ["a"], base=wanted)

    read_log(pd.DataFrame(table | {"base_yaw": 30.0 * t}), ["a"], base=wanted)  # full turns
    lost = np.where(np.arange(90) == 7, np.nan, t)
    refused(r"log: base_z is NaN at row 7 \(t = 2.07 s\); remove the row", base_z=lost)
    refused(r"log: wrench_fz_f is NaN at row 7", wrench_fz_f=lost)
    refused(r"base_roll and base_pitch are up to 20, wanted at most pi", base_pitch=t[-1] - t - 20)
    cells = {"wrench_fz_f": None, "wrench_fz_f_0": t, "wrench_fz_f_1": t}
    refused(r"If wrench_fz_f_0, wrench_fz_f_1 are cells of a foot, add a column of their", **cells)
    table["wrench_fz_f"] = [[x, x] for x in t]
    pd.DataFrame(table).to_parquet(tmp_path / "run.parquet")
    with pytest.raises(DataError, match="wanted numbers; write one column per value, or their sum"):
        read_log(tmp_path / "run.parquet", ["a"], base=wanted)


def test_an_empty_cell_of_another_device_names_the_rate(tmp_path):
    (tmp_path / "run.csv").write_text("time,q_a,wrench_fz_f\n0,1,2\n0.1,1,\n0.2,1,3\n")
    with pytest.raises(DataError, match=r"wrench_fz_f is empty at row 1.*column of another rate"):
        read_log(tmp_path / "run.csv", ["a"], base=BaseColumns(wrenches=("fz f",)))


def test_rows_of_a_csv_file_are_read_from_any_place_before_them(tmp_path, monkeypatch):
    """Blocks of three lines, some of them blank; the first row is line 2."""
    monkeypatch.setattr(csv_files, "_BLOCK", 3)
    lines = ["time,q", "0,10", "", "1,11", "2,12", "3,13", "", "", "4,14", "5,15", "6,16", "7,17"]
    (tmp_path / "run.csv").write_text("\n".join(lines) + "\n")
    rows = csv_files.CSV.open(tmp_path / "run.csv", LogSource()).rows
    blocks = list(rows.scan("q"))
    assert [values.tolist() for values, _ in blocks] == [[10, 11], [12, 13], [14, 15], [16, 17]]
    places = [place for _, place in blocks]
    assert [(place.row, place.line) for place in places] == [(0, 2), (2, 5), (4, 8), (6, 11)]
    for near in (Place(), *places):
        for first in range(near.row, 8):
            for stop in range(first + 1, 9):
                found = rows.read(["q", "time"], first, stop, near)
                assert found["time"].tolist() == list(range(first, stop))
                assert found["q"].tolist() == [10 + k for k in range(first, stop)]
    (tmp_path / "run.csv").write_text("\n".join([*lines, "8,18,0"]) + "\n")
    with pytest.raises(DataError, match="line 13 has 3 cells"):
        rows.read(["q"], 6, 9, places[-1])
