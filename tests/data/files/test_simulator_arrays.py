"""Arrays of MuJoCo and Isaac Lab with a floating base: order of quaternions, axes of velocities."""

import h5py
import mujoco
import numpy as np
import pytest

from robotid.base.exceptions import DataError
from robotid.data.base_motion import BaseColumns, base_state
from robotid.data.files.read import read_log

JOINTS = ("hip", "knee")
BASE = BaseColumns(True, twist="world")  # the arrays themselves state their axes
ROBOT = """<mujoco><option timestep="0.001" gravity="0 0 -9.81"/><worldbody>
<body pos="0 0 1" quat="0.5 0.5 -0.5 0.5"><freejoint/><inertial pos="0.1 0 0" mass="3"
diaginertia="0.1 0.2 0.3"/><body pos="0.2 0 0"><joint name="hip" axis="0 1 0" damping="0.1"/>
<inertial pos="0 0 -0.1" mass="1" diaginertia="0.01 0.01 0.01"/><body pos="0 0 -0.2">
<joint name="knee" axis="1 0 0" damping="0.1"/><inertial pos="0 0 -0.1" mass="0.5"
diaginertia="0.01 0.01 0.01"/></body></body></body></worldbody><actuator><motor joint="hip"/>
<motor joint="knee" gear="2"/></actuator></mujoco>"""


@pytest.fixture(scope="module")
def flight():
    """Arrays of MuJoCo: a robot that tumbles, and the velocity of its link in the world."""
    model = mujoco.MjModel.from_xml_string(ROBOT)
    data = mujoco.MjData(model)
    data.qvel[:] = [1.0, -0.5, 2.0, 3.0, -2.0, 1.0, 0.5, -0.5]
    names = ("time", "qpos", "qvel", "qacc", "qfrc_actuator")
    rows, worlds = [], []
    for k in range(300):
        data.ctrl[:] = [np.sin(0.02 * k), 0.3]
        mujoco.mj_forward(model, data)
        rows.append([np.copy(getattr(data, name)) for name in names])
        velocity = np.zeros(6)
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, 1, velocity, 0)
        worlds.append(np.append(velocity[3:], velocity[:3]))
        mujoco.mj_step(model, data)
    arrays = {name: np.array(x) for name, x in zip(names, zip(*rows, strict=True), strict=True)}
    return arrays, np.array(worlds)


def assert_of_flight(log, arrays, *, twist=True):
    np.testing.assert_array_equal(log.q, arrays["qpos"][:, 7:])
    np.testing.assert_array_equal(log.v, arrays["qvel"][:, 6:])
    np.testing.assert_array_equal(log.tau, arrays["qfrc_actuator"][:, 6:])
    assert np.abs(log.tau).max() > 0.5
    np.testing.assert_array_equal(log.base.pose[:, :3], arrays["qpos"][:, :3])
    some = slice(3, -3)
    _, wanted, _ = base_state(log.t, log.base.pose, None, None)
    if twist:
        np.testing.assert_allclose(log.base.twist[some], wanted[some], atol=2e-2)
        assert np.abs(wanted[:, :3]).max() > 1.0
    else:
        assert log.base.twist is None


def test_generalised_coordinates_of_mujoco_are_read(flight, tmp_path):
    arrays, _ = flight
    np.savez(tmp_path / "log.npz", joints=JOINTS, **arrays)
    log = read_log(tmp_path / "log.npz", JOINTS, base=BASE)
    assert_of_flight(log, arrays)
    np.testing.assert_array_equal(log.a, arrays["qacc"][:, 6:])
    assert not log.notes
    rate = np.gradient(log.base.twist, log.t, axis=0)
    np.testing.assert_allclose(log.base.acceleration[2:-2], rate[2:-2], atol=0.1)
    assert np.abs(rate).max() > 5.0
    no_speeds = {name: x for name, x in arrays.items() if name not in ("qvel", "qacc")}
    np.savez(tmp_path / "log.npz", joints=JOINTS, **no_speeds)
    assert read_log(tmp_path / "log.npz", JOINTS, base=BASE).base.twist is None


@pytest.mark.parametrize("root", ["root_link_state_w", "root_state_w"])
def test_states_of_isaac_lab_are_read(flight, tmp_path, root):
    arrays, world = flight
    with h5py.File(tmp_path / "log.h5", "w") as file:
        file["time"], file["joint_names"] = arrays["time"], list(JOINTS)
        file["joint_pos"], file["joint_vel"] = arrays["qpos"][:, 7:], arrays["qvel"][:, 6:]
        file["applied_torque"] = arrays["qfrc_actuator"][:, 6:]
        file[root] = np.hstack([arrays["qpos"][:, :7], world])
    log = read_log(tmp_path / "log.h5", JOINTS, base=BASE)
    is_link = root == "root_link_state_w"
    assert_of_flight(log, arrays, twist=is_link)
    assert any("velocity of the centre of mass" in note for note in log.notes) != is_link


def test_arrays_of_a_fixed_base_have_no_free_joint(flight, tmp_path):
    arrays, _ = flight
    own = {name: arrays[name][:, -2:] for name in ("qpos", "qvel", "qfrc_actuator")}
    np.savez(tmp_path / "log.npz", time=arrays["time"], joints=JOINTS, **own)
    log = read_log(tmp_path / "log.npz", JOINTS)
    np.testing.assert_array_equal(log.q, own["qpos"])
    np.testing.assert_array_equal(log.tau, own["qfrc_actuator"])


def test_arrays_of_another_width_are_refused(flight, tmp_path):
    arrays, _ = flight
    np.savez(tmp_path / "log.npz", joints=["hip"], **arrays)
    with pytest.raises(DataError, match=r"qpos has 9 columns, wanted 1, .* or 7 more with a free"):
        read_log(tmp_path / "log.npz", ["hip"], base=BASE)
    np.savez(
        tmp_path / "log.npz", joints=JOINTS, time=arrays["time"], joint_pos=arrays["qpos"][:, 7:],
        root_state_w=arrays["qpos"][:, :7],
    )  # fmt: skip
    with pytest.raises(DataError, match="root_state_w has 7 columns, wanted 13"):
        read_log(tmp_path / "log.npz", JOINTS, base=BASE, needs="motion")
