"""Contacts found from torques and motion, against stated ones."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.legged import SOLO_FEET as FEET
from helpers.legged import solo_on_points
from helpers.paths import JOBS

from robotid.base.exceptions import DataError
from robotid.cli.job import read_job
from robotid.data.base_motion import BaseMotion, quaternions_of_angles
from robotid.data.log import Log
from robotid.data.signal_settings import SignalSettings
from robotid.dynamics.constraint_rows import constraint_jacobian
from robotid.dynamics.prepared_logs import find_contacts, with_contacts
from robotid.dynamics.torque import predict_instants
from robotid.robot.constraints import Contact

RAW = SignalSettings(cutoff=None, trim=0.0, velocity="differentiated")


@pytest.fixture(scope="module")
def robot():
    return solo_on_points()


def standing(robot, loaded):
    """Return a log at rest, upward forces of loaded feet (N, 4) and the base's wrench (N, 6)."""
    N, n = len(loaded), len(robot.joints)
    t = np.arange(N) / 100
    pose = np.zeros((N, 7))
    pose[:, :3] = [1.0, 2.0, 0.3]
    pose[:, 3:] = quaternions_of_angles(np.tile([0.0, 0.05, 0.7], (N, 1)))
    q = np.tile([0.1, 1.2, -1.6], (N, n // 3))
    q[:, [robot.joints.index(f"{foot[:2]}_KFE") for foot in FEET]] -= 0.4 * ~loaded
    q = np.hstack([pose, q])
    torque = predict_instants(robot, robot.standard_parameters(), q)
    J = constraint_jacobian(robot, q, loaded)
    f = np.array([np.linalg.pinv(j[:, :6].T) @ x[:6] for j, x in zip(J, torque, strict=True)])
    tau = torque - np.einsum("kmj,km->kj", J, f)
    log = Log(t, q[:, 7:], tau[:, 6:], robot.joints, base=BaseMotion(pose))
    return log, f[:, 2::3], tau[:, :6]


def test_forces_at_rest_are_found(robot):
    every = np.ones((200, 4), dtype=bool)
    log, forces, rest = standing(robot, every)
    assert np.abs(rest).max() < 1e-9  # the feet bear the weight
    t, frames, touches, force = find_contacts(robot, log, RAW)
    np.testing.assert_allclose(t, log.t)
    assert frames == list(FEET)
    np.testing.assert_allclose(force, forces, atol=1e-3)
    assert touches.min() > 0.98


def test_feet_without_load_are_found(robot):
    loaded = np.ones((400, 4), dtype=bool)
    loaded[60:300, 2] = loaded[300:, 3] = False  # the one is in the air for most of the time
    log, _, rest = standing(robot, loaded)
    assert np.abs(rest).max() < 1e-9
    _, _, touches, force = find_contacts(robot, log, RAW)
    np.testing.assert_array_equal(touches > 0.98, loaded)
    np.testing.assert_array_equal(touches < 0.02, ~loaded)
    for lifted in (force[60:300, 2], force[300:, 3]):
        # the acceleration jumps at two samples of either end
        np.testing.assert_allclose(lifted[2:-2], 0.0, atol=1e-3)
    stated = {"FR_FOOT": loaded[:, 1], "FL_FOOT": loaded[:, 0]}
    full = with_contacts(robot, replace(log, contacts=stated), RAW)
    assert list(full.contacts) == list(FEET)
    for own, flags in zip(loaded.T, full.contacts.values(), strict=True):
        np.testing.assert_array_equal(flags, own)
    assert full.notes == (
        "contacts found from torques and motion: HL_FOOT 40 % in contact, 60 % not, 0 % undecided; "
        "HR_FOOT 75 % in contact, 25 % not, 0 % undecided. Undecided samples count as contact",
    )
    assert with_contacts(robot, full, RAW) is full


def test_what_cannot_be_found_names_what_to_log(robot):
    log, *_ = standing(robot, np.ones((50, 4), dtype=bool))
    still = replace(log, tau=0 * log.tau, has_torque=False)
    with pytest.raises(DataError) as error:
        with_contacts(robot, still, RAW)
    assert str(error.value).startswith(
        "log has no column of the contact of FL_FOOT, FR_FOOT, HL_FOOT, HR_FOOT, and the contact "
        "cannot be found from torques and motion: it has no torque or no motion of the base. "
        "Record contact_FL_FOOT (1 in contact, else 0)"
    )
    assert error.value.code == "missing_column"
    measured = replace(robot, constraints=[Contact(FEET[0], measured=("fz",))])
    with pytest.raises(DataError, match="no column contact_FL_FOOT, but a measured force there"):
        with_contacts(measured, replace(log, wrenches={"fz FL_FOOT": log.t}), RAW)
    rng = np.random.default_rng(0)
    noisy = replace(log, tau=log.tau + 3.0 * rng.standard_normal(log.tau.shape))
    with pytest.raises(DataError, match=r"found from torques and motion: [0-9]+ % of samples are"):
        with_contacts(robot, noisy, RAW)


def test_contacts_of_a_trot_agree_with_stated_ones(recordings, monkeypatch):
    monkeypatch.setenv("ROBOTID_DATA", str(recordings))
    job = read_job(JOBS / "legged" / "solo12.toml")
    model = job.model()
    log = job.read(job.identification[0], model)
    t, frames, touches, _ = find_contacts(model, replace(log, contacts={}), job.signals)
    is_decided = np.abs(touches - 0.5) > 0.48
    assert (is_decided.mean(axis=0) > 0.96).all()
    for frame, p, decided in zip(frames, touches.T, is_decided.T, strict=True):
        stated = log.contacts[frame][np.searchsorted(log.t, t - 1e-9)]
        assert np.mean((p > 0.5)[decided] == stated[decided]) > 0.975
        assert min(np.mean(p > 0.98), np.mean(p < 0.02)) > 0.2
    # without the position of the base, the feet on the ground show how fast it moves
    pose, twist = log.base.pose * np.repeat([0, 1], [3, 4]), log.base.twist * np.repeat([0, 1], 3)
    blind = replace(log, contacts={}, base=BaseMotion(pose, twist))
    _, _, touches, _ = find_contacts(model, blind, job.signals)
    assert np.sum(np.abs(touches - 0.5) <= 0.48) < 0.06 * len(touches)


@pytest.mark.parametrize("axes", ["world", "link"])
def test_forces_are_found_beside_a_measured_one_whatever_is_up(robot, axes):
    """The world is tilted; the force on one foot between the others is measured."""
    tilted = robot.with_gravity(np.array([2.0, -1.0, -9.4]))
    every = np.ones((60, 4), dtype=bool)
    log, _, rest = standing(tilted, every)
    assert np.abs(rest).max() < 1e-9
    q = np.hstack([log.base.pose, log.q])
    torque = predict_instants(tilted, tilted.standard_parameters(), q)
    J = constraint_jacobian(tilted, q, every)
    f = np.linalg.lstsq(J[0].T, torque[0] - np.r_[np.zeros(6), log.tau[0]], rcond=None)[0]
    contacts = [replace(x, axes=axes) for x in tilted.constraints]
    contacts[1] = replace(contacts[1], measured=("fx", "fy", "fz"), always=True)
    model = replace(tilted, constraints=tuple(contacts))
    own = constraint_jacobian(model, q, every)
    measured = np.linalg.lstsq(own[0, 3:6].T, J[0, 3:6].T @ f[3:6], rcond=None)[0]
    wrenches = {f"f{x} FR_FOOT": np.full(60, y) for x, y in zip("xyz", measured, strict=True)}
    _, frames, _, force = find_contacts(model, replace(log, wrenches=wrenches), RAW)
    up = np.array([-2.0, 1.0, 9.4]) / np.linalg.norm([-2.0, 1.0, 9.4])
    assert frames == [FEET[0], FEET[2], FEET[3]]
    wanted = f.reshape(4, 3)[[0, 2, 3]] @ up
    np.testing.assert_allclose(force, np.tile(wanted, (60, 1)), rtol=2e-3)
