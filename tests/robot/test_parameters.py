"""Parameters of layouts and bodies, prior deviations, mass matrices, shapes and meshes."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
import trimesh
from helpers.hostile_urdfs import FILES
from helpers.synthetic import truth

from robotid.base.exceptions import DataError, SettingsError
from robotid.diagnosis.urdf.inspection import inspect_urdf
from robotid.dynamics.torque import joint_torque_regressor
from robotid.output.viewer.replays import robot_scene
from robotid.robot.bodies import (
    LinkPlace,
    body_boxes,
    body_points,
    central_inertial,
    density_share,
    find_mesh,
    held_parameters,
    kinematic_lengths,
    least_density,
    link_places,
    principal_moments,
    read_shapes,
    read_surfaces,
)
from robotid.robot.drives import Lag
from robotid.robot.examples import example_urdf, example_urdfs
from robotid.robot.mass_matrix import carried_inertia, check_mass_matrix, joint_mass_matrices
from robotid.robot.model import RobotModel
from robotid.robot.parameters import (
    INERTIAL_TERMS,
    Coupling,
    ParameterLayout,
    inertial_from_pseudo_inertia,
    pseudo_inertia,
    to_paper_order,
)
from robotid.robot.prior import payload_spread, prior_spread
from robotid.robot.tree import parse_urdf


def test_order_is_pinocchios():
    inertia = pin.Inertia(2.0, np.array([0.1, 0.2, 0.3]), np.diag([1.0, 1.1, 1.2]))
    pi = dict(zip(INERTIAL_TERMS, inertia.toDynamicParameters(), strict=True))
    moved = inertia.matrix()[3:, 3:]  # inertia about the frame's origin
    assert pi["m"] == 2.0
    assert pi["mcy"] == pytest.approx(0.4)
    assert pi["Iyy"] == pytest.approx(moved[1, 1])
    assert pi["Ixz"] == pytest.approx(moved[0, 2])


def test_paper_order_is_that_of_equation_9():
    pi = np.arange(20.0)
    P = to_paper_order(pi)
    # [Ixx Ixy Ixz Iyy Iyz Izz mx my mz m]
    np.testing.assert_array_equal(P[:10], [4, 5, 7, 6, 8, 9, 1, 2, 3, 0])


def test_pseudo_inertia_is_pinocchios(rng):
    for _ in range(20):
        inertia = pin.Inertia.Random()
        pi = inertia.toDynamicParameters()
        expected = pin.PseudoInertia.FromInertia(inertia).toMatrix()
        np.testing.assert_allclose(pseudo_inertia(pi)[0], expected, atol=1e-14)
        np.testing.assert_allclose(inertial_from_pseudo_inertia(expected), pi, atol=1e-14)


def test_an_incomplete_body_is_refused():
    with pytest.raises(DataError, match=r"have shape \(13,\), expected a vector of 10 per body"):
        pseudo_inertia(np.zeros(13))


def test_names_and_units_follow_the_layout():
    layout = ParameterLayout(
        bodies=("arm", "rod"),
        joints=("elbow", "slide"),
        couplings=(Coupling("motor", (("elbow", 1.0), ("slide", 2.0))),),
        prismatic=frozenset({"slide"}),
    )
    assert len(layout.names) == 20 + 8 + 3
    unit = dict(zip(layout.names, layout.units, strict=True))
    assert unit["arm.m"] == "kg"
    assert unit["arm.mcy"] == "kg m"
    assert unit["rod.Ixy"] == "kg m^2"
    assert unit["elbow.viscous"] == "N m s/rad"
    assert unit["slide.armature"] == "kg"
    assert unit["slide.coulomb"] == "N"
    assert "motor.offset" not in unit
    assert layout.is_nonnegative().sum() == 3 * 3
    preference = dict(zip(layout.names, layout.preference(), strict=True))
    assert [preference[f"arm.{x}"] for x in ("m", "mcx", "Ixy")] == [0.1, 0.3, 1.0]
    assert [preference[f"elbow.{x}"] for x in ("armature", "viscous")] == [0.3, 1.0]


def test_a_coupling_may_stand_in_the_place_of_a_joints_own_drive():
    motor = Coupling("elbow", (("elbow", 1.0), ("wrist", -0.5)), replaces=True)
    layout = ParameterLayout(("a", "b"), ("elbow", "wrist"), couplings=(motor,))
    terms = ("armature", "viscous", "coulomb", "offset")
    assert layout.drive_names == tuple(f"{n}.{t}" for n in layout.joints for t in terms)
    np.testing.assert_array_equal(layout.drive_ratios, [[1.0, -0.5], [0.0, 1.0]])
    np.testing.assert_array_equal(layout.is_coupled, [True] * 3 + [False] * 5)
    with pytest.raises(SettingsError, match=r"coupling 'elbow' has the name of a joint or of"):
        replace(layout, couplings=(replace(motor, replaces=False),))
    with pytest.raises(SettingsError, match=r"coupling 'hip' has the joints hip, expected joints"):
        replace(layout, couplings=(replace(motor, name="hip"),))


def test_an_unknown_drive_term_is_refused():
    with pytest.raises(SettingsError, match="unknown drive terms stiction; known: armature"):
        ParameterLayout(("a",), ("elbow",), terms=("stiction",))


def test_a_slider_counts_by_its_stroke_and_a_coupling_by_the_mean_of_its_joints():
    ratios = (("a", 2.0), ("c", -0.5))
    options = {
        "bodies": ("x",),
        "couplings": (Coupling("motor", ratios),),
        "joints": ("a", "b", "c"),
    }
    layout = ParameterLayout(prismatic=frozenset("bc"), strokes={"c": 0.8}, **options)
    b, c = 1.0 / (2 * np.pi), 0.8 / (2 * np.pi)  # [m/s] that count as 1 rad/s; b states no stroke
    motor = (2.0 + 0.5 * c) / 2.5
    np.testing.assert_allclose(layout.drive_speeds, [1.0, b, c, motor])
    R = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [2, 0, -0.5]])
    np.testing.assert_array_equal(layout.drive_ratios, R)
    owner = [name.split(".")[0] for name in layout.drive_names]
    places = [("a", "b", "c", "motor").index(name) for name in owner]
    np.testing.assert_array_equal(layout.drive_loads, R[places].T)
    shared = [name.startswith("motor.") for name in layout.drive_names]
    np.testing.assert_array_equal(layout.is_coupled, shared)
    assert "motor.offset" not in layout.drive_names
    own = [
        name for name, mine in zip(layout.names, layout.owned_by(["b", "x"]), strict=True) if mine
    ]
    of_b = [name for name in layout.drive_names if name.startswith("b.")]
    assert own == [*(f"x.{term}" for term in INERTIAL_TERMS), *of_b]
    length = 0.4
    wanted = [1.0, *[0.4] * 3, *[0.16] * 6]
    wanted += [0.16 if n in ("a.armature", "motor.armature") else 1.0 for n in layout.drive_names]
    np.testing.assert_allclose(layout.scales(length), wanted)  # an armature of a slider is a mass


def test_it_is_what_accelerations_cost_armatures_and_couplings_included(rng, ur5):
    # tau(q, 0, a) - tau(q, 0, 0) = M a
    coupling = Coupling("motor", (("wrist_2_joint", 1.0), ("wrist_3_joint", -2.0)))
    path, joints = example_urdf("ur5_robot.urdf"), [ur5.joints[k] for k in (2, 0, 1, 4, 5, 3)]
    terms = ("armature", "offset")
    model = RobotModel.from_urdf(path, joints=joints, terms=terms, couplings=(coupling,))
    pi, q = truth(model), rng.uniform(-2, 2, (3, 6))
    pi[-1] = 0.3
    M = joint_mass_matrices(model, pi, q)
    still, a = np.zeros_like(q), rng.standard_normal(q.shape)
    torque = [
        (joint_torque_regressor(model, q, still, x) @ pi).reshape(q.shape) for x in (a, still)
    ]
    np.testing.assert_allclose(np.einsum("nij,nj->ni", M, a), torque[0] - torque[1], atol=1e-10)


@pytest.mark.parametrize("upper_arm", [None, 1.0, -5.0])
def test_the_least_and_the_share_are_those_of_every_block_of_poses(ur5, upper_arm):
    pi = ur5.standard_parameters()
    if upper_arm is not None:
        pi[10], pi[14:20] = upper_arm, 0.0  # its mass, without inertia
    found = check_mass_matrix(ur5, pi, poses=1500)
    low, high = (np.array([getattr(j, side) for j in ur5.limits]) for side in ("lower", "upper"))
    q = np.random.default_rng(0).uniform(low, high, (1500, 6))
    least = np.linalg.eigvalsh(joint_mass_matrices(ur5, pi, q))[:, 0]
    assert found.smallest_eigenvalue == pytest.approx(least.min(), rel=1e-9)
    assert found.positive_share == np.mean(least > 0)
    assert found.is_positive == (upper_arm is None)
    if upper_arm is None:
        assert least.argmin() > 400, "it is not in the first blocks"


def test_a_floating_base_has_one_too():
    model = RobotModel.from_urdf(example_urdf("solo12.urdf"), free_flyer=True)
    assert check_mass_matrix(model, model.standard_parameters(), poses=20).is_positive


def test_a_slider_without_limits_stays_within_a_metre_and_a_joint_goes_half_a_turn(tmp_path):
    """A bar turns with m x^2 - I at the way x of its slider: possible where x^2 > I / m."""
    moments = 'ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"'
    inertial = f'<inertial><mass value="1"/><inertia {moments}/></inertial>'
    (tmp_path / "bar.urdf").write_text(f"""<robot name="bar"><link name="base"/>
        <link name="arm">{inertial}</link><link name="hand">{inertial}</link>
        <joint name="turn" type="continuous"><parent link="base"/><child link="arm"/>
            <axis xyz="0 0 1"/></joint>
        <joint name="slide" type="prismatic"><parent link="arm"/><child link="hand"/>
            <axis xyz="1 0 0"/></joint></robot>""")
    model = RobotModel.from_urdf(tmp_path / "bar.urdf", terms=())
    pi = np.zeros(20)
    pi[9], pi[10] = -0.5, 2.0  # izz of the arm, mass of the hand
    check = check_mass_matrix(model, pi, poses=450, seed=3)
    draws = np.random.default_rng(3).uniform([-np.pi, -1.0], [np.pi, 1.0], (450, 2))
    turning = 2.0 * draws[:, 1] ** 2 - 0.5
    assert check.poses == 450
    assert check.positive_share == np.mean(turning > 0)
    assert check.smallest_eigenvalue == pytest.approx(turning.min(), rel=1e-9)
    assert not check.is_positive


@pytest.mark.parametrize("free_flyer", [False, True])
@pytest.mark.parametrize("name", ["panda.urdf", "talos_reduced.urdf", "tiago_no_hand.urdf"])
def test_the_links_of_a_body_add_up_to_it(name, free_flyer):
    model = RobotModel.from_urdf(example_urdf(name), free_flyer=free_flyer)
    total = np.zeros((len(model.layout.bodies) + 1, 10))
    for place in link_places(model):
        total[place.body] += place.parameters
    expected = model.standard_parameters()[: model.layout.n_inertial].reshape(-1, 10)
    np.testing.assert_allclose(total[:-1], expected, atol=1e-9)


def test_the_inertia_of_a_link_is_moved_from_its_turned_frame(tmp_path):
    (tmp_path / "r.urdf").write_text("""<robot name="r"><link name="base"/><link name="arm">
      <inertial><origin xyz="0.1 -0.2 0.3" rpy="0.4 -0.7 1.2"/><mass value="2"/>
      <inertia ixx="1" ixy="0.1" ixz="-0.2" iyy="2" iyz="0.3" izz="2.5"/></inertial></link>
      <joint name="j" type="continuous"><parent link="base"/><child link="arm"/></joint></robot>""")
    place = link_places(RobotModel.from_urdf(tmp_path / "r.urdf"))[1]
    at = pin.SE3(pin.rpy.rpyToMatrix(0.4, -0.7, 1.2), np.array([0.1, -0.2, 0.3]))
    moments = np.array([[1.0, 0.1, -0.2], [0.1, 2.0, 0.3], [-0.2, 0.3, 2.5]])
    moved = at.act(pin.Inertia(2.0, np.zeros(3), moments))
    np.testing.assert_allclose(place.parameters, moved.toDynamicParameters(), atol=1e-12)


def test_links_behind_a_locked_joint_are_held(panda):
    places = link_places(panda)
    role = {place.link: place.role for place in places}
    lumped = {place.link for place in places if place.is_lumped}
    assert lumped == {"panda_link8", "panda_hand", "panda_hand_tcp"}
    assert not LinkPlace("of the world", -1, "fixed", np.zeros(10)).is_lumped
    assert role["panda_link7"] == "moved"
    assert role["panda_hand"] == "fixed"
    assert role["panda_leftfinger"] == "held"
    fingers = RobotModel.from_urdf(panda.tree.path).tree.inertials["panda_leftfinger"].mass
    held = held_parameters(panda).reshape(-1, 10)
    assert held[-1, 0] == pytest.approx(2 * fingers)
    assert not held[:-1].any()


def test_the_least_density_of_a_body_is_that_of_its_ellipsoid():
    m, a = 3.0, np.array([0.1, 0.2, 0.05])  # [kg], [m] semi-axes
    x, y, z = m * a**2 / 5.0
    c = np.array([0.3, -0.1, 0.2])
    inertia = np.diag([y + z, z + x, x + y]) + m * (c @ c * np.eye(3) - np.outer(c, c))
    Ixx, Ixy, Ixz, Iyy, Iyz, Izz = inertia[np.triu_indices(3)]
    pi = np.array([m, *(m * c), Ixx, Ixy, Iyy, Ixz, Iyz, Izz])
    assert least_density(pi) == pytest.approx(m / (4.0 / 3.0 * np.pi * a.prod()))
    assert least_density(np.zeros(10)) == 0.0
    assert least_density(np.array([1.0, *np.zeros(9)])) == np.inf
    pi = np.array([1.0, 0, 0, 0, 1.0, 0, 1.0, 0, 0, 2.0])  # a disc: half of the draws are no body
    share = density_share(pi, np.diag([*np.zeros(9), 1e-2]), 1e9, np.random.default_rng(0))
    assert share == 1.0


def test_principal_moments_are_those_of_a_turned_body():
    moments = np.array([0.02, 0.05, 0.11])  # second moments of mass along its axes
    turns = np.random.default_rng(0).uniform(-3.0, 3.0, (12, 3))  # axes as found are of either hand
    for order, turn in zip(4 * ([0, 1, 2], [2, 0, 1], [1, 0, 2]), turns, strict=True):
        turned = pin.rpy.rpyToMatrix(*turn)
        own = moments[order]
        I = turned @ np.diag(own.sum() - own) @ turned.T  # noqa: E741
        c, m = np.array([0.2, -0.3, 0.1]), 2.5
        found, axes = principal_moments(pin.Inertia(m, c, I).toDynamicParameters())
        np.testing.assert_allclose(found, moments, atol=1e-12)
        assert np.linalg.det(axes) == pytest.approx(1.0)
        np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-12)
        S = turned @ np.diag(own) @ turned.T
        np.testing.assert_allclose(axes @ np.diag(found) @ axes.T, S, atol=1e-12)
        stated = central_inertial(pin.Inertia(m, c, I).toDynamicParameters())
        assert (stated.mass, stated.rpy) == (pytest.approx(m), (0.0, 0.0, 0.0))
        np.testing.assert_allclose(stated.com, c)
        np.testing.assert_allclose(stated.inertia, I[np.triu_indices(3)], atol=1e-12)


def test_the_spread_is_what_the_docstring_says(ur5):
    rms = np.array([2.0, 3.0, 5.0])[:, None] * np.ones((3, 6))
    rms[0] *= np.arange(1, 7)  # each joint has its own torque
    model = ur5.with_terms({"elbow_joint": [Lag()]})
    spread = dict(zip(model.layout.names, prior_spread(model, 16 * rms**2, 16), strict=True))
    inertial = ur5.tree.inertials["forearm_link"]
    mass, centre = inertial.mass, np.linalg.norm(ur5.standard_parameters()[21:24]) / inertial.mass
    J = pseudo_inertia(ur5.standard_parameters()[:60])[2]
    radius = centre + np.sqrt(np.trace(J[:3, :3]) / mass)
    assert spread["forearm_link.mcx"] == pytest.approx(mass * radius)
    assert spread["forearm_link.Ixx"] == pytest.approx(mass * radius**2)
    assert spread["elbow_joint.viscous"] == pytest.approx(6.0 / 3.0)
    assert spread["wrist_1_joint.coulomb"] == pytest.approx(8.0)
    assert spread["elbow_joint.lag"] == pytest.approx(3.0 / 5.0)  # its rate is tau a / v
    carried = dict(zip(ur5.joints, carried_inertia(ur5), strict=True))
    heavy, light = "shoulder_lift_joint", "wrist_3_joint"
    assert carried[heavy] > 4.0 / 5.0
    assert carried[light] < 12.0 / 5.0
    assert spread[f"{heavy}.armature"] == pytest.approx(carried[heavy])
    assert spread[f"{light}.armature"] == pytest.approx(12.0 / 5.0)


def test_a_light_link_may_be_wrong_by_a_tenth_of_the_mean_mass(ur5):
    pi = ur5.standard_parameters()
    pi[20:30] *= 1e-6
    squares = np.ones((3, 6))
    spread = prior_spread(ur5.with_parameters(pi), squares, 1)
    assert spread[20] == pytest.approx(0.1 * pi[:60:10].mean(), rel=1e-6)
    assert (prior_spread(ur5.with_parameters(0 * pi), squares, 1) > 0).all()  # of no mass at all


def test_the_spread_of_a_payload_is_the_robots_mass_at_its_length(ur5):
    mass, length = ur5.standard_parameters()[:60:10].sum(), ur5.length
    wanted = mass * np.array([1.0, *[length] * 3, *[length**2] * 6])
    assert abs(length - 1.0) > 0.05, "else its square is no other"
    np.testing.assert_allclose(payload_spread(ur5), wanted)
    light = ur5.with_parameters(0 * ur5.standard_parameters())
    np.testing.assert_allclose(payload_spread(light), 1e-3 * wanted / mass)


def test_the_spread_of_a_drive_of_several_joints_is_the_mean_of_theirs(ur5):
    ratios = (("wrist_2_joint", 1.0), ("elbow_joint", -2.0))
    model = RobotModel.from_urdf(ur5.tree.path, couplings=(Coupling("motor", ratios),))
    tau, v = np.arange(1.0, 7.0), 0.5 * np.arange(2.0, 8.0)
    squares = 9 * np.stack([tau, v, np.full(6, 3.0)]) ** 2
    spread = dict(zip(model.layout.names, prior_spread(model, squares, 9), strict=True))
    each = dict(zip(model.joints, tau / v, strict=True))
    assert spread["elbow_joint.viscous"] == pytest.approx(each["elbow_joint"])
    both = (each["elbow_joint"] + each["wrist_2_joint"]) / 2
    assert spread["motor.viscous"] == pytest.approx(both)
    assert spread["motor.coulomb"] == pytest.approx((3.0 + 5.0) / 2)


URDF = """<robot name="arm">
<link name="base"/>
<link name="one"><inertial><mass value="2"/><origin xyz="0 0 0.1"/>
<inertia ixx=".02" iyy=".02" izz=".01" ixy="0" ixz="0" iyz="0"/></inertial>{one}</link>
<link name="flange"><inertial><mass value="1"/>
<inertia ixx=".01" iyy=".01" izz=".01" ixy="0" ixz="0" iyz="0"/></inertial>{flange}</link>
<joint name="a" type="revolute"><parent link="base"/><child link="one"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" velocity="1" effort="1"/></joint>
<joint name="b" type="fixed"><parent link="one"/><child link="flange"/>
<origin xyz="0 0 1" rpy="0 1.5707963267948966 0"/></joint>
</robot>"""
BOX = '<collision><origin xyz="0 0 0.5"/><geometry><box size="0.2 0.4 1"/></geometry></collision>'
CYLINDER = '<visual><geometry><cylinder radius="0.1" length="0.6"/></geometry></visual>'
SPHERE = '<visual><geometry><sphere radius="0.3"/></geometry></visual>'
MESH = '<collision><geometry><mesh filename="{}" scale="0.5 1 1"/></geometry></collision>'


def arm(tmp_path, one="", flange=""):
    path = tmp_path / "arm.urdf"
    path.write_text(URDF.format(one=one, flange=flange))
    return RobotModel.from_urdf(path)


def extent(model):
    points = body_points(model)["one"]
    return points.min(axis=0), points.max(axis=0)


def test_shapes_of_links_that_are_fixed_to_each_other_make_one_body(tmp_path):
    low, high = extent(arm(tmp_path, BOX, CYLINDER))
    # the flange's cylinder lies along the body's x axis, one metre up
    np.testing.assert_allclose([low[0], high[0]], [-0.3, 0.3], atol=1e-12)
    np.testing.assert_allclose([low[1], high[1]], [-0.2, 0.2], atol=1e-12)
    assert low[2] == pytest.approx(0.0, abs=1e-12)
    assert 1.1 <= high[2] < 1.103  # a prism around the cylinder, which lies in it all around
    points = body_points(arm(tmp_path, CYLINDER, CYLINDER))["one"]
    turn = np.linspace(0.0, 2 * np.pi, 100)
    around = np.column_stack([np.cos(turn), np.sin(turn)])
    assert (around @ points[np.abs(points[:, 2]) < 0.4, :2].T).max(axis=1).min() >= 0.1 - 1e-12


@pytest.mark.parametrize(
    ("shape", "low", "high"),
    [
        ('<box size="0.2 0.4 1"/>', [0.9, -0.2, -0.5], [1.1, 0.2, 0.5]),
        ('<sphere radius="0.3"/>', [0.7, -0.3, -0.3], [1.3, 0.3, 0.3]),
        # a prism of 16 sides around it
        ('<cylinder radius="0.1" length="0.6"/>', [0.898, -0.102, -0.3], [1.102, 0.102, 0.3]),
    ],
)
def test_the_extent_of_a_shape_is_that_which_the_urdf_states(tmp_path, shape, low, high):
    own = f'<collision><origin xyz="1 0 0"/><geometry>{shape}</geometry></collision>'
    seen = '<visual><geometry><box size="9 9 9"/></geometry></visual>'
    flange = '<collision><origin xyz="1 0 1" rpy="0 0 0"/><geometry><box size="0 0 0"/>'
    model = arm(tmp_path, own + seen, flange + "</geometry></collision>")
    points = body_points(model)["one"][:-8]  # but for the flange's
    np.testing.assert_allclose(points.min(axis=0), low, atol=6e-4)
    np.testing.assert_allclose(points.max(axis=0), high, atol=6e-4)


def test_a_body_whose_link_has_mass_but_no_shape_is_not_bounded(tmp_path):
    assert body_points(arm(tmp_path, BOX)) == {}


def test_a_mesh_is_found_beside_the_urdf_and_scaled(tmp_path):
    (tmp_path / "meshes").mkdir()
    trimesh.creation.box([1.0, 2.0, 3.0]).export(tmp_path / "meshes" / "part.stl")
    for name in ("meshes/part.stl", f"package://{tmp_path.name}/meshes/part.stl"):
        low, high = extent(arm(tmp_path, MESH.format(name), SPHERE.replace("0.3", "0.01")))
        np.testing.assert_allclose(high[:2], [0.25, 1.0], atol=1e-6)
        np.testing.assert_allclose(low, [-0.25, -1.0, -1.5], atol=1e-6)
    assert body_points(arm(tmp_path, MESH.format("lost.stl"), SPHERE)) == {}
    assert body_points(arm(tmp_path, BOX + MESH.format("lost.stl"), SPHERE)) == {}


def test_the_box_of_a_body_holds_its_geometry_or_its_frames_and_the_urdfs_own_body(tmp_path):
    # BOX, and the cylinder of the flange: 0.6 x 0.4 x 1.1 m, grown by 5 % of its diagonal; the
    # URDF's own body, 2 kg 0.1 m up and 1 kg in the flange, reaches further down
    grown = 0.05 * np.linalg.norm([0.6, 0.4, 1.1])
    own = 0.4 - np.sqrt(3 * (2 * 0.3**2 + 0.015 + 1 * 0.6**2 + 0.005) / 3)  # [kg m^2] over 3 kg
    low, high = body_boxes(arm(tmp_path, BOX, CYLINDER))["one"]
    np.testing.assert_allclose(low, [-0.3 - grown, -0.2 - grown, own], atol=2e-3)
    np.testing.assert_allclose(high, np.array([0.3, 0.2, 1.1]) + grown, atol=3e-3)
    # frames alone: the flange is 1 m up
    low, high = body_boxes(arm(tmp_path))["one"]
    np.testing.assert_allclose([low, high], [[-0.35, -0.35, -0.35], [0.35, 0.35, 1.35]], atol=1e-9)
    # a joint at the frame of its body: one metre, the length of the robot, is grown by a tenth
    text = (tmp_path / "arm.urdf").read_text().replace('type="fixed"', 'type="continuous"')
    (tmp_path / "two.urdf").write_text(text.replace(".01", ".002"))
    box = body_boxes(RobotModel.from_urdf(tmp_path / "two.urdf"))["flange"]
    np.testing.assert_allclose(box, np.outer([-0.1, 0.1], np.ones(3)), atol=1e-9)
    # a heavy flange's own body reaches beyond the sphere that is drawn: 3 sigma^2 about the centre
    small = arm(tmp_path, SPHERE, '<visual><geometry><sphere radius="0.01"/></geometry></visual>')
    (J,) = pseudo_inertia(small.standard_parameters()[:10])
    centre = J[2, 3] / J[3, 3]
    reach = np.sqrt(3.0 * (J[2, 2] / J[3, 3] - centre**2))
    assert body_boxes(small)["one"][1][2] == pytest.approx(centre + reach, abs=1e-9)
    assert centre + reach > 1.01 + 0.05 * 1.5


def test_the_kinematic_length_of_a_body_is_that_between_its_frames_or_to_the_joint_before(tmp_path):
    assert kinematic_lengths(arm(tmp_path)) == {"one": 1.0}  # the flange; no way along the joints
    joint = (
        '<link name="{1}"><inertial><mass value="1"/><inertia ixx=".01" iyy=".01" izz=".01" '
        'ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="j{1}" type="{3}"><parent '
        'link="{0}"/><child link="{1}"/><origin xyz="0 {2} 0"/><axis xyz="0 1 0"/>'
        '<limit lower="-1" upper="{4}" effort="1" velocity="1"/></joint>'
    )
    path = tmp_path / "chain.urdf"

    def lengths(kind, upper):
        steps = [("base", "a", 0.0, "revolute", 1), ("a", "b", 2.0, "revolute", 1)]
        steps += [("b", "c", 0.5, kind, upper), ("c", "d", 0.1, "revolute", 1)]
        joints = "".join(joint.format(*step) for step in steps)
        path.write_text(f'<robot name="r"><link name="base"/>{joints}</robot>')
        return kinematic_lengths(RobotModel.from_urdf(path))

    housings = 0.1 * 2.6
    expected = {"a": 2.0, "b": 2.0, "c": 0.5, "d": 0.1}
    expected = {body: length + housings for body, length in expected.items()}
    assert lengths("revolute", 1) == pytest.approx(expected)
    # the travel of 3 m is beside both bodies of the prismatic joint
    travel = expected | {body: expected[body] + 3.0 for body in "bc"}
    assert lengths("prismatic", 2) == pytest.approx(travel)
    assert lengths("prismatic", -1).keys() == {"a", "d"}  # without limits


BROKEN = {
    "box without size": "<collision><geometry><box/></geometry></collision>",
    "nothing": "<collision><geometry/></collision>",
    "unknown shape": '<collision><geometry><capsule radius="1"/></geometry></collision>',
    "size of text": '<collision><geometry><box size="1 1 1_0"/></geometry></collision>',
    "garbage": MESH.format("garbage.stl"),
    "counts": MESH.format("counts.ply"),
    "no mesh": MESH.format("arm.urdf"),
    "folder": MESH.format("folder.stl"),
    "nowhere": MESH.format("nan.stl"),
}


@pytest.mark.parametrize("shape", BROKEN.values(), ids=BROKEN)
def test_geometry_that_cannot_be_read_bounds_nothing_and_is_named(tmp_path, shape):
    (tmp_path / "garbage.stl").write_bytes(b"\xff\x00solid")
    (tmp_path / "counts.ply").write_bytes(FILES["counts.ply"])
    (tmp_path / "nan.stl").write_bytes(FILES["nan.stl"])
    (tmp_path / "folder.stl").mkdir()
    model = arm(tmp_path, one=shape, flange=BOX)
    assert body_points(model) == {}

    codes = {finding.code for finding in inspect_urdf(model.tree.path).findings}
    assert ("geometry_unread" in codes) == ("mesh" in shape)


def test_boxes_without_extent_have_no_size_to_compare(tmp_path):
    point = '<collision><geometry><box size="0 0 0"/></geometry></collision>'
    path = tmp_path / "arm.urdf"
    text = URDF.format(one=point, flange=point).replace('type="fixed"', 'type="continuous"')
    one, flange = (text.split("<inertial>")[k].split("</inertial>")[0] for k in (1, 2))
    path.write_text(text.replace(flange, one))
    codes = {finding.code for finding in inspect_urdf(path).findings}
    assert "copied_inertial" not in codes


# --- shapes and meshes ---------------------------------------------------------------------------

PACKAGED = """<robot name="r">
  <material name="rust"><color rgba="0.5 0.2 0.1 1"/></material>
  <link name="base"><visual><geometry><box size="1 2 3"/></geometry>
    <material name="rust"/></visual></link>
  <link name="arm">
    <visual><origin xyz="1 2 3" rpy="0.1 -0.7 2.5"/><geometry>
      <mesh filename="package://my_robot/meshes/cube.stl" scale="0.5 0.5 0.5"/></geometry>
      <material name="own"><color rgba="0 1 0 1"/></material></visual>
    <visual><geometry><mesh filename="package://my_robot/meshes/cube.stl" scale="0.5 0.5 0.5"/>
      </geometry></visual>
    <visual><geometry><cylinder radius="0.1" length="0.4"/></geometry></visual>
    <visual><geometry><mesh filename="package://my_robot/meshes/lost.stl"/></geometry></visual>
    <visual><geometry><sphere radius="oops"/></geometry></visual>
  </link>
  <joint name="turn" type="revolute"><parent link="base"/><child link="arm"/>
    <axis xyz="0 0 1"/><limit lower="-1" upper="1" velocity="1" effort="9"/></joint>
</robot>"""


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A package with a PACKAGED in a folder of its own, beside one with a mesh."""
    monkeypatch.delenv("ROS_PACKAGE_PATH", raising=False)
    folder = tmp_path / "my_robot"
    (folder / "urdf").mkdir(parents=True)
    (folder / "meshes").mkdir()
    trimesh.creation.box((1, 1, 1)).export(folder / "meshes" / "cube.stl")
    (folder / "urdf" / "r.urdf").write_text(PACKAGED)
    return folder


def test_visuals_are_read_with_their_poses_and_colours(package):
    box, mesh, plain, cylinder, lost, oops = read_shapes(parse_urdf(package / "urdf" / "r.urdf"))
    assert (box.link, box.kind, box.size) == ("base", "box", (1, 2, 3))
    assert box.rgba == (0.5, 0.2, 0.1, 1)
    assert (mesh.kind, mesh.size, mesh.rgba) == ("mesh", (0.5, 0.5, 0.5), (0, 1, 0, 1))
    np.testing.assert_allclose(mesh.placement[:3, :3], pin.rpy.rpyToMatrix(0.1, -0.7, 2.5))
    np.testing.assert_allclose(mesh.placement[:3, 3], [1, 2, 3])
    assert plain.rgba is None
    assert cylinder.size == (0.1, 0.4)
    assert lost.file.endswith("lost.stl")
    assert oops.kind == ""


def test_a_mesh_is_found_above_the_urdf_in_the_package_path_and_by_its_path(
    package, tmp_path, monkeypatch
):
    urdf, mesh = package / "urdf" / "r.urdf", package / "meshes" / "cube.stl"
    name = "package://my_robot/meshes/cube.stl"
    assert find_mesh(name, urdf) == mesh
    assert find_mesh("../meshes/cube.stl", urdf).samefile(mesh)
    assert find_mesh(str(mesh), urdf) == mesh
    assert find_mesh(f"file://{mesh}", urdf) == mesh
    assert find_mesh("package://my_robot/meshes/lost.stl", urdf) is None
    elsewhere = tmp_path / "elsewhere" / "x.urdf"
    elsewhere.parent.mkdir()
    assert find_mesh(name, elsewhere) == mesh  # the package is beside the folder
    renamed = package.rename(tmp_path / "my_robot-1.2")
    assert find_mesh(name, elsewhere) is None
    assert find_mesh(name, renamed / "urdf" / "r.urdf") == renamed / "meshes" / "cube.stl"
    monkeypatch.setenv("ROS_PACKAGE_PATH", f"/nowhere:{renamed}")
    assert find_mesh(name, elsewhere) == renamed / "meshes" / "cube.stl"


def test_every_mesh_of_the_example_robots_is_found_but_those_of_another_computer():
    lost = [
        visual.file
        for urdf in example_urdfs()
        for visual in read_shapes(parse_urdf(urdf))
        if visual.kind == "mesh" and find_mesh(visual.file, urdf) is None
    ]
    assert [file for file in lost if not file.startswith("file:///usr/Romeo")] == []


@pytest.mark.parametrize("suffix", ["stl", "dae", "obj", "ply"])
def test_formats_are_read(tmp_path, suffix):
    path = tmp_path / f"box.{suffix}"
    trimesh.creation.box((1, 2, 3)).export(path)
    (surface,) = read_surfaces(path)
    assert len(surface.faces) == 12
    np.testing.assert_allclose(np.ptp(surface.vertices, axis=0), [1, 2, 3])


def test_a_collada_file_in_centimetres_becomes_metres(tmp_path):
    path = tmp_path / "box.dae"
    trimesh.creation.box((100, 200, 300)).export(path)
    text = path.read_text()
    assert "<asset>" in text
    unit = '<unit name="centimeter" meter="0.01"/>'
    head, _, tail = text.partition("<asset>")
    path.write_text(f"{head}<asset>{unit}{tail}")
    (surface,) = read_surfaces(path)
    np.testing.assert_allclose(np.ptp(surface.vertices, axis=0), [1, 2, 3])


def test_a_file_that_is_no_mesh_is_refused_by_name(tmp_path):
    (tmp_path / "bad.dae").write_text("nothing")
    with pytest.raises(ValueError, match=r"bad\.dae cannot be read"):
        read_surfaces(tmp_path / "bad.dae")


def test_a_scene_holds_each_mesh_once_and_names_what_is_missing(package):
    model = RobotModel.from_urdf(package / "urdf" / "r.urdf")
    shown = robot_scene(model)
    assert len(shown.content["meshes"]) == 1
    parts = shown.content["parts"]
    assert [(p["node"], p["shape"]) for p in parts] == [
        (0, "box"), (1, "mesh"), (1, "mesh"), (1, "cylinder"),
    ]  # fmt: skip
    assert parts[0]["colour"] == "#80331a"
    assert parts[1]["colour"] == "#00ff00"
    assert len({p["size"][0] for p in parts[1:3]}) == 1
    (note,) = shown.notes
    assert note.startswith("1 meshes were not found or are not readable")
    assert "lost.stl" in note
    second = '<visual><geometry><mesh filename="other.stl"/></geometry></visual><visual>'
    text = PACKAGED.replace("<visual><geometry><sphere", f"{second}<geometry><sphere")
    (package / "urdf" / "r.urdf").write_text(text)
    (note,) = robot_scene(RobotModel.from_urdf(package / "urdf" / "r.urdf")).notes
    lost = "package://my_robot/meshes/lost.stl"
    assert note == f"2 meshes were not found or are not readable, for example {lost}"


def test_meshes_of_the_example_robots_are_found_from_anywhere(tmp_path):
    whole = "package://example-robot-data/robots/ur_description/meshes/ur5/visual/base.dae"
    for name in (whole, whole.replace("example-robot-data/robots/", "")):
        assert find_mesh(name, tmp_path / "x.urdf").name == "base.dae"
