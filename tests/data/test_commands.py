"""Logs of what was commanded: read of every format, with torque or without, or refused by name."""

import json
import sqlite3
from dataclasses import replace

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from helpers.recorders import (
    StoragePlugin,
    messages_of,
    wide,
    write_bag2,
    write_controller,
    write_idl_controller,
    write_lerobot,
)

from robotid.base.exceptions import DataError, SettingsError
from robotid.base.files import file_sha256, log_exists, source_entry
from robotid.cli.convert import convert
from robotid.data.files.column_names import quantity_of
from robotid.data.files.formats import write_columns
from robotid.data.files.read import lay_out, read_log, read_logs, write_log
from robotid.data.log import COLUMNS, Log
from robotid.data.signal_settings import LogSource, LogUnits, SignalSettings
from robotid.data.transmission import Transmission
from robotid.estimation.fitting.survey import survey_log

JOINTS = ("shoulder", "elbow")


def make_log(count=300, **changes):
    t = np.arange(count) / 100
    phase = t[:, None] * [2.0, 3.0]
    fields = {
        "t": t,
        "q": np.sin(phase),
        "tau": np.zeros((count, 2)),
        "joints": JOINTS,
        "q_ref": np.sin(phase + 0.1),
        "v_ref": np.cos(phase + 0.1) * [2.0, 3.0],
        "tau_ref": 10 * np.cos(phase),
        "has_torque": False,
    }
    return Log(**(fields | changes))


def assert_same(back, log):
    assert back.has_torque == log.has_torque
    for name in ("t", *COLUMNS.values()):
        np.testing.assert_array_equal(getattr(back, name), getattr(log, name), name)


@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".npz", ".h5", ".mat"])
@pytest.mark.parametrize("has_torque", [True, False])
def test_commands_survive_every_format(tmp_path, suffix, has_torque):
    log = make_log(has_torque=has_torque)
    log = replace(log, tau=log.q * 3) if has_torque else log
    write_log(log, tmp_path / f"run{suffix}")
    back = read_log(tmp_path / f"run{suffix}", JOINTS, needs="commands")
    assert_same(back, log)
    assert back.notes == ()
    assert_same(
        read_log(tmp_path / f"run{suffix}", JOINTS[::-1], needs="commands").select(JOINTS), log
    )


def test_commands_are_cut_and_chosen_with_the_log():
    log = make_log()
    part = log.window(1.0, 2.0).select(["elbow"])
    np.testing.assert_array_equal(part.q_ref, log.q_ref[100:201, 1:])
    np.testing.assert_array_equal(part.v_ref, log.v_ref[100:201, 1:])
    np.testing.assert_array_equal(part.tau_ref, log.tau_ref[100:201, 1:])
    assert not part.has_torque
    assert not part.q_ref.flags.writeable


def test_data_frames_and_wide_arrays_hold_commands(tmp_path):
    log = make_log()
    table = {"time": log.t, **columns("q", log.q), **columns("command", log.q_ref)}
    back = read_log(pd.DataFrame(table), JOINTS, needs="commands")
    np.testing.assert_array_equal(back.q_ref, log.q_ref)
    assert (back.v_ref, back.tau_ref) == (None, None)
    np.savez(tmp_path / "run.npz", **wide(replace(log, v=log.q)), q_des=log.q_ref)
    np.testing.assert_array_equal(
        read_log(tmp_path / "run.npz", JOINTS, needs="commands").q_ref, log.q_ref
    )


def columns(kind, values):
    return {f"{kind}_{joint}": values[:, j] for j, joint in enumerate(JOINTS)}


@pytest.mark.parametrize(
    ("alias", "name"),
    [
        ("qref", "q_ref"), ("q_des", "q_ref"), ("qdes", "q_ref"), ("position_command", "q_ref"),
        ("target_position", "q_ref"), ("command", "q_ref"), ("dqref", "v_ref"),
        ("qd_des", "v_ref"), ("velocity_command", "v_ref"), ("tauref", "tau_ref"),
        ("tau_cmd", "tau_ref"), ("desired_effort", "tau_ref"),
    ],
)  # fmt: skip
def test_names_of_peers_are_read(alias, name):
    log = make_log()
    table = {"time": log.t, **columns("q", log.q)}
    if name != "q_ref":
        table |= columns("qref", log.q_ref)
    back = read_log(
        pd.DataFrame(table | columns(alias, getattr(log, name))), JOINTS, needs="commands"
    )
    np.testing.assert_array_equal(getattr(back, name), getattr(log, name))


def test_no_two_quantities_share_a_name():
    assert quantity_of("q_des_elbow") == ("qref", "elbow")
    assert quantity_of("q_elbow") == ("q", "elbow")
    assert quantity_of("command_velocity_elbow") == ("dqref", "elbow")
    assert quantity_of("effort_command_elbow") == ("tauref", "elbow")
    for unread in ("target_current_0", "tau_q_elbow", "q_"):
        assert quantity_of(unread) is None
    assert quantity_of("effort_command_elbow", "current") is None


def test_degrees_and_transmissions_hold_for_commands(tmp_path):
    log = make_log()
    table = {"time": log.t, **columns("q", np.rad2deg(log.q)), **columns("tauref", log.tau_ref)}
    table |= columns("qref", np.rad2deg(log.q_ref)) | columns("dqref", np.rad2deg(log.v_ref))
    write_columns(table, tmp_path / "run.npz")
    units = LogUnits(angle="deg")
    back = read_log(tmp_path / "run.npz", JOINTS, needs="commands", units=units)
    for name in ("q", "q_ref", "v_ref", "tau_ref"):
        np.testing.assert_allclose(getattr(back, name), getattr(log, name), atol=1e-15)
    slid = read_log(
        tmp_path / "run.npz", JOINTS, needs="commands", units=units, prismatic=["elbow"]
    )
    np.testing.assert_array_equal(slid.q_ref[:, 1], np.rad2deg(log.q_ref[:, 1]))


def test_commands_of_motors_pass_the_gears():
    log, T = make_log(), np.array([[2.0, 0.0], [1.0, -3.0]])  # w = T v
    gear = Transmission(
        joints=JOINTS,
        matrix=T.tolist(),
        motors=("a", "b"),
        efficiency=(0.9, 0.7),
        offset=(0.1, 0.2),
    )
    table = {"time": log.t, **columns("q", log.q)}
    table |= dict(zip(("qrefm_a", "qrefm_b"), ((log.q_ref - [0.1, 0.2]) @ T.T).T, strict=True))
    table |= dict(zip(("dqrefm_a", "dqrefm_b"), (log.v_ref @ T.T).T, strict=True))
    turned = np.linalg.solve(T.T, log.tau_ref.T).T / [0.9, 0.7]
    table |= dict(zip(("taurefm_a", "taurefm_b"), turned.T, strict=True))
    back = read_log(pd.DataFrame(table), JOINTS, needs="commands", transmissions=[gear])
    for name in ("q", "q_ref", "v_ref", "tau_ref"):
        np.testing.assert_allclose(getattr(back, name), getattr(log, name), atol=1e-14)


def test_what_is_not_needed_is_not_read():
    log = make_log()
    table = {"time": log.t, **columns("q", log.q), **columns("qref", log.q_ref * np.nan)}
    table |= columns("tau", 3 * log.q)
    frame = pd.DataFrame(table)
    torques = read_log(frame, JOINTS)
    assert (torques.has_torque, torques.q_ref) == (True, None)
    assert torques.notes == ("columns ignored: qref_shoulder, qref_elbow",)
    motion = read_log(frame, JOINTS, needs="motion")
    assert (motion.has_torque, motion.tau.any(), motion.q_ref) == (False, False, None)
    with pytest.raises(DataError, match="qref_shoulder is NaN at row 0"):
        read_log(frame, JOINTS, needs="commands")
    with pytest.raises(SettingsError, match="needs is 'everything', wanted one of torque, motion"):
        read_log(frame, JOINTS, needs="everything")


def frame(**more):
    log = make_log()
    table = {"time": log.t, **columns("q", log.q), **columns("qref", log.q_ref), **more}
    return pd.DataFrame({name: x for name, x in table.items() if x is not None})


def test_a_half_command_names_the_joints():
    with pytest.raises(DataError) as error:
        read_log(frame(qref_elbow=None), JOINTS, needs="commands")
    assert str(error.value) == (
        "log has no column 'qref_elbow'; commanded position columns found: qref_shoulder. If "
        "elbow was at rest, lock it at its position, as --lock elbow=0, or locked = { elbow = 0 } "
        "in the job file"
    )
    with pytest.raises(DataError) as error:
        read_log(frame(qref_elbow=None, qref_shoulder=None), JOINTS, needs="commands")
    assert str(error.value) == (
        "log has no columns 'qref_shoulder', 'qref_elbow'; commanded position columns found: none. "
        "Record the commands of the controller"
    )


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
    log = make_log()
    table = {"time": log.t, **columns("q", log.q)}
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
    log = read_log(frame(dqref_elbow=part, tau_elbow=part), JOINTS, needs="commands")
    assert (log.v_ref, log.has_torque) == (None, False)
    assert log.notes == (
        "torques ignored: shoulder have no torque, and no current with a gain",
        "dqref_elbow ignored: shoulder have no commanded velocity",
        "columns ignored: tau_elbow",
    )
    currents = {f"current_{joint}": part for joint in JOINTS}
    log = read_log(frame(**currents), JOINTS, needs="commands")
    assert not log.has_torque
    log = read_log(frame(**currents), JOINTS, needs="commands", gains=dict.fromkeys(JOINTS, 2.0))
    assert log.has_torque
    assert (log.tau == 2.0).all()


COMMANDED = (
    "All estimators but the simulation need tau_<joint> or current_<joint>. The log has commanded "
    "positions: identify the drives from them, "
)


def test_a_log_without_torque_is_told_what_it_can_do():
    with pytest.raises(DataError) as error:
        read_log(frame(), JOINTS)
    assert str(error.value) == (
        "log has no columns 'tau_shoulder', 'tau_elbow'; torque or current columns found: none. "
        f"{COMMANDED}by --estimator simulation --kp N_M_PER_RAD or in the job file; without kp, "
        'the masses of the URDF determine the scale\n[estimator]\nname = "simulation"\n\n'
        "[controller]\nkp = N_M_PER_RAD  # position gain, if you know it"
    )
    with pytest.raises(DataError) as error:
        read_log(frame(qref_elbow=None), JOINTS)
    assert str(error.value).endswith(
        "none. Record tau_<joint> or current_<joint>. Commanded positions, qref_<joint>, are "
        'enough for the estimator "simulation"'
    )
    with pytest.raises(DataError) as error:
        read_logs(make_log(), JOINTS)
    assert str(error.value) == (
        f'log has no torque. {COMMANDED}with estimator="simulation", controller={{"kp": '
        "N_M_PER_RAD}"
    )
    assert read_logs(make_log(), JOINTS[::-1], needs="commands")[0].joints == JOINTS[::-1]
    with pytest.raises(DataError, match=r"log has no commanded positions; pass them as Log\("):
        read_logs(make_log(q_ref=None), JOINTS, needs="commands")


def test_a_log_without_torque_has_none():
    with pytest.raises(DataError, match="has_torque is False, but tau is not 0"):
        make_log(tau=np.ones((300, 2)))
    with pytest.raises(DataError, match=r"qref has shape \(300, 1\), wanted \(300, 2\)"):
        make_log(q_ref=np.zeros((300, 1)))
    broken = make_log().q_ref.copy()
    broken[7, 1] = np.nan
    with pytest.raises(DataError, match="qref_elbow is NaN at row 7"):
        make_log(q_ref=broken)


def test_commands_in_other_units_than_positions_are_refused():
    log = make_log()
    with pytest.raises(DataError, match=r"the motion of qref_elbow is 57\.3 times that of q_elbow"):
        read_log(frame(qref_elbow=np.rad2deg(0.1 * log.q_ref[:, 1]), q_elbow=0.1 * log.q[:, 1]),
                 JOINTS, needs="commands")  # fmt: skip
    with pytest.raises(DataError, match=r"qref_elbow reaches 57\.3, which looks like degrees"):
        read_log(frame(qref_elbow=np.rad2deg(log.q_ref[:, 1])), JOINTS, needs="commands")
    same = frame(qref_elbow=20 * log.q[:, 1])
    assert read_log(same, JOINTS, needs="commands", units=LogUnits(angle="rad")).q_ref.max() > 19


def test_a_size_without_sign_is_named_and_not_read():
    sizes = {f"loadsize_{joint}": np.ones(300) for joint in JOINTS}
    log = read_log(frame(**sizes), JOINTS, needs="commands")
    assert not log.has_torque
    assert log.notes == (
        "loadsize_shoulder, loadsize_elbow ignored: the absolute value of a load does not "
        "determine the direction of the torque",
    )
    with pytest.raises(DataError) as error:
        read_log(frame(qref_elbow=None, **sizes), JOINTS)
    assert "none. Loads without sign, which are no torques: loadsize_sh" in str(error.value)
    assert "Rename" not in str(error.value)
    chosen = {f"tau_{joint}": f"loadsize_{joint}" for joint in JOINTS}
    assert read_log(frame(**sizes), JOINTS, columns=chosen).notes == (
        "columns ignored: qref_shoulder, qref_elbow",
    )


def test_a_long_log_is_read_in_pieces_with_its_commands(ur5, tmp_path):
    rng = np.random.default_rng(0)
    t = np.arange(2000) / 100
    q = 0.3 * np.sin(t[:, None] * rng.uniform(1, 3, 6))
    log = Log(t=t, q=q, tau=0 * q, joints=ur5.joints, q_ref=q + 0.01, has_torque=False)
    write_log(log, tmp_path / "run.csv")
    layout, table = lay_out(tmp_path / "run.csv", ur5.joints, needs="commands")
    whole = survey_log(layout, table, ur5, SignalSettings(cutoff=None), length=None)
    np.testing.assert_array_equal(whole.source.q_ref, log.q_ref)
    assert not whole.source.has_torque
    rows = survey_log(layout, table, ur5, SignalSettings(cutoff=None), length=500)
    piece = rows.pieces[2]
    np.testing.assert_array_equal(
        piece.header.read(*piece.span, piece.near).q_ref, log.q_ref[slice(*piece.span)]
    )


# --- bags -----------------------------------------------------------------------------------------


def driven(count=60, **changes):
    return make_log(count, v=np.ones((count, 2)), **changes)


@pytest.mark.parametrize("era", ["old", "new"])
@pytest.mark.parametrize("suffix", ["", ".bag"])
@pytest.mark.parametrize("has_torque", [True, False])
def test_the_state_of_a_trajectory_controller_is_read(tmp_path, era, suffix, has_torque):
    log = driven(has_torque=has_torque)
    log = replace(log, tau=log.q * 3) if has_torque else log
    path = write_controller(tmp_path / f"run{suffix}", log, era)
    back = read_log(path, JOINTS, needs="commands")
    assert_same(back, log)
    assert back.notes == ()


def test_definitions_in_idl_are_read(tmp_path):
    path = write_idl_controller(tmp_path / "run.mcap", driven())
    assert_same(read_log(path, JOINTS, needs="commands"), driven())


def test_what_a_controller_put_out_is_the_command(tmp_path):
    log = driven()
    path = write_controller(tmp_path / "run", log, "new", output=log.q_ref + 1)
    np.testing.assert_array_equal(read_log(path, JOINTS, needs="commands").q_ref, log.q_ref + 1)


def test_a_controller_beside_joint_states_is_named(tmp_path):
    log = driven(has_torque=True, tau=np.ones((60, 2)))
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
    path = write_controller(tmp_path / "run", driven(), "new", plugin=StoragePlugin.SQLITE3)
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
    log = driven(v_ref=None, tau_ref=None)
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
        "interval of 20 ms; messages before the first command, left out: 5; messages after the "
        "last command: 1",
    )
    only = LogSource(command="/joint_commands")
    assert_same(read_log(path, JOINTS, needs="commands", source=only), back)
    assert len(read_log(path, JOINTS, needs="motion", source=COMMANDS).t) == 55


def test_commands_of_a_topic_go_before_those_of_a_controllers_own_state(tmp_path):
    log = driven()
    told = replace(log, q=log.q_ref + 1)
    path = write_controller(tmp_path / "run", log, "new", states=list(messages_of(told)))
    source = LogSource(topic="/arm_controller/state", command="/joint_states")
    back = read_log(path, JOINTS, needs="commands", source=source)
    np.testing.assert_array_equal(back.q_ref, log.q_ref + 1)
    np.testing.assert_array_equal(back.q, log.q)


def test_topics_of_commands_that_cannot_be_are_refused(tmp_path):
    path = write_bag2(tmp_path / "bag", paired(driven()), others=["/chatter"])
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


# --- LeRobot --------------------------------------------------------------------------------------

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
    with pytest.raises(
        DataError, match=r"no episode 'episode_4'; episodes: episode_0, episode_3, "
    ):
        read_log(path, JOINTS, units=DEGREES, source=LogSource(topic="episode_4"))


@pytest.mark.parametrize("topic", ["9" * 5000, "²", "episode_٠", "-0", "x"])
def test_an_episode_that_no_dataset_has_is_refused(tmp_path, topic):
    with pytest.raises(DataError, match=r"no episode '.{1,43}'; episodes: episode_0"):
        read_log(dataset(tmp_path), JOINTS, units=DEGREES, source=LogSource(topic=topic))


def test_a_dataset_is_converted_without_its_unit(tmp_path):
    done = convert(dataset(tmp_path), tmp_path / "run.csv")
    assert done.joints == JOINTS
    back = read_log(tmp_path / "run.csv", JOINTS, needs="commands", units=DEGREES)
    np.testing.assert_allclose(back.q_ref, make_log(100).q_ref, atol=1e-6)


def test_normalised_positions_are_no_angles(tmp_path):
    with pytest.raises(DataError) as error:
        read_log(dataset(tmp_path), JOINTS, needs="commands")
    assert error.value.code == "angle_unit"
    assert str(error.value).startswith(
        "arm: the unit of positions is not in the files of LeRobot. By version and use_degrees"
    )


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (
            lambda info: info["features"]["action"].update(names=None),
            "no names of the motors in ac",
        ),
        (
            lambda info: info["features"]["action"].update(names=["a", *JOINTS]),
            "at least 3 names of motors",
        ),
        (lambda info: info.pop("features"), "does not describe a LeRobot dataset of version 2"),
        (lambda info: info.update(features={"image": {}}), "neither observation.state nor action"),
        (lambda info: info.update(features=None), "features is None, wanted a table of tables"),
        (lambda info: info.update(features={"action": 5}), "wanted a table of tables"),
        (lambda info: info["features"].update(x=5), "wanted a table of tables"),
        (lambda info: info["features"]["action"].update(names=5), "no names of the motors in ac"),
        (lambda info: info["features"]["action"].update(names={"m": 5}), "no names of the motors"),
        (lambda info: info["features"]["action"].update(names=[["a"], 5]), "no names of the motor"),
        (
            lambda info: info["features"]["action"].update(names=[JOINTS[0], JOINTS[0]]),
            f"the same name for '{JOINTS[0]}' of action, number 1, and number 0 of action",
        ),
        (
            lambda info: info["features"]["action"].update(names=[f"{JOINTS[0]}.pos", JOINTS[0]]),
            "number 1, and number 0 of action; give each motor another name",
        ),
    ],
)
def test_datasets_that_do_not_fit_are_refused(tmp_path, change, text):
    path = dataset(tmp_path)
    file = path / "meta" / "info.json"
    info = json.loads(file.read_text())
    change(info)
    file.write_text(json.dumps(info))
    with pytest.raises(DataError, match=text):
        read_log(path, JOINTS, needs="commands", units=DEGREES)


@pytest.mark.parametrize("text", ["[" * 5000, "{", '{"features": ' * 60 + "1" + "}" * 60, "5"])
def test_a_description_that_is_none_is_refused(tmp_path, text):
    path = dataset(tmp_path)
    (path / "meta" / "info.json").write_text(text)
    with pytest.raises(DataError, match=r"info\.json"):
        read_log(path, JOINTS, needs="commands", units=DEGREES)
