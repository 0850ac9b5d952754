"""Logs with columns of other names: those that are read, and the message on those that are not."""

import re
import tomllib

import numpy as np
import pandas as pd
import pytest

from robotid.base.exceptions import DataError, SettingsError
from robotid.data.files.read import read_log
from robotid.data.signal_settings import LogSource
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel
from robotid.robot.tree import Joint

UR = ("pan", "lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
T = np.arange(5) / 100.0


def table(*names, clock="time", moved=1.0):
    """Return columns of which each has its own values."""
    return pd.DataFrame({clock: T, **{name: moved * T + k for k, name in enumerate(names)}})


def said(names, joints=UR, moved=1.0, **reading):
    """Return the error of a log with these columns."""
    with pytest.raises(DataError) as caught:
        read_log(table(*names, moved=moved), joints, **reading)
    assert caught.value.code == "missing_column"
    return str(caught.value)


def of(kind, joints=UR):
    return [f"{kind}_{joint}" for joint in joints]


SPELLINGS = [
    ("{}_pos", "{}_vel", "{}_eff", "{}_cmd_pos"),
    ("position.{}", "velocity.{}", "effort.{}", "target.{}"),
    ("/joint_states/{}/position", "/joint_states/{}/vel", "/joint_states/{}/torque", "command/{}"),
    ("Q [rad] {}", "QD-{}", "TAU ({}) [Nm]", "q_ref {}"),
    ("actual_q_{}", "actual_qd_{}", "measured_torque_{}", "{}_desired_position"),
]


@pytest.mark.parametrize("words", SPELLINGS)
@pytest.mark.parametrize("clock", ["timestamp", "stamp", "%time", "Time", "header.stamp"])
def test_words_of_a_quantity_stand_before_or_after_the_joint(words, clock):
    joints = ("pan", "wrist_1")
    names = [word.format(joint) for joint in joints for word in words]
    log = read_log(table(*names, clock=clock), joints)
    np.testing.assert_array_equal(log.t, T)
    for k, values in enumerate((log.q, log.v, log.tau)):
        np.testing.assert_array_equal(values, T[:, None] + [k, 4 + k])
    assert log.assumed == ()
    commanded = read_log(table(*names, clock=clock), joints, needs="commands")
    np.testing.assert_array_equal(commanded.q_ref, T[:, None] + [3, 7])


@pytest.mark.parametrize(
    "name",
    ["q{}", "q_{}", "q[{}]", "joint{}_pos", "J{}.position", "field.position{}", "arm.j{} angle"],
)
@pytest.mark.parametrize("first", [0, 1, 4])
def test_consecutive_numbers_are_read_by_order_and_this_is_said(name, first):
    numbers = [first + k for k in (2, 0, 1)]  # in any order of the file
    names = [*(name.format(k) for k in numbers), *(f"tau{k}" for k in numbers)]
    for joints in (("joint7", "joint8", "joint9"), ("c", "b", "a")):
        log = read_log(table(*names), joints)
        np.testing.assert_array_equal(log.q, T[:, None] + [1, 2, 0])
        np.testing.assert_array_equal(log.tau, T[:, None] + [4, 5, 3])
        (assumed,) = log.assumed
        assert re.search(rf"{first} is {joints[0]}, .*{first + 2} is {joints[2]}$", assumed)


def test_names_that_are_off_by_one_are_read_by_order():
    names = [f"joint{k}_{word}" for word in ("pos", "torque") for k in range(3)]
    log = read_log(table(*names), ("joint1", "joint2", "joint3"))
    np.testing.assert_array_equal(log.q, T[:, None] + [0, 1, 2])
    assert log.assumed[0].endswith("joint0 is joint1, joint1 is joint2, joint2 is joint3")
    log = read_log(table(*names), ("joint1", "joint2"))
    np.testing.assert_array_equal(log.q, T[:, None] + [1, 2])


def test_joints_that_differ_by_number_are_read_by_number():
    log = read_log(table("q1", "q2", "tau1", "tau2"), ("joint_2", "joint_1"))
    np.testing.assert_array_equal(log.q, T[:, None] + [1, 0])


def test_numbers_are_not_read_if_the_order_of_the_joints_is_ambiguous():
    """The legs of the file are not in Pinocchio's order, which is alphabetical."""
    model = RobotModel.from_urdf(example_urdf("a1.urdf"))
    joints = [joint.name for joint in model.tree.movable]
    assert joints != list(model.joints)
    names = [f"{kind}{k}" for kind in ("q", "tau") for k in range(len(joints))]
    assert 'q0"  # by order' in said(names, model.joints, robot=model.tree.movable)
    log = read_log(table(*names), joints, robot=model.tree.movable)
    np.testing.assert_array_equal(log.q[0], np.arange(12.0))


@pytest.mark.parametrize("names", ["q1 q2 q4", "q1 q2", "q_a q_b q_c", "left1 left2 right1"])
def test_other_numbers_are_not_read_by_order(names):
    columns = [x for name in names.split() for x in (name, name.replace("q", "tau"))]
    assert "has no columns 'q_x'" in said(dict.fromkeys(columns), ("x", "y", "z"))


def test_the_whole_table_is_proposed_and_read_once_it_is_pasted():
    """Joints with other names are paired by order; commands are in the table."""
    joints, own = ("pan", "lift"), ("turn", "raise")
    names = [*of("q", own), *of("tau", own), *of("qref", own), "voltage", "wrist_1_pos"]
    locked = [Joint("wrist_1", "revolute", "a", "b")]  # its column is no line of the table
    found = said(names, joints, robot=locked)
    columns = tomllib.loads("[columns]" + found.partition("[columns]")[2])["columns"]
    expected = {f"{kind}_{j}": f"{kind}_{m}" for kind in ("q", "tau", "qref")
                for j, m in zip(joints, own, strict=True)}  # fmt: skip
    assert columns == {"time": "time"} | expected
    assert "check each line, an exchange of joints gives wrong parameters" in found
    read = read_log(table(*names), joints, columns=columns)
    np.testing.assert_array_equal(read.tau, T[:, None] + [2, 3])


def test_missing_columns_are_lines_to_fill_in():
    found = said(["pan_pos", "lift_pos", "M1", "M2"], ("pan", "lift"))
    assert found == (
        "log has no columns 'tau_pan', 'tau_lift'; torque or current columns found: none. Other "
        "columns: M1, M2. Record tau_<joint> or current_<joint>. Commanded positions, "
        'qref_<joint>, are enough for the estimator "simulation". Rename the columns, or state '
        "them in the job file:\n[columns]\n"
        'time = "time"\nq_pan = "pan_pos"\nq_lift = "lift_pos"\n'
        '# tau_pan = "NAME"\n# tau_lift = "NAME"'
    )


@pytest.mark.parametrize(
    "kind",
    ["current_des", "desired_current", "currentref", "current_target", "tau_cmd", "effort_error"],
)
def test_commanded_columns_are_no_torques(kind):
    found = said([*of("q"), *of(kind)])
    sought = ", ".join(f"'tau_{joint}'" for joint in UR)
    assert found == (
        f"log has no columns {sought}; torque or current columns found: none. Commanded, not "
        f"measured: {', '.join(of(kind))}. Record tau_<joint> or current_<joint>. Commanded "
        'positions, qref_<joint>, are enough for the estimator "simulation"'
    )


@pytest.mark.parametrize("kind", ["temp", "voltage", "iq", "tau_ext", "power", "force", "\u03b1q"])
def test_a_column_with_an_unknown_word_is_listed_and_not_read(kind):
    found = said([*of("q"), *of(kind)])
    assert f"{kind}_elbow" in found.partition("[columns]")[0]
    assert f'"{kind}_elbow"' not in found


def test_a_joint_that_was_at_rest_may_be_locked():
    assert said([*of("q"), *of("tau")[:5]], moved=0.0).endswith(
        "If wrist_3 was at rest, lock it at its position, as --lock wrist_3=0, or locked = "
        "{ wrist_3 = 0 } in the job file"
    )
    assert said([*of("q"), *of("tau")[:4]], moved=0.0).endswith(
        "If wrist_2, wrist_3 were at rest, lock them there, as --lock wrist_2=0 --lock wrist_3=0, "
        "or locked = { wrist_2 = 0, wrist_3 = 0 } in the job file"
    )


@pytest.mark.parametrize("stated", [{"a": "1", "b": "1"}, {"a": "b"}, {"b": "a"}])
def test_two_joints_with_one_name_in_the_log_are_refused(stated):
    (name,) = set(stated.values())
    with pytest.raises(SettingsError, match=f"log: joints a and b have the same name '{name}' in"):
        read_log(table(*of("q", "ab1")), ("a", "b"), source=LogSource(joints=stated))
    with pytest.raises(SettingsError, match="joints has a more than once; name each joint once"):
        read_log(table(*of("q", "ab1")), ("a", "b", "a"))


def test_a_joint_that_mimics_another_needs_no_column_and_no_lock(tmp_path):
    model = RobotModel.from_urdf(example_urdf("panda.urdf"))
    leaders = [joint.name for joint in model.tree.movable if joint.mimic is None]
    names = [*of("q", leaders), *of("tau", leaders)]
    found = said(names, model.joints, robot=model.tree.movable)
    assert found.endswith(
        "panda_finger_joint2 mimics panda_finger_joint1: a joint that moves with its leader needs "
        'no column; state mimic = "coupled" in the job file'
    )
    coupled = RobotModel.from_urdf(example_urdf("panda.urdf"), mimic="coupled")
    log = read_log(table(*names), coupled.joints, robot=coupled.tree.movable)
    assert log.joints == coupled.joints
