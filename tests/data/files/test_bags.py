"""Bags: which topic is read, by which clock, and the commands of controllers and other topics."""

import re
import sqlite3
from dataclasses import replace

import numpy as np
import pytest
from helpers.recorders import (
    StoragePlugin,
    messages_of,
    write_bag2,
    write_controller,
    write_idl_controller,
    write_mcap,
)
from mcap.writer import Writer as McapLibraryWriter

from robotid.base.exceptions import DataError, SettingsError
from robotid.data.files.read import read_log, write_log
from robotid.data.log import COLUMNS, Log
from robotid.data.signal_settings import LogSource

JOINTS = ("shoulder", "elbow")
STATE = "sensor_msgs/msg/JointState"
HOW = "(job file table [log], CLI --topic, Python source=LogSource(topic=...))"


def refused(text):
    return pytest.raises(DataError, match="^" + re.escape(text) + "$")


def make_log(count=60, **changes):
    """Return a log of commands, without torque."""
    t = 1000.0 + np.arange(count) / 50
    phase = t[:, None] * [2.0, 3.0]
    fields = {
        "t": t, "q": np.sin(phase), "v": np.cos(phase) * [2.0, 3.0], "tau": np.zeros((count, 2)),
        "joints": JOINTS, "q_ref": np.sin(phase + 0.1), "v_ref": np.cos(phase + 0.1) * [2.0, 3.0],
        "tau_ref": 10 * np.cos(phase), "has_torque": False,
    }  # fmt: skip
    return Log(**(fields | changes))


def measured(**changes):
    """Return a log of torques, without commands."""
    log = make_log()
    tau = 10 * np.cos(log.t[:, None] * [2.0, 3.0])
    return replace(log, tau=tau, q_ref=None, v_ref=None, tau_ref=None, has_torque=True, **changes)


def assert_same(back, log):
    assert back.has_torque == log.has_torque
    for name in ("t", *COLUMNS.values()):
        np.testing.assert_array_equal(getattr(back, name), getattr(log, name), name)


def test_the_clock_is_the_header_unless_stated(tmp_path):
    log = measured()
    path = write_mcap(tmp_path / "run.mcap", messages_of(log), delay=lambda _: 0.25)
    assert_same(read_log(path, JOINTS), log)
    back = read_log(path, JOINTS, source=LogSource(stamp="log"))
    np.testing.assert_allclose(back.t, log.t + 0.25, atol=1e-9)


def test_the_topic_must_be_stated_if_several_would_do(tmp_path):
    log = measured()
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


def test_other_messages_are_passed_over_and_values_are_checked_as_in_any_log(tmp_path):
    log = measured()
    finger = [(t + 0.003, ["finger"], [0.5], [], []) for t in log.t]
    messages = sorted([*messages_of(log), *finger], key=lambda message: message[0])
    back = read_log(write_mcap(tmp_path / "run.mcap", messages), JOINTS)
    assert_same(back, log)
    assert back.notes == ("columns ignored: position_finger",)
    bare = [(*message[:4], []) for message in messages_of(log)]
    with pytest.raises(DataError, match="no columns 'tau_shoulder', 'tau_elbow'; torque or curr"):
        read_log(write_mcap(tmp_path / "bare.mcap", bare), JOINTS)
    path = write_mcap(tmp_path / "deg.mcap", messages_of(replace(log, q=20 * log.q)))
    with pytest.raises(DataError, match=r"^deg.mcap: .* looks like degrees"):
        read_log(path, JOINTS)
    unstamped = [(0.0, *message[1:]) for message in messages_of(log)]
    path = write_bag2(tmp_path / "bag", {"/joint_states": unstamped}, delay=1.0)
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
        DataError, match=r"1 of 61 messages lack .* \(message 60\) lacks position_s"
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
    path = write_bag2(tmp_path / "bag", paired(log, every=2, first=4))
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
    path = write_bag2(tmp_path / "bag", paired(make_log()), others=["/chatter"])
    for source, text in (
        (LogSource(command="/joint_comands"), "bag has no topic '/joint_comands'; topics: "),
        (
            LogSource(command="/chatter"),
            "bag: topic '/chatter' has messages of std_msgs/msg/String, wanted",
        ),
        (replace(COMMANDS, topic="/joint_commands"), "bag: topic and command are both '/joint_co"),
    ):
        with pytest.raises(DataError, match=text):
            read_log(path, JOINTS, needs="commands", source=source)
    write_log(make_log(), tmp_path / "run.csv")
    with pytest.raises(SettingsError, match=r"the topic of a bag, but run\.csv is no bag"):
        read_log(tmp_path / "run.csv", JOINTS, needs="commands", source=COMMANDS)
