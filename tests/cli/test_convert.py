"""`convert` writes what a robot recorded under standard names, or nothing."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.recorders import JOINT_STATE, messages_of, write_states

from robotid.base.exceptions import DataError
from robotid.base.files import write_text
from robotid.cli import main
from robotid.cli.convert import convert
from robotid.data.files.read import open_table, read_log, write_columns
from robotid.data.log import Log
from robotid.data.signal_settings import LogSource

JOINTS = ("shoulder", "elbow")


@pytest.fixture
def log():
    t = np.arange(60) / 50
    phase = t[:, None] * [2.0, 3.0]
    velocity = np.cos(phase) * [2.0, 3.0]
    return Log(t=t, q=np.sin(phase), v=velocity, tau=10 * np.cos(phase), joints=JOINTS)


@pytest.fixture
def bag(tmp_path, log):
    """A bag whose second topic is another arm's."""
    other = replace(log, joints=("left", "right"))
    topics = {"/arm": messages_of(log), "/other": messages_of(other)}
    return write_states(tmp_path / "bag", topics)


def assert_same(back, log):
    for name in ("t", "q", "v", "tau"):
        np.testing.assert_array_equal(getattr(back, name), getattr(log, name), name)


@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".npz", ".h5", ".hdf5", ".mat"])
def test_a_bag_becomes_a_table_of_standard_names(tmp_path, log, bag, suffix):
    target = tmp_path / f"run{suffix}"
    done = convert(bag, target, source=LogSource(topic="/arm"))
    standard = [f"{kind}_{joint}" for kind in ("q", "dq", "tau") for joint in JOINTS]
    assert done == {"path": str(target), "samples": 60, "columns": ["time", *standard],
                    "joints": [*JOINTS], "ignored": [], "local": False}  # fmt: skip
    assert_same(read_log(target, JOINTS), log)


def test_joints_are_chosen_renamed_and_effort_may_be_current(tmp_path, log, bag):
    source = LogSource(topic="/arm", joints={"joint_2": "elbow"}, effort="current")
    done = convert(bag, tmp_path / "run.csv", joints=["joint_2"], source=source)
    assert done["columns"] == ["time", "q_joint_2", "dq_joint_2", "current_joint_2"]
    back = read_log(tmp_path / "run.csv", ["joint_2"], gains={"joint_2": 2.0})
    np.testing.assert_array_equal(back.tau[:, 0], 2 * log.tau[:, 1])
    assert done["ignored"] == []


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"time": [0.0, 1.0], "x": [0.0, 1.0]}, "has no column of a joint, as 'q_<joint>'; "),
        ({"q_a": [0.0, 1.0]}, "has no column 'time'; columns found: q_a. Rename the time column"),
        (
            {"t": [0.0, 1.0], "q_a": [0.0, 1.0], "position_a": [0.0, 1.0]},
            "has several columns for 'q_a': q_a, position_a; keep one of them",
        ),
    ],
)
def test_what_cannot_be_named_is_refused_and_nothing_is_written(tmp_path, arrays, message):
    np.savez(tmp_path / "run.npz", **arrays)
    with pytest.raises(DataError) as caught:
        convert(tmp_path / "run.npz", tmp_path / "out.csv")
    assert str(caught.value).startswith(f"run.npz {message}")
    with pytest.raises(DataError, match=r"has no joint 'b'|has no column|several columns"):
        convert(tmp_path / "run.npz", tmp_path / "out.csv", joints=["b"])
    assert [path.name for path in tmp_path.iterdir()] == ["run.npz"]


def test_columns_of_base_contacts_and_forces_are_kept(tmp_path, log):
    kept = ["base_x", "base_qw", "base_roll", "base_alz", "imu_qx", "imu_az", "contact_l_foot",
            "wrench_mz_l_foot", "foot_force_0"]  # fmt: skip
    lost = ["base_state", "imu_temperature", "wrench_size_l_foot"]
    table = {"time": log.t} | {f"q_{x}": log.q[:, k] for k, x in enumerate(JOINTS)}
    table |= {name: k + log.t for k, name in enumerate([*kept, *lost])}
    write_columns(table, tmp_path / "run.parquet")
    done = convert(tmp_path / "run.parquet", tmp_path / "run.csv", joints=["elbow"])
    assert done["columns"] == ["time", "q_elbow", *kept]
    assert done["ignored"] == lost
    assert not done["local"]
    back = open_table(tmp_path / "run.csv", LogSource()).read(kept)
    for k, name in enumerate(kept):
        np.testing.assert_array_equal(back[name], k + log.t)


def test_the_command_refuses_by_name_and_leaves_what_was_there(tmp_path, bag, capsys):
    target = tmp_path / "run.csv"
    write_text("precious", target)
    assert main(["convert", str(bag), str(target)]) == 1
    assert f"bag has 2 topics of {JOINT_STATE}: /arm, /other" in capsys.readouterr().err
    words = [str(bag), str(tmp_path / "one.csv"), "--joints", "elbow", "--topic", "/arm"]
    assert main(["convert", *words]) == 0
    assert main(["convert", str(bag), str(target), "--topic", "/arm", "--effort", "x"]) == 2
    assert "log: effort is 'x', expected one of" in capsys.readouterr().err
    assert main(["convert", str(bag), str(tmp_path / "run.mcap"), "--topic", "/arm"]) == 1
    assert "run.mcap: logs are written as .csv, " in capsys.readouterr().err
    assert target.read_text() == "precious"
    assert {path.name for path in tmp_path.iterdir()} == {"bag", "one.csv", "run.csv"}
