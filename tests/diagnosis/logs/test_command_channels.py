"""The doctor finds what is wrong with commands, and nothing where nothing is."""

from dataclasses import replace

import numpy as np
import pyarrow.parquet as pq
import pytest
from helpers.findings import Figures
from helpers.servos import Servo, chirps, record

from robotid.base.exceptions import DataError
from robotid.cli.doctor import doctor
from robotid.data.files.read import read_log
from robotid.data.log import Log
from robotid.data.signal_settings import LogSource
from robotid.diagnosis.logs.command_channels import check_commands
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

GOOD = (Servo(), Servo(coulomb=2.0, delay=0.03))


@pytest.fixture(scope="module")
def log():
    """Two joints that follow chirps beyond their bandwidth of 3 Hz, each in its own time."""
    return record(chirps([0.3, 0.2], 8.0), GOOD)


def found(log):
    """The findings but the notes that every such log gets, by code."""
    return {f.code: f for f in check_commands(log) if f.code not in ("no_torque", "loops")}


# --- nothing where nothing is ---------------------------------------------------------------------
def test_forces_of_the_ground_identify_masses_without_torques_and_commands(log):
    bare = replace(log, q_ref=None, v_ref=None, tau_ref=None, tau=0.0 * log.tau, has_torque=False)
    (note,) = check_commands(bare)
    assert note.message.endswith("nothing can be identified from motion alone")
    (note,) = check_commands(replace(bare, wrenches={"fz foot": np.ones(len(log.t))}))
    assert note.message.endswith(
        "the rows of the base identify masses; friction and armature of the joints are not "
        "identified"
    )


def test_a_good_chirp_gives_notes_alone(log):
    note, loops = check_commands(log)
    assert (note.code, note.severity, note.where) == ("no_torque", "note", "log")
    assert "only relative to the controller's gains" in note.message
    assert (loops.code, loops.severity, loops.where) == ("loops", "note", "log")
    for servo, joint in zip(GOOD, log.joints, strict=True):
        # of exp(-s T) k / (s^2 + d s + k): phase T + d / k at rest, 0.707 at sqrt(k) for d = 1.4
        late = servo.delay + servo.damping / servo.stiffness
        assert loops.evidence[f"lag_{joint}"] == pytest.approx(late, rel=0.15)
        ends = np.sqrt(servo.stiffness) / (2 * np.pi)
        assert loops.evidence[f"bandwidth_{joint}"] == pytest.approx(ends, abs=0.3)


@pytest.mark.parametrize("seed", range(3))
def test_steps_and_pseudo_random_commands_are_fine(seed):
    rng = np.random.default_rng(seed)
    levels = 0.2 * rng.choice([-1.0, 1.0], (200, 2)) * rng.uniform(0.5, 1, (200, 2))

    def commands(t):
        places = np.column_stack([t / 0.4, t / 0.5]).astype(int)
        return np.take_along_axis(levels, places, axis=0)

    assert found(record(commands, GOOD, rate=100.0)) == {}


# --- each fault by its own code -------------------------------------------------------------------
@pytest.mark.parametrize("fastest", [0.5, 1.0, 1.5])
def test_a_chirp_below_the_bandwidth_does_not_tell_the_delay(fastest):
    (finding,) = found(record(chirps([0.3, 0.3], fastest), GOOD)).values()
    assert (finding.code, finding.severity, finding.where) == ("slow_command", "warning", "log")
    assert 0.08 < finding.evidence["longest"] < 0.11  # the lag: no delay is longer
    assert fastest <= finding.evidence["frequency"] < 2 * fastest + 0.5


@pytest.mark.parametrize(
    ("servo", "amplitude"), [(Servo(coulomb=2.0), 0.004), (Servo(play=0.02), 0.01)]
)
def test_commands_lost_in_friction_or_backlash_are_named(servo, amplitude):
    (finding,) = found(record(chirps([amplitude, 0.3], 4.0), [servo, GOOD[1]])).values()
    assert (finding.code, finding.where) == ("small_command", "log: joint_0")
    assert finding.severity == "warning"
    assert finding.evidence["followed"] < 0.5
    assert finding.evidence["sweep"] == pytest.approx(2 * amplitude, rel=0.01)
    share, sweep = finding.evidence["followed"], 2 * amplitude
    assert finding.message == (
        f"log: joint_0 follows {100 * share:.0f} % of slow sweeps of {sweep:.3g} rad: friction, "
        f"backlash or the dead band of its drive suppress {(1 - share) * sweep:.2g} rad; move it "
        f"by {5 * (1 - share) * sweep:.2g} rad or more"
    )


def triangles(delay, share, noise=0.0):
    """Return a log of joints that follow a share of triangles of 4 s, late."""
    t = np.arange(0.0, 20.0, 0.005)
    q_ref = np.abs((0.5 * t + [[0.3], [0.8]]) % 2.0 - 1.0).T
    q = np.column_stack([np.interp(t - delay, t, x) for x in q_ref.T]) * share
    q += noise * np.random.default_rng(1).standard_normal(q.shape)
    return Log(t, q, 0 * q, ("a", "b"), q_ref=q_ref, has_torque=False)


def test_the_followed_share_of_a_sweep_is_that_at_the_delay_of_the_joint():
    log = triangles(0.1, [0.4, 1.0])
    assert found(log)["small_command"].evidence["followed"] == pytest.approx(0.4, abs=0.002)


def test_commands_of_few_steps_of_the_encoder_are_named():
    (coarse,) = found(record(chirps([0.01, 0.3], 4.0), [Servo(quantum=0.003), GOOD[1]])).values()
    assert coarse.code == "small_command"
    assert "6.7 steps of its encoder" in coarse.message
    assert found(record(chirps([0.1, 0.3], 4.0), [Servo(quantum=0.003), GOOD[1]])) == {}


def test_a_joint_that_also_moves_far_or_beside_joints_that_show_the_delay_is_fine():
    small, slow, quick = chirps([0.004, 0.3], 4.0), chirps([0.3], 1.0), chirps([0.3, 0.2], 8.0)
    far = record(lambda t: small(t) + np.outer(t, [0.005, 0.0]), [Servo(coulomb=2.0), GOOD[1]])
    assert "small_command" not in found(far)
    both = record(lambda t: np.column_stack([slow(t), quick(t)]), [Servo(), *GOOD])
    assert found(both) == {}
    log = record(chirps([0.3, 0.3], 1.0), GOOD)
    assert list(found(replace(log, q_ref=log.q_ref * [1.0, -1.0]))) == ["command_sign"]


def test_a_drive_at_its_largest_speed_is_named():
    log = record(chirps([0.3, 0.3], 8.0), [Servo(top=1.0), Servo()])
    (finding,) = found(log).values()
    assert f"largest speed of {finding.evidence['speed']:.3g} rad/s in" in finding.message
    [rail] = [x for x in check_commands(log, ["joint_0"]) if x.code == "saturated"]
    assert f"largest speed of {finding.evidence['speed']:.3g} m/s in" in rail.message
    assert f"changes by up to {finding.evidence['error']:.2g} m: " in rail.message
    assert (finding.code, finding.severity) == ("saturated", "warning")
    assert finding.where == "log: joint_0"
    assert finding.evidence["speed"] == pytest.approx(1.0, rel=0.05)
    assert finding.evidence["error"] > 0.2


def test_ramps_that_are_followed_are_no_saturation():
    def ramps(t):
        return np.column_stack([np.abs((0.4 * t + s) % 2 - 1) for s in (0.0, 0.7)])

    stiff = Servo(damping=40.0, noise=1e-5)  # which runs at the ramps' speed all the time
    assert "saturated" not in found(record(ramps, [stiff, stiff]))


def test_a_base_that_moves_is_named():
    told = chirps([0.3, 0.0, 0.2], 8.0)

    def give(t, q):
        return 0.05 * np.column_stack([0 * t, q[:, 0] + q[:, 2], 0 * t])

    (finding,) = found(record(told, [Servo()] * 3, couple=give)).values()
    assert (finding.code, finding.where) == ("moved_by_others", "log: joint_1")
    assert finding.severity == "warning"
    assert finding.evidence["share"] > 0.95
    assert finding.evidence["size"] == pytest.approx(0.011, rel=0.3)
    assert found(record(told, [Servo()] * 3)) == {}


def test_joints_that_are_told_the_same_are_named_in_groups():
    told = chirps([0.3, 0.3], 8.0)

    def commands(t):
        one, other = told(t).T
        return np.column_stack(
            [one, -0.5 * one, other, 1 + 0.2 * other, 0.1 * told(20.0 - t)[:, 0]]
        )

    codes = [f for f in check_commands(record(commands, [Servo()] * 5)) if f.severity != "note"]
    assert [(f.code, f.severity, f.where) for f in codes] == [
        ("proportional_commands", "warning", "log: joint_0, joint_1"),
        ("proportional_commands", "warning", "log: joint_2, joint_3"),
    ]
    assert Figures(codes[0]) == {"correlation": pytest.approx(1.0), "joints": 2.0}


def test_rows_that_are_too_few_for_the_bandwidth_are_named():
    ((code, finding),) = found(record(chirps([0.3, 0.3], 8.0), GOOD, rate=20.0)).items()
    assert (code, finding.severity) == ("slow_sampling", "warning")
    assert finding.evidence["rate"] == pytest.approx(20.0)
    assert finding.evidence["bandwidth"] == pytest.approx(3.0, abs=0.7)
    assert finding.evidence["rows"] == pytest.approx(20.0 / finding.evidence["bandwidth"])
    assert finding.evidence["wanted"] == pytest.approx(10.0 * finding.evidence["bandwidth"])


@pytest.mark.parametrize("early", [0.02, 0.1])
def test_a_command_that_the_drive_had_before_is_an_error(log, early):
    # the lag of the loop is 80 to 100 ms; what is logged comes later than that
    rows = round((0.13 + early) * 200)
    late = replace(
        log.window(1.0, 19.0), q_ref=log.window(1.0 - rows / 200, 19.0 - rows / 200).q_ref
    )
    errors = [f for f in check_commands(late) if f.code == "delayed_command"]
    assert {(f.severity, f.where) for f in errors} == {("error", f"log: {x}") for x in log.joints}
    said = errors[0].message
    assert "before its command: the logged command is not the command of the drive" in said
    assert errors[0].evidence["lag"] < -early / 2


def test_exchanged_and_reversed_commands_are_errors(log):
    (order,) = found(replace(log, q_ref=log.q_ref[:, ::-1])).values()
    assert (order.code, order.severity) == ("command_order", "error")
    assert order.joints == log.joints
    assert "joint_0 follows qref_joint_1, joint_1 follows qref_joint_0" in order.message
    assert order.evidence["unexplained_so_read"] < 0.05 < 0.8 < order.evidence["unexplained"]
    (sign,) = found(replace(log, q_ref=log.q_ref * [1.0, -1.0])).values()
    assert (sign.code, sign.severity, sign.where) == ("command_sign", "error", "log: joint_1")
    assert "negate qref_joint_1" in sign.message


@pytest.mark.parametrize(("sign", "side"), [(1.0, "largest"), (-1.0, "smallest")])
def test_an_end_stop_is_named_with_its_position(log, sign, side):
    noise = 1e-4 * np.random.default_rng(1).standard_normal(log.q.shape)
    stopped = sign * np.minimum(sign * log.q, [0.17, 1.0]) + noise
    (stop,) = found(replace(log, q=stopped)).values()
    assert (stop.code, stop.severity, stop.where) == ("end_stop", "warning", "log: joint_0")
    assert f"stays at its {side} position of {sign * 0.17:.2g} rad" in stop.message
    assert sign * stop.evidence["command"] == pytest.approx(0.3, abs=0.01)


def test_a_drive_that_is_off_for_some_seconds_is_named():
    def commands(t):
        return 0.2 * np.sin(np.outer(t, [3.0, 4.1])) + 0.1 * np.sin(np.outer(t, [7.0, 5.3]))

    log = record(commands, GOOD)
    q, off = log.q.copy(), slice(1000, 1800)  # 5 s to 9 s
    q[off, 1] = q[1000, 1]
    rest = found(replace(log, q=q))["not_followed"]
    assert (rest.severity, rest.where) == ("warning", "log: joint_1")
    assert Figures(rest) == {"seconds": pytest.approx(4.0, abs=0.3)}
    assert "first at t = 5" in rest.message
    q[:, 1] = 0.1 + 1e-4 * np.random.default_rng(1).standard_normal(len(q))
    never = found(replace(log, q=q))["not_followed"]
    assert "its drive is off, or a brake, an obstacle or friction holds it" in never.message


def test_a_loop_that_gravity_deflects_need_not_move_farther():
    weak = found(triangles(0.0, 0.4, noise=1e-4))["small_command"].message
    assert "follows 40 % of slow sweeps of 1 rad, without a dead band: gravity or" in weak
    assert "move it by" not in weak


def test_a_command_that_is_held_is_noted():
    (held,) = found(record(chirps([0.3, 0.3], 8.0), GOOD, hold=4)).values()
    assert (held.code, held.severity) == ("repeated_command", "note")
    assert Figures(held) == {"rows": 4.0, "period": pytest.approx(0.02)}
    assert "at 50 Hz on average, and is constant for 20 ms" in held.message


# --- recordings -----------------------------------------------------------------------------------
#: Findings above a note of each recording: go2's joints are all told one chirp; so101's jaw runs
#: at 1.1 rad/s at most, its lift and elbow have a dead band, and slow motions show no delay.
RECORDED = {
    "go2/chirp": {"proportional_commands"},
    "so101/chirp_sweep": {"proportional_commands", "saturated"},
    "so101/friction_gravity": {"slow_command"},
    "so101/large_amplitude": {"slow_command"},
    "so101/multisine": {"slow_command"},
    "so101/prbs_excitation": {"saturated"},
    "so101/static_holding": {"proportional_commands"},
    "so101/step_response": {"small_command"},
    "so101/workspace_sweep": {"slow_command", "moved_by_others"},
}


@pytest.mark.parametrize("name", RECORDED)
def test_recordings_show_what_is_wrong_with_them(recordings, name):
    path = recordings / "commands" / f"{name}.parquet"
    joints = [x[2:] for x in pq.read_schema(path).names if x.startswith("q_")]
    log = read_log(path, joints, needs="commands")
    loud = {f.code: f for f in check_commands(log) if f.severity != "note"}
    assert set(loud) == RECORDED[name]
    if name == "go2/chirp":
        alike = loud["proportional_commands"]
        assert all(joint in alike.message for joint in joints)
        assert alike.evidence["joints"] == 12
    sizes = [note for note in log.notes if "loadsize" in note]
    assert len(sizes) == name.startswith("so101")


# --- the doctor as a whole ------------------------------------------------------------------------
@pytest.fixture(scope="module")
def of_ur5(ur5):
    """A log of a UR5 whose joints have servos of their own."""
    amplitudes = [0.3, 0.25, 0.3, 0.25, 0.3, 0.2]
    log = record(chirps(amplitudes, 8.0, duration=10.0), [Servo()] * 6, duration=10.0)
    return replace(log, joints=ur5.joints)


def test_sizes_of_loads_taken_for_torques_are_an_error(ur5, of_ur5):
    rng = np.random.default_rng(0)
    log = of_ur5
    v = np.gradient(log.q, log.t, axis=0)
    sizes = np.round(np.abs(3 * v + 10 * log.q + 0.1 * rng.standard_normal(v.shape)) / 0.05) * 0.05
    findings = doctor(ur5, replace(log, tau=sizes, has_torque=True))
    assert {"unsigned_torque"} <= {f.code for f in findings if f.severity == "error"}


def test_loads_of_a_servo_arm_mapped_to_torques_are_an_error(recordings):
    model = RobotModel.from_urdf(example_urdf("so101.urdf"))
    names = ("Rotation", "Pitch", "Elbow", "Wrist_Pitch", "Wrist_Roll", "Jaw")
    path = recordings / "commands" / "so101" / "multisine.parquet"
    source = LogSource(joints=dict(zip(model.joints, names, strict=True)))
    with pytest.raises(DataError, match=r"no columns 'tau_Rotation'.*\. The log has commanded"):
        read_log(path, model.joints, source=source)
    loads = {
        f"tau_{joint}": f"loadsize_{name}" for joint, name in zip(model.joints, names, strict=True)
    }
    log = read_log(path, model.joints, source=source, columns=loads)
    errors = {f.code for f in doctor(model, log) if f.severity == "error"}
    assert errors == {"unsigned_torque", "velocity_scale"}  # the jaw's dq is its motor's
