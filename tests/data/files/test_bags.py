"""Bags: topics, clocks, commands of controllers, and sensors at other stamps than joints."""

import re
import sqlite3
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.recorders import (
    JOINT_STATE,
    StoragePlugin,
    get_types_from_msg,
    joint_state,
    messages_of,
    refused,
    to_ns,
    types_of,
    write_bag,
    write_controller,
    write_idl_controller,
    write_mcap,
    write_states,
)
from helpers.synthetic import sine_log
from mcap.writer import Writer as McapLibraryWriter

from robotid.base.exceptions import DataError, SettingsError
from robotid.cli import main
from robotid.data.base_motion import BaseColumns, ImuFrame, quaternions_of_angles
from robotid.data.files import bags
from robotid.data.files.read import read_log, write_log
from robotid.data.log import COLUMNS
from robotid.data.signal_settings import LogSource

JOINTS = ("shoulder", "elbow")
STATE = "sensor_msgs/msg/JointState"
HOW = "(job file table [log], CLI --topic)"


def make_log(**changes):
    """Return a log of commands, without torque."""
    log = sine_log()
    commands = {"q_ref": log.q + 0.1, "v_ref": 0.9 * log.v, "tau_ref": log.tau}
    return replace(log, **({"tau": 0 * log.tau, "has_torque": False} | commands | changes))


def assert_same(back, log):
    assert back.has_torque == log.has_torque
    for name in ("t", *COLUMNS.values()):
        np.testing.assert_array_equal(getattr(back, name), getattr(log, name), name)


def test_the_clock_is_the_header_unless_stated(tmp_path):
    log = sine_log()
    path = write_mcap(tmp_path / "run.mcap", messages_of(log), delay=lambda _: 0.25)
    assert_same(read_log(path, JOINTS), log)
    back = read_log(path, JOINTS, source=LogSource(stamp="log"))
    np.testing.assert_allclose(back.t, log.t + 0.25, atol=1e-9)


def test_the_topic_must_be_stated_if_several_would_do(tmp_path):
    log = sine_log()
    topics = {"/arm": messages_of(log), "/ghost": messages_of(replace(log, q=log.q + 1))}
    path = write_states(tmp_path / "bag", topics, others=["/chatter"])
    listing = (
        f"topics: {{'/arm': '{STATE}', '/chatter': 'std_msgs/msg/String', '/ghost': '{STATE}'}}"
    )
    with refused(
        f'bag has 2 topics of {STATE}: /arm, /ghost; {listing}. Set one: topic = "/arm" {HOW}'
    ):
        read_log(path, JOINTS)
    assert_same(read_log(path, JOINTS, source=LogSource(topic="/arm")), log)
    with refused(f"bag has no topic '/arn'; {listing}. Did you mean '/arm'?"):
        read_log(path, JOINTS, source=LogSource(topic="/arn"))
    kinds = f"{STATE} or control_msgs/msg/JointTrajectoryControllerState"
    with refused(
        f"bag: topic '/chatter' has messages of std_msgs/msg/String, expected {kinds}; {listing}"
    ):
        read_log(path, JOINTS, source=LogSource(topic="/chatter"))


def test_a_bag_without_joint_states_lists_what_it_holds(tmp_path):
    path = write_states(tmp_path / "bag", {"/joint_states": []}, others=["/chatter"])
    listing = f"topics: {{'/chatter': 'std_msgs/msg/String', '/joint_states': '{STATE}'}}"
    with refused(f"bag has no message of {STATE}; {listing}"):
        read_log(path, JOINTS)
    with refused(f"bag: topic '/joint_states' has no message; {listing}"):
        read_log(path, JOINTS, source=LogSource(topic="/joint_states"))


def test_other_messages_are_passed_over_and_values_are_checked_as_in_any_log(tmp_path):
    log = sine_log()
    finger = [(t + 0.003, ["finger"], [0.5], [], []) for t in log.t]
    messages = sorted([*messages_of(log), *finger], key=lambda message: message[0])
    back = read_log(write_mcap(tmp_path / "run.mcap", messages), JOINTS)
    assert_same(back, log)
    assert back.notes == ("columns ignored: position_finger",)
    bare = [(*message[:4], []) for message in messages_of(log)]
    with pytest.raises(DataError, match="no columns 'tau_shoulder', 'tau_elbow'; no torque or c"):
        read_log(write_mcap(tmp_path / "bare.mcap", bare), JOINTS)
    path = write_mcap(tmp_path / "deg.mcap", messages_of(replace(log, q=20 * log.q)))
    with pytest.raises(DataError, match=r"^deg.mcap: .* looks like degrees"):
        read_log(path, JOINTS)
    unstamped = [(0.0, *message[1:]) for message in messages_of(log)]
    path = write_states(tmp_path / "bag", {"/joint_states": unstamped}, delay=1.0)
    with pytest.raises(DataError, match="header stamps of all 60 messages are 0"):
        read_log(path, JOINTS)
    t, names, q, v, tau = next(messages_of(log))
    for fragment, message in (
        ("has 1 values of velocity", (t + 9, names, q, v[:1], tau)),
        ("names elbow twice", (t + 9, ["elbow", "elbow"], q, v, tau)),
    ):
        path = write_mcap(tmp_path / f"{fragment[:5]}.mcap", [*messages_of(log), message])
        with pytest.raises(DataError, match=f"message 60 on '/joint_states' .*{fragment}"):
            read_log(path, JOINTS)
    path = write_mcap(
        tmp_path / "part.mcap", [*messages_of(log), (t + 9, ["elbow"], q[:1], [], [])]
    )
    with pytest.raises(
        DataError, match=r"1 of 61 messages lack some, message 60 lacks position_shoulder"
    ):
        read_log(path, JOINTS)
    current = LogSource(effort="current")
    gains = {"shoulder": 2.0, "elbow": 3.0}
    path = write_mcap(tmp_path / "amperes.mcap", messages_of(log))
    back = read_log(path, JOINTS, source=current, gains=gains)
    np.testing.assert_array_equal(back.tau, log.tau * [2.0, 3.0])


def test_an_mcap_file_that_is_not_of_ros2_says_so(tmp_path):
    with (tmp_path / "run.mcap").open("wb") as file:
        writer = McapLibraryWriter(file)
        writer.start(profile="ros1")
        writer.finish()
    with pytest.raises(DataError, match=r"foreign bag \(Profile is not ros2.\); record it again"):
        read_log(tmp_path / "run.mcap", JOINTS)


# --- commands -------------------------------------------------------------------------------------


@pytest.mark.parametrize("era", ["old", "new"])
@pytest.mark.parametrize("suffix", ["", ".bag"])
@pytest.mark.parametrize("has_torque", [True, False])
def test_the_state_of_a_trajectory_controller_is_read(tmp_path, era, suffix, has_torque):
    log = make_log(has_torque=has_torque)
    log = replace(log, tau=log.q * 3) if has_torque else log
    path = write_controller(tmp_path / f"run{suffix}", log, era)
    back = read_log(path, JOINTS, needs="commands")
    assert_same(back, log)
    assert back.notes == ()


def test_definitions_in_idl_are_read(tmp_path):
    path = write_idl_controller(tmp_path / "run.mcap", make_log())
    assert_same(read_log(path, JOINTS, needs="commands"), make_log())


def test_a_controller_beside_joint_states_is_named(tmp_path):
    log = make_log(has_torque=True, tau=np.ones((60, 2)))
    path = write_controller(tmp_path / "run", log, "new", states=list(messages_of(log)))
    note = (
        "commands are in topics that are not read: /arm_controller/state; topic = "
        '"/arm_controller/state" reads them and their measured positions'
    )
    assert read_log(path, JOINTS).notes == (note,)
    with pytest.raises(DataError, match=r"no columns 'qref_.* commands are in topics that"):
        read_log(path, JOINTS, needs="commands")
    source = LogSource(topic="/arm_controller/state")
    assert_same(read_log(path, JOINTS, needs="commands", source=source), log)


def test_a_bag_without_the_controllers_definition_says_what_to_do(tmp_path):
    path = write_controller(tmp_path / "run", make_log(), "new", plugin=StoragePlugin.SQLITE3)
    assert len(read_log(path, JOINTS, needs="commands").t) == 60
    with sqlite3.connect(next(path.glob("*.db3"))) as file:
        file.execute("DELETE FROM message_definitions")
    file.close()
    with pytest.raises(
        DataError, match=r"^run does not contain the definition of control_msgs/msg/"
    ):
        read_log(path, JOINTS, needs="commands")


COMMANDS = LogSource(topic="/joint_states", command="/joint_commands")


def paired(log, *, late=0.0035, every=1, first=0):
    """Messages of a log, and of its commands at other times, each to be held until the next."""
    told = replace(log, t=log.t + late, q=log.q_ref, v=None, tau=0 * log.q)
    commands = [(*message[:4], []) for message in messages_of(told)][first::every]
    states = [(*message[:4], []) for message in messages_of(log)]
    return {"/joint_states": states, "/joint_commands": commands}


def test_two_topics_of_joint_states_are_joined_by_holding_the_last_command(tmp_path):
    log = make_log(v_ref=None, tau_ref=None)
    path = write_states(tmp_path / "bag", paired(log, every=2, first=4))
    back = read_log(path, JOINTS, needs="commands", source=COMMANDS)
    # commands 4, 6, ... come 3.5 ms after rows 4, 6, ...: row 5 is the first with one
    np.testing.assert_array_equal(back.t, log.t[5:])
    held = (np.arange(5, 60) - 1) // 2 * 2
    np.testing.assert_array_equal(back.q_ref, log.q_ref[held])
    np.testing.assert_array_equal(back.q, log.q[5:])
    np.testing.assert_array_equal(back.v, log.v[5:])
    assert (back.v_ref, back.has_torque) == (None, False)
    assert back.notes == (
        "a zero-order hold is applied to the commands of topic '/joint_commands', with a median "
        "interval of 40 ms; messages before the first command, left out: 5; messages after the "
        "last command: 1",
    )
    only = LogSource(command="/joint_commands")
    assert_same(read_log(path, JOINTS, needs="commands", source=only), back)
    assert len(read_log(path, JOINTS, needs="motion", source=COMMANDS).t) == 55


def test_commands_of_a_topic_go_before_those_of_a_controllers_own_state(tmp_path):
    log = make_log()
    told = replace(log, q=log.q_ref + 1)
    path = write_controller(tmp_path / "run", log, "new", states=list(messages_of(told)))
    source = LogSource(topic="/arm_controller/state", command="/joint_states")
    back = read_log(path, JOINTS, needs="commands", source=source)
    np.testing.assert_array_equal(back.q_ref, log.q_ref + 1)
    np.testing.assert_array_equal(back.q, log.q)


def test_topics_of_commands_that_cannot_be_are_refused(tmp_path):
    path = write_states(tmp_path / "bag", paired(make_log()), others=["/chatter"])
    for source, text in (
        (LogSource(command="/joint_comands"), "bag has no topic '/joint_comands'; topics: "),
        (
            LogSource(command="/chatter"),
            "bag: topic '/chatter' has messages of std_msgs/msg/String, expected",
        ),
        (replace(COMMANDS, topic="/joint_commands"), "bag: topic and command are both '/joint_co"),
    ):
        with pytest.raises(DataError, match=text):
            read_log(path, JOINTS, needs="commands", source=source)
    write_log(make_log(), tmp_path / "run.csv")
    with pytest.raises(SettingsError, match=r"the topic of a bag, but run\.csv is no bag"):
        read_log(tmp_path / "run.csv", JOINTS, needs="commands", source=COMMANDS)


ODOMETRY, IMU = "nav_msgs/msg/Odometry", "sensor_msgs/msg/Imu"
WRENCH, LOW_STATE = "geometry_msgs/msg/WrenchStamped", "unitree_go/msg/LowState"
LEG = ("hip", "knee")
T = 5.0 + np.arange(40) / 100  # [s] of the joints
S = 5.0 + np.arange(21) / 50 + 0.003  # [s] of the sensors
BASE = BaseColumns(True)
DEFINITION = (
    "float32[4] quaternion\nfloat32[3] gyroscope\nfloat32[3] accelerometer\n",
    "float32 q\nfloat32 dq\nfloat32 tau_est\n",
    "unitree_go/IMUState imu_state\nunitree_go/MotorState[3] motor_state\nint16[4] foot_force\n",
)


def angles(t):
    return np.column_stack([0.3 * t, -0.2 * t, 1.0 + 0.5 * t])


def places(t):
    return np.column_stack([t, 2.0 - t, 0.3 + 0.1 * t])


class Maker:
    """Messages of a store, by type."""

    def __init__(self, path):
        self.types = types_of(path)
        kinds = [f"unitree_go/msg/{x}" for x in ("IMUState", "MotorState", "LowState")]
        for kind, text in zip(kinds, DEFINITION, strict=True):
            self.types.register(get_types_from_msg(text, kind))

    def new(self, kind, *values):
        return self.types.types[kind](*values)

    def xyz(self, values, kind="geometry_msgs/msg/Vector3"):
        return self.new(kind, *map(float, values))

    def header(self, t, frame):
        header = joint_state(self.types, to_ns(t), [], [], [], []).header
        header.frame_id = frame
        return header

    def quaternion(self, t):
        q = quaternions_of_angles(angles(np.array([t])))[0] * (-1.0 if t > 5.2 else 1.0)
        return self.new("geometry_msgs/msg/Quaternion", *q)

    def odometry(self, t, shift=0.0):
        pose = self.new(
            "geometry_msgs/msg/Pose", self.xyz(places(t)[0] + shift, "geometry_msgs/msg/Point"),
            self.quaternion(t),
        )  # fmt: skip
        twist = self.new("geometry_msgs/msg/Twist", self.xyz([t, 2, 3]), self.xyz([4, 5, t]))
        nothing = np.zeros(36)
        return self.new(
            ODOMETRY, self.header(t, "odom"), "trunk",
            self.new("geometry_msgs/msg/PoseWithCovariance", pose, nothing),
            self.new("geometry_msgs/msg/TwistWithCovariance", twist, nothing),
        )  # fmt: skip

    def imu(self, t, known=True):
        covariance = np.zeros(9)
        orientation = covariance if known else np.append(-1.0, covariance[1:])
        return self.new(
            IMU, self.header(t, "imu_link"), self.quaternion(t), orientation,
            self.xyz([0.1, 0.2, t]), covariance, self.xyz([t, 0.5, 9.81]), covariance,
        )  # fmt: skip

    def wrench(self, t, frame="l_sole"):
        own = self.new("geometry_msgs/msg/Wrench", self.xyz([1, 2, 10 * t]), self.xyz([4, t, 6]))
        return self.new(WRENCH, self.header(t, frame), own)

    def low_state(self, t):
        q = self.quaternion(t)
        imu = self.new(
            "unitree_go/msg/IMUState", np.array([q.w, q.x, q.y, q.z], np.float32),
            np.array([0.1, 0.2, t], np.float32), np.array([t, 0.5, 9.81], np.float32),
        )  # fmt: skip
        motors = [self.new("unitree_go/msg/MotorState", t, k, k - t) for k in range(3)]
        return self.new(LOW_STATE, imu, motors, np.array([20, 30, 40, 50], np.int16))


def write(path, topics, plugin=StoragePlugin.MCAP):
    """Write joint states and {topic: (type, {stamp: make message})}."""
    maker = Maker(path)
    written = {  # recorded one after the other, whatever their stamps
        topic: (kind, [(5.0 + 0.01 * k, make(maker, t)) for k, t in enumerate(stamps)])
        for topic, (kind, stamps, make) in topics.items()
    }
    return write_bag(path, written, maker.types, plugin)


def joints(maker, t):
    return joint_state(maker.types, to_ns(t), LEG, [t, 2 * t], [1, 2], [3, t])


LEG_STATES = {"/joint_states": (JOINT_STATE, T, joints)}
ODOM = {"/odom": (ODOMETRY, S, Maker.odometry)}
FORCE = {"/left": (WRENCH, S, Maker.wrench)}
INERTIAL = {"/imu": (IMU, S, Maker.imu)}


@pytest.mark.parametrize("name", ["log", "log.bag"])
def test_odometry_is_interpolated_at_the_stamps_of_the_joints(tmp_path, name):
    path = write(tmp_path / name, LEG_STATES | ODOM | FORCE)
    log = read_log(path, LEG, base=BASE)
    np.testing.assert_allclose(log.t, T[1:])  # the first joint state is before the odometry
    np.testing.assert_allclose(log.q[:, 1], 2 * log.t)
    np.testing.assert_allclose(log.base.pose[:, :3], places(log.t), atol=1e-12)
    wanted = quaternions_of_angles(angles(log.t))
    sign = np.sign(np.sum(log.base.pose[:, 3:] * wanted, axis=1))
    np.testing.assert_allclose(log.base.pose[:, 3:] * sign[:, None], wanted, atol=1e-5)
    np.testing.assert_allclose(log.base.twist[:, [0, 1, 2, 3, 4]], np.column_stack(
        [log.t, *np.tile([[2.0], [3.0], [4.0], [5.0]], len(log.t))]))  # fmt: skip
    np.testing.assert_allclose(log.base.twist[:, 5], log.t)
    assert log.notes == ("interpolated at the stamps of the joints: topic '/odom'",)
    plain = read_log(path, LEG)
    assert len(plain.t) == len(T)
    assert not plain.notes


def test_wrenches_have_the_axes_of_their_frame(tmp_path):
    path = write(tmp_path / "log", LEG_STATES | {"/left": (WRENCH, np.roll(S, 7), Maker.wrench)})
    wanted = BaseColumns(wrenches=("fz l_sole", "my l_sole"), local=("l_sole",))
    log = read_log(path, LEG, base=wanted)
    np.testing.assert_allclose(log.wrenches["fz l_sole"], 10 * log.t)
    np.testing.assert_allclose(log.wrenches["my l_sole"], log.t)
    with pytest.raises(DataError, match=r"wrench_fz_l_sole.* axes of their frames.*axes = 'link'"):
        read_log(path, LEG, base=BaseColumns(wrenches=("fz l_sole",)))


@pytest.mark.parametrize(("late", "early"), [("/odom", "/left"), ("/left", "/odom")])
def test_rows_lie_between_the_messages_of_all_topics(tmp_path, late, early):
    stamps = {late: S, early: S - 0.1}  # 5.003 to 5.403 s, 4.903 to 5.303 s
    topics = {"/odom": (ODOMETRY, Maker.odometry), "/left": (WRENCH, Maker.wrench)}
    sensors = {name: (kind, stamps[name], make) for name, (kind, make) in topics.items()}
    path = write(tmp_path / "log", LEG_STATES | sensors)
    wanted = BaseColumns(True, wrenches=("fz l_sole",), local=("l_sole",))
    log = read_log(path, LEG, base=wanted)
    np.testing.assert_allclose(log.t, T[1:31])  # 5.01 to 5.30 s
    np.testing.assert_allclose(log.wrenches["fz l_sole"], 10 * log.t)
    np.testing.assert_allclose(log.base.pose[:, :3], places(log.t), atol=1e-12)


def test_a_bag_is_converted_with_base_and_forces(tmp_path, capsys):
    path, target = write(tmp_path / "log", LEG_STATES | ODOM | FORCE), tmp_path / "log.csv"
    wanted = BaseColumns(True, wrenches=("fz l_sole", "my l_sole"), local=("l_sole",))
    assert main(["convert", str(path), str(target), "--joints", "knee"]) == 0
    assert "axes = 'link' in [[contact]]" in capsys.readouterr().out
    one, other = (read_log(x, ["knee"], base=wanted) for x in (path, target))
    np.testing.assert_array_equal(one.base.pose, other.base.pose)
    np.testing.assert_array_equal(one.base.twist, other.base.twist)
    np.testing.assert_array_equal(other.wrenches["fz l_sole"], one.wrenches["fz l_sole"])
    np.testing.assert_allclose(other.wrenches["my l_sole"], other.t)
    twice = write(tmp_path / "twice", LEG_STATES | ODOM | {"/mocap": ODOM["/odom"]})
    assert main(["convert", str(twice), str(target)]) == 1
    assert "log has 2 topics" in capsys.readouterr().err.replace("twice", "log")
    assert main(["convert", str(twice), str(target), "--sensors", "/odom"]) == 0
    np.testing.assert_allclose(read_log(target, LEG, base=BASE).base.twist[:, 1], 2.0)


def test_one_of_several_topics_is_stated(tmp_path):
    none = {"/mocap/odom": (ODOMETRY, S[:0], lambda m, t: m.odometry(t, 1.0))}
    empty = read_log(write(tmp_path / "empty", LEG_STATES | ODOM | none), LEG, base=BASE)
    np.testing.assert_allclose(empty.base.pose[:, 0], empty.t, atol=1e-9)
    other = {"/mocap/odom": (ODOMETRY, S, lambda m, t: m.odometry(t, 1.0))}
    path = write(tmp_path / "log", LEG_STATES | ODOM | other)
    with pytest.raises(
        DataError,
        match=re.escape(
            "log has 2 topics with base_x: /mocap/odom, /odom. Set all topics of sensors to "
            'read: sensors = ["/mocap/odom"]'
        ),
    ):
        read_log(path, LEG, base=BASE)
    assert len(read_log(path, LEG).t) == len(T)
    for topic, shift in (("/odom", 0.0), ("/mocap/odom", 1.0)):
        source = LogSource(sensors=(topic,))
        log = read_log(path, LEG, base=BASE, source=source)
        np.testing.assert_allclose(log.base.pose[:, 0], log.t + shift, atol=1e-9)
    for topic, message in (
        ("/odo", "no message of a topic '/odo', given in sensors"),
        ("/joint_states", "topic '/joint_states', given in sensors, has messages of sensor_"),
    ):
        with pytest.raises(DataError, match=message):
            read_log(path, LEG, source=LogSource(sensors=(topic,)))


def test_a_bag_without_odometry_names_what_is_missing(tmp_path):
    path = write(tmp_path / "log", LEG_STATES | INERTIAL)
    with pytest.raises(DataError, match=r"no column base_x, .*columns of the base found: imu_qx"):
        read_log(path, LEG, base=BASE)
    late = {"/odom": (ODOMETRY, S + 10.0, Maker.odometry)}
    path = write(tmp_path / "late", LEG_STATES | late)
    with pytest.raises(DataError, match=r"'/odom' has times 15.003 s to 15.403 s, the joints 5"):
        read_log(path, LEG, base=BASE)
    never = {"/odom": (ODOMETRY, S, lambda m, t: m.odometry(0.0))}
    path = write(tmp_path / "never", LEG_STATES | never)
    with pytest.raises(DataError, match=r"'/odom': the header stamps of all 21 messages are 0"):
        read_log(path, LEG, base=BASE)


@pytest.mark.parametrize("plugin", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_a_state_of_unitree_has_motors_imu_and_feet(tmp_path, plugin):
    path = write(tmp_path / "log", {"/lowstate": (LOW_STATE, T, Maker.low_state)}, plugin=plugin)
    source = LogSource(joints={"hip": "0", "knee": "2"})
    flags = BaseColumns(contacts=("a", "b"), thresholds=(25.0, 45.5))
    columns = {"contact_a": "foot_force_0", "contact_b": "foot_force_3"}
    log = read_log(path, LEG, base=flags, source=source, columns=columns)
    np.testing.assert_allclose(log.t, T)
    np.testing.assert_allclose(log.q, np.column_stack([T, T]), rtol=1e-6)
    np.testing.assert_allclose(log.v, np.tile([0.0, 2.0], (len(T), 1)))
    np.testing.assert_allclose(log.tau, np.column_stack([-T, 2 - T]), rtol=1e-6)
    assert not log.contacts["a"].any()
    assert log.contacts["b"].all()
    log = read_log(path, LEG, base=INSIDE, source=source)
    assert_imu(log)


INSIDE = BaseColumns(
    True, imu=ImuFrame(np.array([0, 0, 0, 1.0]), np.zeros(3), np.zeros(3), np.zeros(3))
)


def assert_imu(log):
    one = np.ones(len(log.t))
    wanted = np.column_stack([0.1 * one, 0.2 * one, log.t, log.t, 0.5 * one, 9.81 * one])
    np.testing.assert_allclose(log.base.imu.values, wanted, rtol=1e-6)
    q = quaternions_of_angles(angles(log.t))
    np.testing.assert_allclose(np.abs(np.sum(log.base.pose[:, 3:] * q, axis=1)), 1.0, atol=1e-6)
    assert not log.base.has_position


def test_an_imu_without_orientation_needs_that_of_the_base(tmp_path):
    path = write(tmp_path / "log", LEG_STATES | INERTIAL)
    assert_imu(read_log(path, LEG, base=INSIDE))
    blind = {"/imu": (IMU, S, lambda m, t: m.imu(t, known=False))}
    path = write(tmp_path / "blind", LEG_STATES | blind)
    with pytest.raises(DataError, match="no column imu_qx, imu_qy, imu_qz, imu_qw of the IMU; col"):
        read_log(path, LEG, base=INSIDE)
    path = write(tmp_path / "both", LEG_STATES | blind | ODOM)
    wanted = places(T[1:])
    np.testing.assert_allclose(read_log(path, LEG, base=INSIDE).base.pose[:, :3], wanted, atol=1e-9)


def test_a_field_of_a_controller_is_of_the_first_point_that_has_a_number():
    """Joints without a command are NaN; the output comes before the reference."""
    nan = float("nan")
    message = SimpleNamespace(
        feedback=SimpleNamespace(positions=[1.0, 2.0], velocities=[nan, nan], effort=[]),
        actual=SimpleNamespace(positions=[9.0, 9.0], velocities=[3.0, nan], effort=[5.0, 6.0]),
        output=SimpleNamespace(positions=[nan, nan], velocities=[nan, 7.0]),
        reference=SimpleNamespace(positions=[0.1, nan], velocities=[8.0, 8.0], effort=[nan, nan]),
        desired=SimpleNamespace(positions=[0.3, 0.4], velocities=[4.0, 4.0], effort=[nan, 0.5]),
    )
    found = bags._controlled(message)
    np.testing.assert_array_equal(found["position"], [1.0, 2.0])
    np.testing.assert_array_equal(found["velocity"], [3.0, nan])
    np.testing.assert_array_equal(found["effort"], [5.0, 6.0])
    np.testing.assert_array_equal(found["qref"], [0.1, nan])
    np.testing.assert_array_equal(found["dqref"], [nan, 7.0])
    np.testing.assert_array_equal(found["tauref"], [nan, 0.5])
