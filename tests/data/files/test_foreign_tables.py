"""Logs that others named: PlotJuggler, DataFrames, rostopic, LeRobot; lists of logs."""

import dataclasses
import json
from dataclasses import replace
from functools import partial

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from helpers.corruptions import table_of
from helpers.recorders import assert_same, refused, write_lerobot
from helpers.synthetic import exact_log, sine_log, truth

import robotid
from robotid.base.exceptions import DataError, ModelError, SettingsError
from robotid.base.files import file_sha256, log_exists, source_entry
from robotid.cli.convert import convert
from robotid.cli.job import read_job
from robotid.data.files.read import open_table, read_log, read_logs, write_log
from robotid.data.files.table import Place
from robotid.data.log import Log
from robotid.data.signal_settings import LogSource, LogUnits
from robotid.robot.examples import example_urdf

JOINTS = ("shoulder", "elbow")
T = np.arange(60) / 50
LOG = sine_log(t=T)
WORDS = {"position": LOG.q, "velocity": LOG.v, "effort": LOG.tau}


def juggled(*topics, words=WORDS, scale=1.0):
    """Return the columns of PlotJuggler's export of joint states, in the order of their names."""
    columns = {
        f"{topic}/{joint}/{word}": scale * values[:, j]
        for topic in topics
        for word, values in words.items()
        for j, joint in enumerate(JOINTS)
    }
    return {"__time": LOG.t} | dict(sorted(columns.items()))


@pytest.fixture(params=["csv", "txt", "parquet", "frame"])
def given(request, tmp_path):
    """A function that makes a file or a DataFrame of columns."""

    def make(columns):
        frame = pd.DataFrame(columns)
        if signs := {"csv": ",.", "txt": ";,"}.get(request.param):  # between cells, of decimals
            path = tmp_path / f"run.{request.param}"
            frame.to_csv(path, index=False, sep=signs[0], decimal=signs[1])
        if request.param == "parquet":
            frame.to_parquet(tmp_path / "run.parquet")
        return frame if request.param == "frame" else tmp_path / f"run.{request.param}"

    return make


def test_plotjugglers_export_is_read(given):
    extra = {"/imu/linear_acceleration/x": LOG.t}
    back = read_log(given(juggled("/joint_states") | extra), JOINTS)
    assert_same(back, LOG)
    assert back.notes == ("columns ignored: /imu/linear_acceleration/x",)


def test_of_several_topics_that_with_efforts_is_taken_and_of_two_such_one_must_be_stated(given):
    ghost = juggled("/ghost", words={"position": LOG.q + 1.0})
    assert_same(read_log(given(juggled("/joint_states") | ghost), JOINTS), LOG)
    both = given(juggled("/left") | juggled("/right", scale=2.0))
    with pytest.raises(
        DataError, match="2 topics of joint states: /left, /right; its columns have"
    ):
        read_log(both, JOINTS)
    np.testing.assert_array_equal(
        read_log(both, JOINTS, source=LogSource(topic="/right")).tau, 2.0 * LOG.tau
    )
    with pytest.raises(DataError, match=r"no topic '/rigt'; topics: /left, /right\. Did you mean"):
        read_log(both, JOINTS, source=LogSource(topic="/rigt"))


def test_efforts_may_be_currents_and_columns_may_be_mapped_by_the_names_in_the_file(given):
    log = read_log(
        given(juggled("/joint_states")),
        JOINTS,
        gains={"elbow": 3.0, "shoulder": 2.0},
        source=LogSource(effort="current"),
    )
    np.testing.assert_allclose(log.tau, LOG.tau * [2.0, 3.0])
    columns = juggled("/js") | {"M2": 5 * LOG.tau[:, 1]}
    names = {"tau_elbow": "M2", "q_elbow": "/js/elbow/position"}
    mapped = read_log(given(columns), JOINTS, columns=names)
    np.testing.assert_array_equal(mapped.tau[:, 1], 5 * LOG.tau[:, 1])


def test_standard_columns_and_a_clock_count_more_than_those_of_plotjuggler(given):
    others = juggled("/a") | juggled("/b")
    del others["__time"]
    assert_same(read_log(given(table_of(LOG) | others), JOINTS), LOG)
    both = pd.DataFrame(juggled("/joints") | {"time": 7.0 + LOG.t})
    back = read_log(both, JOINTS)
    np.testing.assert_array_equal(back.t, 7.0 + LOG.t)
    assert back.notes == ("columns ignored: __time",)


def test_rows_of_a_file_are_read_by_the_same_names(tmp_path):
    pd.DataFrame(juggled("/joint_states")).to_csv(tmp_path / "run.csv", index=False)
    rows = open_table(tmp_path / "run.csv", LogSource()).rows
    assert rows.count() == 60
    (stamps,) = [values for values, _ in rows.scan("time")]
    np.testing.assert_array_equal(stamps, LOG.t)
    part = rows.read(["effort_elbow", "position_shoulder"], 10, 20, Place())
    np.testing.assert_array_equal(part["effort_elbow"], LOG.tau[10:20, 1])
    np.testing.assert_array_equal(part["position_shoulder"], LOG.q[10:20, 0])
    convert(tmp_path / "run.csv", tmp_path / "own.csv")
    assert_same(read_log(tmp_path / "own.csv", JOINTS), LOG)


def test_a_data_frame_may_have_time_as_its_index_or_come_from_another_library():
    frame = pd.DataFrame(juggled("/joint_states"))
    assert_same(read_log(frame.set_index("__time"), JOINTS), LOG)
    columns = juggled("/joint_states")

    class Other:
        def __getitem__(self, name):
            return columns[name].tolist()

    Other.columns = tuple(columns)
    assert_same(read_log(Other(), JOINTS), LOG)


def test_logs_are_given_one_or_several_of_every_kind(ur5, tmp_path, rng):
    log = exact_log(ur5, truth(ur5), rng, samples=100)
    write_log(log, tmp_path / "run.csv")
    table = pd.DataFrame(table_of(log))
    for one in (log, tmp_path / "run.csv", str(tmp_path / "run.csv"), table):
        for some in (one, [one], (x for x in [one])):
            (back,) = read_logs(some, ur5.joints)
            np.testing.assert_array_equal(back.tau, log.tau)
    assert len(read_logs([log, table, tmp_path / "run.csv"], ur5.joints)) == 3
    assert read_logs((), ur5.joints) == ()
    bare = replace(log, tau=0 * log.tau, has_torque=False)
    with pytest.raises(DataError, match="has no torque"):
        read_logs(bare, ur5.joints)
    (measured,) = read_logs(replace(bare, wrenches={"fz foot": log.t}), ur5.joints)  # is enough
    assert not measured.has_torque
    cases = ((3, "int"), ([log, None], "NoneType"), ({"q": 1}, "dict"), (log.q, "ndarray"))
    for wrong, kind in cases:
        with pytest.raises(DataError, match=f"^a log is a {kind}, expected a robotid.Log, the"):
            read_logs(wrong, ur5.joints)


def test_swapped_arguments_are_named(ur5, rng, tmp_path):
    log = exact_log(ur5, truth(ur5), rng, samples=100)
    urdf = example_urdf("ur5_robot.urdf")
    table = tmp_path / "run.csv"
    robotid.write_log(log, table)
    for given, robot, what in (
        (log, ur5, "a Log"),
        ([log], urdf, "a list"),
        (table, ur5, "the file run.csv"),
        (str(table), str(urdf), "the file run.csv"),
    ):
        for call in (robotid.identify, partial(robotid.payload, reference=[log])):
            with pytest.raises(ModelError, match=rf"model is {what}, and .*; swap the two"):
                call(given, robot)
    with pytest.raises(ModelError, match="model is a Log, expected a RobotModel or the path"):
        robotid.identify(log, log)


def test_names_that_differ_in_case_alone_are_to_be_renamed(ur5, rng):
    log = exact_log(ur5, truth(ur5), rng, samples=100)
    names = tuple(name.upper() for name in ur5.joints[:2]) + ur5.joints[2:]
    other = replace(log, joints=names)
    with pytest.raises(DataError) as refusal:
        read_logs(other, ur5.joints)
    said = str(refusal.value)
    assert said.startswith(
        "log has the joints SHOULDER_PAN_JOINT, SHOULDER_LIFT_JOINT, which are "
        "shoulder_pan_joint, shoulder_lift_joint in the model; rename them: "
        "dataclasses.replace(log, joints="
    )
    renamed = eval(said.rpartition("rename them: ")[2], {"dataclasses": dataclasses, "log": other})
    (back,) = read_logs(renamed, ur5.joints)
    np.testing.assert_array_equal(back.q, log.q)


def test_a_log_is_taken_by_the_names_of_its_joints(ur5, rng):
    log = exact_log(ur5, truth(ur5), rng, samples=100)
    (back,) = read_logs(log.select(ur5.joints[::-1]), ur5.joints)
    assert back.joints == ur5.joints
    np.testing.assert_array_equal(back.tau, log.tau)
    with refused(
        "log has the joints elbow_joint, but not wrist_1_joint, which the model has; record them, "
        "or if they were at rest, lock them at their positions: RobotModel.from_urdf(..., "
        "locked={'wrist_1_joint': 0.0})"
    ):
        read_logs(log.select(["elbow_joint"]), ["elbow_joint", "wrist_1_joint"])
    names = [f"panda_joint{k}" for k in range(1, 8)]  # a finger mimics another without columns
    log = pd.DataFrame({"time": T} | {f"{x}_{name}": T for x in ("q", "tau") for name in names})
    with pytest.raises(
        DataError, match="them there, as --lock panda_finger_joint1=0 --lock panda_"
    ):
        robotid.identify(example_urdf("panda.urdf"), log)


NANOSECONDS = 1_700_000_000_000_000_000 + (T * 1e9).round().astype(int)


def test_rostopics_export_names_the_joints_in_its_rows(given):
    """rostopic echo -p: the time of arrival, the stamp, and texts beside the numbers."""
    columns = {"%time": NANOSECONDS + 7_000_000, "field.header.seq": range(60)}
    columns |= {"field.header.stamp": NANOSECONDS, "field.header.frame_id": ["base"] * 60}
    columns |= {f"field.name{k}": [name] * 60 for k, name in enumerate(JOINTS)}
    for word, values in WORDS.items():
        columns |= {f"field.{word}{k}": values[:, k] for k in range(2)}
    back = read_log(given(columns), JOINTS[::-1], units=LogUnits(time="ns"))
    np.testing.assert_allclose(back.t, 1.7e9 + T, rtol=0, atol=5e-7)
    np.testing.assert_array_equal(back.q, LOG.q[:, ::-1])
    np.testing.assert_array_equal(back.tau, LOG.tau[:, ::-1])
    assert "columns ignored: %time" in back.notes[0]


@pytest.mark.parametrize(("sec", "nanosec"), [("sec", "nanosec"), ("stamp.secs", "stamp.nsecs")])
def test_seconds_and_nanoseconds_are_one_stamp(given, sec, nanosec):
    columns = {nanosec: NANOSECONDS % 10**9, sec: NANOSECONDS // 10**9}
    columns |= {f"{joint}_pos": LOG.q[:, k] for k, joint in enumerate(JOINTS)}
    columns |= {f"{joint}_eff": LOG.tau[:, k] for k, joint in enumerate(JOINTS)}
    back = read_log(given(columns), JOINTS)
    np.testing.assert_allclose(back.t, 1.7e9 + T, rtol=0, atol=5e-7)
    np.testing.assert_array_equal(back.tau, LOG.tau)
    assert back.notes == ()


@pytest.mark.parametrize("suffix", [".csv", ".dat", ".txt"])
def test_a_job_states_names_and_rate_of_a_file_without_them(ur5, tmp_path, rng, suffix):
    log = exact_log(ur5, truth(ur5), rng, samples=300, rate=50.0)
    table = np.hstack([log.q, log.tau])
    separator = "," if suffix == ".csv" else " "
    np.savetxt(tmp_path / f"run{suffix}", table, fmt="%.17g", delimiter=separator)
    names = [f"{kind}_{joint}" for kind in ("q", "tau") for joint in log.joints]
    job = f'urdf = "{ur5.tree.path}"\n[log]\nnames = {names}\nrate = 50\n'
    (tmp_path / "job.toml").write_text(f'{job}[[identification]]\nlog = "run{suffix}"\n')
    job = read_job(tmp_path / "job.toml")
    back = job.read(job.identification[0], ur5)
    np.testing.assert_array_equal(back.tau, log.tau)
    np.testing.assert_allclose(back.t, np.arange(300) / 50, rtol=0, atol=1e-12)
    rows = open_table(tmp_path / f"run{suffix}", job.source).rows
    (stamps,) = [values for values, _ in rows.scan("time")]
    part = rows.read(["time", "tau_elbow_joint"], 100, 120, Place())
    np.testing.assert_array_equal(stamps, back.t)
    np.testing.assert_array_equal(part["time"], back.t[100:120])
    np.testing.assert_array_equal(part["tau_elbow_joint"], log.tau[100:120, 2])


def test_names_that_do_not_fit_and_a_rate_that_is_not_needed_are_told(tmp_path):
    np.savez(tmp_path / "run.npz", data=np.hstack([LOG.q, LOG.tau]))
    names = ("q_shoulder", "q_elbow", "tau_shoulder", "tau_elbow")
    back = read_log(tmp_path / "run.npz", JOINTS, source=LogSource(names=names, rate=50.0))
    np.testing.assert_array_equal(back.tau, LOG.tau)
    with refused("run.npz has 4 columns, but log.names has 3; name each column, in their order"):
        read_log(tmp_path / "run.npz", JOINTS, source=LogSource(names=names[:3], rate=50.0))
    timed = read_log(pd.DataFrame(juggled("/arm")), JOINTS, source=LogSource(rate=7.0))
    np.testing.assert_array_equal(timed.t, LOG.t)
    assert timed.notes == ("log.rate is not used: the log has time stamps",)


def make_log(count):
    t = np.arange(count) / 50
    q = np.sin(t[:, None] * [2.0, 3.0])
    return Log(t, q, 0 * q, JOINTS, q_ref=np.sin(t[:, None] * [2.0, 3.0] + 0.1), has_torque=False)


DEGREES = LogUnits(angle="deg")


MOTORS = {
    "v2.0": {"observation.state": {"motors": list(JOINTS)}, "action": {"motors": list(JOINTS)}},
    "v2.1": {key: list(JOINTS) for key in ("observation.state", "action")},
    "v3.0": {key: [f"{j}.pos" for j in JOINTS] for key in ("observation.state", "action")},
}


def dataset(folder, version="v2.1", episodes=(0,)):
    logs = {number: make_log(100 + number) for number in episodes}
    moves = {n: (np.rad2deg(log.q) + n, np.rad2deg(log.q_ref)) for n, log in logs.items()}
    return write_lerobot(folder / "arm", moves, MOTORS[version], version=version)


@pytest.mark.parametrize("version", MOTORS)
def test_an_episode_of_lerobot_is_read(tmp_path, version):
    path, log = dataset(tmp_path, version), make_log(100)
    back = read_log(path, JOINTS[::-1], needs="commands", units=DEGREES).select(JOINTS)
    np.testing.assert_allclose(back.t, np.arange(100) / 50, atol=1e-6)
    np.testing.assert_allclose(back.q, log.q, atol=1e-6)
    np.testing.assert_allclose(back.q_ref, log.q_ref, atol=1e-6)
    assert (back.has_torque, back.v_ref) == (False, None)
    assert back.notes == (
        "episode 0: its time stamps are frame numbers over the frame rate, so the delay "
        "between commands and positions has an error of up to one frame",
    )


def test_frames_of_an_episode_are_in_their_order_whatever_that_of_the_rows_and_files(tmp_path, rng):
    path = dataset(tmp_path, "v3.0", episodes=(0, 3))
    (file,) = path.glob("data/**/*.parquet")
    table = pq.read_table(file)
    table = table.take(rng.permutation(len(table)))
    for k, rows in enumerate((slice(0, 90), slice(90, 150), slice(150, None))):
        part = table.take(np.arange(len(table))[rows])
        pq.write_table(part, file.with_name(f"file-00{2 - k}.parquet"))
    for number in (0, 3):
        source, log = LogSource(topic=f"episode_{number}"), make_log(100 + number)
        back = read_log(path, JOINTS, needs="commands", units=DEGREES, source=source)
        np.testing.assert_allclose(back.t, np.arange(100 + number) / 50, atol=1e-6)
        np.testing.assert_allclose(back.q, log.q + np.deg2rad(number), atol=1e-6)
        np.testing.assert_allclose(back.q_ref, log.q_ref, atol=1e-6)


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_each_log_of_a_job_is_an_episode_of_its_own(tmp_path, version):
    path = dataset(tmp_path, version, episodes=(3, 12))
    logs = {number: path / f"episode_{number}" for number in (12, 3)}
    for number, episode in logs.items():
        log = read_log(episode, JOINTS, needs="commands", units=DEGREES)
        assert log.name == f"episode_{number}"
        q = make_log(100 + number).q + np.deg2rad(number)
        np.testing.assert_allclose(log.q, q, atol=1e-6)
    with pytest.raises(DataError, match="arm has no episode 'episode_4'"):
        read_log(path / "episode_4", JOINTS, needs="commands", units=DEGREES)
    other = LogSource(topic="episode_3")
    with pytest.raises(SettingsError, match=r"topic is 'episode_3', but the log is episode_12 of"):
        read_log(logs[12], JOINTS, needs="commands", source=other)
    first, second = map(file_sha256, logs.values())
    assert len({first, second, file_sha256(path)}) == 3
    assert source_entry(str(logs[3])) == {"path": str(logs[3]), "sha256": second}
    (file, *_) = sorted(path.glob("data/**/*.parquet"))
    file.write_bytes(b"x")
    assert file_sha256(logs[12]) != first
    assert log_exists(logs[12])
    assert not log_exists(tmp_path / "episode_3")


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_one_episode_of_several_is_stated(tmp_path, version):
    path = dataset(tmp_path, version, episodes=(0, 3, 12))
    with pytest.raises(DataError, match=r"arm has 3 episodes: episode_0, episode_12, episode_3"):
        read_log(path, JOINTS, needs="commands", units=DEGREES)
    for topic in ("episode_3", "3", "episode_000003"):
        source = LogSource(topic=topic)
        log = read_log(path, JOINTS, needs="commands", units=DEGREES, source=source)
        assert len(log.t) == 103
        np.testing.assert_allclose(log.q, make_log(103).q + np.deg2rad(3), atol=1e-6)


@pytest.mark.parametrize("topic", ["9" * 5000, "²", "episode_٠", "-0", "x"])
def test_an_episode_that_no_dataset_has_is_refused(tmp_path, topic):
    with pytest.raises(DataError, match=r"no episode '.{1,43}'; episodes: episode_0"):
        read_log(dataset(tmp_path), JOINTS, units=DEGREES, source=LogSource(topic=topic))


def test_normalised_positions_are_no_angles(tmp_path):
    with pytest.raises(DataError) as error:
        read_log(dataset(tmp_path), JOINTS, needs="commands")
    assert error.value.code == "angle_unit"
    wanted = "arm: LeRobot's files lack the unit of positions: degrees, or normalised positions"
    assert str(error.value).startswith(wanted)


MISSING, NAMELESS = object(), "no names of the motors in ac"
DOUBLE = "same name for .* of action, number 1, and number 0 of action; give each motor another"


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (MISSING, "does not describe a LeRobot dataset of version 2"),
        (None, "features is None, expected a table of tables"),
        ({"action": 5}, "expected a table of tables"),
        ({"image": {}}, "neither observation.state nor action"),
        *[({"action": {"names": names}}, NAMELESS)
          for names in (None, 5, {"m": 5}, [["a"], 5])],
        ({"action": {"names": ["a", *JOINTS]}}, "at least 3 names of motors"),
        ({"action": {"names": [JOINTS[0], JOINTS[0]]}}, DOUBLE),
        ({"action": {"names": [f"{JOINTS[0]}.pos", JOINTS[0]]}}, DOUBLE),
    ],
)  # fmt: skip
def test_datasets_that_do_not_fit_are_refused(tmp_path, change, text):
    path = dataset(tmp_path)
    file = path / "meta" / "info.json"
    info = json.loads(file.read_text())
    features = info.pop("features")
    if change is not MISSING:
        info["features"] = features | change if change and "action" in change else change
    file.write_text(json.dumps(info))
    with pytest.raises(DataError, match=text):
        read_log(path, JOINTS, needs="commands", units=DEGREES)


@pytest.mark.parametrize("text", ["[" * 5000, "{", '{"features": ' * 60 + "1" + "}" * 60, "5"])
def test_a_description_that_is_none_is_refused(tmp_path, text):
    path = dataset(tmp_path)
    (path / "meta" / "info.json").write_text(text)
    with pytest.raises(DataError, match=r"info\.json"):
        read_log(path, JOINTS, needs="commands", units=DEGREES)
