"""Which columns of a log are read, and what is refused: tables of logs and of messages."""

import re
import subprocess
import sys
import tomllib
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from helpers.recorders import wide
from helpers.synthetic import sine_log

from robotid.base.exceptions import DataError, SettingsError
from robotid.data.base_motion import BaseColumns
from robotid.data.files.columns import quantity_of
from robotid.data.files.read import lay_out, read_log, read_logs, write_columns, write_log
from robotid.data.log import COLUMNS, Log
from robotid.data.signal_settings import LogSource, LogUnits, Transmission
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel
from robotid.robot.tree import Joint

JOINTS = ("shoulder", "elbow")
T = 1000.0 + np.arange(300) / 100
PHASE = T[:, None] * [2.0, 3.0]
LOG = sine_log(300, 100, a=-np.sin(PHASE) * [4.0, 9.0])
ONE = np.ones(300)
#: Changes of a table that leave out the columns of a quantity.
NO_Q, NO_TAU = ({f"{kind}_{joint}": None for joint in JOINTS} for kind in ("q", "tau"))


def of(kind, values):
    return {f"{kind}_{joint}": values[:, j] for j, joint in enumerate(JOINTS)}


def frame(**changes):
    """The columns of a small log by standard name; None takes one out."""
    table = {"time": LOG.t} | of("q", LOG.q) | of("tau", LOG.tau) | changes
    return pd.DataFrame({name: x for name, x in table.items() if x is not None})


def spoilt(values, row, value):
    values = values.copy()
    values[row] = value
    return values


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_standard_columns_are_read_in_the_order_of_the_joints(tmp_path, suffix):
    path = tmp_path / f"run{suffix}"
    table = frame(tau_wrist=np.nan * ONE, voltage=ONE)  # NaN in a column that is not read
    table = table[table.columns[::-1]]
    table.to_csv(path, index=False) if suffix == ".csv" else table.to_parquet(path)
    log = read_log(path, JOINTS[::-1])
    for name in ("q", "tau"):
        np.testing.assert_array_equal(getattr(log, name), getattr(LOG, name)[:, ::-1])
    np.testing.assert_array_equal(log.t, LOG.t)
    assert (log.v, log.a, log.joints, log.path) == (None, None, JOINTS[::-1], str(path))
    assert log.notes == ("columns ignored: voltage, tau_wrist",)
    assert len(read_log(path, JOINTS, start=1001.0).t) == 200
    assert len(read_log(path, JOINTS, end=1001.0).t) == 101


SPELLINGS = [
    ("{}_pos", "{}_vel", "{}_eff", "{}_cmd_pos"),
    ("position_{}", "velocity_{}", "effort_{}", "q_des_{}"),
    ("position.{}", "velocity.{}", "effort.{}", "target.{}"),
    ("/joint_states/{}/position", "/joint_states/{}/vel", "/joint_states/{}/torque", "command/{}"),
    ("Q [rad] {}", "QD-{}", "TAU ({}) [Nm]", "q_ref {}"),
    ("actual_q_{}", "actual_qd_{}", "measured_torque_{}", "{}_desired_position"),
    ("observation.state.{}.pos", "observation.{}.vel", "observation.{}.torque", "action.{}.pos"),
]
CLOCKS = ["timestamp", "t", "stamp", "%time", "Time [s]", "header.stamp", "time"]


@pytest.mark.parametrize(("words", "clock"), list(zip(SPELLINGS, CLOCKS, strict=True)))
def test_words_of_a_quantity_stand_before_or_after_the_joint(words, clock):
    joints = ("pan", "wrist_1")
    names = [word.format(joint) for joint in joints for word in words]
    table = pd.DataFrame({clock: T, **{name: 0.1 * k + ONE for k, name in enumerate(names)}})
    log = read_log(table, joints)
    np.testing.assert_array_equal(log.t, T)
    for k, values in enumerate((log.q, log.v, log.tau)):
        np.testing.assert_allclose(values[0], [1.0 + 0.1 * k, 1.4 + 0.1 * k])
    assert log.assumed == ()
    commanded = read_log(table, joints, needs="commands")
    np.testing.assert_allclose(commanded.q_ref[0], [1.3, 1.7])


NUMBERED = "q{},q_{},q[{}],q{} [rad],joint{}_pos,J{}.position,field.position{},arm.j{} angle"


@pytest.mark.parametrize("name", NUMBERED.split(","))
@pytest.mark.parametrize("first", [0, 4])
def test_consecutive_numbers_are_read_by_order_and_this_is_said(name, first):
    numbers = [first + k for k in (2, 0, 1)]  # in any order of the file
    names = [*(name.format(k) for k in numbers), *(f"tau{k} (N m)" for k in numbers)]
    table = pd.DataFrame({"time": T, **{x: ONE * k for k, x in enumerate(names)}})
    for joints in (("joint7", "joint8", "joint9"), ("c", "b", "a")):
        log = read_log(table, joints)
        np.testing.assert_array_equal(log.q[0], [1, 2, 0])
        np.testing.assert_array_equal(log.tau[0], [4, 5, 3])
        (assumed,) = log.assumed
        assert re.search(rf"{first} is {joints[0]}, .*{first + 2} is {joints[2]}$", assumed)


def test_joints_that_differ_by_number_are_read_by_number():
    names = ["q1", "q2", "tau1", "tau2"]
    table = pd.DataFrame({"time": T, **{x: ONE * k for k, x in enumerate(names)}})
    np.testing.assert_array_equal(read_log(table, ("joint_2", "joint_1")).q[0], [1, 0])
    names = [f"joint{k}_{word}" for word in ("pos", "torque") for k in range(3)]  # off by one
    table = pd.DataFrame({"time": T, **{x: ONE * k for k, x in enumerate(names)}})
    log = read_log(table, ("joint1", "joint2", "joint3"))
    np.testing.assert_array_equal(log.q[0], [0, 1, 2])
    assert log.assumed[0].endswith("joint0 is joint1, joint1 is joint2, joint2 is joint3")
    np.testing.assert_array_equal(read_log(table, ("joint1", "joint2")).q[0], [1, 2])


def test_numbers_are_not_read_if_the_order_of_the_joints_is_ambiguous():
    """The legs of the file are not in Pinocchio's order, which is alphabetical."""
    model = RobotModel.from_urdf(example_urdf("a1.urdf"))
    joints = [joint.name for joint in model.tree.movable]
    assert joints != list(model.joints)
    names = [f"{kind}{k}" for kind in ("q", "tau") for k in range(len(joints))]
    table = pd.DataFrame({"time": T, **{x: ONE * k for k, x in enumerate(names)}})
    with pytest.raises(DataError, match='q0"  # by order'):
        read_log(table, model.joints, robot=model.tree.movable)
    log = read_log(table, joints, robot=model.tree.movable)
    np.testing.assert_array_equal(log.q[0], np.arange(12.0))


@pytest.mark.parametrize("names", ["q1 q2 q4", "q1 q2", "q_a q_b q_c", "left1 left2 right1"])
def test_other_numbers_are_not_read_by_order(names):
    columns = [x for name in names.split() for x in (name, name.replace("q", "tau"))]
    with pytest.raises(DataError, match="has no columns 'q_x'"):
        read_log(pd.DataFrame({"time": T, **dict.fromkeys(columns, T)}), ("x", "y", "z"))


def test_a_table_to_paste_is_proposed_and_read():
    """Joints with other names are paired by order; commands are in the table."""
    own = ("turn", "raise")
    names = [f"{kind}_{x}" for kind in ("q", "tau", "qref") for x in own]
    names += ["voltage", "wrist_1_pos"]  # that of a locked joint is no line of the table
    table = pd.DataFrame({"time": T, **{x: ONE * k for k, x in enumerate(names)}})
    with pytest.raises(DataError) as caught:
        read_log(table, JOINTS, robot=[Joint("wrist_1", "revolute", "a", "b")])
    assert caught.value.code == "missing_column"
    columns = tomllib.loads("[columns]" + str(caught.value).partition("[columns]")[2])["columns"]
    assert columns == {"time": "time"} | {
        f"{kind}_{j}": f"{kind}_{m}"
        for kind in ("q", "tau", "qref")
        for j, m in zip(JOINTS, own, strict=True)
    }
    assert "check each line, an exchange of joints gives wrong parameters" in str(caught.value)
    np.testing.assert_array_equal(read_log(table, JOINTS, columns=columns).tau[0], [2, 3])


#: Changes of the table, arguments, and the fragments of the error in their order.
REFUSED = {
    "two names": (dict(position_elbow=ONE), {}, "has 'q_elbow' and 'position_elbow', two names of "
                  'the same quantity; remove one, or set in the job file columns = { q_elbow ='),
    "two clocks": (dict(t=T), {}, "has 'time' and 't', two names of the same quantity"),
    "moving joint without torque": (
        dict(tau_elbow=None), {}, "log has no column 'tau_elbow'; torque or current columns found: "
        "tau_shoulder. If elbow, which moves in the log, has no drive, set passive ="),
    "resting joint without torque": (
        dict(tau_elbow=None, q_elbow=ONE), {}, "If elbow was at rest, lock it at its position, as "
        "--lock elbow=0, or locked = { elbow = 0 } in the job file$"),
    "no positions": (NO_Q, {}, "no columns 'q_shoulder', 'q_elbow'; no position columns were "
                     "recognised. Record the position of each joint$"),
    "no torques": (NO_TAU, {}, "no torque or current columns were recognised. Record tau_<joint> "
                   "or current_<joint>. Commanded positions, qref_<joint>, are enough for"),
    "other columns": (NO_TAU | dict(M1=ONE), {}, 'Other columns: M1. ', "If the log has other "
                      'names for them, set these in the job file:\n[columns]\ntime = "time"\nq_sh',
                      '# tau_elbow = "NAME"$'),
    "misspelt": (dict(q_elbow=None, q_elbow2=ONE), {}, '\nq_elbow = "q_elbow2"  # by order$'),
    "no time": (dict(time=None, Clock=T), {}, "log has no column 'time'; columns found: q_shoulder"
                ", q_elbow, tau_shoulder, tau_elbow. Other columns: Clock. Without time stamps, gi",
                "the rate of the rows [Hz", '\n[columns]\nq_shoulder = "', '\n# time = "NAME"$'),
    "units in names": (dict(time=None, stamp_ms=T, q_elbow=None, q_elbow_deg=ONE), {}, "no column "
                       "'time'; columns", '\n[columns]\ntime = "stamp_ms"\n', 'w = "q_elbow_deg"\n',
                       '"\n[units]  # by the names\ntime = "ms"\nangle = "deg"$'),
    "no standard name": ({}, dict(columns={"tau_elbw": "tau_elbow"}), "columns: 'tau_elbw' is not a"
                         " standard name of a column, as 'time' or 'tau_shoulder'. Did you mean"),
    "no such column": ({}, dict(columns={"tau_elbow": "tau_elbo"}), "log has no column 'tau_elbo', "
                       "which is given for 'tau_elbow' in columns", "Did you mean 'tau_elbow'?"),
    "read twice": ({}, dict(columns={"tau_shoulder": "tau_elbow", "tau_elbow": "tau_elbow"}),
                   "tau_elbow are read twice; correct columns in the job file"),
    "two joints, one name": ({}, dict(source=LogSource(joints={"shoulder": "elbow"})),
                             "joints shoulder and elbow have the same name 'elbow' in the log"),
    "renamed joint is not read": ({}, dict(source=LogSource(joints={"elbo": "M2"})), "log.joints "
                                  "renames 'elbo', which is not among the joints read", "Did you"),
    "gain of another joint": ({}, dict(gains={"elbo": 1.0}), "a gain is given for 'elbo', which is "
                              "not among the joints read: shoulder, elbow. Did you mean 'elbow'?"),
    "gain 0": ({}, dict(gains={"elbow": 0.0}), "gain of 'elbow' is 0.0, expected a number other"),
    "gain NaN": ({}, dict(gains={"elbow": np.nan}), "gain of 'elbow' is nan, expected a number"),
    "no gain": (dict(tau_elbow=None, i_elbow=ONE), {}, "joint 'elbow' has the current 'i_elbow' but"
                " no gain; set it in N m/A: --gain elbow=..., or in the job file [torque] gains",
                "robotid payload URDF LOADED --reference BARE --mass KG --gains$"),
    "no gains, no torque": (
        dict(tau_elbow=None, tau_shoulder=None, i_elbow=ONE), {}, "--gain elbow=..., or", "No "
        "torque of shoulder was found; if at rest, lock", "with --lock shoulder=0. A payload"),
    "no gains, no positions": (NO_Q | NO_TAU | dict(i_elbow=ONE), {}, "no columns 'q_shoulder', "),
    "NaN": (dict(tau_elbow=spoilt(T, 34, np.nan)), {}, "log: tau_elbow is NaN at row 34 (t = 1000.3"
            "4 s); remove such rows or correct the recording"),
    "huge": (dict(q_elbow=spoilt(T, 9, 1e308)), {}, "q_elbow is 1e+308, which is implausibly larg"),
    "text": (dict(tau_elbow=["much"] * 300), {}, "column 'tau_elbow' contains", "convert it"),
    "far": (dict(q_elbow=20 * LOG.q[:, 1]), {}, "q_elbow reaches 20, which looks like degrees"),
    "outside": ({}, dict(start=2000.0), "0 rows lie between 2000 s", "the log spans 1000 s to 100"),
    "needs": ({}, dict(needs="everything"), "is 'everything', expected one of torque, motion"),
    "no commands": ({}, dict(needs="commands"), "; no commanded position columns were recognised. "
                    "Record the commands of the controller"),
    "half a command": (dict(qref_elbow=ONE, q_shoulder=ONE), dict(needs="commands"), "no column "
                       "'qref_shoulder'; commanded position columns found: qref_elbow. If shoulde"),
    "commands only": (NO_TAU | of("qref", LOG.q), {}, "All estimators but the simulation need tau_",
                      "by --estimator simulation --kp N_M_PER_RAD", "kp = N_M_PER_RAD  # position"),
    "sizes of loads": (NO_TAU | of("loadsize", LOG.q), {}, "recognised. Loads without sign, which "
                       "are no torques: loadsize_sh"),
    "motors": (NO_TAU | dict(taum_a=ONE), {}, "For columns of motors, as taum_a, add [[transmis"),
}  # fmt: skip


@pytest.mark.parametrize(("changes", "reading", "fragments"),
                         [(a, b, c) for a, b, *c in REFUSED.values()], ids=REFUSED)  # fmt: skip
def test_a_log_that_is_refused_says_why(changes, reading, fragments):
    with pytest.raises((DataError, SettingsError)) as caught:
        read_log(frame(**changes), JOINTS, **reading)
    message = f"{caught.value}$"
    for fragment in fragments:
        assert fragment in message
        message = message[message.index(fragment) :]


def test_many_joints_without_columns_are_locked_together():
    locks = r'other 7 joints .*--joints shoulder,elbow --lock "\*=0", or locked = { "\*" = 0 }'
    with pytest.raises(DataError, match=locks):
        read_log(frame(), [*JOINTS, *(f"finger_{k}" for k in range(7))])


@pytest.mark.parametrize("joints", [(), "elbow", ("elbow", 3), 5])
def test_joints_must_be_a_list_of_names(joints):
    with pytest.raises(SettingsError, match="expected a list of at least one name"):
        read_log(frame(), joints)
    with pytest.raises(SettingsError, match="joints has elbow more than once; name each joint"):
        read_log(frame(), ["elbow", "elbow"])


@pytest.mark.parametrize(
    "kind",
    ["current_des", "desired_current", "currentref", "current_target", "tau_cmd", "effort_error"],
)
def test_commanded_columns_are_no_torques(kind):
    with pytest.raises(DataError) as caught:
        read_log(frame(**NO_TAU, **of(kind, LOG.q)), JOINTS)
    names = f"{kind}_shoulder, {kind}_elbow"
    assert f"were recognised. Commanded, not measured: {names}. Record tau_" in str(caught.value)
    assert "[columns]" not in str(caught.value)


@pytest.mark.parametrize("kind", ["temp", "voltage", "iq", "tau_ext", "power", "force", "\u03b1q"])
def test_a_column_with_an_unknown_word_is_listed_and_not_read(kind):
    with pytest.raises(DataError) as caught:
        read_log(frame(**NO_TAU, **of(kind, LOG.q)), JOINTS)
    assert f"{kind}_elbow" in str(caught.value).partition("[columns]")[0]
    assert f'"{kind}_elbow"' not in str(caught.value)


def test_stated_columns_go_before_names():
    table = frame(position_elbow=0 * ONE)
    log = read_log(table, JOINTS, columns={"q_elbow": "position_elbow"})
    np.testing.assert_array_equal(log.q[:, 1], 0.0)
    assert log.notes == ("columns ignored: q_elbow",)
    swapped = {"q_elbow": "q_shoulder", "q_shoulder": "q_elbow"}
    log = read_log(frame(), JOINTS, columns=swapped)
    np.testing.assert_array_equal(log.q, LOG.q[:, ::-1])
    # a column that is stated for one joint is no alias of another
    given = frame(q_shoulder=None, position_elbow=0 * ONE)
    log = read_log(given, JOINTS, columns={"q_shoulder": "position_elbow"})
    np.testing.assert_array_equal(log.q, LOG.q * [0.0, 1.0])


def test_a_quantity_of_some_joints_only_is_noted():
    table = frame(dq_elbow=LOG.v[:, 1], qdd_shoulder=LOG.a[:, 0])
    log = read_log(table, JOINTS)
    assert (log.v, log.a) == (None, None)
    assert log.notes == (
        "dq_elbow ignored: shoulder have no velocity",
        "qdd_shoulder ignored: elbow have no acceleration",
    )
    assert read_log(table, ["elbow"]).v.shape == (300, 1)


def test_current_times_gain_is_torque_and_the_gain_decides():
    bare = frame(tau_elbow=None, i_elbow=2 * ONE)
    log = read_log(bare, JOINTS, gains={"elbow": -8.7})
    np.testing.assert_array_equal(log.tau[:, 1], -17.4)
    np.testing.assert_array_equal(log.tau[:, 0], LOG.tau[:, 0])
    both = frame(current_elbow=2 * ONE)
    log = read_log(both, JOINTS, gains={"elbow": 10.0})
    np.testing.assert_array_equal(log.tau[:, 1], 20.0)
    assert log.notes == ("tau_elbow ignored: current_elbow is read (a gain)",)
    log = read_log(both, JOINTS)
    np.testing.assert_array_equal(log.tau, LOG.tau)
    assert log.notes == ("current_elbow ignored: tau_elbow is read (no gain)",)
    log = read_log(frame(), JOINTS, gains={"elbow": 10.0})
    assert log.notes == ("the gain of 'elbow' is not used: tau_elbow is a torque",)


def test_names_of_joints_in_the_file_may_be_stated():
    table = frame().rename(columns=lambda x: x.replace("shoulder", "M1").replace("elbow", "M2"))
    source = LogSource(joints={"shoulder": "M1", "elbow": "M2"})
    np.testing.assert_array_equal(read_log(table, JOINTS, source=source).q, LOG.q)
    swapped = LogSource(joints={"M1": "M2", "M2": "M1"})
    np.testing.assert_array_equal(read_log(table, ("M1", "M2"), source=swapped).q, LOG.q[:, ::-1])
    with pytest.raises(DataError, match="no columns 'q_M3', 'tau_M3'"):
        read_log(table, JOINTS, source=LogSource(joints={"shoulder": "M1", "elbow": "M3"}))


def test_a_joint_that_mimics_another_needs_no_column_and_no_lock():
    model = RobotModel.from_urdf(example_urdf("panda.urdf"))
    leaders = [joint.name for joint in model.tree.movable if joint.mimic is None]
    table = pd.DataFrame({"time": T} | {f"{k}_{x}": ONE for k in ("q", "tau") for x in leaders})
    with pytest.raises(DataError, match=r"joint2 mimics panda_finger_joint1: .* mimic = \"coupl"):
        read_log(table, model.joints, robot=model.tree.movable)
    coupled = RobotModel.from_urdf(example_urdf("panda.urdf"), mimic="coupled")
    assert read_log(table, coupled.joints, robot=coupled.tree.movable).joints == coupled.joints


# --- units ----------------------------------------------------------------------------------------


def test_stated_units_become_si():
    table = {
        "time": LOG.t * 1e3,
        **{f"{kind}_shoulder": np.degrees(x[:, 0])
           for kind, x in (("q", LOG.q), ("dq", LOG.v), ("ddq", LOG.a))},
        **{f"{kind}_elbow": x[:, 1] for kind, x in (("q", LOG.q), ("dq", LOG.v), ("ddq", LOG.a))},
    }  # fmt: skip
    given = frame(**table)  # the elbow is in m
    with pytest.raises(DataError, match="looks like milliseconds"):
        read_log(given, JOINTS)
    with pytest.raises(DataError, match="looks like degrees"):
        read_log(given, JOINTS, units=LogUnits(time="ms"))
    units = LogUnits("ms", "deg")
    log = read_log(given, JOINTS, units=units, prismatic=["elbow", "torso"], start=1001, end=1002)
    np.testing.assert_allclose(log.t, LOG.t[100:201], rtol=1e-15)
    for name in ("q", "v", "a"):
        np.testing.assert_allclose(getattr(log, name), getattr(LOG, name)[100:201], rtol=1e-14)


def test_percentages_become_positions_between_their_ends():
    ends = {"shoulder": (-2.0, 3.0), "elbow": (-0.5, 2.0)}
    table = {}
    for j, (joint, (low, high)) in enumerate(ends.items()):
        for kind, x in (("q", LOG.q[:, j]), ("qref", LOG.q[::-1, j])):
            table[f"{kind}_{joint}"] = 100 * (x - low) / (high - low)
        for kind, x in (("dq", LOG.v[:, j]), ("dqref", LOG.v[::-1, j])):
            table[f"{kind}_{joint}"] = 100 * x / (high - low)
    units = LogUnits(angle="deg", percent={x: list(own) for x, own in ends.items()})
    log = read_log(frame(**table), JOINTS, units=units, needs="commands")
    np.testing.assert_allclose(log.q, LOG.q, atol=1e-12)
    np.testing.assert_allclose(log.v, LOG.v, atol=1e-12)
    np.testing.assert_allclose(log.q_ref, LOG.q[::-1], atol=1e-12)
    np.testing.assert_allclose(log.v_ref, LOG.v[::-1], atol=1e-12)
    for wrong in ([0.1], [0.3, 0.3], ["a", 1.0], 5.0, [0.0, np.inf]):
        with pytest.raises(SettingsError, match=r"percent of jaw is .* expected two different"):
            LogUnits(percent={"jaw": wrong})


@pytest.mark.parametrize(("name", "value", "message"), [
    ("time", 1002.02, r"t\[203\] = 1002\.020 s is a duplicate time stamp, the same as t\[202\]"),
    ("time", 1002.01, r"t\[203\] = 1002\.010 s follows t\[202\] = 1002\.020 s"),
    ("q_elbow", np.nan, "q_elbow is NaN at row 203"),
])  # fmt: skip
def test_rows_of_a_part_are_named_by_their_number_in_the_file(name, value, message):
    layout, _ = lay_out(frame(), JOINTS)
    part = {key: x[200:210].to_numpy(copy=True) for key, x in frame().items()}
    part[name][3] = value
    with pytest.raises(DataError, match=message):
        layout.to_log(part, 200)


# --- a base, contacts and other sensors -----------------------------------------------------------


def test_columns_of_another_rate_are_named_with_their_share():
    t = T[:40]
    held = np.where(np.arange(40) % 4, np.nan, t)
    wanted = BaseColumns(True, wrenches=("fz f", "mx f"))
    pose = {f"base_{x}": 0.0 * t for x in ("x", "y", "z", "qx", "qy", "qz")} | {"base_qw": t**0}
    table = {"time": t, "q_a": 0 * t, "wrench_fz_f": held, "wrench_mx_f": t} | pose
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
        given = {x: y for x, y in (table | changes).items() if y is not None}
        with pytest.raises(DataError, match=words):
            read_log(pd.DataFrame(given), ["a"], base=wanted)

    read_log(pd.DataFrame(table | {"base_yaw": 30.0 * t}), ["a"], base=wanted)  # full turns
    lost = np.where(np.arange(90) == 7, np.nan, t)
    refused(r"log: base_z is NaN at row 7 \(t = 2.07 s\); remove such rows", base_z=lost)
    refused(r"log: wrench_fz_f is NaN at row 7", wrench_fz_f=lost)
    refused(r"base_roll and base_pitch are up to 20, expected at most", base_pitch=t[-1] - t - 20)
    cells = {"wrench_fz_f": None, "wrench_fz_f_0": t, "wrench_fz_f_1": t}
    refused(r"If wrench_fz_f_0, wrench_fz_f_1 are cells of a foot, add a column of their", **cells)
    table["wrench_fz_f"] = [[x, x] for x in t]
    pd.DataFrame(table).to_parquet(tmp_path / "run.parquet")
    with pytest.raises(DataError, match="expected numbers; write one column per value, or their"):
        read_log(tmp_path / "run.parquet", ["a"], base=wanted)


# --- real recordings ------------------------------------------------------------------------------


def test_a_csv_file_is_read_without_any_other_library(tmp_path):
    write_log(LOG, tmp_path / "run.csv")
    code = (
        "import sys\nfrom robotid.data.files.read import read_log\n"
        f"read_log({str(tmp_path / 'run.csv')!r}, {JOINTS!r})\n"
        "sys.exit(any(m.split('.')[0] in ('rosbags', 'h5py', 'pyarrow') for m in sys.modules))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


DRIVEN = ("shoulder", "elbow", "wrist")
# the last motor turns with the last two joints
WRIST = dict(joints=("elbow", "wrist"), motors=("m2", "m3"), matrix=((45.0, 0.0), (32.0, -30.0)))
MOTORS = (
    Transmission(joints=("shoulder",), motors=("m1",), matrix=(-101.0,), efficiency=(0.8,)),
    Transmission(**WRIST, efficiency=(0.9, 0.7), offset=(0.3, -1.2)),
)
GEARS = np.array([[-101.0, 0, 0], [0, 45, 0], [0, 32, -30]])
OFFSET, EFFICIENCY = np.array([0, 0.3, -1.2]), np.array([0.8, 0.9, 0.7])


@pytest.fixture
def motion(rng):
    """Positions, speeds and torques of the joints and their commands, by kind."""
    kinds = [f"{kind}{ref}" for ref in ("", "ref") for kind in ("q", "dq", "tau")]
    return {kind: rng.uniform(-1, 1, (20, 3)) for kind in kinds}


def motor_side(motion):
    """What motors do that drive the joints so: w = T v, q_m = T (q - q_0), power passes."""
    moved = {}
    for ref in ("", "ref"):
        moved[f"q{ref}m"] = (motion[f"q{ref}"] - OFFSET) @ GEARS.T
        moved[f"dq{ref}m"] = motion[f"dq{ref}"] @ GEARS.T
        moved[f"tau{ref}m"] = np.linalg.solve(GEARS.T, motion[f"tau{ref}"].T).T / EFFICIENCY
    return {"time": np.arange(20) / 100} | {
        f"{kind}_m{i + 1}": x[:, i] for kind, x in moved.items() for i in range(3)
    }


def save(path, table):
    write_columns(table, path)
    return path


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_motor_columns_become_those_of_the_joints(tmp_path, motion, suffix):
    path = save(tmp_path / f"run{suffix}", motor_side(motion))
    log = read_log(path, DRIVEN, transmissions=MOTORS, needs="commands")
    assert log.notes == ()
    for kind, values in motion.items():
        np.testing.assert_allclose(getattr(log, COLUMNS[kind]), values, atol=1e-12)
    # without losses, the motors give the power that the joints take
    table, lossless = motor_side(motion), Transmission(**WRIST)
    own = read_log(path, DRIVEN, transmissions=(MOTORS[0], lossless))
    power = sum(table[f"taum_{m}"] * table[f"dqm_{m}"] for m in ("m2", "m3"))
    np.testing.assert_allclose(np.sum(own.tau[:, 1:] * own.v[:, 1:], axis=1), power)


def test_each_quantity_may_be_of_either_side(tmp_path, motion):
    table = {name: x for name, x in motor_side(motion).items() if not name.startswith("qm")}
    table |= {f"q_{joint}": motion["q"][:, j] for j, joint in enumerate(DRIVEN)}
    log = read_log(save(tmp_path / "run.csv", table), DRIVEN, transmissions=MOTORS)
    np.testing.assert_array_equal(log.q, motion["q"])
    np.testing.assert_allclose(log.tau, motion["tau"], atol=1e-12)


def test_currents_of_motors_take_gains_at_the_motor_and_angles_may_be_degrees(tmp_path, motion):
    table = motor_side(motion)
    table["currentm_m3"] = table.pop("taum_m3") / 0.12
    table |= {name: np.rad2deg(x) for name, x in table.items() if name[:2] in ("qm", "dq")}
    path = save(tmp_path / "run.csv", table)
    units = LogUnits(angle="deg")
    log = read_log(
        path, DRIVEN, transmissions=MOTORS, gains={"m3": 0.12}, units=units, prismatic=["wrist"]
    )
    np.testing.assert_allclose(log.q, motion["q"], atol=1e-12)  # what turns is the motor
    np.testing.assert_allclose(log.tau, motion["tau"], atol=1e-12)
    with pytest.raises(DataError, match=r"'m3' has the current 'currentm_m3' but no gain"):
        read_log(path, DRIVEN, transmissions=MOTORS, units=units)


def test_joints_of_a_transmission_are_all_read(tmp_path, motion):
    path = save(tmp_path / "run.csv", motor_side(motion))
    text = "transmission: wrist are not among the joints identified: shoulder, elbow. Leave them"
    with refused(text, SettingsError):
        read_log(path, DRIVEN[:2], transmissions=MOTORS)


def test_motors_of_several_joints_drive_in_the_place_of_the_joints_without_their_own():
    assert Transmission(**WRIST).shared == {"wrist": (("elbow", 1.0), ("wrist", -30.0 / 32.0))}
    assert Transmission(**WRIST).gears == {"elbow": 45.0, "wrist": 32.0}
    assert Transmission(joints=DRIVEN, matrix=(3.0, -4.0, 5.0)).shared == {}
    assert Transmission(joints=("a", "b"), matrix=(1e6, -1e-6)).gears == {"a": 1e6, "b": -1e-6}
    crossed = Transmission(joints=("a", "b"), motors=("x", "y"), matrix=((0, 7.0), (8.0, 8.0)))
    assert crossed.shared == {"a": (("a", 1.0), ("b", 1.0))}
    assert crossed.gears == {"b": 7.0, "a": 8.0}
    back = Transmission(
        joints=("a", "b", "c"), matrix=((5.0, 0, 0), (0, 3.0, -32.0), (0, 2.0, 7.0))
    )
    assert back.shared == {
        "b": (("b", 3.0 / -32.0), ("c", 1.0)),
        "c": (("b", 2.0 / 7.0), ("c", 1.0)),
    }
    assert back.gears == {"a": 5.0, "b": -32.0, "c": 7.0}


def refused(text, kind=DataError):
    return pytest.raises(kind, match="^" + re.escape(text))


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (
            {"matrix": ((1.0, 1.0), (2.0, 2.0))},
            "transmission of elbow, wrist: matrix [[1.0, 1.0], [2.0, 2.0]] is singular, expected "
            "linearly independent rows, one for each motor",
        ),
        ({"matrix": (10.0, 0.0)}, "transmission of elbow, wrist: matrix [10.0, 0.0] is singular"),
        (
            {"matrix": ((1.0, 1.0),)},
            "transmission of elbow, wrist: matrix is [[1.0, 1.0]], expected 2 rows of 2 numbers",
        ),
        ({"motors": ("m2", "m2")}, "transmission: motors contains m2 twice"),
        ({"motors": ("m2",)}, "transmission of elbow, wrist: motors has 1 entries, expected 2"),
        ({"efficiency": (0.9, 1.2)}, "transmission: efficiency of 'm3' is 1.2, expected more than"),
        ({"matrix": "file"}, "transmission: matrix is 'file', expected rows of numbers"),
    ],
)
def test_an_impossible_transmission_is_refused(change, text):
    with refused(text, SettingsError):
        Transmission(**(WRIST | change))


def test_both_sides_of_one_joint_are_refused(tmp_path, motion):
    path = save(tmp_path / "run.csv", motor_side(motion) | {"q_wrist": motion["q"][:, 2]})
    text = (
        "run.csv has 'qm_m2' of a motor and 'q_wrist' of a joint that it drives, two position "
        "columns of one transmission; remove the columns of the motors"
    )
    with refused(text):
        read_log(path, DRIVEN, transmissions=MOTORS)


def test_gears_without_a_motor_column_are_named(tmp_path, motion):
    table = motor_side(motion)
    del table["taum_m2"]
    with pytest.raises(DataError, match=r"^run.csv has no column 'taum_m2'; torque or current"):
        read_log(save(tmp_path / "run.csv", table), DRIVEN, transmissions=MOTORS)


def test_a_motor_or_joint_in_two_transmissions_is_refused(tmp_path, motion):
    path = save(tmp_path / "run.csv", motor_side(motion))
    for noun, other in (("motors m3", ("a", "m3")), ("joints wrist", ("wrist", "m4"))):
        more = Transmission(joints=other[:1], motors=other[1:], matrix=(1.0,))
        with refused(f"several transmissions contain the {noun}", SettingsError):
            read_log(path, DRIVEN, transmissions=[*MOTORS, more])


def test_gear_ratios_of_the_urdf_are_used_only_if_asked_for():
    asked = Transmission(joints=("elbow", "wrist"), matrix="urdf")
    assert asked.stated({"wrist": -80.0, "elbow": 50.0, "other": 1.0}).T.tolist() == [
        [50.0, 0.0], [0.0, -80.0],
    ]  # fmt: skip
    stated = Transmission(**WRIST)
    assert stated.stated({"wrist": 9.0}) is stated
    with refused(
        "transmission: matrix is 'urdf', but the URDF has no <transmission> with a "
        "<mechanicalReduction> only for elbow; it has one for wrist. Set",
        SettingsError,
    ):
        asked.stated({"wrist": 80.0})


DEGREES = LogUnits(angle="deg")
COMMANDED = replace(
    LOG, v=None, a=None, tau=np.zeros((300, 2)), has_torque=False, q_ref=np.sin(PHASE + 0.1),
    v_ref=np.cos(PHASE + 0.1) * [2.0, 3.0], tau_ref=10 * np.cos(PHASE),
)  # fmt: skip


def commanded(**more):
    return frame(**NO_TAU, **of("qref", COMMANDED.q_ref), **more)


def test_no_two_quantities_share_a_name():
    assert quantity_of("q_des_elbow") == ("qref", "elbow")
    assert quantity_of("q_elbow") == ("q", "elbow")
    assert quantity_of("command_velocity_elbow") == ("dqref", "elbow")
    assert quantity_of("effort_command_elbow") == ("tauref", "elbow")
    for unread in ("target_current_0", "tau_q_elbow", "q_"):
        assert quantity_of(unread) is None
    assert quantity_of("effort_command_elbow", "current") is None


def test_what_is_not_needed_is_not_read():
    log = COMMANDED
    table = {"time": log.t, **of("q", log.q), **of("qref", log.q_ref * np.nan)}
    table |= of("tau", 3 * log.q)
    given = pd.DataFrame(table)
    torques = read_log(given, JOINTS)
    assert (torques.has_torque, torques.q_ref) == (True, None)
    assert torques.notes == ("columns ignored: qref_shoulder, qref_elbow",)
    motion = read_log(given, JOINTS, needs="motion")
    assert (motion.has_torque, motion.tau.any(), motion.q_ref) == (False, False, None)
    with pytest.raises(DataError, match="qref_shoulder is NaN at row 0"):
        read_log(given, JOINTS, needs="commands")


@pytest.mark.parametrize(
    ("torques", "commands", "read"),
    [
        (2, 2, "both"), (2, 1, "torque"), (2, 0, "torque"), (0, 2, "commands"),
        (1, 2, "tau_elbow"), (1, 1, "tau_elbow"), (1, 0, "tau_elbow"), (0, 0, "tau_shoulder"),
        (0, 1, "qref_elbow"),
    ],
)  # fmt: skip
def test_of_torques_or_commands_what_there_is_must_be_whole(torques, commands, read):
    """A joint without what another has is refused; not commands of some beside all torques."""
    log = COMMANDED
    table = {"time": log.t, **of("q", log.q)}
    table |= {f"tau_{joint}": log.t + k for k, joint in enumerate(JOINTS[:torques])}
    table |= {f"qref_{joint}": log.q_ref[:, k] for k, joint in enumerate(JOINTS[:commands])}
    if "_" in read:
        with pytest.raises(DataError, match=f"no columns? '{read}'"):
            read_log(pd.DataFrame(table), JOINTS, needs="any")
        return
    found = read_log(pd.DataFrame(table), JOINTS, needs="any")
    assert found.has_torque is (read != "commands")
    wanted = log.t[:, None] + [0, 1] if found.has_torque else np.zeros((300, 2))
    np.testing.assert_array_equal(found.tau, wanted)
    assert (found.q_ref is None) is (read == "torque")
    if found.q_ref is not None:
        np.testing.assert_array_equal(found.q_ref, log.q_ref)


def test_half_of_the_rest_is_noted():
    part = np.ones(300)
    log = read_log(commanded(dqref_elbow=part).assign(tau_elbow=part), JOINTS, needs="commands")
    assert (log.v_ref, log.has_torque) == (None, False)
    assert log.notes == (
        "torques ignored: shoulder have no torque, and no current with a gain",
        "dqref_elbow ignored: shoulder have no commanded velocity",
        "columns ignored: tau_elbow",
    )
    currents = {f"current_{joint}": part for joint in JOINTS}
    log = read_log(commanded(**currents), JOINTS, needs="commands")
    assert not log.has_torque
    log = read_log(
        commanded(**currents), JOINTS, needs="commands", gains=dict.fromkeys(JOINTS, 2.0)
    )
    assert log.has_torque
    assert (log.tau == 2.0).all()
    half = commanded().assign(tau_shoulder=part)
    log = read_log(half, JOINTS, needs="commands", passive=("elbow",))  # it needs no torque
    np.testing.assert_array_equal(log.tau, np.column_stack([part, 0 * part]))
    assert log.has_torque


def test_degrees_and_wide_arrays_hold_for_commands(tmp_path):
    log = COMMANDED
    table = {"time": log.t, **of("q", np.rad2deg(log.q)), **of("tauref", log.tau_ref)}
    table |= of("qref", np.rad2deg(log.q_ref)) | of("dqref", np.rad2deg(log.v_ref))
    back = read_log(pd.DataFrame(table), JOINTS, needs="commands", units=DEGREES)
    for name in ("q", "q_ref", "v_ref", "tau_ref"):
        np.testing.assert_allclose(getattr(back, name), getattr(log, name), atol=1e-15)
    how = {"needs": "commands", "units": DEGREES, "prismatic": ["elbow"]}
    slid = read_log(pd.DataFrame(table), JOINTS, **how)
    np.testing.assert_array_equal(slid.q_ref[:, 1], np.rad2deg(log.q_ref[:, 1]))
    arrays = wide(Log(log.t, log.q, log.q, JOINTS, v=log.q))
    np.savez(tmp_path / "run.npz", **arrays, q_des=log.q_ref)
    back = read_log(tmp_path / "run.npz", JOINTS, needs="commands")
    np.testing.assert_array_equal(back.q_ref, log.q_ref)


def test_a_log_without_torque_is_told_what_it_can_do():
    log = COMMANDED
    for given, needs, fragment in (
        (log, "torque", r'log has no torque. .* with estimator="simulation", controller={"kp": N'),
        (Log(log.t, log.q, log.q, JOINTS), "commands", "log has no commanded positions; pass them"),
    ):
        with pytest.raises(DataError, match=fragment):
            read_logs(given, JOINTS, needs=needs)
    sizes = {f"loadsize_{joint}": np.ones(300) for joint in JOINTS}
    assert read_log(commanded(**sizes), JOINTS, needs="commands").notes == (
        "loadsize_shoulder, loadsize_elbow ignored: the absolute value of a load does not "
        "determine the direction of the torque",
    )
    chosen = {f"tau_{joint}": f"loadsize_{joint}" for joint in JOINTS}
    assert read_log(commanded(**sizes), JOINTS, columns=chosen).has_torque
