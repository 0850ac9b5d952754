"""Payloads by the difference of two runs; the true torques come from RNEA of a model with it."""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pinocchio as pin
import pytest
from helpers.synthetic import exact_log, truth
from scipy.stats import t as t_of

from robotid.base.exceptions import DataError, ModelError, SettingsError
from robotid.data.signal_settings import SignalSettings
from robotid.dynamics.base_parameters import structural_mapping
from robotid.dynamics.torque import joint_torque_regressor
from robotid.identification.payload_fit import identify_payload, payload_of
from robotid.robot.drives import FAMILIES
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

#: Friction is chosen where the test is about that.
with_known_friction = partial(identify_payload, friction="viscous+coulomb")

EXACT = SignalSettings(cutoff=None, trim=0.0, min_velocity=0.0, velocity="measured")
MASS, COM = 2.0, np.array([0.02, 0.03, 0.08])
INERTIA = np.array([[0.03, 0.002, -0.001], [0.002, 0.025, 0.003], [-0.001, 0.003, 0.02]])
GAINS = np.array([14.0, 13.0, 11.0, 9.0, 8.0, 7.0])
LEVEL = np.array([0.6, 0.8, 0.4, 0.08, 0.05, 0.03])  # [N m] of noise, about 1 % of the torque


@pytest.fixture(scope="module")
def hand(ur5):
    """The last four joints of a UR5."""
    return RobotModel.from_urdf(ur5.tree.path, joints=ur5.joints[2:])


def load_torque(model, log, link, mass=MASS, com=COM, inertia=INERTIA):
    """Return what a payload on a link adds to the torques of a motion, by RNEA."""
    bare, loaded = model.pin_model.copy(), model.pin_model.copy()
    frame = bare.frames[bare.getFrameId(link)]
    loaded.appendBodyToJoint(frame.parentJoint, pin.Inertia(mass, com, inertia), frame.placement)
    states = list(zip(model.configurations(log.q), log.v, log.a, strict=True))
    with_it, without = (
        np.array([pin.rnea(m, data, *state) for state in states])
        for m in (loaded, bare)
        for data in [m.createData()]
    )
    return with_it - without


def recorded(model, rng, links=("tool0",), noise=None, samples=700, friction=1.0, **load):
    """Return the logs of a robot with payloads, and without."""
    pi = truth(model)
    without, other = (exact_log(model, pi, rng, samples=samples, rate=100.0) for _ in range(2))
    if friction != 1.0:
        size = model.layout.n_inertial
        warm = [
            0.0 if term.is_inertia else friction - 1 for _, term in model.layout.drive_parameters
        ]
        change = np.append(np.zeros(size), warm * pi[size:])
        W = joint_torque_regressor(model, other.q, other.v, other.a)
        other = replace(other, tau=other.tau + (W @ change).reshape(other.tau.shape))
    tau = other.tau + sum(load_torque(model, other, link, **load) for link in links)
    logs = [replace(other, tau=tau), without]
    if noise is not None:
        logs = [
            x.__class__(**{**vars(x), "tau": x.tau + noise * rng.standard_normal(x.tau.shape)})
            for x in logs
        ]
    return logs


def test_a_payload_on_a_link_that_is_fixed_to_a_moving_one_is_exact(ur5, rng):
    log, without = recorded(ur5, rng, links=["tool0"], friction=1.3)
    payload = with_known_friction(ur5, [log], [without], links=["tool0"], signals=EXACT)["tool0"]
    assert payload.mass == pytest.approx(MASS, rel=1e-6)
    np.testing.assert_allclose(payload.com, COM, rtol=1e-5)
    np.testing.assert_allclose(payload.inertia, INERTIA, atol=1e-6)
    at_link = INERTIA + MASS * (COM @ COM * np.eye(3) - np.outer(COM, COM))
    np.testing.assert_allclose(payload.inertia_at_link, at_link, atol=1e-6)
    assert payload.determined == ("mass", "com", "inertia")
    urdf = example_urdf("ur5_robot.urdf")
    found = with_known_friction(urdf, [log], [without], links=["tool0"], signals=EXACT)
    assert found["tool0"].mass == payload.mass
    said = str(found).splitlines()
    low, high = payload.mass_interval
    assert said[0].startswith("tool0: 2 +- ")
    assert said[0].endswith(f" kg, 95 %: [{low:.4g}, {high:.4g}]")
    wanted = pytest.approx(COM, rel=1e-3)
    assert [float(x.split(" +-")[0]) for x in said[1].partition(": ")[2].split(", ")] == wanted
    wanted = pytest.approx(np.diag(INERTIA), rel=1e-3)
    assert [float(x.split(" +-")[0]) for x in said[2].partition(": ")[2].split(", ")] == wanted
    assert repr(found).startswith("<PayloadFit of ur5: tool0 2 +- ")


def test_a_known_mass_is_checked_by_the_torque_that_does_not_know_it(hand, rng):
    logs = [replace(log, tau=1.1 * log.tau) for log in recorded(hand, rng, noise=LEVEL[2:])]
    asked = {"links": ["tool0"], "signals": EXACT}
    free = with_known_friction(hand, logs[:1], logs[1:], **asked)
    found = with_known_friction(hand, logs[:1], logs[1:], masses={"tool0": MASS}, **asked)
    check = found.checks["tool0"]
    assert free.checks == {}
    assert (check.known, check.identified) == (MASS, pytest.approx(free["tool0"].mass))
    assert check.ratio == pytest.approx(1.1, abs=0.03)
    assert check.std_error == pytest.approx(free["tool0"].mass_std_error)
    assert check.interval == pytest.approx(free["tool0"].mass_interval)
    assert check.contradicts
    assert check.message in str(found)
    assert found.to_dict()["mass_checks"] == [check.to_dict()]
    gains = with_known_friction(
        hand, logs[:1], logs[1:], masses={"tool0": MASS}, unknown_gains=hand.joints, **asked
    )
    assert gains.checks == {}  # the mass determines the gains


def test_intervals_hold_the_truth_of_payload_gains_and_robot(ur5):
    beta = structural_mapping(ur5).to_base(truth(ur5))
    outside = []
    for seed in range(2):
        log, without = recorded(ur5, np.random.default_rng(seed), noise=LEVEL, friction=1.2)
        free = with_known_friction(ur5, [log], [without], links=["tool0"], signals=EXACT)["tool0"]
        low, high = free.mass_interval
        outside.append(not low < MASS < high)
        log, without = (replace(x, tau=x.tau / GAINS) for x in (log, without))
        found = with_known_friction(
            ur5, [log], [without], links=["tool0"], masses={"tool0": MASS},
            unknown_gains=ur5.joints, signals=EXACT,
        )  # fmt: skip
        for gain, true in zip(found.gains.values(), GAINS, strict=True):
            low, high = gain.interval
            assert abs(gain.value - true) < 5 * gain.std_error < 0.25 * true
            outside.append(not low < true < high)
        # a scale that is not known shows in every parameter
        outside += (np.abs(found.base - beta) > 2 * found.base_error).tolist()
    assert 0.02 < np.mean(outside) < 0.09, np.mean(outside)


def test_gains_are_exact_without_noise_and_some_may_be_known(hand, rng):
    log, without = (replace(x, tau=x.tau / GAINS[2:]) for x in recorded(hand, rng, friction=1.2))
    found = with_known_friction(
        hand, [log], [without], links=["tool0"], masses={"tool0": MASS},
        unknown_gains=hand.joints, signals=EXACT,
    )  # fmt: skip
    np.testing.assert_allclose([g.value for g in found.gains.values()], GAINS[2:], rtol=1e-6)
    # with the gain of one joint known, no mass need be
    one = np.where(np.arange(4) == 1, GAINS[2:], 1.0)
    log, without = (replace(x, tau=x.tau * one) for x in (log, without))
    others = [joint for j, joint in enumerate(hand.joints) if j != 1]
    found = with_known_friction(
        hand, [log], [without], links=["tool0"], unknown_gains=others, signals=EXACT
    )
    assert found["tool0"].mass == pytest.approx(MASS, rel=1e-6)
    assert found.gains["wrist_2_joint"].value == pytest.approx(GAINS[4], rel=1e-6)


def test_errors_about_the_centre_of_mass_are_those_of_first_order(rng):
    """By finite differences of the ten parameters in the frame of the link."""

    def about(x):
        com = x[1:4] / x[0]
        at_link = np.array([[x[4], x[5], x[7]], [x[5], x[6], x[8]], [x[7], x[8], x[9]]])
        inertia = at_link - x[0] * (com @ com * np.eye(3) - np.outer(com, com))
        return np.concatenate([com, inertia.ravel()])

    at_link = INERTIA + MASS * (COM @ COM * np.eye(3) - np.outer(COM, COM))
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = at_link.tolist()
    x = np.array([MASS, *(MASS * COM), xx, xy, yy, xz, yz, zz])
    scale = np.array([0.1, *[0.01] * 3, *[0.0005] * 6])
    root = scale[:, None] * rng.standard_normal((10, 10)) / 3
    C, freedom = root @ root.T, np.linspace(5.0, 14.0, 10)
    step = 1e-6 * scale
    J = np.array(
        [about(x + h * e) - about(x - h * e) for h, e in zip(step, np.eye(10), strict=True)]
    )
    J = (J / (2 * step)[:, None]).T
    errors = np.sqrt(np.diag(J @ C @ J.T))
    found = payload_of(SimpleNamespace(length=1.0), "tool", x, C, freedom)
    np.testing.assert_allclose(found.com, COM)
    np.testing.assert_allclose(found.inertia, INERTIA, atol=1e-12)
    np.testing.assert_allclose(found.com_std_error, errors[:3], rtol=1e-5)
    np.testing.assert_allclose(found.inertia_std_error.ravel(), errors[3:], rtol=1e-5)
    np.testing.assert_allclose(found.parameters, x)
    reach = t_of(5.0).ppf(0.975) * np.sqrt(C[0, 0])
    np.testing.assert_allclose(found.mass_interval, [MASS - reach, MASS + reach])
    assert found.mass_std_error == np.sqrt(C[0, 0])
    assert found.determined == ("mass", "com", "inertia")
    # an inertia is open from 0.3 of the mean principal moment on, a centre from 0.05 lengths
    for factor, is_open in ((0.95, False), (1.05, True)):
        wider = (factor * 0.3 * np.trace(INERTIA) / 3 / errors[3:].max()) ** 2 * C
        long = payload_of(SimpleNamespace(length=100.0), "tool", x, wider, np.full(10, np.inf))
        assert ("inertia" in long.reasons, "com" in long.reasons) == (is_open, False)
        length = errors[:3].max() / 0.05 / factor
        short = payload_of(SimpleNamespace(length=length), "tool", x, C, freedom)
        assert ("com" in short.reasons) == is_open
        of_mass = np.diag([(factor * MASS / 3.0) ** 2, *np.zeros(9)])  # three standard errors
        light = payload_of(SimpleNamespace(length=100.0), "tool", x, of_mass, freedom)
        assert ("com" in light.reasons) == is_open


def test_friction_that_grows_with_the_load_is_reckoned_with_the_payload(ur5, rng):
    log, without = recorded(ur5, rng, samples=500)
    pi = truth(ur5)
    pi[ur5.layout.n_inertial :] = 0.0

    def with_friction(x, extra=0.0):
        rigid = (joint_torque_regressor(ur5, x.q, x.v, x.a) @ pi).reshape(x.tau.shape) + extra
        return replace(x, tau=x.tau + 0.08 * np.sign(x.v) * np.abs(rigid))

    logs = with_friction(log, load_torque(ur5, log, "tool0")), with_friction(without)
    own = {joint: FAMILIES["load"].make({}) for joint in ur5.joints}
    found = [
        with_known_friction(model, logs[:1], logs[1:], links=["tool0"], signals=EXACT)["tool0"]
        for model in (ur5, ur5.with_terms(own))
    ]
    assert abs(found[0].mass - MASS) > 0.001
    assert found[1].mass == pytest.approx(MASS, abs=1e-5)
    assert found[1].mass_std_error < 0.05 * found[0].mass_std_error
    np.testing.assert_allclose(found[1].com, COM, atol=1e-5)


def test_what_cannot_be_asked_is_refused_by_name(ur5, rng):
    log, without = recorded(ur5, rng, noise=LEVEL)

    def refused(error, match, logs=(log, without), **asked):
        with pytest.raises(error, match=match):
            with_known_friction(ur5, [logs[0]], [logs[1]], signals=EXACT, **asked)

    refused(DataError, "tool0 carries 2.* less than in the reference: .* swap", (without, log),
            links=["tool0"])  # fmt: skip
    refused(DataError, "no motion determines the mass of the payload on shoulder_link",
            links=["shoulder_link"])  # fmt: skip
    refused(SettingsError, "base_link does not move", links=["base_link"])
    refused(SettingsError, "tool0 and ee_link belong to one moving body, wrist_3_link",
            links=["tool0", "ee_link"])  # fmt: skip
    refused(ModelError, "link 'hook' is not in ur5_robot.urdf; links: ", links=["hook"])
    refused(SettingsError, "their scale is not determined", unknown_gains=ur5.joints)
    refused(SettingsError, "a mass is given for ee_link", masses={"ee_link": 1.0})
    refused(SettingsError, "is -1.0 kg", masses={"wrist_3_link": -1.0})
    refused(SettingsError, "unknown gains are given for hip", unknown_gains=["hip"])
    short = [x.window(0.0, 1.0) for x in (log, without)]
    refused(
        DataError, "the motion does not determine the mass of the payload on wrist_3_link", short
    )
    # no payload at all is determined, too: its error is small beside the masses of the robot
    empty, _ = recorded(ur5, rng, links=(), noise=LEVEL)
    nothing = with_known_friction(ur5, [empty], [without], links=["tool0"], signals=EXACT)["tool0"]
    assert abs(nothing.mass) < 3.0 * nothing.mass_std_error < 0.1
    assert nothing.determined == ("mass",)


def test_friction_of_currents_is_chosen_on_the_torques_that_the_gains_make(model, rng):
    log, without = recorded(model, rng, samples=500)
    pi = truth(model) * (np.arange(len(model.layout.names)) < model.layout.n_inertial)

    gains = np.array([40.0, 3.0, 9.0])

    def current(x, mu):
        rigid = (joint_torque_regressor(model, x.q, x.v, x.a) @ pi).reshape(x.tau.shape)
        return replace(x, tau=(x.tau + mu * np.sign(x.v) * np.abs(rigid)) / gains)

    logs = current(log, 0.0), current(without, 0.08)  # it is that of the robot without the load
    asked = {"links": ["tool0"], "masses": {"tool0": MASS}, "unknown_gains": model.joints}
    plain, found = (
        fit(model, logs[:1], logs[1:], signals=EXACT, **asked)
        for fit in (with_known_friction, identify_payload)
    )
    assert {"shoulder_lift_joint", "elbow_joint"} <= found.model.layout.own.keys()
    errors = [
        np.abs(np.array([gain.value for gain in fit.gains.values()]) / gains - 1)[:2].max()
        for fit in (plain, found)
    ]
    assert errors[1] < 0.5 * errors[0]
