"""Poses of another link than the root become those of the root."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pinocchio as pin
import pytest

from robotid.base.exceptions import ModelError
from robotid.data.base_motion import ImuFrame, ImuMotion
from robotid.data.files.read import read_log
from robotid.data.signal_settings import BaseSource
from robotid.dynamics.constraint_rows import logged_base
from robotid.dynamics.prepared_logs import closed_log
from robotid.robot.constraints import frame_id
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

FRAME = ImuFrame(np.r_[0, 0, 0, 1.0], np.zeros(3), np.r_[0, 0, -9.81], np.zeros(3))


@pytest.fixture(scope="module")
def robot():
    joints = ["FL_HAA", "FL_HFE", "FL_KFE"]
    return RobotModel.from_urdf(example_urdf("solo12.urdf"), joints=joints, free_flyer=True)


@pytest.mark.parametrize("link", ["FL_FOOT", "base_link"])
@pytest.mark.parametrize("has_position", [True, False])
def test_the_pose_of_the_root_follows_from_that_of_a_moving_link(robot, link, has_position):
    rng, n = np.random.default_rng(0), 30
    q, t = rng.uniform(-1, 1, (n, 3)), 7.0 + 0.1 * np.arange(n)
    pin_model = robot.pin_model
    data, frame = pin_model.createData(), frame_id(pin_model, link)
    roots, links = np.empty((2, n, 7))
    for k in range(n):
        roots[k] = np.r_[
            rng.uniform(-1, 1, 3), pin.Quaternion(pin.exp3(rng.uniform(-2, 2, 3))).coeffs()
        ]
        pin.framesForwardKinematics(pin_model, data, np.r_[roots[k], q[k]])
        links[k] = pin.SE3ToXYZQUAT(data.oMf[frame])
    names = ["x", "y", "z", "qx", "qy", "qz", "qw", "vx", "vy", "vz", "wx", "wy", "wz"]
    table = {"time": t} | {f"q_{x}": q[:, j] for j, x in enumerate(robot.joints)}
    table |= {f"base_{x}": np.c_[links, links][:, k] for k, x in enumerate(names)}
    wanted = logged_base(robot, BaseSource(link=link))
    log = read_log(pd.DataFrame(table), robot.joints, needs="motion", base=wanted)
    if not has_position:
        pose = log.base.pose * np.r_[0, 0, 0, np.ones(4)]
        log = replace(log, base=replace(log.base, pose=pose))
    imu = ImuMotion(rng.normal(size=(n, 6)), FRAME)
    closed = closed_log(robot, replace(log, base=replace(log.base, imu=imu)))
    found = closed.base
    assert found.imu is imu
    if link != "base_link":
        assert closed.notes[-1] == f"the pose of the base is computed from the pose of {link}"
    assert found.link == ""
    signs = np.sign(np.sum(found.pose[:, 3:] * roots[:, 3:], axis=1))
    np.testing.assert_allclose(found.pose[:, 3:], signs[:, None] * roots[:, 3:], atol=1e-12)
    assert (found.twist is not None) == (link == "base_link")  # the root itself
    assert found.has_position == has_position
    if has_position:
        np.testing.assert_allclose(found.pose[:, :3], roots[:, :3], atol=1e-12)
    else:
        assert not found.pose[:, :3].any()


def test_an_unknown_link_is_named(robot):
    with pytest.raises(ModelError, match=r"link in .base. is 'FL_FOT'.*'FL_FOOT'"):
        logged_base(robot, BaseSource(link="FL_FOT"))
