"""Closed chains: positions from the closure, base parameters, rows without forces of loops."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from robotid.base.exceptions import DataError, ModelError
from robotid.base.text import seconds
from robotid.cli.identify import identify
from robotid.data.log import Log
from robotid.data.signal_settings import SignalSettings
from robotid.dynamics.base_parameters import structural_mapping
from robotid.dynamics.constraint_rows import (
    constraint_jacobian,
    force_basis,
    loop_basis,
    without_forces,
)
from robotid.dynamics.prepared_logs import closed_log
from robotid.dynamics.torque import joint_torque_regressor, random_regressor
from robotid.robot.closure import Chains
from robotid.robot.constraints import Contact, Loop
from robotid.robot.drives import TERMS, Spring
from robotid.robot.model import RobotModel
from tests.helpers.closed_chains import (
    ANKLE_LOOPS,
    FOUR_BAR,
    FOUR_BAR_LOOP,
    PARALLELOGRAM,
    Oracle,
    ankle,
    four_bar,
)


@pytest.fixture(params=[four_bar, ankle])
def robot(request, tmp_path):
    return request.param(tmp_path)


@pytest.fixture
def bars(tmp_path):
    return four_bar(tmp_path)


def some_parameters(model, rng):
    """Return the URDF's parameters with drives."""
    pi = model.standard_parameters()
    pi[model.layout.n_inertial :] = rng.uniform(0.02, 0.1, len(model.layout.drive_names))
    pi[[name.endswith("coulomb") for name in model.layout.names]] = 0.0  # smooth in the oracle
    return pi


def states(model, rng, samples):
    """Return q and v that the loops permit."""
    q, Z = Chains(model).random_states(samples, rng)
    return q, np.einsum("kij,kj->ki", Z, rng.standard_normal(q.shape))


def test_rows_are_those_of_pinocchios_constraint_dynamics(robot, rng):
    pi = some_parameters(robot, rng)
    oracle, (q, v) = Oracle(robot, pi), states(robot, rng, 10)
    tau = rng.standard_normal(q.shape) * ~np.isin(robot.joints, robot.passive)
    a = np.array([oracle.acceleration(*x) for x in zip(q, v, tau, strict=True)])
    P = (loop_basis(robot, q), joint_torque_regressor(robot, q, v, a))
    predicted = without_forces(P[0], (P[1] @ pi).reshape(q.shape))
    np.testing.assert_allclose(predicted, without_forces(P[0], tau), atol=1e-8)
    assert np.abs(predicted).max() > 0.1
    J = constraint_jacobian(robot, q, np.ones((10, 0)))
    kept = Chains(robot).accelerations(q, v)
    np.testing.assert_allclose(J @ (a - kept)[..., None], 0.0, atol=1e-9)


def test_rows_of_a_floating_leg_with_rods_are_those_of_pinocchio(tmp_path, rng):
    """Loops, springs and a foot together, on a floating base: no force of them is in the rows."""
    feet = ("foot", "shank")
    biped = ankle(
        tmp_path, free_flyer=True, own_terms={"pitch": [TERMS["viscous"], Spring()]},
        constraints=(*ANKLE_LOOPS, Contact("foot"), Contact("shank", "surface")),
    )  # fmt: skip
    n, on_ground = len(biped.joints), feet[:1]
    pi = some_parameters(biped, rng)
    joints, Z = Chains(biped).random_states(4, rng)
    pose = np.array([pin.SE3ToXYZQUAT(pin.SE3.Random()) for _ in joints])
    q = np.hstack([pose, joints])
    contacts = np.array([[foot in on_ground for foot in feet]] * len(q))
    J = constraint_jacobian(biped, q, contacts)
    twist, speeds = rng.standard_normal((len(q), 6)), rng.standard_normal((len(q), n))
    v = np.hstack([twist, np.einsum("kij,kj->ki", Z, speeds)])
    for k, own in enumerate(J):  # the feet stand, the loops remain closed
        v[k] -= np.linalg.pinv(own, rcond=1e-6) @ own @ v[k]
    tau = np.zeros((len(q), 6 + n))
    tau[:, 6:] = rng.standard_normal((len(q), n)) * ~np.isin(biped.joints, biped.passive)
    oracle = Oracle(biped, pi, on_ground)
    a = np.array([oracle.acceleration(*x) for x in zip(q, v, tau, strict=True)])
    basis = force_basis(J, np.ones(v.shape, dtype=bool))
    torque = (joint_torque_regressor(biped, q, v, a) @ pi).reshape(v.shape)
    predicted = without_forces(basis, torque)
    np.testing.assert_allclose(predicted, without_forces(basis, tau), atol=1e-8)
    assert np.sum(basis**2) == pytest.approx(len(q) * (6 + 3))


def test_a_walk_does_not_cross_dead_centres(tmp_path, rng):
    """Crank and rocker are parallel; at their dead centres they can cross."""
    path = tmp_path / "parallelogram.urdf"
    path.write_text(PARALLELOGRAM)
    options = {"constraints": [FOUR_BAR_LOOP], "passive": ("elbow", "pivot")}
    bars = RobotModel.from_urdf(path, **options)
    q, _ = Chains(bars).random_states(120, rng)
    np.testing.assert_allclose(q, q[:, :1] * [1.0, -1.0, 1.0], atol=1e-7)
    assert np.sin(q[:, 0] + 0.5).min() > 0.0
    assert np.ptp(q[:, 0]) > 1.0
    flat = PARALLELOGRAM.replace("0 0 0.5", "0 0 0").replace("0 0 -0.5", "0 0 0")
    path.write_text(flat)
    bars = RobotModel.from_urdf(path, **options)
    with pytest.raises(ModelError, match="the positions of elbow, pivot near the zero position"):
        Chains(bars).closed(np.zeros((1, 3)), np.array([False, True, True]))


def test_base_parameters_are_those_of_the_closed_chain(robot, rng):
    mapping = structural_mapping(robot)
    W, pi = random_regressor(robot, 150, rng), rng.standard_normal(len(robot.layout.names))
    torque, again = W @ pi, W[:, mapping.independent] @ mapping.to_base(pi)
    np.testing.assert_allclose(torque, again, atol=1e-8 * np.abs(torque).max())
    s = np.linalg.svd(W * robot.layout.scales(robot.length), compute_uv=False)
    assert np.sum(s > 1e-9 * s[0]) == len(mapping.K)


def test_masses_of_a_coupler_are_masses_at_its_joints(bars):
    """Of 12 planar parameters, the pivots bear two masses, and two of the coupler are moved."""
    mapping = structural_mapping(bars, inertial_only=True)
    assert len(mapping.K) == 8
    assert len(structural_mapping(replace(bars, constraints=()), inertial_only=True).K) == 9
    moved = dict.fromkeys(mapping.names, 0.0)
    # a mass at the coupler's end is a mass at the rocker's end
    moved |= {"coupler.m": 1.0, "coupler.mcx": 0.38, "coupler.Izz": 0.38**2}
    moved |= {"rocker.m": -1.0, "rocker.mcx": -0.3, "rocker.Izz": -(0.3**2)}
    np.testing.assert_allclose(mapping.to_base(np.array([*moved.values()])), 0.0, atol=1e-9)


def test_positions_follow_from_the_closure(robot, rng):
    chains, unknown = Chains(robot), np.isin(robot.joints, robot.passive)
    t = np.linspace(0.0, 1.0, 40)[:, None]
    q = np.zeros((40, len(robot.joints)))
    q[:, ~unknown] = 0.3 * np.sin(4 * t + rng.uniform(0, 3, (~unknown).sum()))
    found = chains.closed(q, unknown)
    np.testing.assert_array_equal(found[:, ~unknown], q[:, ~unknown])
    assert chains.gaps(found).max() < 1e-12
    assert np.abs(np.diff(found, axis=0)).max() < 0.2
    later = chains.closed(q[20:], unknown)  # a piece of a log is assembled in the same way
    np.testing.assert_allclose(later, found[20:], atol=1e-9)


def test_a_turning_crank_keeps_its_assembly(bars):
    q = np.zeros((60, 3))
    q[:, 0] = np.linspace(0.0, 7.0, 60)
    chains, unknown = Chains(bars), np.array([False, True, True])
    found = chains.closed(q, unknown)
    assert np.abs(np.diff(found, axis=0)).max() < 0.4
    for start in (20, 35, 50):
        later = chains.closed(q[start : start + 1], unknown)[0]
        turned = (later - found[start]) / (2 * np.pi)
        np.testing.assert_allclose(turned, np.rint(turned), atol=1e-9)


def test_a_log_is_completed(bars):
    t = np.linspace(0.0, 1.0, 30)
    drive = np.sin(t)[:, None]
    log = Log(t, drive, drive + 1.0, ("drive",), v=np.cos(t)[:, None])
    whole = closed_log(bars, log)
    assert whole.joints == bars.joints
    np.testing.assert_array_equal(whole.q[:, 0], drive[:, 0])
    np.testing.assert_array_equal(whole.tau, [[x + 1.0, 0.0, 0.0] for x in drive[:, 0]])
    assert Chains(bars).gaps(whole.q).max() < 1e-12
    assert whole.v is None
    assert whole.notes == (
        "positions of elbow, pivot are computed from the loops; velocities are not used, since "
        "these joints have none",
    )
    logged = replace(whole, tau=whole.tau + 1.0)
    np.testing.assert_array_equal(closed_log(bars, logged).tau[:, 1:], 0.0)
    moved = replace(whole, q=whole.q + np.array([0.0, 0.1, 0.0]))
    with pytest.raises(DataError, match=r"the positions do not close the loop coupler_end - rock"):
        closed_log(bars, moved)


def test_positions_out_of_reach_are_refused(tmp_path):
    text = FOUR_BAR.replace('xyz="0.35 0 0"', 'xyz="0.6 0 0"')
    path = tmp_path / "long.urdf"
    path.write_text(text)
    robot = RobotModel.from_urdf(path, constraints=[FOUR_BAR_LOOP], passive=("elbow", "pivot"))
    t = np.linspace(0.0, 3.0, 60)
    # the crank's end is 0.68 m from the pivot at 2.031 rad
    x = t[np.argmax(t > np.arccos((0.15**2 + 0.6**2 - 0.68**2) / (2 * 0.15 * 0.6)))]
    with pytest.raises(DataError, match="no position of elbow, pivot closes") as error:
        closed_log(robot, Log(t, t[:, None], t[:, None], ("drive",)))
    _, figures = str(error.value).split(f" at t = {seconds(x)} s: ")
    left, wanted = figures.split(" m remain, expected at most ")
    assert float(left) >= np.sqrt(0.15**2 + 0.6**2 - 2 * 0.15 * 0.6 * np.cos(x)) - 0.68
    assert wanted.startswith("6e-06 m")
    q = np.column_stack([t, 5.0 * t, -t])
    chains = Chains(robot)
    found, first = chains.closed(q, np.array([False, True, True])), int(np.argmax(t == x))
    assert chains.gaps(found[:first]).max() < 1e-9
    np.testing.assert_array_equal(found[first:], np.tile(found[first], (60 - first, 1)))
    np.testing.assert_array_equal(found[: first + 1, 0], t[: first + 1])


def test_a_log_in_another_order_keeps_each_joint_and_names_the_loop_that_is_open(tmp_path, rng):
    robot = ankle(tmp_path)
    t = np.linspace(0.0, 1.0, 20)
    motors = ("right_motor", "left_motor")
    q, tau = 0.2 * np.sin(np.outer(t, [3.0, 2.0])), rng.standard_normal((20, 2))
    whole = closed_log(robot, Log(t, q, tau, motors, a=q, q_ref=q))
    assert "; accelerations, commands are not used" in whole.notes[0]
    for j, joint in enumerate(robot.joints):
        wanted = tau[:, motors.index(joint)] if joint in motors else np.zeros(20)
        np.testing.assert_array_equal(whole.tau[:, j], wanted)
    own = [robot.joints.index(joint) for joint in motors]
    np.testing.assert_array_equal(whole.q[:, own], q)
    # complete logs: joints in the order of the log, torques of passive joints are not used
    order = rng.permutation(8)
    names = tuple(robot.joints[k] for k in order)
    moved = whole.q.copy()
    moved[13:, robot.joints.index("right_w")] += 0.5
    log = Log(t, moved[:, order], rng.standard_normal((20, 8)), names)
    with pytest.raises(DataError, match="not close the loop right_rod_end - right_heel") as error:
        closed_log(robot, log)
    gaps, allowed = Chains(robot).gaps(moved), 0.02 * robot.length
    stated = f"{gaps[13, 1]:.3g} m remain, expected at most {allowed:.2g} m"
    assert f"at t = {seconds(t[13])} s: {stated}" in str(error.value)
    assert gaps[13:, 0].max() < 1e-9
    data, ids = robot.pin_model.createData(), map(robot.pin_model.getFrameId, robot.loops[1].frames)
    pin.framesForwardKinematics(robot.pin_model, data, robot.configurations(moved[13:14])[0])
    rod, heel = (data.oMf[k].translation for k in ids)
    assert gaps[13, 1] == pytest.approx(np.linalg.norm(rod - heel), rel=1e-9)
    assert [Chains(robot).is_closed(x) for x in moved[[12, 13]]] == [True, False]


def test_accelerations_that_keep_a_hinge_are_the_smallest_that_pinocchios_rows_permit(
    tmp_path, rng
):
    robot = ankle(tmp_path, constraints=[Loop(("left_rod_end", "left_heel"), "hinge", (1, 2, -1))])
    (q, v), flags = rng.uniform(-0.5, 0.5, (2, 4, 8)), np.ones((4, 0))
    places = (q, q + 1e-6 * v, q - 1e-6 * v)
    J, after, before = (constraint_jacobian(robot, x, flags) for x in places)
    drift = ((after - before) / 2e-6 @ v[..., None])[..., 0]
    wanted = [-np.linalg.pinv(A) @ x for A, x in zip(J, drift, strict=True)]
    assert np.linalg.matrix_rank(J[0]) == 5
    np.testing.assert_allclose(Chains(robot).accelerations(q, v), wanted, rtol=1e-5, atol=1e-7)


def test_undetermined_positions_are_refused(bars):
    with pytest.raises(ModelError, match="the loops do not determine the positions of drive, elbo"):
        Chains(bars).closed(np.zeros((1, 3)), np.ones(3, dtype=bool))
    t = np.linspace(0.0, 1.0, 30)
    log = Log(t, t[:, None], t[:, None], ("drive",))
    with pytest.raises(DataError, match="no position of elbow, pivot, and no loop determines it"):
        closed_log(replace(bars, constraints=()), log)


def test_a_loop_that_never_closes_is_refused(tmp_path):
    robot = four_bar(tmp_path, constraints=[replace(FOUR_BAR_LOOP, kind="rigid")])
    with pytest.raises(ModelError, match=r"\(rigid\) does not close near the zero position: "):
        structural_mapping(robot)


@pytest.mark.parametrize("kind", ["point", "hinge", "rigid"])
def test_errors_change_as_rows_and_drift_state(kind, rng):
    loop = Loop(("a", "b"), kind, (0.3, -0.2, 0.9))
    M, w, velocity = pin.SE3.Random(), rng.standard_normal(3), rng.standard_normal(3)
    axis = np.array(loop.axis) / np.linalg.norm(loop.axis)
    turn = pin.exp3(0.7 * axis * (kind == "hinge"))
    permitted = {"point": rng.standard_normal(3), "hinge": 1.3 * axis, "rigid": np.zeros(3)}[kind]
    places = [M, M * pin.SE3(turn, np.zeros(3))]
    twists = [np.append(velocity, w), np.append(turn.T @ velocity, turn.T @ (w + permitted))]

    def error(t, speeds):
        moved = zip(places, speeds, strict=True)
        return loop.error([x * pin.exp6(pin.Motion(t * v)) for x, v in moved])

    other = [twists[0], rng.standard_normal(6)]  # not permitted
    columns = [
        np.append(x.rotation @ v[:3], x.rotation @ v[3:])
        for x, v in zip(places, other, strict=True)
    ]
    rows = loop.rows([x[:, None] for x in columns], M)[:, 0]
    np.testing.assert_allclose(rows, (error(1e-6, other) - error(-1e-6, other)) / 2e-6, atol=1e-8)
    turning = [x.rotation @ v[3:] for x, v in zip(places, twists, strict=True)]
    centripetal = [
        np.append(x.rotation @ np.cross(v[3:], v[:3]), np.zeros(3))
        for x, v in zip(places, twists, strict=True)
    ]
    h = 1e-4
    second = (error(h, twists) - 2 * error(0.0, twists) + error(-h, twists)) / h**2
    np.testing.assert_allclose(loop.drift(centripetal, turning, M.rotation), second, atol=1e-5)


def test_a_four_bar_is_identified_from_the_log_of_its_crank(bars, rng):
    pi, size = some_parameters(bars, rng), np.array([0.7, 0.4, 0.15])
    phase, rates = np.array([0.3, 2.0, 4.0]), 2 * np.pi * np.array([0.5, 1.1, 2.3])

    def command(t, q, v):
        wanted = size @ (np.sin(rates * t + phase) - np.sin(phase))
        speed = size @ (rates * np.cos(rates * t + phase))
        return np.array([60.0 * (wanted - q[0]) + 4.0 * (speed - v[0]), 0.0, 0.0])

    start = Chains(bars).closed(np.zeros((1, 3)), np.array([False, True, True]))[0]
    t, q, _, tau = Oracle(bars, pi).simulate(start, command, 2.4, 4e-3)
    log = Log(t, q[:, :1], tau[:, :1], ("drive",))
    settings = SignalSettings(cutoff=40.0, trim=0.1, min_velocity=0.05)
    found = identify(bars, log, signals=settings, estimator="wls", friction="none", doctor=False)
    truth = found.mapping.to_base(pi)
    error = np.abs(found.estimate.theta - truth)
    assert (error < 0.02 * np.abs(truth).max()).all()
    (evaluated,) = found.fitted
    assert np.abs(evaluated.recording.trajectory.q[:, 1] - 0.5).max() > 0.5
    urdf = found.mapping.to_base(bars.standard_parameters())
    assert np.abs(urdf - truth).max() > 0.05 * np.abs(truth).max()
