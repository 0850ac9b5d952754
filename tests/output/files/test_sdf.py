"""What an SDF states moves as what was identified, by a reader that shares no line with it."""

import xml.etree.ElementTree as ET

import numpy as np
import pinocchio as pin
import pytest
from helpers.simulators import SIMULATED, simulated, states

from robotid.output.files.sdf import write_sdf


def pose(element):
    """Return the pose of an element and what it is relative to."""
    stated = element.find("pose")
    values = list(map(float, stated.text.split()))
    if stated.get("rotation_format") == "quat_xyzw":
        return pin.XYZQUATToSE3(np.array(values)), stated.get("relative_to")
    return pin.SE3(pin.rpy.rpyToMatrix(*values[3:]), np.array(values[:3])), None


def read(path, gravity):
    """Return Pinocchio's model of an SDF's tree, and its root element."""
    robot = ET.parse(path).getroot().find("model")
    frames = {x.get("name"): pose(x) for tag in ("link", "frame") for x in robot.findall(tag)}
    joints = {joint.findtext("child"): joint for joint in robot.findall("joint")}
    model, at = pin.Model(), {"world": (0, pin.SE3.Identity())}
    model.gravity.linear = np.array(gravity)

    def place(name):  # the joint that a link or frame moves with, and its place behind it
        if name in at:
            return at[name]
        placement, parent = frames[name]
        number, behind = place(parent or "world")
        placement, joint = behind * placement, joints.get(name)
        if joint is None and number == 0 and parent is None:
            number = model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "base")
        elif joint is not None:
            assert joint.findtext("parent") == (parent or "world")
        if joint is not None and joint.get("type") != "fixed":
            kind = pin.JointModelPrismaticUnaligned
            if joint.get("type") != "prismatic":
                kind = pin.JointModelRevoluteUnaligned
            axis = np.array(list(map(float, joint.findtext("axis/xyz").split())))
            kind = kind(axis / np.linalg.norm(axis))
            number = model.addJoint(number, kind, placement, joint.get("name"))
            placement = pin.SE3.Identity()
        at[name] = (number, placement)
        return at[name]

    def depth_first(parent):  # as Pinocchio wants its joints
        for name, (_, above) in frames.items():
            if above == parent:
                yield name
                yield from depth_first(name)

    links = {link.get("name"): link for link in robot.findall("link")}
    for name in depth_first(None):
        number, placement = place(name)
        inertial = links[name].find("inertial") if name in links else None
        if inertial is not None:
            about, _ = pose(inertial)
            np.testing.assert_array_equal(about.rotation, np.eye(3))  # moments in the link's axes
            xx, xy, xz, yy, yz, zz = (float(moment.text) for moment in inertial.find("inertia"))
            I = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])  # noqa: E741
            body = pin.Inertia(float(inertial.findtext("mass")), about.translation, I)
            model.appendBodyToJoint(number, body, placement)
    return model, robot, at


@pytest.mark.parametrize("name", SIMULATED)
def test_mass_matrix_and_forces_are_pinocchios(name, tmp_path):
    model, pi = simulated(name)
    notes = write_sdf(model, pi, tmp_path / "robot.sdf")
    read_back, element, _ = read(tmp_path / "robot.sdf", model.pin_model.gravity.linear)
    data, base = read_back.createData(), 6 * model.free_flyer
    drives = {joint.get("name"): joint for joint in element.findall("joint")}
    for state in states(model, pi, 3):
        assert read_back.nv == len(state.v)
        P, q = np.zeros((read_back.nv, read_back.nv)), np.zeros(read_back.nq)
        P[:base, :base], q[: base and 7] = np.eye(base), state.q[: base and 7]
        M, force = np.zeros_like(P), np.zeros(read_back.nv)
        for joint, column in state.columns.items():
            own = read_back.joints[read_back.getJointId(joint)]
            P[own.idx_v, column], q[own.idx_q] = 1.0, state.angles[joint]
            rotor = drives[joint].find("{drake.mit.edu}rotor_inertia")
            M[own.idx_v, own.idx_v] = 0.0 if rotor is None else float(rotor.text)
            damping = float(drives[joint].findtext("axis/dynamics/damping") or 0.0)
            force[own.idx_v] = damping * state.v[column]
        v, a = P @ state.v, P @ state.a
        force += M @ a + pin.rnea(read_back, data, q, v, a)
        M += np.triu(pin.crba(read_back, data, q)) + np.triu(data.M, 1).T
        M, force, largest = P.T @ M @ P, P.T @ force, abs(state.M).max()
        if model.layout.couplings:  # which an SDF cannot state
            apart = [state.columns[joint] for joint, _ in model.layout.couplings[0].ratios]
            M, state.M = np.delete(M, apart, axis=0), np.delete(state.M, apart, axis=0)
            force, state.tau = np.delete(force, apart), np.delete(state.tau, apart)
            drive = model.layout.couplings[0].name
            assert f"{drive}.armature, {drive}.viscous, {drive}.coulomb" in notes[0]
        np.testing.assert_allclose(M, state.M, atol=1e-9 * largest, rtol=0)
        np.testing.assert_allclose(force, state.tau, atol=1e-9 * abs(state.tau).max(), rtol=0)


def test_shapes_lie_where_the_urdf_has_them(tmp_path):
    model, pi = simulated("humanoid, floating")  # with links on fixed joints, which are frames
    write_sdf(model, pi, tmp_path / "robot.sdf")
    _, element, at = read(tmp_path / "robot.sdf", model.pin_model.gravity.linear)
    urdf = {
        name: frame.placement
        for frame in model.pin_model.frames
        if frame.type == pin.FrameType.BODY
        for name in [frame.name]
    }
    counted = 0
    for link in element.findall("link"):
        for shape in [*link.findall("visual"), *link.findall("collision")]:
            frame = shape.find("pose").get("relative_to")
            assert frame in urdf
            np.testing.assert_allclose(at[frame][1].homogeneous, urdf[frame].homogeneous, atol=1e-9)
            counted += frame != link.get("name")
            uri = shape.findtext("geometry/mesh/uri")
            assert uri is None or uri.startswith("file:///")
    assert counted > 5
