"""Logs as robots write them: each format written by its own library; faulty files in one table."""

import os
import re
import sys
import tracemalloc
import zipfile
from dataclasses import replace

import h5py
import mujoco
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import scipy.io
from helpers.recorders import (
    StoragePlugin,
    assert_same,
    messages_of,
    refused,
    wide,
    write_mat5,
    write_mat73,
    write_mcap,
    write_states,
)
from helpers.synthetic import sine_log

from robotid.base.exceptions import DataError, MissingDependencyError
from robotid.cli.convert import convert
from robotid.data.base_motion import BaseColumns, base_state
from robotid.data.files import csv_files, parquet_files
from robotid.data.files.parquet_files import read_text_table, write_rows
from robotid.data.files.read import lay_out, open_table, read_log, write_columns, write_log
from robotid.data.files.table import Place, Table, with_even_stamps
from robotid.data.log import Log
from robotid.data.signal_settings import LogSource, LogUnits

JOINTS = ("shoulder", "elbow")
HOW = "(job file table [log], CLI --topic)"
WRITTEN = [".csv", ".parquet", ".npz", ".h5", ".hdf5", ".mat"]


def npz_columns(path, log):
    columns = {f"q_{j}": x for j, x in zip(log.joints, log.q.T, strict=True)}
    columns |= {f"velocity_{j}": x for j, x in zip(log.joints, log.v.T, strict=True)}
    columns |= {f"torque_{j}": x for j, x in zip(log.joints, log.tau.T, strict=True)}
    np.savez_compressed(path, t=log.t, **columns)
    return path


def npz(path, log):
    np.savez(path, **wide(log))
    return path


def hdf5(path, log):
    with h5py.File(path, "w") as file:
        group = file.create_group("robot/arm")
        for name, values in wide(log, object).items():
            group[name] = values
    return path


def across(path, log):
    return write_mat5(path, {k: x.T if x.ndim == 2 else x for k, x in wide(log, object).items()})


def topics(log):
    return {"/joint_states": messages_of(log)}


def bag(path, log, **how):
    return write_states(path.parent / "bag", topics(log), others=["/chatter"], **how)


FORMATS = {
    "mcap": (".mcap", lambda path, log: write_mcap(path, messages_of(log))),
    "mcap folder": (".", lambda path, log: bag(path, log, plugin=StoragePlugin.MCAP)),
    "ros2 folder": (".", bag), "db3": (".", lambda path, log: next(bag(path, log).glob("*.db3"))),
    "ros1": (".bag", lambda path, log: write_states(path, topics(log))), "npz": (".npz", npz),
    "npz columns": (".npz", npz_columns), "hdf5": (".h5", hdf5),
    "mat struct": (".mat", lambda path, log: write_mat5(path, {"log": wide(log), "comment": "x"})),
    "mat joints by samples": (".mat", across),
    "mat 7.3": (".mat", lambda path, log: write_mat73(path, wide(log, object))),
    "mat 7.3 struct": (".mat", lambda path, log: write_mat73(path, {"log": wide(log, object)})),
}  # fmt: skip


def recorded(name, folder, log):
    suffix, write = FORMATS[name]
    return write(folder / f"run{suffix}", log)


@pytest.mark.parametrize("name", FORMATS)
def test_what_a_library_wrote_is_read_unchanged(tmp_path, name):
    log = sine_log()
    path = recorded(name, tmp_path, log)
    back = read_log(path, JOINTS)
    assert_same(back, log)
    assert (back.joints, back.path, back.notes) == (JOINTS, str(path), ())
    assert_same(read_log(path, JOINTS[::-1]), log.select(JOINTS[::-1]))


@pytest.mark.parametrize("suffix", WRITTEN)
@pytest.mark.parametrize("has_torque", [True, False])
def test_written_logs_are_read_back_to_the_last_bit(tmp_path, rng, suffix, has_torque):
    tau = rng.standard_normal((5000, 2)) * 10.0 ** rng.integers(-300, 29, (5000, 2))
    tau[:5, 0] = [-0.0, 5e-324, 9.999999999999999e29, 0.1 + 0.2, 1e22]
    names = {".mat": JOINTS, ".csv": ("arm, left", 'the "elbow"')}
    log = Log(
        1.7e9 + np.cumsum(rng.uniform(1e-4, 1e-2, 5000)), rng.standard_normal((5000, 2)),
        tau if has_torque else 0.0 * np.abs(tau), names.get(suffix, ("arm/a", "the elbow")),
        has_torque=has_torque,
        **{name: rng.standard_normal((5000, 2)) for name in ("v", "a", "q_ref", "v_ref")},
        tau_ref=tau,
    )  # fmt: skip
    path = tmp_path / f"run{suffix}"
    write_log(log, path)
    back = read_log(path, log.joints, needs="commands")
    for name in ("t", "q", "v", "a", "tau", "q_ref", "v_ref", "tau_ref"):
        assert getattr(back, name).tobytes() == getattr(log, name).tobytes(), name
    assert (back.notes, back.has_torque) == ((), has_torque)
    write_log(replace(log, v=None, a=None), path)  # it replaces its own file
    assert read_log(path, log.joints, needs="commands").v is None
    assert list(tmp_path.iterdir()) == [path]
    if not suffix.startswith(".h"):  # whose names are sorted
        first = open_table(path, LogSource()).names[:3]
        assert first == ["time", *(f"q_{joint}" for joint in log.joints)]


def test_writing_replaces_a_file_at_once_or_not_at_all(tmp_path, monkeypatch):
    path = tmp_path / "run.csv"
    write_log(sine_log(), path)
    before = path.read_bytes()

    def fail(*_):
        raise OSError("disk full")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OSError, match="disk full"):
        write_log(sine_log(v=None), path)
    assert path.read_bytes() == before
    with pytest.raises(DataError, match="'q_joint-1' is not a valid name of a MATLAB variable"):
        write_log(sine_log(joints=("joint-1", "elbow")), tmp_path / "run.mat")
    assert list(tmp_path.iterdir()) == [path]


def test_suffixes_of_formats_are_known_in_any_case(tmp_path):
    (tmp_path / "run.xlsx").touch()
    known = ".csv, .dat, .txt, .parquet, .npz, .h5, .hdf5, .mat"
    with refused(
        f"run.xlsx: the suffix is '.xlsx', expected a log file of type {known}, .mcap, .db3 or "
        ".bag, or the folder of a ROS 2 bag or of a LeRobot dataset; convert it"
    ):
        read_log(tmp_path / "run.xlsx", ["a"])
    written = f"logs are written as {', '.join(WRITTEN[:-1])} or .mat files"
    for name, found in (("run", "but the name has no extension"), ("run.mcap", "not '.mcap'")):
        with refused(f"{name}: {written}, {found}"):
            write_log(sine_log(), tmp_path / name)
    write_log(sine_log(), tmp_path / "run.csv")
    path = (tmp_path / "run.csv").rename(tmp_path / "RUN.CSV")
    assert len(read_log(path, JOINTS).t) == 60


@pytest.mark.parametrize(
    ("name", "module", "purpose", "package", "extra"),
    [
        ("mcap", "rosbags.rosbag2", "reading ROS bags and MCAP files", "rosbags", "bag"),
        ("ros1", "rosbags.rosbag1", "reading ROS bags and MCAP files", "rosbags", "bag"),
        ("hdf5", "h5py", "reading HDF5 and MATLAB v7.3", "h5py", "hdf5"),
        ("mat 7.3", "h5py", "reading HDF5 and MATLAB v7.3", "h5py", "hdf5"),
        (".parquet", "pyarrow", "reading Parquet", "pyarrow", "parquet"),
    ],
)
def test_without_its_library_a_format_says_how_to_install_it(
    tmp_path, monkeypatch, name, module, purpose, package, extra
):
    path = tmp_path / f"run{name}"
    path = recorded(name, tmp_path, sine_log()) if name in FORMATS else path
    path.touch()
    monkeypatch.setitem(sys.modules, module, None)
    words = rf"^{purpose} needs {package}, which is not installed: pip install '.\[{extra}\]'"
    with pytest.raises(MissingDependencyError, match=words):
        read_log(path, JOINTS)
    if extra != "bag":
        with pytest.raises(MissingDependencyError, match=f"^writing .* needs {package}"):
            write_log(sine_log(), tmp_path / ("out.h5" if extra == "hdf5" else "out.parquet"))


# --- rows of long files ---------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_rows_are_read_from_any_place_that_a_scan_tells(tmp_path, suffix):
    rows = np.arange(20_000.0)
    path = tmp_path / f"run{suffix}"
    write_columns({"time": rows / 8, "q": -rows}, path)
    if suffix == ".parquet":  # in groups, as most programs write it
        pq.write_table(pq.read_table(path), path, row_group_size=3000)
    table = open_table(path, LogSource())
    blocks, places = zip(*table.rows.scan("q"), strict=True)
    assert len(places) > 1
    assert [place.row for place in places] == np.cumsum([0, *map(len, blocks[:-1])]).tolist()
    np.testing.assert_array_equal(np.concatenate(blocks), -rows)
    assert table.rows.count() == 20_000
    for place in places:
        first, stop = place.row + 3, min(place.row + 5000, 20_000)
        part = table.rows.read(["q", "time"], first, stop, place)
        np.testing.assert_array_equal(part["q"], -rows[first:stop])
        np.testing.assert_array_equal(part["time"], rows[first:stop] / 8)


def test_rows_of_a_csv_file_with_blank_lines_have_their_places(tmp_path, monkeypatch):
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
        for first, stop in ((near.row, 7), (near.row + 1, 8), (near.row, near.row + 1)):
            part = rows.read(["q", "time"], first, stop, near)
            assert part["time"].tolist() == list(range(first, stop))
            assert part["q"].tolist() == [10 + k for k in range(first, stop)]
    (tmp_path / "run.csv").write_text("\n".join([*lines, "8,18,0"]) + "\n")
    with pytest.raises(DataError, match="line 13 has 3 cells"):
        rows.read(["q"], 6, 9, places[-1])


@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".npz"])
def test_even_stamps_are_the_line_through_those_of_the_rows(tmp_path, monkeypatch, suffix):
    """A file of a joint whose rows wait for every fifth one, in ms; of CSV read in six blocks."""
    monkeypatch.setattr(csv_files, "_BLOCK", 90)
    k = np.arange(500)
    t = 7000.0 + 4.0 * (k // 5 * 5 + 4) + 0.01 * (k % 5)
    path = tmp_path / f"log{suffix}"
    write_columns({"time": t, "q_a": np.sin(0.01 * k), "tau_a": np.cos(0.01 * k)}, path)
    step, start = np.polyfit(k, t, 1)
    how = {"source": LogSource(stamp="even"), "units": LogUnits(time="ms")}
    log = read_log(path, ["a"], **how)
    np.testing.assert_allclose(log.t, (start + step * k) / 1e3, atol=1e-12)
    layout, table = lay_out(path, ["a"], **how)
    reader = table.reader(layout.wanted)
    blocks = list(reader.scan("time"))
    assert len(blocks) == (6 if suffix == ".csv" else 1)
    np.testing.assert_allclose(np.concatenate([x for x, _ in blocks]) / 1e3, log.t, atol=1e-12)
    part = layout.to_log(reader.read(layout.wanted, 123, 321, blocks[0][1]), 123)
    np.testing.assert_allclose(part.t, log.t[123:321], atol=1e-12)
    np.testing.assert_array_equal(part.q, log.q[123:321])
    assert reader.count() == pytest.approx(500, rel=0.2)
    convert(path, tmp_path / "out.csv", source=how["source"])
    out = pd.read_csv(tmp_path / "out.csv")
    assert np.ptp(np.diff(out["time"])) < 1e-9
    np.testing.assert_array_equal(out["q_a"], np.sin(0.01 * k))


def test_the_line_is_that_of_stamps_since_the_epoch_and_of_a_single_one(rng):
    k, t = np.arange(90), 1.7e9 + 0.004 * np.arange(90) + 0.001 * rng.random(90)
    step, start = np.polyfit(k, t - t[0], 1)
    table = with_even_stamps(Table(["time"], lambda names: {"time": t}), "time")
    np.testing.assert_allclose(table.read(["time"])["time"] - t[0], start + step * k, atol=1e-6)
    one = with_even_stamps(Table(["time"], lambda names: {"time": np.array([3.0])}), "time")
    assert one.read(["time"]) == {"time": [3.0]}


# --- CSV and Parquet ------------------------------------------------------------------------------

HEADER = "time,q_a,tau_a\n"
ROWS = "0.0,1.0,2.0\n0.1,1.5,2.5\n"


@pytest.mark.parametrize(
    "content",
    [
        HEADER + ROWS, ("\ufeff" + HEADER + ROWS), (HEADER + ROWS).replace("\n", "\r\n"),
        (HEADER + ROWS).rstrip("\n"), HEADER + ROWS + "\n  \n", (HEADER + ROWS).replace(",", ";"),
        (HEADER + ROWS).replace(",", "\t"), (HEADER + ROWS).replace(",", " , "),
        "# " + HEADER + ROWS,
        'mode,time,q_a,"tau_a"\n"a, b",0.0,1.0,2.0\n#c,0.1,"1.5",2.5\n',
    ],
)  # fmt: skip
def test_csv_dialects(tmp_path, content):
    (tmp_path / "run.csv").write_bytes(content.encode())
    log = read_log(tmp_path / "run.csv", ["a"])
    np.testing.assert_array_equal(log.t, [0.0, 0.1])
    np.testing.assert_array_equal(log.q, [[1.0], [1.5]])
    np.testing.assert_array_equal(log.tau, [[2.0], [2.5]])


BIG = "9" * 20_000_000
CSV_FAULTS = [
    ("", "is empty; its first line must name the columns"),
    ("\n" + HEADER + ROWS, "is empty; its first line must name the columns"),
    (HEADER, "has a header but no rows; record at least 2"),
    (HEADER + "\n", "has a header but no rows; record at least 2"),
    (HEADER + "0,1,2\n", "has 1 rows, expected at least 2; record longer"),
    (ROWS, "has no header. Set the names of its 3 columns in the job file, and the rate of its "
     'rows if none of them is the time. An example:\n[log]\nnames = ["time", "q_1", "tau_1"]'),
    ("time,q_a,q_a,tau_a\n0,1,2,3\n1,1,2,3\n", "has more than one column q_a; rename or remove"),
    (HEADER + ROWS + "0.2,1.", ": line 4 has 2 cells, the header has 3; correct it"),
    (HEADER + "0.0,1.0,2.0,9.0\n" + ROWS, ": line 2 has 4 cells, the header has 3; correct it"),
    (HEADER + ROWS + "0.2,abc,3.0\n", ": q_a is 'abc' at row 2, expected a number; remove such"),
    (HEADER + ROWS + "0.2,1.0,\n", ": tau_a is empty at row 2, expected a number; remove such rows "
     "or correct the recording, or interpolate a column of another rate at the joints' stamps"),
    ('time,q_a,tau_a\n"0,0","1,0","2,0"\n', ": time is '0,0' at row 0, expected a number; write "
     "decimals with a point; remove"),
    ((HEADER + ROWS).encode("utf-16"), "is not UTF-8 text"),
    (HEADER.encode() + b"\xe9\n", "is not UTF-8 text"),
    ("time,q_a,wrench_fz_f\n0,1,2\n0.1,1,\n0.2,1,3\n", "wrench_fz_f is empty at row 1, expected a "
     "number; interpolate a column of another rate"),
    (f"{HEADER}0,0,0\n{BIG},0,0\n", "time is "),
    (f'{HEADER}0,0,0\n"{BIG},0,0\n', "line 3 "),
    (f"{HEADER}0,0,0\n0.1,{BIG}x,0\n", "line 3 cannot be read"),
    (f"{HEADER}0,0,0\n0.1,0,0,{BIG}\n", "line 3 "),
    (f"time,q_a,tau_a,{BIG[:9999]}\n0,0,0,0\n", "a column has a name of 9999 characters"),
]  # fmt: skip


@pytest.mark.parametrize("k", range(len(CSV_FAULTS)))
def test_csv_that_cannot_be_read_says_why(tmp_path, k):
    content, fragment = CSV_FAULTS[k]
    path = tmp_path / "run.csv"
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    base = BaseColumns(wrenches=("fz f",) if "wrench" in fragment else ())
    with pytest.raises(DataError) as caught:
        read_log(path, ["a"], base=base)
    assert str(caught.value).startswith("run.csv")
    assert fragment in str(caught.value)
    assert len(str(caught.value)) < 500


def test_parquet_columns_become_numbers_or_are_refused(tmp_path):
    numbers = {"t": pa.array([0, 1, 2], pa.int32()), "q_a": pa.array([0.5, 1, 2], pa.float32())}
    pq.write_table(pa.table(numbers | {"tau_a": pa.array([1, 2, 3], pa.uint8())}),
                   tmp_path / "run.parquet")  # fmt: skip
    log = read_log(tmp_path / "run.parquet", ["a"], units=LogUnits(time="s"))
    np.testing.assert_array_equal(log.q[:, 0], [0.5, 1, 2])
    assert log.t.dtype == log.q.dtype == log.tau.dtype == np.float64
    for values in ([1.0, None, 3.0], [1, None, 3]):
        table = pa.table({"t": [0.0, 0.1, 0.2], "q_a": [0, 1, 2], "tau_a": values})
        pq.write_table(table, tmp_path / "run.parquet")
        with pytest.raises(DataError, match=r"^run\.parquet: tau_a is NaN at row 1 \(t = 0\.1 s\)"):
            read_log(tmp_path / "run.parquet", ["a"])
    stamps = pa.array([0, 1, 2], pa.timestamp("ns"))
    pq.write_table(pa.table({"time": stamps, "q_a": [0, 1, 2], "tau_a": [0, 1, 2]}),
                   tmp_path / "run.parquet")  # fmt: skip
    with refused("run.parquet: time contains timestamp[ns], expected numbers; convert it"):
        read_log(tmp_path / "run.parquet", ["a"])
    empty = dict.fromkeys(["t", "q_a", "q_b", "tau_a"], np.empty(0))
    pq.write_table(pa.table(empty), tmp_path / "run.parquet")
    with pytest.raises(DataError, match=r"^run\.parquet has no column 'tau_b'"):
        read_log(tmp_path / "run.parquet", ["a", "b"])


def test_tables_of_texts_are_read_from_csv_and_parquet(tmp_path):
    text = '\ufeffunit,log,mass\na,"x,1.csv",\n\nb,y.csv,2.5\n'
    (tmp_path / "t.csv").write_text(text, encoding="utf-8")
    columns = {"unit": ["a", "b"], "log": ["x,1.csv", "y.csv"], "mass": [None, 2.5]}
    pq.write_table(pa.table(columns), tmp_path / "t.parquet")
    expected = (
        ["unit", "log", "mass"],
        [{"unit": "a", "log": "x,1.csv", "mass": ""}, {"unit": "b", "log": "y.csv", "mass": "2.5"}],
    )
    assert read_text_table(tmp_path / "t.csv") == expected
    assert read_text_table(tmp_path / "t.parquet") == expected
    for name, content, fragment in (
        ("f.csv", "a,b\n1,2,3\n", "row 1 has 3 values, expected 2"),
        ("f.csv", "", "is empty"),
        ("f.csv", "a,a\n1,2\n", "several columns 'a'"),
        ("f.csv", 'a\n"x\n', "is not a CSV table"),
        ("f.txt", "a\n1\n", "the suffix is '.txt', expected a table of type .csv or .parquet"),
        ("f.parquet", "a\n1\n", "broken Parquet file"),
        ("none.csv", None, "there is no table"),
    ):
        if content is not None:
            (tmp_path / name).write_text(content)
        with pytest.raises(DataError, match=fragment):
            read_text_table(tmp_path / name)


def test_rows_are_written_in_groups_of_a_fixed_size(tmp_path, monkeypatch):
    monkeypatch.setattr(parquet_files, "_GROUP", 4)
    rows = [{"name": f"n{k}", "value": k / 3} if k != 5 else {"name": "n5"} for k in range(10)]
    write_rows(tmp_path / "a", iter(rows), {"name": str, "value": float})
    with pq.ParquetFile(tmp_path / "a") as file:
        assert [file.metadata.row_group(k).num_rows for k in range(3)] == [4, 4, 2]
        values = file.read().to_pylist()
    assert values == [{"name": None, "value": None} | row for row in rows]


# --- arrays ---------------------------------------------------------------------------------------


def test_groups_are_chosen_like_topics(tmp_path):
    log = sine_log()
    path = tmp_path / "run.h5"
    with h5py.File(path, "w") as file:
        for group, arrays in (("left", wide(log, object)), ("right", {"time": log.t})):
            for name, values in arrays.items():
                file[f"{group}/{name}"] = values
    with pytest.raises(DataError) as caught:
        read_log(path, JOINTS)
    assert str(caught.value).startswith("run.h5 has 2 groups with a time: left, right; ")
    assert str(caught.value).endswith(f'. Set one: topic = "left" {HOW}')
    assert_same(read_log(path, JOINTS, source=LogSource(topic="/left/")), log)
    with refused("run.h5 has no group 'lefd'; groups found: left, right. Did you mean 'left'?"):
        read_log(path, JOINTS, source=LogSource(topic="lefd"))


def test_arrays_are_numbered_or_named_by_texts(tmp_path):
    log = sine_log()
    path = tmp_path / "run.npz"
    np.savez(path, time=log.t, q=log.q, tau=log.tau, mass=3.0, image=np.zeros((60, 2, 2)))
    by_order = read_log(path, JOINTS)
    assert_same(by_order, log, ("t", "q", "tau"))
    assert by_order.assumed[0].endswith("order of the joints: 0 is shoulder, 1 is elbow")
    numbered = LogSource(joints={"shoulder": "0", "elbow": "1"})
    assert_same(read_log(path, JOINTS, source=numbered), log, ("t", "q", "tau"))
    for axis in (0, slice(None)):  # of one joint, with one axis or two
        np.savez(path, t=log.t, q=log.q[:, axis][:, :1] if axis else log.q[:, 0], joints=["a"],
                 tau=log.tau[:, :1])  # fmt: skip
        np.testing.assert_array_equal(read_log(path, ["a"]).q, log.q[:, :1])
    names = ("elbow", "wrist")
    matrix = wide(log) | {"joints": np.array(names)}  # of characters
    column = wide(log) | {"joints": np.array(names)[:, None]}
    for path in (write_mat5(tmp_path / "5.mat", matrix), write_mat73(tmp_path / "7.mat", column)):
        assert_same(read_log(path, names), replace(log, joints=names))


@pytest.mark.parametrize(
    ("changes", "fragment"),
    [
        ({"tau": np.zeros((59, 2))}, "tau_shoulder has 59 samples, time has 60; record the same"),
        ({"tau": np.zeros((60, 3))}, "tau has the shape (60, 3), but the file names 2 joints"),
        ({"time": None}, "has no column 'time'; columns found: q_shoulder, q_elbow"),
        ({"tau": np.array([None] * 60)}, "has no columns 'tau_shoulder', 'tau_elbow'"),
        ({"time": np.zeros(0), "q": np.zeros((0, 2)), "tau": np.zeros((0, 2))}, "has no column"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(tmp_path, changes, fragment):
    arrays = {name: x for name, x in (wide(sine_log()) | changes).items() if x is not None}
    np.savez(tmp_path / "run.npz", **arrays)
    with pytest.raises(DataError, match=re.escape(fragment)):
        read_log(tmp_path / "run.npz", JOINTS)


# --- simulators -----------------------------------------------------------------------------------

BODY = ("hip", "knee")
BASE = BaseColumns(True, twist="world")  # the arrays themselves state their axes
ROBOT = """<mujoco><option timestep="0.001" gravity="0 0 -9.81"/><worldbody>
<body pos="0 0 1" quat="0.5 0.5 -0.5 0.5"><freejoint/><inertial pos="0.1 0 0" mass="3"
diaginertia="0.1 0.2 0.3"/><body pos="0.2 0 0"><joint name="hip" axis="0 1 0" damping="0.1"/>
<inertial pos="0 0 -0.1" mass="1" diaginertia="0.01 0.01 0.01"/><body pos="0 0 -0.2">
<joint name="knee" axis="1 0 0" damping="0.1"/><inertial pos="0 0 -0.1" mass="0.5"
diaginertia="0.01 0.01 0.01"/></body></body></body></worldbody><actuator><motor joint="hip"/>
<motor joint="knee" gear="2"/></actuator></mujoco>"""


@pytest.fixture(scope="module")
def flight():
    """Arrays of MuJoCo: a robot that tumbles, and the velocity of its link in the world."""
    model = mujoco.MjModel.from_xml_string(ROBOT)
    data = mujoco.MjData(model)
    data.qvel[:] = [1.0, -0.5, 2.0, 3.0, -2.0, 1.0, 0.5, -0.5]
    names = ("time", "qpos", "qvel", "qacc", "qfrc_actuator")
    rows, worlds = [], []
    for k in range(300):
        data.ctrl[:] = [np.sin(0.02 * k), 0.3]
        mujoco.mj_forward(model, data)
        rows.append([np.copy(getattr(data, name)) for name in names])
        velocity = np.zeros(6)
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, 1, velocity, 0)
        worlds.append(np.append(velocity[3:], velocity[:3]))
        mujoco.mj_step(model, data)
    arrays = {name: np.array(x) for name, x in zip(names, zip(*rows, strict=True), strict=True)}
    return arrays, np.array(worlds)


def assert_of_flight(log, arrays, *, twist=True):
    np.testing.assert_array_equal(log.q, arrays["qpos"][:, 7:])
    np.testing.assert_array_equal(log.v, arrays["qvel"][:, 6:])
    np.testing.assert_array_equal(log.tau, arrays["qfrc_actuator"][:, 6:])
    assert np.abs(log.tau).max() > 0.5
    np.testing.assert_array_equal(log.base.pose[:, :3], arrays["qpos"][:, :3])
    some = slice(3, -3)
    _, wanted, _ = base_state(log.t, log.base.pose, None, None)
    if twist:
        np.testing.assert_allclose(log.base.twist[some], wanted[some], atol=2e-2)
        assert np.abs(wanted[:, :3]).max() > 1.0
    else:
        assert log.base.twist is None


def test_generalised_coordinates_of_mujoco_are_read(flight, tmp_path):
    arrays, _ = flight
    np.savez(tmp_path / "log.npz", joints=BODY, **arrays)
    log = read_log(tmp_path / "log.npz", BODY, base=BASE)
    assert_of_flight(log, arrays)
    np.testing.assert_array_equal(log.a, arrays["qacc"][:, 6:])
    assert not log.notes
    rate = np.gradient(log.base.twist, log.t, axis=0)
    np.testing.assert_allclose(log.base.acceleration[2:-2], rate[2:-2], atol=0.1)
    assert np.abs(rate).max() > 5.0
    no_speeds = {name: x for name, x in arrays.items() if name not in ("qvel", "qacc")}
    np.savez(tmp_path / "log.npz", joints=BODY, **no_speeds)
    assert read_log(tmp_path / "log.npz", BODY, base=BASE).base.twist is None


@pytest.mark.parametrize("root", ["root_link_state_w", "root_state_w"])
def test_states_of_isaac_lab_are_read(flight, tmp_path, root):
    arrays, world = flight
    with h5py.File(tmp_path / "log.h5", "w") as file:
        file["time"], file["joint_names"] = arrays["time"], list(BODY)
        file["joint_pos"], file["joint_vel"] = arrays["qpos"][:, 7:], arrays["qvel"][:, 6:]
        file["applied_torque"] = arrays["qfrc_actuator"][:, 6:]
        file[root] = np.hstack([arrays["qpos"][:, :7], world])
    log = read_log(tmp_path / "log.h5", BODY, base=BASE)
    is_link = root == "root_link_state_w"
    assert_of_flight(log, arrays, twist=is_link)
    assert any("velocity of the centre of mass" in note for note in log.notes) != is_link


def test_arrays_of_a_fixed_base_have_no_free_joint(flight, tmp_path):
    arrays, _ = flight
    own = {name: arrays[name][:, -2:] for name in ("qpos", "qvel", "qfrc_actuator")}
    np.savez(tmp_path / "log.npz", time=arrays["time"], joints=BODY, **own)
    log = read_log(tmp_path / "log.npz", BODY)
    np.testing.assert_array_equal(log.q, own["qpos"])
    np.testing.assert_array_equal(log.tau, own["qfrc_actuator"])


def test_arrays_of_another_width_are_refused(flight, tmp_path):
    arrays, _ = flight
    np.savez(tmp_path / "log.npz", joints=["hip"], **arrays)
    with pytest.raises(DataError, match=r"qpos has 9 columns, expected 1, .* or 7 more with a"):
        read_log(tmp_path / "log.npz", ["hip"], base=BASE)
    np.savez(
        tmp_path / "log.npz", joints=BODY, time=arrays["time"], joint_pos=arrays["qpos"][:, 7:],
        root_state_w=arrays["qpos"][:, :7],
    )  # fmt: skip
    with pytest.raises(DataError, match="root_state_w has 7 columns, expected 13"):
        read_log(tmp_path / "log.npz", BODY, base=BASE, needs="motion")


# --- broken files ---------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["mcap", "db3", "ros1", "npz", "hdf5", "mat struct", "mat 7.3"])
@pytest.mark.parametrize("left", [0.0, 0.5, 0.9])
def test_files_that_were_cut_are_refused_by_name(tmp_path, name, left):
    path = recorded(name, tmp_path, sine_log(2000))
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * left)])
    with pytest.raises(DataError, match=rf"^{path.name}: broken,? .*"):
        read_log(path, JOINTS)


def test_a_file_of_noise_a_pipe_a_device_and_a_folder_are_no_log(tmp_path):
    for suffix in ("csv", "parquet", "npz", "h5", "mat", "mcap", "db3", "bag"):
        path = tmp_path / f"noise.{suffix}"
        path.write_bytes(b"\x00\x01\x02" * 100)
        with pytest.raises(DataError, match=re.escape(path.name)):
            read_log(path, ["a"])
    os.mkfifo(tmp_path / "run.csv")
    (tmp_path / "run.h5").mkdir()
    (tmp_path / "null.csv").symlink_to("/dev/null")
    for name, fragment in [
        ("run.csv", "run.csv' is a pipe or a device, expected a log file"),
        ("null.csv", "null.csv' is a pipe or a device, expected a log file"),
        ("run.h5", "run.h5 is a folder without metadata.yaml, so it is not a ROS 2 bag, and "
         "without meta/info.json, so it is not a LeRobot dataset"),
        ("none.csv", "there is no log file '.*none.csv'"),
    ]:  # fmt: skip
        with pytest.raises(DataError, match=fragment):
            read_log(tmp_path / name, ["a"])


def npy(header):
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header


def npz_with(header):
    def write(path):
        with zipfile.ZipFile(path, "w") as file:
            file.writestr("time.npy", npy(header))

    return write


def spoilt(write, first, size):
    """Return a writer that overwrites some bytes."""

    def rewrite(path):
        write(path)
        content = bytearray(path.read_bytes())
        content[first : first + size] = b"\xff" * size
        path.write_bytes(content)

    return rewrite


def hdf5_with(**arrays):
    def write(path):
        with h5py.File(path, "w") as file:
            for name, x in arrays.items():
                if isinstance(x, dict):
                    file.create_dataset(name, dtype="f8", **x)
                else:
                    file[name] = x

    return write


def mat_that_claims(path):
    cell = np.empty((7, 11), dtype=object)
    cell[:] = 0.0
    scipy.io.savemat(path, {"time": cell})
    content, shape = path.read_bytes(), np.array([7, 11], dtype="<i4").tobytes()
    assert content.count(shape) == 1
    path.write_bytes(content.replace(shape, np.array([3000, 4000], dtype="<i4").tobytes()))


T = np.arange(20) / 100
NOISE = np.random.default_rng(0).normal(size=20)
HUGE = repr({"descr": "<f8", "fortran_order": False, "shape": (10**12,)}).encode()
BROKEN = [
    (".npz", npz_with(HUGE), r"time has the shape \(1000000000000,\), which is too large for a"),
    (".npz", spoilt(lambda path: np.savez_compressed(path, time=T, q_a=T, tau_a=NOISE), 60, 20),
     "broken NPZ file"),
    *[(".npz", npz_with(header), "broken NPZ file") for header in (
        b"{" * 100, b"", b"()", b"{'descr': 'nonsense', 'fortran_order': 0, 'shape': 3}")],
    (".mat", spoilt(lambda path: scipy.io.savemat(path, {"time": T}, do_compression=True), 150, 9),
     "broken MATLAB file"),
    (".mat", mat_that_claims, r"time has the shape \(3000, 4000\)"),
    (".h5", hdf5_with(time=dict(shape=(10**12,), chunks=(1024,)),
                      q=dict(shape=(10**12, 1), chunks=(1024, 1))), r"the shape \(1000000000000,"),
    (".h5", hdf5_with(time=T, q=T[:, None], tau=T[:, None], joints=np.array([b"\xff\xfe"])),
     "a name in joints is not UTF-8 text"),
    (".h5", hdf5_with(time="now", q="here", tau_a=["x"] * 20), "no columns 'time', 'q_a', "),
    (".parquet", lambda path: path.write_bytes(b"PAR1 not really"), r"file \(ArrowInvalid: Parq"),
]  # fmt: skip


@pytest.mark.parametrize("k", range(len(BROKEN)))
def test_broken_files_are_refused_before_they_cost_memory(tmp_path, k):
    suffix, write, fragment = BROKEN[k]
    path = tmp_path / f"run{suffix}"
    write(path)
    tracemalloc.start()
    with pytest.raises(DataError, match=fragment) as caught:
        read_log(path, ["a"])
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert str(caught.value).startswith(path.name)
    assert len(str(caught.value)) < 500
    assert peak < 2**27
