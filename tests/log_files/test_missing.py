"""Logs whose columns or joints have other names than the wanted ones: the whole message."""

import numpy as np
import pandas as pd
import pytest

from robotid.exceptions import DataError, SettingsError
from robotid.log_files.read import read_log
from robotid.logs.settings import LogSource

UR = ("pan", "lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
SO101 = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
DESIRED = ", ".join(f"current_des_{joint}" for joint in UR)
SOUGHT = ", ".join(f"'tau_{joint}'" for joint in UR)


def said(names, joints=UR, **reading):
    """Return the error of a log with these columns."""
    frame = pd.DataFrame({name: np.zeros(3) for name in names} | {"time": np.arange(3.0)})
    with pytest.raises(DataError) as caught:
        read_log(frame, joints, **reading)
    assert caught.value.code == "missing_column"
    return str(caught.value)


def of(kind, joints=UR):
    return [f"{kind}_{joint}" for joint in joints]


def test_one_misspelt_current_is_named_and_no_desired_one():
    currents = [name.replace("current_elbow", "curent_elbow") for name in of("current")]
    assert said([*of("q"), *currents, *of("current_des")]) == (
        "log has no column 'tau_elbow'; torque or current columns found: current_pan, "
        "current_lift, current_wrist_1, current_wrist_2, current_wrist_3. Commanded, not "
        f"measured: {DESIRED}. Did you mean 'curent_elbow'? Rename it, or state it in the job "
        'file: columns = { current_elbow = "curent_elbow" }'
    )


@pytest.mark.parametrize(
    ("kind", "standard"),
    [("curent", "current"), ("TAU", "tau"), ("Effort", "tau"), ("trq", "tau"), ("tau [Nm]", "tau")],
)
def test_misspelt_columns_of_all_joints_are_one_table(kind, standard):
    names = of(kind)
    assert said([*of("q"), *names, *of("current_des")]) == (
        f"log has no columns {SOUGHT}; torque or current columns found: none. Commanded, not "
        f"measured: {DESIRED}. Similar names are in the log. Rename these columns, or check them "
        "and state them in the job file:\n[columns]\n"
        + "\n".join(f'{standard}_{joint} = "{kind}_{joint}"' for joint in UR)
    )


@pytest.mark.parametrize("name", ["{}.{}", "{}-{}", "{}/{}", "{} {}", "{}{}"])
def test_other_separators_are_similar(name):
    names = [name.format(kind, joint) for kind in ("q", "tau") for joint in ("1", "2")]
    lines = said(names, ["1", "2"]).splitlines()
    assert lines[1:] == [
        "[columns]",
        *(
            f'{kind}_{joint} = "{name.format(kind, joint)}"'
            for kind in ("q", "tau")
            for joint in ("1", "2")
        ),
    ]


def test_units_in_names_make_no_difference():
    found = said(
        [f"{name} [{unit}]" for kind, unit in (("q", "rad"), ("tau", "Nm")) for name in of(kind)]
    )
    assert 'q_wrist_1 = "q_wrist_1 [rad]"' in found
    assert 'tau_wrist_3 = "tau_wrist_3 [Nm]"' in found


def test_the_joint_may_come_first():
    found = said([*of("q"), *(f"{joint}_torque" for joint in UR)])
    assert 'tau_wrist_2 = "wrist_2_torque"' in found


@pytest.mark.parametrize(
    "kind",
    ["current_des", "desired_current", "currentref", "current_target", "tau_cmd", "effort_error"],
)
def test_commanded_columns_are_no_torques(kind):
    found = said([*of("q"), *of(kind)])
    listing = ", ".join(of(kind))
    assert found == (
        f"log has no columns {SOUGHT}; torque or current columns found: none. Commanded, not "
        f"measured: {listing}. Record tau_<joint> or current_<joint>. Commanded positions, "
        'qref_<joint>, are enough for the estimator "simulation"'
    )


def test_commanded_positions_are_found_where_they_are_wanted():
    names = [name.replace("qref_elbow", "qrf_elbow") for name in of("qref")]
    assert said([*of("q"), *names, *of("current_des")], needs="commands") == (
        "log has no column 'qref_elbow'; commanded position columns found: qref_pan, qref_lift, "
        f"qref_wrist_1, qref_wrist_2, qref_wrist_3. Commanded, not measured: {DESIRED}. Did you "
        "mean 'qrf_elbow'? Rename it, or state it in the job file: columns = { qref_elbow = "
        '"qrf_elbow" }'
    )


def test_the_first_column_that_is_missing_is_the_example():
    found = said([*of("q"), *of("torque_ratio", UR[:3])])
    assert 'columns = { tau_pan = "NAME" }. Record tau_<joint> or current_<joint>. ' in found


@pytest.mark.parametrize("kind", ["temperature", "temp", "voltage", "iq", "tau_ext", "power"])
def test_another_quantity_is_listed_and_not_proposed(kind):
    found = said([*of("q"), *of(kind)])
    assert "Did you mean" not in found
    assert "[columns]" not in found
    assert f"{kind}_elbow" in found


def test_a_joint_that_was_at_rest_may_be_locked():
    assert said([*of("q"), *of("tau")[:5]]).endswith(
        "If wrist_3 was at rest, lock it at its position, as --lock wrist_3=0, or locked = "
        "{ wrist_3 = 0 } in the job file"
    )
    assert said([*of("q"), *of("tau")[:4]]).endswith(
        "If wrist_2, wrist_3 were at rest, lock them there, as --lock wrist_2=0 --lock wrist_3=0, "
        "or locked = { wrist_2 = 0, wrist_3 = 0 } in the job file"
    )


HEAD = (
    "log has no columns of joints {} under the names of the URDF; names in the log: {}. State the "
    "name of each joint in the job file, or with one flag per joint, as --rename {}. This table is "
    "a guess: check each line, an exchange of joints gives wrong parameters.\n[log.joints]\n"
)


def test_numbers_are_paired_by_order():
    names = [*of("q", "123456"), *of("qref", "123456")]
    assert said(names, SO101, needs="commands") == (
        HEAD.format(", ".join(SO101), "1, 2, 3, 4, 5, 6", "shoulder_pan=1")
        + 'shoulder_pan = "1"   # by order\n'
        'shoulder_lift = "2"  # by order\n'
        'elbow_flex = "3"     # by order\n'
        'wrist_flex = "4"     # by order\n'
        'wrist_roll = "5"     # by order\n'
        'gripper = "6"        # by order'
    )


def test_similar_names_are_paired_before_the_others():
    names = ("Rotation", "Pitch", "Elbow", "Wrist_Pitch", "Wrist_Roll", "Jaw", "rail")
    columns = [*of("q", names), *of("current", names)]
    assert said(columns, SO101, gains=dict.fromkeys(SO101, 1.0)) == (
        HEAD.format(", ".join(SO101), ", ".join(names), "shoulder_pan=Rotation")
        + 'shoulder_pan = "Rotation"   # by order\n'
        'shoulder_lift = "Pitch"     # by order\n'
        'elbow_flex = "Elbow"        # similar name\n'
        'wrist_flex = "Wrist_Pitch"  # by order\n'
        'wrist_roll = "Wrist_Roll"   # similar name\n'
        'gripper = "Jaw"             # by order\n'
        "Other names in the log: rail."
    )


def test_numbers_in_names_decide():
    columns = [*of("q", ("arm.j2", "arm.j1")), *of("tau", ("arm.j2", "arm.j1"))]
    assert said(columns, ("joint_1", "joint_2")).endswith(
        'joint_1 = "arm.j1"  # similar name\njoint_2 = "arm.j2"  # similar name'
    )


def test_stated_names_are_not_guessed_again():
    columns = [*of("q", "12"), *of("tau", "12")]
    found = said(columns, ("a", "b"), source=LogSource(joints={"b": "1"}))
    assert found.endswith('[log.joints]\na = "2"  # by order')


def test_a_misspelt_name_in_the_job_file_is_named_with_the_similar_one():
    columns = [*of("q", ("M1", "left")), *of("tau", ("M1", "left"))]
    found = said(columns, ("a", "b"), source=LogSource(joints={"a": "M1", "b": "lift"}))
    assert found.startswith(
        'log has no columns under the names that [log.joints] states: b = "lift"; names in the '
        "log: left. State"
    )
    assert found.endswith('[log.joints]\nb = "left"  # similar name')
    found = said(columns[::2], ("a", "b"), source=LogSource(joints={"a": "M1", "b": "M2"}))
    assert found.endswith('[log.joints] states: b = "M2"; names in the log: M1')


@pytest.mark.parametrize("stated", [{"a": "1", "b": "1"}, {"a": "b"}, {"b": "a"}])
def test_two_joints_with_one_name_in_the_log_are_refused(stated):
    frame = pd.DataFrame({name: np.arange(3.0) for name in ("time", *of("q", "ab1"))})
    (name,) = set(stated.values())
    with pytest.raises(SettingsError, match=f"log: joints a and b have the same name '{name}' in"):
        read_log(frame, ("a", "b"), source=LogSource(joints=stated))
    with pytest.raises(SettingsError, match="joints has a more than once; name each joint once"):
        read_log(frame, ("a", "b", "a"))


def test_the_name_of_a_locked_joint_is_not_given_to_another():
    """The log has its own names and a gripper that is not read; one joint has no columns."""
    columns = [*of("q", ("pan", "lift", "gripper")), *of("tau", ("pan", "lift", "gripper"))]
    found = said(columns, ("pan", "lift", "elbow"))
    assert "[log.joints]" not in found
    assert "--lock elbow=0" in found


def test_a_single_column_of_another_joint_is_a_misspelt_one():
    found = said(["q_pan", "tau_pan", "q_elbw"], ("pan", "elbow"))
    assert "[log.joints]" not in found
    assert found.startswith("log has no columns 'q_elbow', 'tau_elbow'; position and torque or")
    assert "q_elbw" in found
    both = said(["q_pan", "tau_pan", "q_elbw", "tau_elbw"], ("pan", "elbow"))
    assert both.endswith('[log.joints]\nelbow = "elbw"  # similar name')
