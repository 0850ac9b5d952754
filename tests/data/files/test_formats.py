"""Logs as robots write them: each format written by its own library, and read back unchanged."""

import re
import sys
from dataclasses import replace

import h5py
import numpy as np
import pyarrow.parquet as pq
import pytest
from helpers.recorders import (
    StoragePlugin,
    messages_of,
    wide,
    write_bag1,
    write_bag2,
    write_mat5,
    write_mat73,
    write_mcap,
)
from mcap.writer import Writer as McapLibraryWriter

from robotid.base.exceptions import DataError, MissingDependencyError, SettingsError
from robotid.data.files.formats import open_table, write_columns
from robotid.data.files.read import read_log, write_log
from robotid.data.log import Log
from robotid.data.signal_settings import LogSource

JOINTS = ("shoulder", "elbow")
STATE = "sensor_msgs/msg/JointState"
HOW = "(job file table [log], CLI --topic, Python source=LogSource(topic=...))"


CURE = (
    ". A payload of known mass determines unknown gains: robotid payload URDF LOADED --reference "
    "BARE --mass KG --gains"
)


def refused(text, kind=DataError):
    return pytest.raises(kind, match="^" + re.escape(text) + "$")


def make_log(count=60, **changes):
    t = np.arange(count) / 50
    phase = t[:, None] * [2.0, 3.0]
    fields = {
        "t": t,
        "q": np.sin(phase),
        "v": np.cos(phase) * [2.0, 3.0],
        "tau": 10 * np.cos(phase),
        "joints": JOINTS,
    }
    return Log(**(fields | changes))


def assert_same(back, log, names=("t", "q", "v", "tau")):
    for name in names:
        np.testing.assert_array_equal(getattr(back, name), getattr(log, name), name)


def folder_bag(path, log):
    return write_bag2(path / "bag", {"/joint_states": messages_of(log)}, others=["/chatter"])


def file_in_folder(path, log):
    (found,) = folder_bag(path, log).glob("*.db3")
    return found


def mcap_folder(path, log):
    topics = {"/joint_states": messages_of(log)}
    return write_bag2(path / "bag", topics, plugin=StoragePlugin.MCAP)


def npz(path, log):
    np.savez(path / "run.npz", **wide(log))
    return path / "run.npz"


def npz_columns(path, log):
    columns = {f"q_{j}": x for j, x in zip(log.joints, log.q.T, strict=True)}
    columns |= {f"velocity_{j}": x for j, x in zip(log.joints, log.v.T, strict=True)}
    columns |= {f"torque_{j}": x for j, x in zip(log.joints, log.tau.T, strict=True)}
    np.savez_compressed(path / "run.npz", t=log.t, **columns)
    return path / "run.npz"


def hdf5(path, log):
    with h5py.File(path / "run.h5", "w") as file:
        group = file.create_group("robot/arm")
        for name, values in wide(log, object).items():
            group[name] = values
    return path / "run.h5"


def mat5_struct(path, log):
    return write_mat5(path / "run.mat", {"log": wide(log), "comment": "cold robot"})


def mat5_across(path, log):
    arrays = {name: x.T if x.ndim == 2 else x for name, x in wide(log, object).items()}
    return write_mat5(path / "run.mat", arrays)


FORMATS = {
    "mcap": lambda path, log: write_mcap(path / "run.mcap", messages_of(log)),
    "mcap folder": mcap_folder,
    "ros2 folder": folder_bag,
    "db3": file_in_folder,
    "ros1": lambda path, log: write_bag1(path / "run.bag", messages_of(log)),
    "npz": npz,
    "npz columns": npz_columns,
    "hdf5": hdf5,
    "mat struct": mat5_struct,
    "mat joints by samples": mat5_across,
    "mat 7.3": lambda path, log: write_mat73(path / "run.mat", wide(log, object)),
    "mat 7.3 struct": lambda path, log: write_mat73(path / "run.mat", {"log": wide(log, object)}),
}
each_format = pytest.mark.parametrize("write", FORMATS.values(), ids=FORMATS)


# --- reading --------------------------------------------------------------------------------------


@each_format
def test_what_the_library_wrote_is_read_unchanged(tmp_path, write):
    log = make_log()
    path = write(tmp_path, log)
    back = read_log(path, JOINTS)
    assert_same(back, log)
    assert (back.joints, back.path, back.notes) == (JOINTS, str(path), ())
    assert_same(read_log(path, JOINTS[::-1]), log.select(JOINTS[::-1]))


@pytest.mark.parametrize("suffix", [".npz", ".h5", ".hdf5", ".mat"])
def test_written_logs_are_read_back_to_the_last_bit(tmp_path, suffix):
    log = make_log(a=np.random.default_rng(0).standard_normal((60, 2)))
    path = tmp_path / f"run{suffix}"
    write_log(log, path)
    assert_same(read_log(path, JOINTS), log, ("t", "q", "v", "a", "tau"))
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("suffix", [".npz", ".h5"])
def test_names_with_slashes_survive(tmp_path, suffix):
    log = make_log(joints=("arm/shoulder", "arm/the elbow"))
    write_log(log, tmp_path / f"run{suffix}")
    assert_same(read_log(tmp_path / f"run{suffix}", log.joints), log)


def test_names_that_matlab_cannot_hold_are_refused_and_nothing_is_written(tmp_path):
    with refused(
        "'q_joint-1' is not a valid name of a MATLAB variable (letters, digits and _, at most 63 "
        "characters); write another format"
    ):
        write_log(make_log(joints=("joint-1", "elbow")), tmp_path / "run.mat")
    assert list(tmp_path.iterdir()) == []


# --- bags -----------------------------------------------------------------------------------------


def test_the_clock_is_the_header_unless_stated(tmp_path):
    log = make_log()
    path = write_mcap(tmp_path / "run.mcap", messages_of(log), delay=lambda _: 0.25)
    assert_same(read_log(path, JOINTS), log)
    back = read_log(path, JOINTS, source=LogSource(stamp="log"))
    np.testing.assert_allclose(back.t, log.t + 0.25, atol=1e-9)


def test_headers_that_were_never_stamped_are_refused(tmp_path):
    log = make_log()
    unstamped = [(0.0, *message[1:]) for message in messages_of(log)]
    path = write_bag2(tmp_path / "bag", {"/joint_states": unstamped}, delay=1.0)
    with refused(
        "bag, topic '/joint_states': the header stamps of all 60 messages are 0. To use "
        'the time of recording, state stamp = "log" (job file table [log], CLI --stamp log, '
        'Python source=LogSource(stamp="log"))'
    ):
        read_log(path, JOINTS)


def test_stamps_that_go_back_are_refused_as_in_any_log(tmp_path):
    messages = list(messages_of(make_log()))
    messages[8] = (messages[6][0] - 0.005, *messages[8][1:])
    path = write_mcap(tmp_path / "run.mcap", messages, delay=lambda k: 0.05 * (k == 8))
    with refused(
        "run.mcap: t must increase, but t[8] = 0.115 s follows t[7] = 0.140 s; sort the rows, or "
        "correct the recording"
    ):
        read_log(path, JOINTS)
    by_log = read_log(path, JOINTS, source=LogSource(stamp="log"))
    assert by_log.t[8] == 0.165


def test_the_topic_must_be_stated_if_several_would_do(tmp_path):
    log = make_log()
    topics = {"/arm": messages_of(log), "/ghost": messages_of(replace(log, q=log.q + 1))}
    path = write_bag2(tmp_path / "bag", topics, others=["/chatter"])
    listing = (
        f"topics: {{'/arm': '{STATE}', '/chatter': 'std_msgs/msg/String', '/ghost': '{STATE}'}}"
    )
    with refused(
        f'bag has 2 topics of {STATE}: /arm, /ghost; {listing}. State one: topic = "/arm" {HOW}'
    ):
        read_log(path, JOINTS)
    assert_same(read_log(path, JOINTS, source=LogSource(topic="/arm")), log)
    with refused(f"bag has no topic '/arn'; {listing}. Did you mean '/arm'?"):
        read_log(path, JOINTS, source=LogSource(topic="/arn"))
    kinds = f"{STATE} or control_msgs/msg/JointTrajectoryControllerState"
    with refused(
        f"bag: topic '/chatter' has messages of std_msgs/msg/String, wanted {kinds}; {listing}"
    ):
        read_log(path, JOINTS, source=LogSource(topic="/chatter"))


def test_a_bag_without_joint_states_lists_what_it_holds(tmp_path):
    path = write_bag2(tmp_path / "bag", {"/joint_states": []}, others=["/chatter"])
    listing = f"topics: {{'/chatter': 'std_msgs/msg/String', '/joint_states': '{STATE}'}}"
    with refused(f"bag has no message of {STATE}; {listing}"):
        read_log(path, JOINTS)
    with refused(f"bag: topic '/joint_states' has no message; {listing}"):
        read_log(path, JOINTS, source=LogSource(topic="/joint_states"))


def gripper(log):
    return [(t + 0.003, ["finger"], [0.5], [], []) for t in log.t]


def test_messages_of_other_joints_are_passed_over(tmp_path):
    log = make_log()
    messages = sorted([*messages_of(log), *gripper(log)], key=lambda message: message[0])
    path = write_mcap(tmp_path / "run.mcap", messages)
    back = read_log(path, JOINTS)
    assert_same(back, log)
    assert back.notes == ("columns ignored: position_finger",)


def test_joints_missing_in_some_messages_are_refused(tmp_path):
    messages = list(messages_of(make_log()))
    for k in (7, 30):
        t, names, *rows = messages[k]
        i = names.index("elbow")
        messages[k] = (t, [*names[:i], *names[i + 1 :]], *(np.delete(x, i) for x in rows))
    path = write_mcap(tmp_path / "run.mcap", messages)
    with refused(
        "run.mcap, topic '/joint_states': 2 of 60 messages lack some of the required "
        "values, the first (message 7) lacks position_elbow, effort_elbow, velocity_elbow. A row "
        "is one message; read only joints that are always published together, and leave out the "
        "others"
    ):
        read_log(path, JOINTS)
    np.testing.assert_array_equal(read_log(path, ["shoulder"]).q, make_log().q[:, :1])


def test_a_bag_without_efforts_is_refused_as_any_log(tmp_path):
    messages = [(*message[:4], []) for message in messages_of(make_log())]
    path = write_mcap(tmp_path / "run.mcap", messages)
    with refused(
        "run.mcap has no columns 'tau_shoulder', 'tau_elbow'; torque or current columns found: "
        "none. Record tau_<joint> or current_<joint>. Commanded positions, qref_<joint>, are "
        'enough for the estimator "simulation"'
    ):
        read_log(path, JOINTS)


def test_degrees_and_nan_in_a_bag_are_refused_as_in_any_log(tmp_path):
    log = make_log()
    with pytest.raises(DataError, match=r"^deg.mcap: .* looks like degrees"):
        read_log(write_mcap(tmp_path / "deg.mcap", messages_of(replace(log, q=20 * log.q))), JOINTS)
    messages = list(messages_of(log))
    messages[3] = (*messages[3][:4], [np.nan, 0.0])
    with pytest.raises(DataError, match=r"^nan.mcap: tau_elbow is NaN at row 3 \(t = 0.06 s\)"):
        read_log(write_mcap(tmp_path / "nan.mcap", messages), JOINTS)


def test_effort_is_a_current_if_stated(tmp_path):
    log = make_log()
    path = write_mcap(tmp_path / "run.mcap", messages_of(log))
    current = LogSource(effort="current")
    back = read_log(path, JOINTS, source=current, gains={"shoulder": 2.0, "elbow": 3.0})
    np.testing.assert_array_equal(back.tau, log.tau * [2.0, 3.0])
    with refused(
        "run.mcap: joints shoulder, elbow have currents but no gain; state it in N m/A: "
        "--gain shoulder=... --gain elbow=..., or in the job file [torque] gains = "
        "{ shoulder = ..., elbow = ... }" + CURE
    ):
        read_log(path, JOINTS, source=current)


def test_messages_that_do_not_fit_together_are_refused(tmp_path):
    messages = list(messages_of(make_log()))
    t, names, q, v, tau = messages[5]
    wrong = {
        "has 1 values of velocity": (t, names, q, v[:1], tau),
        "names elbow twice": (t, ["elbow", "elbow"], q, v, tau),
    }
    for number, (text, message) in enumerate(wrong.items()):
        path = write_mcap(tmp_path / f"{number}.mcap", [*messages[:5], message])
        with pytest.raises(DataError, match=f"message 5 on '/joint_states' .*{re.escape(text)}"):
            read_log(path, JOINTS)


def test_a_folder_that_is_no_bag_is_refused(tmp_path):
    with refused(
        f"{tmp_path.name} is a folder without metadata.yaml, so it is not a ROS 2 bag, and "
        "without meta/info.json, so it is not a LeRobot dataset; give the .mcap or "
        ".db3 file in it, or restore it with 'ros2 bag reindex'"
    ):
        read_log(tmp_path, JOINTS)


@pytest.mark.parametrize("name", ["mcap", "db3", "ros1", "npz", "hdf5", "mat struct", "mat 7.3"])
@pytest.mark.parametrize("left", [0.0, 0.5, 0.9])
def test_broken_files_are_refused_by_name(tmp_path, name, left):
    path = FORMATS[name](tmp_path, make_log(2000))
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * left)])
    with pytest.raises(DataError, match=rf"^{path.name}: broken,? .*"):
        read_log(path, JOINTS)


def test_an_mcap_file_that_is_not_of_ros2_says_so(tmp_path):
    path = tmp_path / "run.mcap"
    with path.open("wb") as file:
        writer = McapLibraryWriter(file)
        writer.start(profile="ros1")
        writer.finish()
    with refused(
        "run.mcap: broken, unfinished or foreign bag (Profile is not ros2.); record it again, or "
        "restore it with 'mcap recover', 'ros2 bag reindex' or 'rosbag reindex'"
    ):
        read_log(path, JOINTS)


@pytest.mark.parametrize(
    ("name", "module", "purpose", "extra"),
    [
        ("mcap", "rosbags.rosbag2", "reading ROS bags and MCAP files needs rosbags", "bag"),
        ("ros1", "rosbags.rosbag1", "reading ROS bags and MCAP files needs rosbags", "bag"),
        ("hdf5", "h5py", "reading HDF5 and MATLAB v7.3 needs h5py", "hdf5"),
        ("mat 7.3", "h5py", "reading HDF5 and MATLAB v7.3 needs h5py", "hdf5"),
    ],
)
def test_without_its_library_a_format_says_how_to_install_it(
    tmp_path, monkeypatch, name, module, purpose, extra
):
    path = FORMATS[name](tmp_path, make_log())
    monkeypatch.setitem(sys.modules, module, None)
    text = (
        f"{purpose}, which is not installed: pip install '.[{extra}]' in a checkout of robotid, "
        f"or pip install 'robotid[{extra}]' where an index has it"
    )
    with refused(text, MissingDependencyError):
        read_log(path, JOINTS)
    if module == "h5py":
        with refused(text.replace("reading HDF5 and MATLAB v7.3", "writing HDF5"),
                     MissingDependencyError):  # fmt: skip
            write_log(make_log(), tmp_path / "out.h5")


# --- arrays ---------------------------------------------------------------------------------------


def test_groups_are_chosen_like_topics(tmp_path):
    log = make_log()
    path = tmp_path / "run.h5"
    with h5py.File(path, "w") as file:
        for group, arrays in (("left", wide(log, object)), ("right", {"time": log.t})):
            for name, values in arrays.items():
                file[f"{group}/{name}"] = values
    with pytest.raises(DataError) as caught:
        read_log(path, JOINTS)
    assert str(caught.value).startswith("run.h5 has 2 groups with a time: left, right; ")
    assert str(caught.value).endswith(f'. State one: topic = "left" {HOW}')
    assert_same(read_log(path, JOINTS, source=LogSource(topic="/left/")), log)
    with refused("run.h5 has no group 'lefd'; groups found: left, right. Did you mean "
                 "'left'?"):  # fmt: skip
        read_log(path, JOINTS, source=LogSource(topic="lefd"))


def test_arrays_without_joint_names_are_numbered_and_mapped(tmp_path):
    log = make_log()
    path = tmp_path / "run.npz"
    np.savez(path, time=log.t, q=log.q, tau=log.tau, mass=3.0, image=np.zeros((60, 2, 2)))
    by_order = read_log(path, JOINTS)
    assert_same(by_order, log, ("t", "q", "tau"))
    assert by_order.assumed == (
        "numbered columns are read in the order of the joints: 0 is shoulder, 1 is elbow",
    )
    numbered = LogSource(joints={"shoulder": "0", "elbow": "1"})
    assert_same(read_log(path, JOINTS, source=numbered), log, ("t", "q", "tau"))


def test_one_joint_needs_no_second_axis(tmp_path):
    log = make_log().select(["elbow"])
    for name, axis in (("flat", 0), ("column", slice(None))):
        path = tmp_path / f"{name}.npz"
        np.savez(path, t=log.t, q=log.q[:, axis], tau=log.tau[:, axis], joints=["elbow"])
        assert_same(read_log(path, ["elbow"]), log, ("t", "q", "tau"))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"tau": np.zeros((59, 2))},
            "run.npz: tau_shoulder has 59 samples, time has 60; record the same number of samples",
        ),
        (
            {"tau": np.zeros((60, 3))},
            "run.npz: tau has the shape (60, 3), but the file names 2 joints: shoulder, elbow; "
            "write one column per joint",
        ),
        (
            {"time": None},
            "run.npz has no column 'time'; columns found: q_shoulder, q_elbow, "
            "dq_shoulder, dq_elbow, tau_shoulder, tau_elbow. Rename it, or state in the job file: "
            'columns = { time = "NAME" }, or without time stamps the rate of the rows [Hz]: log = '
            "{ rate = 100 }",
        ),
        (
            {"tau": np.array([None] * 60)},
            "run.npz has no columns 'tau_shoulder', 'tau_elbow'; torque or current columns found: "
            "none. Record tau_<joint> or current_<joint>. Commanded positions, qref_<joint>, are "
            'enough for the estimator "simulation"',
        ),
    ],
)
def test_arrays_that_do_not_fit_are_refused(tmp_path, changes, message):
    arrays = {name: x for name, x in (wide(make_log()) | changes).items() if x is not None}
    np.savez(tmp_path / "run.npz", **arrays)
    with refused(message):
        read_log(tmp_path / "run.npz", JOINTS)


def test_matlab_texts_name_the_joints(tmp_path):
    log = make_log()
    names = ("elbow", "wrist")
    matrix = wide(log) | {"joints": np.array(names)}  # of characters
    column = wide(log) | {"joints": np.array(names)[:, None]}
    for path in (write_mat5(tmp_path / "5.mat", matrix), write_mat73(tmp_path / "7.mat", column)):
        assert_same(read_log(path, names), replace(log, joints=names))


# --- names ----------------------------------------------------------------------------------------


def test_joints_may_have_other_names_in_the_file(tmp_path):
    log = make_log()
    path = tmp_path / "run.csv"
    write_log(replace(log, joints=("M1", "M2")), path)
    source = LogSource(joints={"shoulder": "M1", "elbow": "M2"})
    back = read_log(path, JOINTS, source=source)
    assert_same(back, log)
    assert back.joints == JOINTS
    swapped = LogSource(joints={"M1": "M2", "M2": "M1"})
    np.testing.assert_array_equal(read_log(path, ("M1", "M2"), source=swapped).q, log.q[:, ::-1])
    with pytest.raises(DataError, match=r"^run.csv has no columns 'q_M3', 'tau_M3'; "):
        read_log(path, JOINTS, source=LogSource(joints={"shoulder": "M1", "elbow": "M3"}))
    with refused(
        "run.csv: log.joints renames 'elbo', which is not among the joints read: shoulder, "
        "elbow. Did you mean 'elbow'?",
        SettingsError,
    ):
        read_log(path, JOINTS, source=LogSource(joints={"elbo": "M2"}))


def test_a_topic_of_a_csv_file_is_noted(tmp_path):
    write_log(make_log(), tmp_path / "run.csv")
    back = read_log(tmp_path / "run.csv", JOINTS, source=LogSource(topic="/arm"))
    assert back.notes == ("the topic '/arm' is not used: .csv files have none",)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"effort": "percent"}, "effort is 'percent', wanted one of torque, current"),
        ({"stamp": "wall"}, "stamp is 'wall', wanted one of header, log, even"),
        ({"joints": {"elbow": 2}}, "joints.elbow is 2, wanted a name"),
    ],
)
def test_a_source_that_is_not_known_is_refused(settings, message):
    with refused(f"log: {message}", SettingsError):
        LogSource(**settings)


def test_reading_a_csv_file_loads_no_other_library(tmp_path):
    import subprocess

    write_log(make_log(), tmp_path / "run.csv")
    code = (
        "import sys\nfrom robotid.data.files.read import read_log\n"
        f"read_log({str(tmp_path / 'run.csv')!r}, {JOINTS!r})\n"
        "sys.exit(any(m.split('.')[0] in ('rosbags', 'h5py', 'pyarrow') for m in sys.modules))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_rows_are_read_from_any_place_that_a_scan_tells(tmp_path, suffix):
    rows = np.arange(20_000.0)
    path = tmp_path / f"run{suffix}"
    write_columns({"time": rows / 8, "q": -rows}, path)
    if suffix == ".parquet":  # in groups, as most programs write it
        pq.write_table(pq.read_table(path), path, row_group_size=3000)
    table = open_table(path, LogSource())
    places, blocks = [], []
    for block, place in table.rows.scan("q"):
        blocks.append(block)
        places.append(place)
    assert len(places) > 1
    assert [place.row for place in places] == np.cumsum([0, *map(len, blocks[:-1])]).tolist()
    np.testing.assert_array_equal(np.concatenate(blocks), -rows)
    assert table.rows.count() == 20_000
    for place in places:
        first, stop = place.row + 3, min(place.row + 5000, 20_000)
        found = table.rows.read(["q", "time"], first, stop, place)
        np.testing.assert_array_equal(found["q"], -rows[first:stop])
        np.testing.assert_array_equal(found["time"], rows[first:stop] / 8)
