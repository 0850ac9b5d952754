"""Friction is chosen against the bodies of least squares, not against those of a wrong prior."""

import re

import numpy as np
import pinocchio as pin
import pytest

import robotid
from robotid.robot.examples import example_urdf

RATE, SECONDS, NOISE = 100.0, 24.0, 0.01  # [Hz], [s], of the standard deviation of each torque


@pytest.mark.parametrize("seed", [0, 1])
def test_bodies_of_1_g_in_the_urdf_do_not_become_springs(tmp_path, seed):
    source = example_urdf("ur10_robot.urdf")
    light = '<inertia ixx="1e-6" iyy="1e-6" izz="1e-6" ixy="0" ixz="0" iyz="0"'
    text = re.sub(r'<mass value="[^"]*"', '<mass value="1e-3"', source.read_text())
    (tmp_path / "light.urdf").write_text(re.sub(r"<inertia [^>/]*", light, text))
    plant = pin.buildModelFromUrdf(str(source))
    rng = np.random.default_rng(seed)
    t = np.arange(round(RATE * SECONDS)) / RATE
    w = 2 * np.pi / SECONDS * np.arange(1, 9)
    a, b = rng.uniform(-0.35, 0.35, (2, len(w), plant.nv))
    S, C = np.sin(np.outer(t, w)), np.cos(np.outer(t, w))
    q, v, acc = S @ a + C @ b, (C * w) @ a - (S * w) @ b, -(S * w**2) @ a - (C * w**2) @ b
    data = plant.createData()
    tau = np.array([pin.rnea(plant, data, *row) for row in zip(q, v, acc, strict=True)])
    size = np.std(tau, axis=0)
    tau += size * (0.1 * v + 0.1 * np.sign(v) + NOISE * rng.standard_normal(tau.shape))
    log = robotid.Log(t=t, q=q, tau=tau, joints=tuple(plant.names)[1:])
    found = robotid.identify(tmp_path / "light.urdf", log)
    assert {c.joint: c.families for c in found.drives if c.families} == {}
