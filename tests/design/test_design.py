"""Designs within limits, their multipliers, and motions from posture to posture."""

import re
from dataclasses import replace
from itertools import count

import numpy as np
import pytest
import yaml

from robotid.base.exceptions import SettingsError
from robotid.data.files.read import open_table
from robotid.data.signal_settings import LogSource
from robotid.design import design as designs
from robotid.design.clearance import Box, Clearance
from robotid.design.design import (
    _PLACES,
    SOFT,
    SPARE,
    DesignedMotion,
    Designer,
    FourierBasis,
    Multipliers,
    Route,
    State,
    _free_range,
    design_stands,
    design_sweeps,
)
from robotid.design.excitation import write_motion
from robotid.design.limits import LIMITS, Course, MotionLimits
from robotid.design.previews import Run
from robotid.dynamics.factors import Factors
from robotid.dynamics.torque import joint_torque_regressor
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

WRIST = ["wrist_1_joint", "wrist_2_joint", "wrist_3_joint"]


@pytest.fixture(scope="module")
def wrist():
    """The last three joints of a UR10: small, and its links may meet."""
    return RobotModel.from_urdf(example_urdf("ur10_robot.urdf"), joints=WRIST)


@pytest.fixture(scope="module")
def designer(wrist):
    limits = MotionLimits.of_model(wrist, acceleration=8.0, jerk={"wrist_1_joint": 60.0}, power=40)
    return Designer.of_model(wrist, FourierBasis(4.0, 3), limits, noise={"wrist_2_joint": 0.7})


@pytest.fixture(scope="module")
def design(designer):
    return designer.design(np.random.default_rng(1), starts=1)  # some starts end 0.15 higher


def test_the_information_is_that_of_the_regressor(wrist, designer, rng):
    C = designer.random(rng)
    step = 4.0 / 42  # 14 instants within a third of 4 s
    t = step * np.arange(43)
    q, v, a, _ = designer.basis.derivatives(t, 3) @ C
    signs = np.tanh(v / 0.01)
    W = joint_torque_regressor(wrist, q, v, a, signs)[:, designer.information.mapping.independent]
    density = 0.1 * (np.array([0.01 * 54.0, 0.7, 0.01 * 54.0])) ** 2  # 1 % of 54 N m, for 0.1 s
    weights = np.tile(step / density, 43)[:, None]
    S = designer.spread
    expected = S[:, None] * (W.T @ (weights * W)) * S + np.eye(len(S))
    rows = designer.information.rows(q, v, a)
    np.testing.assert_allclose(designer.matrix(rows), expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", ["D", "A", "E"])
def test_the_gradient_of_the_lagrangian_is_that_of_differences(designer, wrist, rng, name):
    around = Clearance(wrist, least=0.05, boxes=[Box("post", (0.9, 0.2, -0.5), (1.0, 0.4, 0.5))])
    designer = replace(designer, name=name, clearance=around)
    C, D = 1.5 * designer.random(rng), rng.standard_normal((5, 3))
    shape = (len(LIMITS), 43, 3)
    pairs = (len(around.pairs), 43)
    held = rng.uniform(0.0, 0.05, shape), rng.uniform(0.0, 0.1, pairs) * (rng.random(pairs) < 0.3)
    multipliers, h = Multipliers(0.2, *held), 1e-6
    up, down = (designer._lagrangian(C + s * h * D, multipliers)[0] for s in (1, -1))
    slope = np.sum(designer._lagrangian(C, multipliers)[1] * D)
    assert slope == pytest.approx((up - down) / (2 * h), rel=1e-4)


def test_a_design_keeps_its_limits_between_its_instants(wrist, designer, design):
    t = np.linspace(0.0, 4.0, 20_001)
    q, v, a, jerk = design.motion.basis.derivatives(t, 3) @ design.motion.coefficients
    information = designer.information
    torque = information.torque(information.rows(q, v, a))
    used = np.abs(designer.limits.used(q, v, a, jerk, torque))
    assert used.max() < 1.001
    np.testing.assert_allclose(used.max(axis=1), design.used, atol=2e-3)
    assert np.abs(v[[0, -1]]).max() < 1e-9
    assert np.abs(a[[0, -1]]).max() < 1e-9


def test_designs_are_the_same_under_a_seed_and_no_worse_with_more_time(designer, monkeypatch):
    short = replace(designer, basis=FourierBasis(4.0, 2))
    told = []
    one, other = (
        short.design(np.random.default_rng(3), starts=1, seconds=0.0, progress=progress)
        for progress in (None, lambda *call: told.append(call))
    )
    assert [start for start, _ in told] == [0, 1]  # as it starts, and before the finer grid
    assert told[-1][1] == pytest.approx(other.objective, abs=0.05)
    np.testing.assert_array_equal(one.motion.coefficients, other.motion.coefficients)
    assert not one.is_converged
    assert one.used.max() <= 1.0
    calls = count(step=1.0)  # a clock of calls, the same on every machine
    monkeypatch.setattr("time.monotonic", lambda: next(calls))
    few, many = (short.design(np.random.default_rng(3), starts=99, seconds=s) for s in (150, 600))
    assert many.starts > few.starts
    assert many.is_converged  # on the finer grid
    assert many.objective <= few.objective


def test_a_search_near_the_limits_continues_beyond_them_and_a_stalled_one_restarts(designer, rng):
    within = designer.random(rng)
    for excess, continues in ((1.005, True), (1.05, False)):
        share = excess / np.abs(designer._constraints(within)[0]).max()
        C = np.vstack([within[:1], share * within[1:]])
        feasible = designer._feasible(C, 0.997)
        state = State(feasible, designer._objective(feasible), C, Multipliers(0.1))
        after, _ = designer._updated(state, C, 2e-3)
        assert np.array_equal(after.iterate, C) == continues


def test_the_search_is_given_the_slope_of_what_it_minimises(designer, rng, monkeypatch):
    C, slopes = designer.random(rng), []

    def minimize(cost, x, **_options):
        D, h = rng.standard_normal(x.size), 1e-6
        slopes.append((cost(x)[1] @ D, (cost(x + h * D)[0] - cost(x - h * D)[0]) / (2 * h)))
        raise designs._OutOfTime

    monkeypatch.setattr("scipy.optimize.minimize", minimize)
    state = State(C, designer._objective(C), C, Multipliers(0.1))
    assert list(designer._search(state, 2e-3, lambda: False)) == [state]
    ((slope, expected),) = slopes
    assert slope == pytest.approx(expected, rel=1e-4)


@pytest.fixture(scope="module")
def told(designer, design):
    """The information of a design and the prior's."""
    return information_of(designer, design) + np.eye(len(designer.spread))


def information_of(designer, design):
    """Return the information of a motion itself, without the prior's."""
    rows = designer.information.rows(*design.motion.evaluate(np.linspace(0, 4.0, 421)))
    return designer.matrix(rows, 4.0 / 420) - designer.known


def test_what_is_known_already_is_not_asked_for_again(designer, design, told):
    next_one = replace(designer, known=told)
    again = next_one._objective(design.motion.coefficients)
    fresh = next_one.design(np.random.default_rng(4), starts=1)
    assert fresh.objective < again - 0.02
    # its condition is that of the motion itself, without what was known before
    t = np.linspace(0, 4.0, fresh.intervals + 1)
    rows = designer.information.rows(*fresh.motion.evaluate(t))
    own = designer.matrix(rows, 4.0 / fresh.intervals) - designer.known
    assert fresh.condition == pytest.approx(np.sqrt(np.linalg.cond(own)), rel=1e-6)


def test_an_earlier_run_is_known_with_its_own_noise_in_units_of_the_spread(wrist, designer, rng):
    b, pi = len(designer.spread), wrist.standard_parameters()
    W, tau = rng.standard_normal((3, 60, b)), rng.standard_normal((3, 60))
    R = tuple(np.linalg.qr(np.dstack([W, tau]), mode="r"))
    factors = Factors(R, (np.arange(b),) * 3, np.full(3, 60), ("",) * b)
    run = Run((factors,), pi, np.ones((3, 3)), 60, 0.5, 0.02)
    after = Designer.of_model(wrist, designer.basis, designer.limits, run=run)
    error = tau - W @ designer.information.mapping.to_base(pi)
    np.testing.assert_allclose(after.noise, np.mean(error**2, axis=1) / 0.5 * 0.02)
    told, S = np.einsum("j,jna,jnb->ab", 0.02 / after.noise, W, W), after.spread
    np.testing.assert_allclose(after.known, np.eye(b) + S[:, None] * told * S, rtol=1e-9)


def test_a_motion_after_another_narrows_what_that_one_left_wide(designer, design, told):
    after, before = replace(designer, known=told, name="widest"), np.diag(np.linalg.inv(told))
    widest = after.widest
    assert len(widest) == round(len(told) / 4)
    assert before[widest].min() >= np.delete(before, widest).max()
    found, usual = (some.design(np.random.default_rng(7), starts=1) for some in (after, designer))
    again, fresh, own = (
        np.mean(np.log(np.diag(np.linalg.inv(told + information_of(designer, x)))[widest]))
        for x in (design, usual, found)
    )
    assert own < fresh - 0.02
    assert own < again - 0.1


def test_a_design_keeps_clear_of_what_stands_around(wrist, designer):
    # a wall 3 cm beside the tool at rest
    wall = Box("wall", (-2.0, 0.35, -2.0), (2.0, 0.40, 2.0))
    around = Clearance(wrist, least=0.01, boxes=[wall])
    found = replace(designer, clearance=around).design(np.random.default_rng(5), starts=1)
    assert found.contact is None or found.contact.margin >= 0.0
    t = np.linspace(0.0, 4.0, 4001)
    near = around.near(around.placed(found.motion.evaluate(t)[0]), 0.05, around.everything)
    assert (near.distance.min(axis=1) >= around.required).all()


def test_motions_begin_and_end_at_rest_and_their_derivatives_are_true(rng):
    basis = FourierBasis(7.0, 4)
    assert basis.shortest == pytest.approx(1.75)
    t = np.linspace(0.0, 7.0, 4001)
    D = basis.derivatives(t, 3)
    assert D.shape == (4, 4001, basis.size)
    np.testing.assert_array_equal(D[:, :, 0], np.eye(4)[0][:, None] * np.ones(4001))
    assert np.abs(D[1:3, [0, -1]]).max() < 1e-12
    for k in range(3):
        slope = np.gradient(D[k], t, axis=0)[2:-2]
        np.testing.assert_allclose(slope, D[k + 1][2:-2], atol=3e-3 * np.abs(D[k + 1]).max())
    assert np.linalg.matrix_rank(D[0]) == basis.size
    C = rng.standard_normal((basis.size, 3))
    q, v, a = DesignedMotion(basis, C).evaluate(t)
    np.testing.assert_allclose((q, v, a), D[:3] @ C)
    with pytest.raises(SettingsError, match="harmonics is 1, expected 2 or more"):
        FourierBasis(5.0, 1)


def test_costs_are_those_of_the_augmented_lagrangian_and_slopes_their_derivatives(rng):
    used, aim = rng.normal(size=(6, 5, 2)), np.array([[0.02], [0.1], [0.05]])
    distance = aim + 0.03 * rng.normal(size=(3, 5))
    limits, distances = rng.uniform(0, 2, used.shape), rng.uniform(0, 2, distance.shape)
    own = Multipliers(2.5, limits, distances)
    cases = (
        (own.of_limits(used), used**2 / (1 - SPARE) ** 2 - 1.0, limits),
        (own.of_distances(distance, aim), (aim - distance) / SOFT, distances),
    )
    for (cost, slopes), over, known in cases:
        pushed = np.maximum(known + 2.5 * over, 0.0)
        assert cost == pytest.approx(((pushed**2 - known**2) / 5.0).sum())
        np.testing.assert_allclose(slopes, pushed)
        assert 0 < (pushed == 0.0).sum() < pushed.size
    raised = own.raised(used, distance, aim)
    assert raised.weight == 2.5
    np.testing.assert_allclose(raised.limits, own.of_limits(used)[1])
    np.testing.assert_allclose(raised.distances, own.of_distances(distance, aim)[1])
    assert own.raised(used, None, aim).distances == 0.0
    edge = own.distance_without_cost(aim)
    assert own.of_distances(edge, aim)[1] == pytest.approx(np.zeros((3, 5)), abs=1e-12)
    assert (own.of_distances(edge - 1e-6, aim)[1] > 0).all()


def test_multipliers_on_a_finer_grid_have_the_same_sum_and_lie_between_their_neighbours(rng):
    limits, distances = rng.random((6, 5, 2)), rng.random((3, 5))
    fine = Multipliers(8.0, limits, distances).finer(4)
    assert fine.weight == 2.0
    for coarse, dense in ((limits, fine.limits), (distances, fine.distances)):
        np.testing.assert_allclose(4 * dense[:, ::4], coarse)
        np.testing.assert_allclose(8 * dense[:, 2::4], coarse[:, 1:] + coarse[:, :-1])


@pytest.fixture(scope="module")
def between():
    joints = ["shoulder_lift_joint", "elbow_joint", "wrist_1_joint"]
    model = RobotModel.from_urdf(example_urdf("ur10_robot.urdf"), joints=joints)
    limits = MotionLimits.of_model(model, share=0.8)
    return Designer.of_model(
        model, FourierBasis(10.0, 5), limits, clearance=Clearance(model, least=0.01, floor=-0.1)
    )


def test_a_route_rests_cruises_and_its_derivatives_are_true():
    places = np.array([[0.0, 1.0], [1.0, 1.0], [0.5, -1.0]])
    route = Route(places, np.array([2.0, 1.0]), np.array([0.1, 0.5]), np.array([0.5, 0.3, 0.2]))
    assert route.duration == pytest.approx(4.0)
    t = np.linspace(0.0, 4.0, 40_001)
    q, v, a = route.evaluate(t)
    np.testing.assert_allclose(np.gradient(q, t, axis=0)[1:-1], v[1:-1], atol=2e-4)
    np.testing.assert_allclose(np.gradient(v, t, axis=0)[1:-1], a[1:-1], atol=4e-2)
    for time, place in ((0.4, 0), (2.6, 1), (3.9, 2)):
        k = np.searchsorted(t, time)
        np.testing.assert_allclose(q[k], places[place], atol=1e-12)
        assert np.abs(v[k]).max() == 0.0
    cruise = (t > 0.71) & (t < 2.29)  # 0.5 + 0.2 to 2.5 - 0.2
    np.testing.assert_allclose(v[cruise, 0], 1.0 / (2.0 * 0.9), rtol=1e-12)


def test_room_ends_at_the_nearest_place_where_the_robot_cannot_rest(between):
    low, high = (between.limits.middle + s * between.limits.sizes[0] for s in (-1, 1))
    step, blocked = (high - low) / (_PLACES - 1), 0
    for posture in between.postures.resting(np.random.default_rng(0), 200)[:5]:
        for j, room in enumerate(_free_range(between, posture)):
            for way, left in zip((-1.0, 1.0), room, strict=True):
                q = np.tile(posture, (50, 1))
                q[:, j] += way * np.linspace(0.0, max(left - step[j], 0.0), 50)
                assert between.postures.can_rest(q).mean() > 0.95  # but between the places
                q[0, j] = posture[j] + way * left
                if min(q[0, j] - low[j], high[j] - q[0, j]) > 1e-9:
                    assert not between.postures.can_rest(q[:1])[0]
                    blocked += 1
    assert blocked > 10


def test_sweeps_go_both_ways_at_each_speed_while_the_others_rest(between, rng):
    design = design_sweeps(between, rng, speeds=(0.1, 0.4))
    # the page shows what was checked, at the same instants
    kinds = [k for k, kind in enumerate(LIMITS) if kind != "jerk"]
    shown = between.course(design)
    np.testing.assert_allclose(shown.largest[kinds], design.used[kinds], rtol=1e-9)
    assert len(shown.t) - 1 == round(100 * design.duration)
    assert design.used.max() <= 1.0
    assert design.contact is None or design.contact.distance >= 0.01
    t = np.arange(0.0, design.motion.duration, 0.01)
    _, v, a = design.motion.evaluate(t)
    for j, fastest in enumerate(between.limits.sizes[1]):
        steady = v[(np.abs(a).max(axis=1) < 1e-9) & (np.abs(v[:, j]) > 1e-6)]
        assert set(np.round(steady[:, j] / fastest, 6)) == {-0.4, -0.1, 0.1, 0.4}
        assert np.abs(np.delete(steady, j, axis=1)).max() == 0.0


def test_sweeps_beyond_a_limit_are_each_a_fifth_shorter(between, monkeypatch):
    spans = []
    for attempts in (1, 3):
        results = iter([False] * (attempts - 1) + [True])
        monkeypatch.setattr(designs, "_is_feasible", lambda _, verdicts=results: next(verdicts))
        design = design_sweeps(between, np.random.default_rng(0), speeds=(0.8,))
        spans.append(np.ptp(design.motion.places, axis=0))
    assert (spans[1] / spans[0]).min() == pytest.approx(0.64)


def test_stands_tell_more_of_gravity_than_random_ones(between):
    design = design_stands(between, np.random.default_rng(0), count=6)
    assert design.used.max() <= 1.0
    assert design.contact is None or design.contact.distance >= 0.01
    places = design.motion.places
    assert len(places) >= 4

    def told(q):
        rows = between.information.rows(q, 0.0 * q, 0.0 * q)
        scale = between.spread * np.sqrt(2.0 / between.noise)[:, None]
        A = (scale[..., None] * rows.W).swapaxes(0, 1).reshape(len(between.spread), -1)
        return np.linalg.slogdet(A @ A.T + np.eye(len(A)))[1]

    rng = np.random.default_rng(1)
    some = between.postures.resting(rng)
    random = [told(rng.choice(some, len(places), replace=False)) for _ in range(50)]
    assert told(places) > max(random)


def test_limits_are_those_of_the_urdf_and_those_stated(panda):
    stated = {"velocity": 0.7, "acceleration": 3.0, "torque": 20.0}  # less than half the URDF's
    of_joint = {key: {"panda_joint4": value} for key, value in stated.items()}
    limits = MotionLimits.of_model(panda, share=0.5, jerk=7.0, **of_joint)
    for j, joint in enumerate(panda.limits):
        assert limits.middle[j] == pytest.approx((joint.lower + joint.upper) / 2)
        half = (joint.upper - joint.lower) / 2
        most = joint.velocity / 2, np.inf, joint.effort / 2
        v, a, torque = stated.values() if j == 3 else most
        np.testing.assert_allclose(limits.sizes[:, j], [half / 2, v, a, 7.0, torque, np.inf])
    assert abs(limits.middle[3]) > 1.0  # its range is not even


def test_shares_are_signed_and_power_is_torque_times_speed(panda):
    limits = MotionLimits.of_model(panda, power=10.0)
    x = np.full((1, 7), 2.0)
    used = limits.used((limits.middle - limits.sizes[0])[None], x, x, x, -3.0 * x)
    np.testing.assert_allclose(used[0], -1.0)
    np.testing.assert_allclose(used[1], x / limits.sizes[1])
    np.testing.assert_array_equal(used[2:4], 0.0)
    np.testing.assert_allclose(used[4], -6.0 / limits.sizes[4][None])
    np.testing.assert_allclose(used[5], -1.2)


def test_a_course_peaks_where_most_of_a_limit_is_used_either_way():
    limits = MotionLimits(np.array([1.0, 0.0]), np.full((6, 2), 2.0))
    t = np.linspace(0.0, 3.0, 1501)
    q = np.column_stack([1.0 + np.where(t > 1.0, -1.5, 1.0) * np.sin(np.pi * t), 0.2 * t])
    v, a = (np.column_stack([x, -3.0 * x]) for x in (np.cos(t), np.exp(-t)))
    torque = np.column_stack([4.0 + t, -t])
    course = Course.of_motion(t, (q, v, a, torque), limits)
    used = [q - [1.0, 0.0], v, a, np.gradient(a, t, axis=0), torque, torque * v]
    np.testing.assert_allclose(course.used, np.array(used) / 2.0)
    np.testing.assert_allclose(course.largest, np.abs(used).max(axis=1) / 2.0)
    assert course.peak("position", 0) == pytest.approx(1.5)
    assert course.peak("torque", 1) == pytest.approx(3.0)
    few = course.thinned
    np.testing.assert_array_equal(few.t, t[::2])
    np.testing.assert_array_equal(few.values, course.values[:, ::2])
    whole = Course.of_motion(t[:1000], tuple(x[:1000] for x in (q, v, a, torque)), limits)
    assert len(whole.thinned.t) == 1000


@pytest.fixture(scope="module")
def course(wrist):
    """A motion of the last three joints of a UR10, between a post and a floor."""
    limits = MotionLimits.of_model(wrist, acceleration={"wrist_2_joint": 4.0})
    post = Box("post", (1.2, 0.1, -0.5), (1.3, 0.2, 0.5))
    around = Clearance(wrist, least=0.03, floor=-0.5, boxes=[post])
    designer = Designer.of_model(wrist, FourierBasis(4.0, 3), limits)
    fine = replace(designer, finer=10)
    design = fine.checked(designer.random(np.random.default_rng(0)))
    return wrist, designer, design, replace(designer, clearance=around).course(design)


def test_a_course_has_the_values_of_the_motion_and_shares_of_its_limits(course):
    model, _, design, found = course
    q, v, a, jerk = design.motion.basis.derivatives(found.t, 3) @ design.motion.coefficients
    np.testing.assert_allclose(found.values[:3], [q, v, a], atol=1e-12)
    np.testing.assert_allclose(found.values[3][1:-1], jerk[1:-1], atol=0.01)  # by differences
    np.testing.assert_allclose(found.values[5], found.values[4] * v, atol=1e-12)
    speeds = np.array([j.velocity for j in model.limits])
    np.testing.assert_allclose(found.used[1], v / (0.9 * speeds), atol=1e-12)
    kinds = [k for k, kind in enumerate(LIMITS) if kind != "jerk"]
    np.testing.assert_allclose(found.largest[kinds], design.used[kinds], rtol=1e-9)
    assert np.abs(found.largest - design.used).max() < 0.01  # jerk by differences
    k = LIMITS.index("acceleration")
    assert found.largest[k, 0] == 0.0  # it has no limit
    at = found.peak("acceleration", 1)
    peak = np.abs(design.motion.evaluate(np.array([at]))[2][0, 1])
    assert peak == pytest.approx(4.0 * found.largest[k, 1], rel=1e-9)
    signs = set()
    for kind, used in zip(LIMITS, found.used, strict=True):  # the largest, of either sign
        for j in range(3):
            at = used[found.t == found.peak(kind, j), j]
            assert np.abs(at) == np.abs(used[:, j]).max()
            signs |= set(np.sign(at))
    assert {-1.0, 1.0} <= signs


def test_the_distance_of_a_course_is_that_of_all_pairs(course):
    *_, found = course
    around = found.clearance
    poses = around.placed(found.values[0])
    exact = around.near(poses, np.inf, around.everything).distance
    distance, pairs = found.nearness(around.everything)
    np.testing.assert_allclose(distance, exact.min(axis=0), atol=1e-9)
    np.testing.assert_array_equal(exact[pairs, np.arange(len(distance))], exact.min(axis=0))
    margins = (exact - around.required[:, None])[found.changes(around)]
    assert found.nearest.margin == pytest.approx(margins.min())
    assert found.nearest.time == found.t[np.unravel_index(margins.argmin(), margins.shape)[1]]
    floor = np.array(["the floor" in pair for pair in around.named])
    assert exact[floor].min() > 0.2  # farther than what is looked at first
    np.testing.assert_allclose(found.nearness(floor)[0], exact[floor].min(axis=0), atol=1e-9)
    assert found.changes(around).all()
    turned = found.values.copy()
    turned[0, :, :2] = turned[0, 0, :2]  # the last joint moves alone
    last = [any("wrist_3" in name or "ee_" in name for name in pair) for pair in around.named]
    changes = replace(found, values=turned).changes(around)
    assert changes.any()
    assert not changes[~np.array(last)].any()
    nothing = np.zeros(len(around.pairs), dtype=bool)
    assert np.isinf(found.nearness(nothing)[0]).all()


JOINTS = tuple(f"joint_{k}" for k in range(6))


@pytest.fixture
def motion(rng):
    return DesignedMotion(FourierBasis(2.0, 3), rng.standard_normal((5, 6)))


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_a_table_has_positions_velocities_and_accelerations(motion, tmp_path, suffix):
    path = write_motion(motion, JOINTS, 2.0, 50.0, tmp_path / f"m{suffix}")
    table = open_table(path, LogSource()).read(["time", "q_joint_2", "dq_joint_2", "ddq_joint_5"])
    np.testing.assert_array_equal(table["time"], np.arange(101) / 50)
    q, v, a = motion.evaluate(table["time"])
    np.testing.assert_array_equal(table["q_joint_2"], q[:, 2])
    np.testing.assert_array_equal(table["dq_joint_2"], v[:, 2])
    np.testing.assert_array_equal(table["ddq_joint_5"], a[:, 5])


@pytest.mark.parametrize("suffix", [".csv", ".yaml", ".script"])
def test_the_last_row_is_the_end_of_the_motion_where_it_rests(rng, tmp_path, suffix):
    """Of 2.06 s, whose last row is at 2.1 s at 10 Hz, and at 2.064 s every 8 ms."""
    motion = DesignedMotion(FourierBasis(2.06, 3), rng.standard_normal((5, 6)))
    text = write_motion(motion, JOINTS, 2.06, 10.0, tmp_path / f"m{suffix}").read_text()
    q = motion.evaluate(np.array([2.06]))[0][0]
    if suffix == ".csv":
        found = np.array(text.splitlines()[-1].split(","), dtype=float)
        np.testing.assert_allclose(found, [2.1, *q, *[0.0] * 12], atol=1e-9)
        return
    numbers = re.findall(r"(?:positions: |servoj\()\[(.*?)\]", text)[-1]
    np.testing.assert_allclose(np.array(numbers.split(","), dtype=float), q, atol=1e-6)


def test_ros_reads_it_as_a_joint_trajectory(motion, tmp_path):
    path = write_motion(motion, JOINTS, 2.0, 40.0, tmp_path / "m.yaml")
    content = yaml.safe_load(path.read_text())
    assert content["joint_names"] == list(JOINTS)
    assert len(content["points"]) == 81
    for k, seconds, rest in ((7, 0, 175_000_000), (41, 1, 25_000_000)):
        point = content["points"][k]
        assert point["time_from_start"] == {"sec": seconds, "nanosec": rest}
        q, v, a = motion.evaluate(np.array([k / 40]))
        for name, values in (("positions", q), ("velocities", v), ("accelerations", a)):
            np.testing.assert_allclose(point[name], values[0], atol=1e-6)
