"""Contacts found from torques and motion, against stated ones."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.stats
from helpers.paths import JOBS

from robotid.base.exceptions import DataError
from robotid.cli.job import read_job
from robotid.data.base_motion import BaseMotion, quaternions_of_angles
from robotid.data.log import Log
from robotid.data.signal_settings import SignalSettings
from robotid.data.signals import process
from robotid.dynamics import completed_logs
from robotid.dynamics.completed_logs import (
    FoundContact,
    _forces,
    _noise_of_groups,
    _probabilities,
    find_contacts,
    with_contacts,
)
from robotid.dynamics.constraint_rows import constraint_jacobian
from robotid.dynamics.prediction import predict, predict_instants
from robotid.robot.constraints import Contact

FEET = ("FL_FOOT", "FR_FOOT", "HL_FOOT", "HR_FOOT")
RAW = SignalSettings(cutoff=None, trim=0.0, velocity="differentiated")


def standing(robot, loaded):
    """Return a log at rest, the forces upwards (N, 4), and the wrench left on the base (N, 6).

    Args:
        robot: The robot.
        loaded: Whether each foot has a load, by sample, shape (N, 4); the others are lifted.
    """
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
    t, found = find_contacts(robot, log, RAW)
    np.testing.assert_allclose(t, log.t)
    assert [x.frame for x in found] == list(FEET)
    for k, contact in enumerate(found):
        np.testing.assert_allclose(contact.force, forces[:, k], atol=1e-3)
        assert contact.shares == pytest.approx((1.0, 0.0, 0.0))


def test_feet_without_load_are_found(robot):
    loaded = np.ones((400, 4), dtype=bool)
    loaded[60:300, 2] = loaded[300:, 3] = False  # the one is in the air for most of the time
    log, _, rest = standing(robot, loaded)
    assert np.abs(rest).max() < 1e-9
    _, found = find_contacts(robot, log, RAW)
    for contact, own in zip(found, loaded.T, strict=True):
        np.testing.assert_array_equal(contact.touches > 0.98, own)
        np.testing.assert_array_equal(contact.touches < 0.02, ~own)
        lifted = contact.force[~own]  # the acceleration jumps at two samples of either end
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


def test_the_shares_are_of_all_samples_of_which_undecided_ones_count_as_contact(robot, monkeypatch):
    log, *_ = standing(robot, np.ones((200, 4), dtype=bool))
    touches = [np.repeat([1.0, 0.0, 0.5], n) for n in ([120, 50, 30], [40, 150, 10])]
    found = [FoundContact(FEET[k], x, 0.0 * x) for k, x in zip((1, 3), touches, strict=True)]
    monkeypatch.setattr(completed_logs, "find_contacts", lambda *_: (log.t, found))
    stated = {foot: log.t >= 0.0 for foot in (FEET[0], FEET[2])}
    full = with_contacts(robot, replace(log, contacts=stated), RAW)
    assert full.notes == (
        "contacts found from torques and motion: FR_FOOT 60 % in contact, 25 % not, 15 % "
        "undecided; HR_FOOT 20 % in contact, 75 % not, 5 % undecided. Undecided samples count as "
        "contact",
    )
    for k, x in zip((1, 3), touches, strict=True):
        np.testing.assert_array_equal(full.contacts[FEET[k]], x > 0.0)
    part = [FoundContact(FEET[1], np.zeros(190), np.zeros(190))]  # rows beyond are undecided, too
    monkeypatch.setattr(completed_logs, "find_contacts", lambda *_: (log.t[4:-6], part))
    full = with_contacts(
        robot, replace(log, contacts={FEET[k]: log.t >= 0 for k in (0, 2, 3)}), RAW
    )
    np.testing.assert_array_equal(
        np.flatnonzero(full.contacts[FEET[1]]), [*range(4), *range(194, 200)]
    )


def test_what_cannot_be_found_names_what_to_log(robot):
    log, *_ = standing(robot, np.ones((50, 4), dtype=bool))
    still = replace(log, tau=0 * log.tau, has_torque=False)
    with pytest.raises(DataError) as error:
        with_contacts(robot, still, RAW)
    assert str(error.value).startswith(
        "log has no column of the contact of FL_FOOT, FR_FOOT, HL_FOOT, HR_FOOT, and the contact "
        "cannot be found from torques and motion: it has no torque or no motion of the base. "
        "Record contact_FL_FOOT, 1 while the link touches the ground"
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
    t, found = find_contacts(model, replace(log, contacts={}), job.signals)
    for contact in found:
        stated = log.contacts[contact.frame][np.searchsorted(log.t, t - 1e-9)]
        on, off, undecided = contact.shares
        assert undecided < 0.04
        decided = np.abs(contact.touches - 0.5) > 0.48
        assert np.mean((contact.touches > 0.5)[decided] == stated[decided]) > 0.975
        assert min(on, off) > 0.2


@pytest.mark.parametrize("levels", [(0.1, 0.01), (1.0, 0.03), (0.02, 0.3)])
def test_rows_count_by_their_noise_which_their_residuals_give(robot, rng, levels):
    """Forces are near those with the true weights, though rows of the base have large leverages."""
    log, *_ = standing(robot, np.ones((300, 4), dtype=bool))
    motion = process(log, RAW)
    motion = replace(motion, contacts=np.empty((len(motion.t), 0), dtype=bool))
    J = constraint_jacobian(robot, motion.q, np.ones((len(motion.t), 4), dtype=bool))
    sigma = np.where(np.arange(18) < 6, *levels)  # of the base and of the joints
    f = np.array([1.5, -1.0, 5.0] * 4) * rng.uniform(0.5, 1.5, (len(motion.t), 12))
    b = np.einsum("kmj,km->kj", J, f) + sigma * rng.standard_normal((len(motion.t), 18))
    torque = predict(replace(robot, constraints=()), [robot.standard_parameters()], motion)[0]
    found, _ = _forces(robot, replace(motion, tau=torque - b), robot.contacts)

    def upwards(sigma):
        return np.array([np.linalg.lstsq((j / sigma).T, x / sigma, rcond=None)[0][2::3]
                         for j, x in zip(J, b, strict=True)])  # fmt: skip

    wanted, plain = upwards(sigma), upwards(np.ones(18))
    assert np.std(found - wanted) < 0.75 * np.std(plain - wanted)
    true = f[:, 2::3]
    assert np.std(found - true) < 1.06 * np.std(wanted - true)
    assert np.std(plain - true) > (1.0 if levels[0] < levels[1] else 1.8) * np.std(wanted - true)


def test_the_noise_of_forces_moments_and_joints_is_found_at_any_ratio(robot, rng):
    """Two contacts, whose forces ten samples of each determine; in any number of samples."""
    two = replace(robot, constraints=[Contact(foot) for foot in FEET[:2]])
    q = np.hstack([np.tile([0, 0, 0.3, 0, 0, 0, 1.0], (1501, 1)), rng.uniform(-1, 1, (1501, 12))])
    J = constraint_jacobian(two, q, np.ones((1501, 2), dtype=bool))
    f = np.array([20.0, -30.0, 60.0] * 2) * rng.uniform(0.5, 1.5, (1501, 6))
    for levels in ((2.0, 0.1, 0.05), (0.5, 0.05, 0.9), (0.3, 4.0, 0.3)):
        sigma = np.repeat(levels, [3, 3, 12])
        b = np.einsum("kmj,km->kj", J, f) + sigma * rng.standard_normal((1501, 18))
        found = _noise_of_groups(J, b, 30.0)
        np.testing.assert_allclose(found[[0, 3, 6]], levels, rtol=0.15)
        assert all(len(set(x)) == 1 for x in np.split(found, [3, 6]))


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
    _, found = find_contacts(model, replace(log, wrenches=wrenches), RAW)
    up = np.array([-2.0, 1.0, 9.4]) / np.linalg.norm([-2.0, 1.0, 9.4])
    assert [x.frame for x in found] == [FEET[0], FEET[2], FEET[3]]
    for contact, k in zip(found, (0, 2, 3), strict=True):
        np.testing.assert_allclose(contact.force, f[3 * k : 3 * k + 3] @ up, rtol=2e-3)


def of_feet(rng, drift):
    """Return contact, force, height and velocity of four feet, of which three or one touch."""
    touches = np.arange(900)[:, None] // 50 % 4 == np.arange(4)
    touches[300:] ^= True
    force = np.where(touches, 0.33, 0.0) + 0.11 * rng.normal(size=(900, 4))
    height = np.where(touches, 0.0, 0.03) + 0.014 * rng.normal(size=(900, 4))
    speed = 10.0 ** (np.where(touches, -1.0, -0.3) + 0.3 * rng.normal(size=(900, 4)))
    way = rng.normal(size=(900, 4, 3))
    way *= (speed / np.linalg.norm(way, axis=2))[..., None]
    return touches, force, height, way + drift


def test_probabilities_are_those_of_two_normal_distributions(rng):
    """By Bayes' rule, with the shares, means and deviations that the probabilities give."""
    _, force, height, velocity = of_feet(rng, 0.0)
    p = _probabilities(force, height, velocity, 4)
    odds = np.log(p.mean() / (1.0 - p.mean()))
    speed = np.log10(np.linalg.norm(velocity, axis=2) + 1e-3)
    for x in (force, height, speed):
        on = np.average(x, weights=p)
        off = 0.0 if x is force else np.average(x, weights=1.0 - p)
        a = np.sqrt(np.average((x - on) ** 2, weights=p))
        b = np.sqrt(np.average((x - off) ** 2, weights=1.0 - p))
        if x is force:  # a normal distribution with the median of |x|
            order = np.argsort(np.abs(x).ravel())
            share = np.cumsum((1.0 - p).ravel()[order]) / (1.0 - p).sum()
            median = np.abs(x).ravel()[order][np.searchsorted(share, 0.5)]
            b = min(b, median / scipy.stats.norm.ppf(0.75))
        y = np.clip(x, min(on, off), max(on, off))
        odds = odds + scipy.stats.norm(on, a).logpdf(y) - scipy.stats.norm(off, b).logpdf(y)
    np.testing.assert_allclose(p, 1.0 / (1.0 + np.exp(-odds)), atol=0.02)
    assert np.mean((p > 0.05) & (p < 0.95)) > 0.005  # some are undecided


def test_without_a_position_speeds_are_relative_to_the_links_in_contact(rng):
    state = rng.bit_generator.state
    drift = np.array([0.8, -0.5, 0.3]) * np.sin(0.03 * np.arange(900))[:, None, None]
    touches, force, _, velocity = of_feet(rng, drift)
    rng.bit_generator.state = state
    still = of_feet(rng, 0.0)[3]
    p, wanted = (_probabilities(force, None, v, 4) for v in (velocity, still))
    assert np.mean(np.abs(p - wanted)) < 2e-3
    assert np.mean((p > 0.5) == touches) > 0.95
