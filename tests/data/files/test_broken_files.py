"""Files that claim, hold or are what no log is: refused in words, before they cost memory."""

import os
import re
import tracemalloc
import zipfile

import h5py
import numpy as np
import pytest
import scipy.io

from robotid.base.exceptions import DataError
from robotid.data.files.read import read_log, write_log
from robotid.data.log import Log
from robotid.data.measured_velocity import velocity_lag
from robotid.data.signal_settings import SignalSettings
from robotid.data.signals import process

T = np.arange(20) / 100
Q = np.sin(T)


def refused(path, message):
    """Reading refuses the file with the message, in little memory."""
    tracemalloc.start()
    with pytest.raises(DataError, match=message) as caught:
        read_log(path, ["a"])
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert str(caught.value).startswith(path.name)
    assert len(str(caught.value)) < 500
    assert peak < 2**27


def npy(shape, descr="<f8", body=b""):
    header = repr({"descr": descr, "fortran_order": False, "shape": shape}).encode()
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + body


def test_an_npz_that_claims_a_shape_of_1e12_is_refused_before_it_is_allocated(tmp_path):
    path = tmp_path / "run.npz"
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("time.npy", npy((10**12,)))
    refused(
        path, r"time has the shape \(1000000000000,\), which is too large for a file of \d+ bytes"
    )


def test_an_npz_with_a_zlib_fault_is_refused(tmp_path):
    path = tmp_path / "run.npz"
    np.savez_compressed(path, time=T, q_a=Q, tau_a=np.random.default_rng(0).normal(size=20))
    content = bytearray(path.read_bytes())
    content[60:80] = b"\xff" * 20
    path.write_bytes(content)
    refused(path, "broken NPZ file")


@pytest.mark.parametrize(
    "header", [b"{" * 100, b"", b"()", b"{'descr': 'nonsense', 'fortran_order': 0, 'shape': 3}"]
)
def test_an_npz_with_a_faulty_header_is_refused(tmp_path, header):
    path = tmp_path / "run.npz"
    with zipfile.ZipFile(path, "w") as file:
        content = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header
        file.writestr("time.npy", content)
    refused(path, "broken NPZ file")


def test_a_mat_with_a_zlib_fault_or_a_shape_of_1e9_is_refused(tmp_path):
    path = tmp_path / "run.mat"
    scipy.io.savemat(path, {"time": T, "q_a": Q}, do_compression=True)
    content = bytearray(path.read_bytes())
    content[150:170] = b"\xff" * 20
    path.write_bytes(content)
    refused(path, "broken MATLAB file")
    cell = np.empty((7, 11), dtype=object)
    cell[:] = 0.0
    scipy.io.savemat(path, {"time": cell})
    content, shape = path.read_bytes(), np.array([7, 11], dtype="<i4").tobytes()
    assert content.count(shape) == 1
    path.write_bytes(content.replace(shape, np.array([3000, 4000], dtype="<i4").tobytes()))
    refused(path, r"time has the shape \(3000, 4000\)")


def test_an_hdf5_that_claims_a_shape_of_1e12_is_refused_before_it_is_allocated(tmp_path):
    path = tmp_path / "run.h5"
    with h5py.File(path, "w") as file:
        file.create_dataset("time", shape=(10**12,), dtype="f8", chunks=(1024,))
        file.create_dataset("q", shape=(10**12, 1), dtype="f8", chunks=(1024, 1))
    refused(path, r"has the shape \(1000000000000,")


def test_text_in_an_hdf5_that_is_no_utf8_is_refused(tmp_path):
    path = tmp_path / "run.h5"
    with h5py.File(path, "w") as file:
        file["time"], file["q"], file["tau"] = T, Q[:, None], Q[:, None]
        file["joints"] = np.array([b"\xff\xfe"])
    refused(path, "a name in joints is not UTF-8 text")
    with h5py.File(path, "w") as file:
        file["time"], file["q"], file["tau_a"] = "now", "here", ["x"] * 20
    refused(path, "has no column 'time'")


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("{},0,0", "time is '9{79}' at row 1, wanted a number|is inf"),
        ('"{},0,0', "line 3 has 1 cells, the header has 3|line 3 cannot be read"),
        ("0.1,{}x,0", "line 3 cannot be read"),
        ("0.1,0,0,{}", "line 3 cannot be read|line 3 has 4 cells"),
    ],
)
def test_a_csv_with_a_cell_of_20_megabytes_is_refused(tmp_path, row, message):
    path = tmp_path / "run.csv"
    big = "9" * 20_000_000
    path.write_text(f"time,q_a,tau_a\n0,0,0\n{row.format(big)}\n")
    with pytest.raises(DataError, match=message) as caught:
        read_log(path, ["a"])
    assert len(str(caught.value)) < 500
    path.write_text(f"time,q_a,tau_a,{big[:9999]}\n0,0,0,0\n")
    with pytest.raises(DataError) as caught:
        read_log(path, ["a"])
    assert len(str(caught.value)) < 500


@pytest.mark.parametrize("column", ["time", "q_a", "dq_a", "tau_a"])
def test_values_whose_squares_overflow_are_refused(tmp_path, column):
    table = {"time": T.copy(), "q_a": Q.copy(), "dq_a": Q.copy(), "tau_a": Q.copy()}
    table[column][-1] = 1e308
    np.savez(tmp_path / "run.npz", **table)
    refused(tmp_path / "run.npz", f"{column} is 1e.308, which is implausibly large, at row 19")


def test_a_pipe_a_device_and_a_folder_are_no_log(tmp_path):
    os.mkfifo(tmp_path / "run.csv")
    (tmp_path / "run.h5").mkdir()
    (tmp_path / "null.csv").symlink_to("/dev/null")
    for name, message in [
        ("run.csv", "run.csv' is a pipe or a device, wanted a log file"),
        ("null.csv", "null.csv' is a pipe or a device, wanted a log file"),
        ("run.h5", "run.h5 is a folder without metadata.yaml"),
        ("none.csv", "there is no log file '.*none.csv'"),
    ]:
        with pytest.raises(DataError, match=message):
            read_log(tmp_path / name, ["a"])


def log_of(t, q):
    return Log(t=t, q=q[:, None], v=np.gradient(q, t)[:, None], tau=q[:, None], joints=("a",))


def test_a_jump_of_the_clock_costs_no_memory(tmp_path):
    t = np.arange(2000) / 100
    q = np.sin(5 * t) + np.sin(8 * t)
    log = log_of(t, q)
    v = np.roll(log.v, 5, axis=0)  # 50 ms late
    late = Log(t=t, q=log.q, v=v, tau=log.tau, joints=("a",))
    jumped = Log(t=t + 1e9 * (t > 15), q=log.q, v=v, tau=log.tau, joints=("a",))
    tracemalloc.start()
    assert velocity_lag(jumped) == pytest.approx(0.05, abs=2e-3)
    assert len(process(jumped, SignalSettings()).t) == pytest.approx(1920, abs=4)
    assert tracemalloc.get_traced_memory()[1] < 2**24
    tracemalloc.stop()
    assert velocity_lag(late) == pytest.approx(0.05, abs=2e-3)
    message = "2000 rows over 1e.09 s would become .* lower rate, or max_gap if the clock jumps"
    with pytest.raises(ValueError, match=message):
        process(jumped, SignalSettings(max_gap=1e10))


@pytest.mark.parametrize("rows", [2, 3, 4, 5])
def test_a_few_rows_have_no_lag_and_no_trajectory(rows, tmp_path):
    log = log_of(T[:rows], Q[:rows])
    assert velocity_lag(log) == 0.0
    write_log(log, tmp_path / "run.csv")
    with pytest.raises(DataError, match="none of its 1 segments without gaps is long enough"):
        process(read_log(tmp_path / "run.csv", ["a"]), SignalSettings())


def test_every_message_names_the_file_that_it_is_about(tmp_path):
    for suffix in ("csv", "parquet", "npz", "h5", "mat", "mcap", "db3", "bag"):
        path = tmp_path / f"run.{suffix}"
        path.write_bytes(b"\x00\x01\x02" * 100)
        with pytest.raises(DataError, match=re.escape(path.name)):
            read_log(path, ["a"])
