"""Terms that are offered, what they gain in held-out windows, and scales of stated gains."""

from types import SimpleNamespace

import numpy as np
import pytest
from helpers.mujoco_plant import plant

from robotid.data.log import Log
from robotid.dynamics.simulation.loops import cut_windows
from robotid.identification.closed_loop.loop_simulator import (
    GainScale,
    _gains,
    _last,
    candidates,
)
from robotid.robot.drives import LoadFriction, PositionCoulomb


def test_gains_are_those_of_fits_to_the_other_folds(rng):
    parts = [(rng.standard_normal((rows, 5)), rng.standard_normal(rows)) for rows in (12, 9, 15)]
    H, g = (np.array(x) for x in zip(*((A.T @ A, A.T @ b) for A, b in parts), strict=True))
    sets = {7: [1], 9: [4, 3]}
    found = _gains(H, g, [0, 2], sets)
    for k, (A, b) in enumerate(parts):
        others = [part for i, part in enumerate(parts) if i != k]
        A_f, b_f = (np.concatenate(x) for x in zip(*others, strict=True))

        def left(columns, A=A, b=b, A_f=A_f, b_f=b_f):
            fitted = np.linalg.lstsq(A_f[:, columns], b_f, rcond=None)[0]
            return np.sum((A[:, columns] @ fitted - b) ** 2)

        for s, own in sets.items():
            assert found[s][k] == pytest.approx(left([0, 2]) - left([0, 2, *own]), rel=1e-9)


def test_terms_are_scaled_by_half_the_range_of_a_joint_and_need_some_of_it(rng):
    model, t = plant("planar", rng).model, np.arange(200) / 100.0
    q = 0.3 + np.outer(np.cos(np.pi * t / 2), [0.4, 0.04])  # the second moves by less than 0.05
    log = Log(t, q, 0 * q, model.joints, q_ref=q, has_torque=False)
    simulator = SimpleNamespace(
        robot=SimpleNamespace(model=model), windows=cut_windows(log, 1.0, 0.0)
    )
    offered = [free for set_ in candidates(simulator, np.array([2.0, 3.0])) for free in set_]
    by_position = [free for free in offered if isinstance(free.term, PositionCoulomb)]
    assert [free.joints for free in by_position] == [(0,), (0,)]
    by_order = [2.0 / (np.ptp(q[:, 0]) / 2) ** order for order in (1, 2)]
    assert [free.spread for free in by_position] == pytest.approx(by_order)
    assert {free.spread for free in offered if isinstance(free.term, LoadFriction)} == {1.0}


@pytest.mark.parametrize(
    ("change", "common", "is_wrong"),
    [
        ((-0.2, -0.18), -0.19, True),
        ((0.2, 0.18), 0.19, True),
        ((-0.03, -0.03), -0.03, False),  # small
        ((-0.2, 0.6), -0.19, False),  # one joint shows another
    ],
)
def test_gains_are_wrong_where_all_joints_show_it(change, common, is_wrong):
    scale = GainScale(np.array(change), np.array([0.05, 0.05]), common, 0.006)
    assert scale.is_wrong is is_wrong
    unsure = GainScale(np.array(change), np.array([0.05, 0.05]), common, 0.07)
    assert not unsure.is_wrong


def test_the_last_unknowns_are_those_of_the_inverse(rng):
    A = rng.standard_normal((9, 5)) * [1.0, 1e3, 1.0, 1e-2, 10.0]
    H, x = A.T @ A, np.arange(1.0, 6.0)
    found, error = _last(H, H @ x, 2)
    np.testing.assert_allclose(found, x[3:], rtol=1e-8)
    np.testing.assert_allclose(error, np.sqrt(np.diag(np.linalg.inv(H)))[3:], rtol=1e-8)
    A[:, 4] = A[:, 0]  # the last is not distinguishable from the first, that before it is
    _, error = _last(A.T @ A, A.T @ A @ x, 2)
    left = np.linalg.inv(A[:, :4].T @ A[:, :4])
    assert error[0] == pytest.approx(np.sqrt(left[3, 3]), rel=1e-8)
    assert error[1] == np.inf
