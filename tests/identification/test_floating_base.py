"""Identification of robots whose base floats: simulated in MuJoCo, and recorded."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from helpers.legged import recorded, with_other_bodies
from helpers.replay_data import leave_out_meshes, shown

import robotid
from robotid.cli.replay import replay_identified
from robotid.data.base_motion import BaseMotion
from robotid.diagnosis.logs.check_logs import diagnose
from robotid.dynamics.base_parameters import structural_mapping
from robotid.dynamics.torque import predict, trajectory_regressor
from robotid.estimation.estimators import WLS
from robotid.estimation.fitting.fitted import next_errors
from robotid.estimation.fitting.recorded import Recordings, hold_log
from robotid.identification.repeated_errors import with_repeated_errors
from robotid.output.files.entries import build_result
from robotid.output.files.result_file import stated_covariance
from robotid.robot.constraints import Contact
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

FEET = ("FL_foot", "FR_foot", "RL_foot", "RR_foot")
POSTURE = {"hip": (0.0, 0.12), "thigh": (0.8, 0.25), "calf": (-1.6, 0.3)}  # middle, reach [rad]
ARMATURE, DAMPING, TORQUE = 0.01, 0.2, 0.05
IMU = pin.SE3(pin.rpy.rpyToMatrix(0.3, -0.2, 1.0), np.array([0.15, -0.05, 0.1]))
SIGNALS = robotid.SignalSettings(rate=125.0, cutoff=25.0, velocity="differentiated")


@pytest.fixture(scope="module")
def go1():
    return RobotModel.from_urdf(
        example_urdf("go1.urdf"), free_flyer=True, terms=("armature", "viscous"),
        constraints=[Contact(foot) for foot in FEET],
    )  # fmt: skip


@pytest.fixture(scope="module")
def trot(go1):
    """The Go1 of MuJoCo with an IMU, and the random numbers after its recording."""
    rng = np.random.default_rng(3)
    middle, reach = np.array([POSTURE[joint.split("_")[1]] for joint in go1.joints]).T
    log = recorded(
        go1, FEET, middle, reach, rng, duration=9.5, step=2e-4, kp=100.0, kd=2.0, highest=1.5,
        armature=ARMATURE, damping=DAMPING, torque=TORQUE, imu=IMU,
    )  # fmt: skip
    return log, rng


@pytest.fixture(scope="module")
def found(go1, trot):
    """The Go1 of MuJoCo, identified from a URDF with other bodies; the truth, and that URDF's."""
    log, rng = trot
    log = replace(log, base=BaseMotion(log.base.pose))
    other = with_other_bodies(go1, rng)
    result = robotid.identify(
        other, log.window(end=5.0), validation=log.window(5.0, 7.0), doctor=False, friction="none",
        signals=SIGNALS, estimator="wls",
    )  # fmt: skip
    return result, truth_of(go1), other.standard_parameters()


def truth_of(model):
    """Return the parameters of the robot in MuJoCo."""
    drives = {".armature": ARMATURE, ".viscous": DAMPING}
    return model.standard_parameters() + [
        sum(x for end, x in drives.items() if name.endswith(end)) for name in model.layout.names
    ]


def test_the_expected_errors_are_those_of_unseen_steps(found):
    (unseen,) = found[0].validation
    residual = unseen.recording.trajectory.tau - unseen.torques["estimate"]
    measured = np.sqrt(np.mean(residual**2, axis=0, where=unseen.recording.mask))
    ratio = next_errors(found[0]) / measured
    np.testing.assert_allclose(ratio[6:], 1.0, atol=0.15)
    np.testing.assert_allclose(ratio[:6], 1.0, atol=0.6)  # few rows of the base are determined
    C = stated_covariance(build_result(found[0], {}), found[0].model.layout.names)
    whole, repeated = found[0].standard_covariance, found[0].repeated
    np.testing.assert_allclose(C, whole - repeated, atol=0.05 * np.abs(repeated).max())


def test_the_bodies_of_another_simulator_are_found(found):
    result, truth, before = found
    K = result.mapping.K
    is_drive = [x.endswith((".armature", ".viscous")) for x in result.mapping.base_names]
    z = ((result.base - K @ truth) / result.base_error)[~np.array(is_drive)]
    assert len(z) == 94
    assert np.mean(np.abs(z) < 2.0) > 0.85  # one run, correlated parameters
    assert np.abs(z).max() < 6.0
    masses = slice(0, result.model.layout.n_inertial, 10)
    assert result.standard[masses].sum() == pytest.approx(truth[masses].sum(), rel=2e-3)
    assert abs(before[masses].sum() / truth[masses].sum() - 1.0) > 0.02


def test_unseen_motion_is_predicted_judged_and_drawn_by_the_joints(found, monkeypatch):
    result, _, before = found
    (metrics,) = result.predictions.values()
    joints = [metrics.per_joint[joint] for joint in result.model.joints]
    assert all(m.relative_error_pct < 5.0 for m in joints)
    assert all(m.relative_error_pct < m.baselines["urdf"] for m in joints)
    assert set(result.verdict.joints) == set(result.model.joints)
    (note,) = [x for x in result.verdict.reasons if "wrench on the base" in x]
    of_base = {x[5:]: metrics.per_joint[x] for x in result.model.row_names[:6]}
    errors = (f"{x} {m.relative_error_pct:.0f} %" for x, m in of_base.items())
    assert ", ".join(errors) in note
    check, masses = result.scale_check, slice(0, result.model.layout.n_inertial, 10)
    ratio = result.standard[masses].sum() / before[masses].sum()
    assert [check.scale, check.factor] == pytest.approx([ratio, ratio])
    assert check.is_total_determined
    (one,), some = result.validation, np.arange(0, 200, 4)
    W = trajectory_regressor(result.model, one.recording.trajectory, some)
    np.testing.assert_allclose(
        (W @ result.standard).reshape(-1, 18), one.torques["estimate"][some], atol=1e-9
    )  # without the forces of contacts, so that bands are those of these errors
    leave_out_meshes(monkeypatch)
    other = replace(result, estimate=replace(result.estimate, sigma=np.arange(1.0, 19.0)))
    noise = shown(replay_identified(other).html)["torques"]["scale"]["of"]
    np.testing.assert_allclose(noise, np.arange(7.0, 19.0))  # without the rows of the base


def test_contacts_without_flags_are_found(go1, trot):
    whole = trot[0].window(0.5, 6.5)
    log = replace(whole, base=BaseMotion(whole.base.pose))
    for base in (log.base, whole.base):
        held = hold_log(go1, replace(log, base=base, contacts={}), SIGNALS)
        motion, used = held.whole.trajectory, held.whole.mask
        (torque,) = predict(go1, [truth_of(go1)], motion)
        assert np.sqrt(np.mean((motion.tau - torque)[used] ** 2)) < 0.7 * TORQUE
        found = held.windows[0]
        assert list(found.contacts) == list(log.contacts)
        for foot, flags in found.contacts.items():
            assert np.mean(flags < log.contacts[foot]) < 0.001  # in contact, but found in the air
            assert np.mean(flags > log.contacts[foot]) < 0.15
        assert "RR_foot" in found.notes[-1]


def test_an_imu_replaces_position_and_velocity_of_the_base(go1, trot):
    log, truth = trot[0].window(0.5, 6.5), truth_of(go1)
    pose = log.base.pose * np.append(np.zeros(3), np.ones(4))

    def whole(imu):
        held = hold_log(go1, replace(log, base=BaseMotion(pose, imu=imu)), SIGNALS)
        motion, used = held.whole.trajectory, held.whole.mask
        (torque,) = predict(go1, [truth], motion)
        return held, np.sqrt(np.mean((motion.tau - torque)[used] ** 2))

    imu = log.base.imu
    assert whole(imu)[1] < 0.7 * TORQUE
    elsewhere = replace(imu, frame=replace(imu.frame, lever=-imu.frame.lever))
    assert whole(elsewhere)[1] > 2.0 * TORQUE
    size = np.repeat([2e-3, 0.05], 3)  # [rad/s, m/s^2]
    noise = size * np.random.default_rng(1).standard_normal(imu.values.shape)
    held, _ = whole(replace(imu, values=imu.values + noise))
    recordings = Recordings(go1, structural_mapping(go1), [held])
    beta = WLS().fit(recordings.problem()).theta
    found = recordings.mapping.to_standard(beta, truth)
    fitted, true = predict(go1, [found, truth], held.whole.trajectory)
    assert np.linalg.norm(fitted - true) < 0.01 * np.linalg.norm(true)
    masses = slice(0, go1.layout.n_inertial, 10)
    assert found[masses].sum() == pytest.approx(truth[masses].sum(), rel=0.01)


def test_a_bias_of_the_accelerometers_is_estimated(go1, trot):
    log, bias, truth = trot[0], np.array([0.05, -0.03, 0.06]), truth_of(go1)  # [m/s^2]
    imu = log.base.imu
    values = imu.values + np.concatenate([np.zeros(3), bias])
    biased = replace(log, base=replace(log.base, imu=replace(imu, values=values))).window(1.0, 9.0)
    result = robotid.identify(
        go1, biased, doctor=False, friction="none", signals=SIGNALS, estimator="wls"
    )
    off = (result.base - result.mapping.K @ truth) / result.base_error
    inertial = result.mapping.independent < go1.layout.n_inertial
    assert np.mean(np.abs(off[inertial]) < result.errors.quantile[inertial]) > 0.9
    assert 0.6 < np.sqrt(np.mean(off[inertial] ** 2)) < 1.4  # not too wide either
    total = (np.arange(len(result.standard)) % 10 == 0) * 1.0
    total[go1.layout.n_inertial :] = 0.0
    error = np.sqrt(total @ result.standard_covariance @ total)
    assert abs(total @ (result.standard - truth)) < 2.5 * error
    assert error < 0.3 * (total @ truth) * bias[2] / 9.81  # what the bias would change
    method = result.errors.method.rpartition("subtracted: ")[2]
    found, _, sure = method.partition(" m/s^2, uncertain by ")
    sure = float(sure.removesuffix(" m/s^2"))
    np.testing.assert_allclose([float(x) for x in found.split(", ")], bias, atol=0.015)
    assert 0.001 < sure < 0.01
    held = hold_log(go1, biased, SIGNALS)
    mapping, plain = structural_mapping(go1), replace(biased, base=BaseMotion(biased.base.pose))
    once = with_repeated_errors(Recordings(go1, mapping, [held], [held]))
    for log in (*once.fitted, *once.validation):  # both are read with this bias
        np.testing.assert_array_equal(log.windows[0].base.imu.frame.offset, once.repeated.bias)
    both = Recordings(go1, mapping, [held, hold_log(go1, plain, SIGNALS)])  # one without an IMU
    np.testing.assert_allclose(with_repeated_errors(both).repeated.bias, bias, atol=0.015)
    again = with_repeated_errors(once).repeated  # of what is left: the whole bias is the same
    np.testing.assert_allclose(again.bias, once.repeated.bias, atol=0.4 * sure)


FAULTS = {
    "nothing": (lambda log: log, {}),
    "sign of a leg, gain of a joint": (
        lambda log: replace(log, tau=log.tau * [-1, -1, -1, *[1] * 5, 1.3, 1, 1, 1]),
        {"torque_sign": "FL_hip FL_thigh FL_calf", "current_for_torque": "RL_calf"},
    ),
    "scale of a position": (
        lambda log: replace(log, q=log.q * [*[1] * 5, 1.3, *[1] * 6]), {"angle_scale": "FR_calf"}
    ),
    "gain of the knees": (
        lambda log: replace(log, tau=log.tau * ([1, 1, 1.3] * 4)),
        {"current_for_torque": "FL_calf FR_calf RL_calf RR_calf"},
    ),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_of_a_leg_is_found_at_its_joints(go1, trot, fault):
    changed, wanted = FAULTS[fault]
    log = changed(replace(trot[0], base=BaseMotion(trot[0].base.pose)).window(end=5.0))
    other = with_other_bodies(go1, np.random.default_rng(7))
    found = [x for x in diagnose(other, [log], [], SIGNALS) if x.severity != "note"]
    named = {
        code: " ".join(j.removesuffix("_joint") for x in found if x.code == code for j in x.joints)
        for code in {x.code for x in found} - {"moving_contact"}
    }
    assert named == wanted
    factors = [x.evidence["factor"] for x in found if "factor" in x.evidence]
    np.testing.assert_allclose(factors, 1 / 1.3, rtol=0.1)
