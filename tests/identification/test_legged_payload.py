"""Robots whose joints bear no torque of their own: a robot on its feet, and a cart-pole."""

import re
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from helpers.stands import recorded, stand

from robotid import identify, save_result
from robotid.base.exceptions import DataError
from robotid.data.base_motion import BaseMotion
from robotid.data.files.read import read_log
from robotid.data.log import Log
from robotid.data.signal_settings import SignalSettings
from robotid.design.previews import preview
from robotid.dynamics.constraint_rows import constraint_jacobian
from robotid.dynamics.simulation.simulation_settings import Payload
from robotid.dynamics.simulation.simulator import carried
from robotid.dynamics.torque import joint_torque_regressor
from robotid.identification.payload_fit import identify_payload
from robotid.robot.constraints import Contact
from robotid.robot.drives import Spring, Viscous
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

RAW = SignalSettings(cutoff=None, velocity="measured", acceleration="measured")
PACK = Payload("base_link", 0.4, (0.05, 0.02, 0.06), (1e-3, 0, 1e-3, 0, 0, 1e-3))
FEET = ("FL_FOOT", "FR_FOOT", "HL_FOOT", "HR_FOOT")


@pytest.fixture(scope="module")
def robot():
    return RobotModel.from_urdf(
        example_urdf("solo12.urdf"), free_flyer=True, terms=("viscous",),
        constraints=[Contact(foot) for foot in FEET],
    )  # fmt: skip


@pytest.fixture(scope="module")
def runs(robot):
    """Return the log with the payload, and that without it."""
    found = []
    for seed, payload in enumerate((PACK, Payload())):
        rng = np.random.default_rng(seed)
        motion = stand(robot, np.tile([0.0, 0.8, -1.6], 4), 0.25, rng, length=1.0)
        pi = carried(robot, robot.standard_parameters(), payload)
        found.append(recorded(robot, pi, motion, rng, rate=80.0, duration=3.0))
    return found


def test_the_payload_of_the_trunk_is_found(robot, runs):
    fit = identify_payload(robot, *runs, signals=RAW, friction="none")
    (payload,) = fit.payloads
    assert payload.link == "base_link"  # the base floats: it is the default
    assert payload.mass == pytest.approx(0.4, abs=3 * payload.mass_std_error)
    assert 1e-4 < payload.mass_std_error < 0.01
    assert (np.abs(payload.com - PACK.com) < 4 * payload.com_std_error).all()
    assert payload.com_std_error.max() < 0.02
    assert fit.unexplained.max() < 0.1


@pytest.fixture(scope="module")
def planned(robot):
    motion = stand(
        robot, np.tile([0.0, 0.8, -1.6], 4), 0.25, np.random.default_rng(5), parts=5, length=1.0,
        rate=60.0,
    )  # fmt: skip
    t = np.arange(300) / 60.0
    q, v, a = motion.evaluate(t)
    flags = motion.touching(t).T
    log = Log(
        t, q[:, 7:], 0.0 * q[:, 7:], robot.joints, v[:, 6:], a[:, 6:], has_torque=False,
        base=BaseMotion(q[:, :7], v[:, :6], a[:, :6]),
        contacts=dict(zip(FEET, flags, strict=True)),
    )  # fmt: skip
    return robot, log


def test_the_errors_are_those_of_least_squares_with_noise_in_the_joints(planned):
    model, log = planned
    size = np.linspace(0.01, 0.05, 12)
    found = preview(
        model, log, noise=dict(zip(model.joints, size, strict=True)), signals=RAW, estimator="wls"
    )
    found_white = preview(model, log, noise=replace(found.noise, correlation=np.zeros(12)),
                          signals=RAW, estimator="wls")  # fmt: skip
    np.testing.assert_allclose(found.base_error, found_white.base_error * np.sqrt(0.1 * 60.0))
    recording = found.expected.fitted[0].recording
    motion, rows = recording.trajectory, recording.mask.all(axis=1)
    q, v, a = motion.q, motion.v, motion.a
    K, independent = found.expected.mapping.K, found.expected.mapping.independent
    W = joint_torque_regressor(model, q, v, a).reshape(len(q), 18, -1)[rows][..., independent]
    J = constraint_jacobian(model, q, motion.contacts)[rows]
    P = np.eye(18) - np.linalg.pinv(J) @ J
    projected = (P @ W).reshape(-1, len(K))
    bread = np.linalg.inv(projected.T @ projected)
    score = (P @ W)[:, 6:].swapaxes(1, 2) * size @ (size[:, None] * (P @ W)[:, 6:])
    wanted = np.sqrt(np.diag(bread @ score.sum(axis=0) @ bread))
    np.testing.assert_allclose(found_white.base_error, wanted, rtol=1e-5)
    level = np.einsum("kjj,j->", P[:, 6:, 6:], size**2) / np.trace(P, axis1=1, axis2=2).sum()
    np.testing.assert_allclose(found.expected.estimate.sigma, np.sqrt(level), rtol=0.01)


STEP, HELD = 1e-3, 5  # [s] of the plant; steps of a row of the log
URDF = """<robot name="cartpole"><link name="rail"/>
<link name="cart"><inertial><mass value="1.3"/>
<inertia ixx="1e-2" ixy="0" ixz="0" iyy="1e-2" iyz="0" izz="1e-2"/></inertial></link>
<link name="pole"><inertial><origin xyz="0 0 -0.25"/><mass value="0.25"/>
<inertia ixx="5e-3" ixy="0" ixz="0" iyy="5e-3" iyz="0" izz="1e-4"/></inertial></link>
<joint name="slider" type="prismatic"><parent link="rail"/><child link="cart"/><axis xyz="1 0 0"/>
<limit lower="-2" upper="2" effort="50" velocity="5"/></joint>
<joint name="hinge" type="continuous"><parent link="cart"/><child link="pole"/>
<axis xyz="0 1 0"/></joint></robot>"""


def swung(path, seed):
    """Return a log of the cart on a spring of its own, driven by sines; viscous friction 0.5."""
    rng, plant = np.random.default_rng(seed), pin.buildModelFromUrdf(str(path))
    data, f, phase = plant.createData(), *rng.uniform([[0.3], [0.0]], [[2.5], [6.0]], (2, 6))
    q, v, rows = np.array([0.0, 1.0, 0.0]), np.zeros(2), []
    for k in range(round(10.0 / STEP)):
        t = k * STEP
        force = 4.0 * np.sin(2 * np.pi * f * t + phase).sum() - 20.0 * q[0]
        if k % HELD == 0:
            rows.append([t, q[0], np.arctan2(q[2], q[1]), force + 0.01 * rng.standard_normal()])
        a = pin.aba(plant, data, q, v, np.array([force - 0.5 * v[0], 0.0]))
        v = v + STEP * a
        q = pin.integrate(plant, q, STEP * v)
    t, slider, hinge, force = np.array(rows).T
    tau = np.column_stack([force, 0.0 * force])
    return Log(1000.0 + t, np.column_stack([slider, np.unwrap(hinge)]), tau, ("slider", "hinge"))


@pytest.fixture(scope="module")
def cartpole(tmp_path_factory):
    path = tmp_path_factory.mktemp("cartpole") / "cartpole.urdf"
    path.write_text(URDF)
    return path, swung(path, 1), swung(path, 2)


@pytest.mark.parametrize("own", [{}, {"hinge": [Viscous()]}, {"hinge": [Spring()]}])
def test_the_torque_of_a_declared_passive_joint_is_not_judged(cartpole, tmp_path, own):
    path, log, other = cartpole
    model = RobotModel.from_urdf(path, passive=["hinge"], own_terms=own)
    found = identify(model, [log], validation=[other])
    assert found.verdict.status == "good"
    assert set(found.verdict.joints) == set(found.metrics().per_joint) == {"slider"}
    assert found.scale.gravity == {}, "that of the hinge is its inertia's, and has no scale"
    save_result(found, tmp_path, report=False)  # friction is projected for simulators
    figures = (tmp_path / "result.json").read_text()
    assert not re.search(r"\d{30}|Infinity|inf %", figures)


def test_a_moving_joint_without_a_torque_column_is_proposed_as_passive(cartpole, tmp_path):
    log = cartpole[1]
    table = np.column_stack([log.t, log.q, log.tau[:, 0]])
    file, names = tmp_path / "log.csv", "time,q_slider,q_hinge,tau_slider"
    np.savetxt(file, table, delimiter=",", header=names, comments="", fmt="%.9g")
    with pytest.raises(DataError, match=r'no drive, set passive = \["hinge"\]') as caught:
        read_log(file, ["slider", "hinge"])
    assert "lock" not in str(caught.value)
    assert read_log(file, ["slider", "hinge"], passive=["hinge"]).joints == ("slider", "hinge")
