import numpy as np
import pytest

from robotid.design import design as designs
from robotid.design.clearance import Clearance
from robotid.design.design import (
    _PLACES,
    Designer,
    FourierBasis,
    Route,
    _free_range,
    design_stands,
    design_sweeps,
)
from robotid.design.limits import LIMITS, MotionLimits
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel


@pytest.fixture(scope="module")
def designer():
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


def test_room_ends_at_the_nearest_place_where_the_robot_cannot_rest(designer):
    low, high = (designer.limits.middle + s * designer.limits.sizes[0] for s in (-1, 1))
    step, blocked = (high - low) / (_PLACES - 1), 0
    for posture in designer.postures.resting(np.random.default_rng(0), 200)[:5]:
        for j, room in enumerate(_free_range(designer, posture)):
            for way, left in zip((-1.0, 1.0), room, strict=True):
                q = np.tile(posture, (50, 1))
                q[:, j] += way * np.linspace(0.0, max(left - step[j], 0.0), 50)
                assert designer.postures.can_rest(q).mean() > 0.95  # but between the places
                q[0, j] = posture[j] + way * left
                if min(q[0, j] - low[j], high[j] - q[0, j]) > 1e-9:
                    assert not designer.postures.can_rest(q[:1])[0]
                    blocked += 1
    assert blocked > 10


def test_sweeps_go_both_ways_at_each_speed_while_the_others_rest(designer, rng):
    design = design_sweeps(designer, rng, speeds=(0.1, 0.4))
    # the page shows what was checked, at the same instants
    kinds = [k for k, kind in enumerate(LIMITS) if kind != "jerk"]
    shown = designer.course(design)
    np.testing.assert_allclose(shown.largest[kinds], design.used[kinds], rtol=1e-9)
    assert len(shown.t) - 1 == round(100 * design.duration)
    assert design.used.max() <= 1.0
    assert design.contact is None or design.contact.distance >= 0.01
    t = np.arange(0.0, design.motion.duration, 0.01)
    _, v, a = design.motion.evaluate(t)
    for j, fastest in enumerate(designer.limits.sizes[1]):
        steady = v[(np.abs(a).max(axis=1) < 1e-9) & (np.abs(v[:, j]) > 1e-6)]
        assert set(np.round(steady[:, j] / fastest, 6)) == {-0.4, -0.1, 0.1, 0.4}
        assert np.abs(np.delete(steady, j, axis=1)).max() == 0.0


def test_sweeps_beyond_a_limit_are_each_a_fifth_shorter(designer, monkeypatch):
    spans = []
    for attempts in (1, 3):
        results = iter([False] * (attempts - 1) + [True])
        monkeypatch.setattr(designs, "_is_feasible", lambda _, verdicts=results: next(verdicts))
        design = design_sweeps(designer, np.random.default_rng(0), speeds=(0.8,))
        spans.append(np.ptp(design.motion.places, axis=0))
    assert (spans[1] / spans[0]).min() == pytest.approx(0.64)


def test_stands_tell_more_of_gravity_than_random_ones(designer):
    design = design_stands(designer, np.random.default_rng(0), count=6)
    assert design.used.max() <= 1.0
    assert design.contact is None or design.contact.distance >= 0.01
    places = design.motion.places
    assert len(places) >= 4

    def told(q):
        rows = designer.information.rows(q, 0.0 * q, 0.0 * q)
        scale = designer.spread * np.sqrt(2.0 / designer.noise)[:, None]
        A = (scale[..., None] * rows.W).swapaxes(0, 1).reshape(len(designer.spread), -1)
        return np.linalg.slogdet(A @ A.T + np.eye(len(A)))[1]

    rng = np.random.default_rng(1)
    some = designer.postures.resting(rng)
    random = [told(rng.choice(some, len(places), replace=False)) for _ in range(50)]
    assert told(places) > max(random)
