"""A cart-pole: the pole has no drive, and its torque is no channel that could be tested."""

import re

import numpy as np
import pinocchio as pin
import pytest

from robotid import identify, save_result
from robotid.base.exceptions import DataError
from robotid.data.files.read import read_log
from robotid.data.log import Log
from robotid.robot.drives import Spring, Viscous
from robotid.robot.model import RobotModel

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
    assert "gain_change" not in {finding.code for finding in found.findings}
    assert found.scale_check.friction["hinge"] == 0.0
    save_result(found, tmp_path, report=False)  # friction is projected for simulators
    figures = (tmp_path / "result.json").read_text()
    assert not re.search(r"\d{30}|Infinity|inf %", figures)


def test_a_moving_joint_without_a_torque_column_is_proposed_as_passive(cartpole, tmp_path):
    log = cartpole[1]
    table = np.column_stack([log.t, log.q, log.tau[:, 0]])
    file, names = tmp_path / "log.csv", "time,q_slider,q_hinge,tau_slider"
    np.savetxt(file, table, delimiter=",", header=names, comments="", fmt="%.9g")
    with pytest.raises(DataError, match=r'no drive, state passive = \["hinge"\]') as caught:
        read_log(file, ["slider", "hinge"])
    assert "lock" not in str(caught.value)
    assert read_log(file, ["slider", "hinge"], passive=["hinge"]).joints == ("slider", "hinge")
