"""Commands in logs: their names, units and gears, and what of torques and commands is read."""

import numpy as np
import pandas as pd
import pytest
from helpers.recorders import wide

from robotid.base.exceptions import DataError
from robotid.data.files.columns import quantity_of
from robotid.data.files.read import read_log, read_logs
from robotid.data.log import Log
from robotid.data.signal_settings import LogUnits, Transmission

JOINTS = ("shoulder", "elbow")
DEGREES = LogUnits(angle="deg")


def make_log(count=300, **changes):
    t = 1000.0 + np.arange(count) / 100
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


def columns(kind, values):
    return {f"{kind}_{joint}": values[:, j] for j, joint in enumerate(JOINTS)}


def frame(**more):
    log = make_log()
    table = {"time": log.t, **columns("q", log.q), **columns("qref", log.q_ref), **more}
    return pd.DataFrame({name: x for name, x in table.items() if x is not None})


def test_no_two_quantities_share_a_name():
    assert quantity_of("q_des_elbow") == ("qref", "elbow")
    assert quantity_of("q_elbow") == ("q", "elbow")
    assert quantity_of("command_velocity_elbow") == ("dqref", "elbow")
    assert quantity_of("effort_command_elbow") == ("tauref", "elbow")
    for unread in ("target_current_0", "tau_q_elbow", "q_"):
        assert quantity_of(unread) is None
    assert quantity_of("effort_command_elbow", "current") is None


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
    half = frame(tau_shoulder=part)
    log = read_log(half, JOINTS, needs="commands", passive=("elbow",))  # it needs no torque
    np.testing.assert_array_equal(log.tau, np.column_stack([part, 0 * part]))
    assert log.has_torque


def test_degrees_and_wide_arrays_hold_for_commands(tmp_path):
    log = make_log()
    table = {"time": log.t, **columns("q", np.rad2deg(log.q)), **columns("tauref", log.tau_ref)}
    table |= columns("qref", np.rad2deg(log.q_ref)) | columns("dqref", np.rad2deg(log.v_ref))
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
    log = make_log()
    for given, needs, fragment in (
        (log, "torque", r'log has no torque. .* with estimator="simulation", controller={"kp": N'),
        (Log(log.t, log.q, log.q, JOINTS), "commands", "log has no commanded positions; pass them"),
    ):
        with pytest.raises(DataError, match=fragment):
            read_logs(given, JOINTS, needs=needs)
    sizes = {f"loadsize_{joint}": np.ones(300) for joint in JOINTS}
    assert read_log(frame(**sizes), JOINTS, needs="commands").notes == (
        "loadsize_shoulder, loadsize_elbow ignored: the absolute value of a load does not "
        "determine the direction of the torque",
    )
    chosen = {f"tau_{joint}": f"loadsize_{joint}" for joint in JOINTS}
    assert read_log(frame(**sizes), JOINTS, columns=chosen).has_torque
    with pytest.raises(DataError, match="has_torque is False, but tau is not 0"):
        Log(log.t, log.q, log.q, JOINTS, has_torque=False)
