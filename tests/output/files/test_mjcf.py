"""What MuJoCo loads moves as what was identified."""

import xml.etree.ElementTree as ET

import mujoco
import numpy as np
import pinocchio as pin
import pytest
from helpers.closed_chains import Oracle, ankle, four_bar
from helpers.robots import possible_parameters
from helpers.simulators import SIMULATED, simulated, states
from scipy.spatial.distance import pdist

from robotid.output.files.exports import _pose
from robotid.output.files.mjcf import write_mjcf
from robotid.output.files.sdf import write_sdf
from robotid.robot.closure import Chains
from robotid.robot.model import RobotModel
from robotid.robot.parameters import Coupling
from robotid.robot.tree import Joint

OFF = mujoco.mjtDisableBit
SMALL = """<robot name="arm--1">
<link name="base"><visual><geometry><mesh filename="a.stl"/></geometry></visual></link>
<link name="upper">{inertials[0]}
  <visual><origin xyz="0 0 .1" rpy="0 0 1"/><geometry><box size=".1 .2 .4"/></geometry></visual>
  <collision><geometry><cylinder radius=".05" length=".4"/></geometry></collision></link>
<link name="{last}">{inertials[1]}
  <collision><geometry><sphere radius=".07"/></geometry></collision>
  <visual><geometry><mesh filename="b.stl" scale="1 2 3"/></geometry></visual></link>
<joint name="j" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 3 4"/>
  <limit lower="-1" upper="2" effort="7" velocity="1"/></joint>
<joint name="k" type="continuous"><parent link="upper"/><child link="{last}"/><axis xyz="1 0 0"/>
  <limit effort="0" velocity="1"/></joint></robot>"""
INERTIAL = """<inertial><origin xyz=".1 0 0"/><mass value="2"/>
<inertia ixx=".1" iyy=".1" izz="{izz}" ixy="0" ixz="0" iyz="0"/></inertial>"""


def small(folder, last="lower", held=".1", **options):
    path, inertials = folder / "arm.urdf", [INERTIAL.format(izz=izz) for izz in (".1", held)]
    path.write_text(SMALL.format(last=last, inertials=inertials))
    return RobotModel.from_urdf(path, **options)


def load(path):
    model = mujoco.MjModel.from_xml_path(str(path))
    return model, mujoco.MjData(model)


def named(model, joint):
    return mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, joint)


@pytest.mark.parametrize("name", SIMULATED)
def test_mass_matrix_and_forces_are_pinocchios(name, tmp_path):
    model, pi = simulated(name)
    write_mjcf(model, pi, tmp_path / "robot.xml")
    robot, data = load(tmp_path / "robot.xml")
    robot.opt.disableflags = OFF.mjDSBL_CONSTRAINT
    for state in states(model, pi, 5):
        assert robot.nv == len(state.v)
        P, turning = np.zeros((robot.nv, robot.nv)), np.zeros(robot.nv)  # v_mujoco = P v
        if model.free_flyer:  # MuJoCo's base velocity is in the world's axes, its spin in its own
            assert named(robot, "root_joint") == 0
            R = pin.XYZQUATToSE3(state.q[:7]).rotation
            P[:3, :3], P[3:6, 3:6] = R, np.eye(3)
            turning[:3] = R @ np.cross(state.v[3:6], state.v[:3])
            data.qpos[:7] = state.q[[0, 1, 2, 6, 3, 4, 5]]
        for joint, column in state.columns.items():
            P[robot.jnt_dofadr[named(robot, joint)], column] = 1.0
            data.qpos[robot.jnt_qposadr[named(robot, joint)]] = state.angles[joint]
        data.qvel, data.qacc = P @ state.v, P @ state.a + turning
        mujoco.mj_inverse(robot, data)
        M = np.zeros((robot.nv, robot.nv))
        for row, unit in zip(M, np.eye(robot.nv), strict=True):
            mujoco.mj_mulM(robot, data, row, unit)
        np.testing.assert_allclose(P.T @ M @ P, state.M, atol=1e-9 * abs(state.M).max(), rtol=0)
        found = P.T @ data.qfrc_inverse
        np.testing.assert_allclose(found, state.tau, atol=1e-9 * abs(state.tau).max(), rtol=0)


def test_limits_shapes_and_meshes(tmp_path):
    box = b"\0" * 80 + (4).to_bytes(4, "little")
    corners = np.vstack([np.zeros(3), np.eye(3)]).astype("<f4")
    for face in ([0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]):
        box += bytes(12) + corners[face].tobytes() + b"\0\0"
    (tmp_path / "b.stl").write_bytes(box)
    (tmp_path / "a.stl").write_text("solid a\nendsolid a\n")  # MuJoCo reads no text
    model = small(tmp_path)
    pi = possible_parameters(model, np.random.default_rng(0))
    pi[model.layout.names.index("k.offset")] = 0.0
    notes = write_mjcf(model, pi, tmp_path / "robot.xml")
    assert notes == ("meshes not exported, missing or in a format that MJCF cannot read: a.stl",)
    robot, _ = load(tmp_path / "robot.xml")
    np.testing.assert_array_equal(robot.jnt_range, [[-1, 2], [0, 0]])
    np.testing.assert_allclose(robot.jnt_axis, [[0, 0.6, 0.8], [1, 0, 0]])
    np.testing.assert_array_equal(robot.actuator_ctrlrange, [[-7, 7], [0, 0]])
    np.testing.assert_array_equal(robot.actuator_ctrllimited, [True, False])
    np.testing.assert_array_equal(robot.actuator_biastype, [1, 0])
    kinds = mujoco.mjtGeom
    sizes = {kinds.mjGEOM_BOX: [0.05, 0.1, 0.2], kinds.mjGEOM_CYLINDER: [0.05, 0.2, 0]}
    sizes[kinds.mjGEOM_SPHERE] = [0.07, 0, 0]
    for kind, size in sizes.items():
        (geom,) = np.flatnonzero(robot.geom_type == kind)
        np.testing.assert_allclose(robot.geom_size[geom], size)
        assert robot.geom_contype[geom] == (kind != kinds.mjGEOM_BOX)  # which is only seen
        assert robot.geom_group[geom] == (2 if kind == kinds.mjGEOM_BOX else 3)
    assert not robot.geom_conaffinity.any()
    turned = [np.cos(0.5), 0, 0, np.sin(0.5)]
    np.testing.assert_allclose(robot.geom_quat[0], turned)
    edges = [1, 2, 5**0.5, 3, 10**0.5, 13**0.5]  # of the scaled mesh, wherever it was moved
    np.testing.assert_allclose(np.sort(pdist(robot.mesh_vert)), edges, rtol=1e-5)


def test_an_actuator_takes_off_the_offsets_of_all_drives_that_turn_with_its_joint(tmp_path):
    shared = Coupling("k", (("j", 0.5), ("k", -3.0)), replaces=True)
    model = small(tmp_path, couplings=[shared])
    pi = possible_parameters(model, np.random.default_rng(0))
    for name, offset in {"j": 0.7, "k": 0.9}.items():
        pi[model.layout.names.index(f"{name}.offset")] = offset
    write_mjcf(model, pi, tmp_path / "robot.xml")
    robot, _ = load(tmp_path / "robot.xml")
    bias = [-(0.7 + 0.5 * 0.9), 3.0 * 0.9]
    np.testing.assert_allclose(robot.actuator_biasprm[:, 0], bias, rtol=1e-12)


@pytest.mark.parametrize("robot", [four_bar, ankle])
def test_loops_are_closed_in_mujoco(robot, tmp_path, rng):
    model = robot(tmp_path, terms=("viscous",))
    pi = model.standard_parameters()
    pi[model.layout.n_inertial :] = rng.uniform(0.02, 0.1, len(model.layout.drive_names))
    write_mjcf(model, pi, tmp_path / "closed.xml")
    robot, data = load(tmp_path / "closed.xml")
    assert robot.nu == len(model.joints) - len(model.passive)
    oracle = Oracle(model, pi)
    q, Z = Chains(model).random_states(5, rng)
    at = np.array([robot.joint(joint).qposadr[0] for joint in model.joints])
    for q_k, Z_k in zip(q, Z, strict=True):
        v = Z_k @ rng.standard_normal(len(q_k))
        tau = rng.standard_normal(len(q_k)) * ~np.isin(model.joints, model.passive)
        data.qpos[at], data.qvel[at] = q_k, v
        data.ctrl[:] = [tau[model.joints.index(robot.actuator(k).name)] for k in range(robot.nu)]
        mujoco.mj_forward(robot, data)
        wanted = oracle.acceleration(q_k, v, tau)
        np.testing.assert_allclose(data.qacc[at], wanted, atol=1e-2 * np.abs(wanted).max())


BODY = """<inertial><origin xyz=".1 .2 0"/><mass value="2"/>
<inertia ixx=".4" iyy=".5" izz=".6" ixy="0" ixz="0" iyz="0"/></inertial>"""
URDF = f"""<robot name="hand"><link name="base"/><link name="a">{BODY}</link>
<link name="b">{BODY}</link><link name="c">{BODY}</link>
<joint name="ja" type="revolute"><parent link="base"/><child link="a"/><axis xyz="0 0 1"/>
<limit lower="-1" upper="2" effort="7" velocity="1"/></joint>
<joint name="jb" type="revolute"><parent link="base"/><child link="b"/><axis xyz="0 1 0"/>
<limit lower="-3" upper="2.5" effort="8" velocity="2"/></joint>
<joint name="jc" type="revolute"><parent link="b"/><child link="c"/><origin xyz=".3 0 0"/>
<axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="9" velocity="3"/>
<mimic joint="jb" multiplier="-1.5" offset="0.25"/></joint></robot>"""


def hand(folder, **options):
    (folder / "hand.urdf").write_text(URDF)
    return RobotModel.from_urdf(folder / "hand.urdf", **options)


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_the_pose_of_a_locked_joint_has_an_axis_of_any_length(kind):
    xyz, rpy, axis, at = (0.1, -0.2, 0.3), (0.4, -0.5, 0.6), (1.0, 4.0, -8.0), 0.7
    unit = np.array(axis) / 9.0
    found = _pose(Joint("j", kind, "a", "b", xyz=xyz, rpy=rpy, axis=axis), at)
    way = pin.SE3(np.eye(3), at * unit)
    if kind == "revolute":
        way = pin.SE3(pin.exp3(at * unit), np.zeros(3))
    wanted = pin.SE3(pin.rpy.rpyToMatrix(*rpy), np.array(xyz)) * way
    np.testing.assert_allclose(pin.XYZQUATToSE3(found).homogeneous, wanted.homogeneous, atol=1e-12)


def test_a_joint_follows_its_leader_by_ratio_and_offset(tmp_path):
    model = hand(tmp_path, mimic="coupled")
    pi = model.standard_parameters()
    write_mjcf(model, pi, tmp_path / "hand.xml")
    (held,) = ET.parse(tmp_path / "hand.xml").getroot().findall("equality/joint")
    assert (held.get("joint1"), held.get("joint2")) == ("jc", "jb")
    figures = [float(x) for x in held.get("polycoef").split()]
    assert figures == pytest.approx([0.25, -1.5, 0.0, 0.0, 0.0])
    write_sdf(model, pi, tmp_path / "hand.sdf")
    (mimic,) = ET.parse(tmp_path / "hand.sdf").getroot().iter("mimic")
    assert mimic.get("joint") == "jb"
    stated = {tag: float(mimic.findtext(tag)) for tag in ("multiplier", "offset", "reference")}
    assert stated == pytest.approx({"multiplier": -1.5, "offset": 0.25, "reference": 0.0})
    for name, end in (("hand.xml", "</mujoco>\n"), ("hand.sdf", "</sdf>\n")):
        assert (tmp_path / name).read_text().endswith(end)
