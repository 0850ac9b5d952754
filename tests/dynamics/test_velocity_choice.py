"""velocity = "auto" takes the velocities that predict torque better where none was fitted."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.corruptions import clean_log, robot
from helpers.driven import arm

from robotid.data.log import Trajectory
from robotid.data.signal_settings import SignalSettings
from robotid.dynamics import used_rows
from robotid.dynamics.torque import joint_torque_regressor
from robotid.estimation.fitting.survey import hold_log

LSB = 2 * np.pi / 4096  # [rad] of a 12-bit encoder


@pytest.fixture(scope="module")
def log():
    return clean_log(robot("ur5"), 0)


def chosen(log, **settings):
    return hold_log(robot("ur5"), log, SignalSettings(**settings)).signals.velocity


def late(log, delay):
    v = np.column_stack([np.interp(log.t - delay, log.t, x) for x in log.v.T])
    return replace(log, v=v)


def noisy(log, sigma, column):
    noise = sigma * np.random.default_rng(0).standard_normal(log.q.shape)
    return replace(log, **{column: getattr(log, column) + noise})


def test_a_good_measured_velocity_is_taken_also_where_the_position_is_worse(log):
    coarse = replace(log, q=np.round(log.q / LSB) * LSB)
    assert chosen(log) == chosen(coarse) == chosen(noisy(log, 1e-3, "q")) == "measured"


def test_a_velocity_of_few_steps_or_of_noise_is_not_taken(log):
    v = np.gradient(np.round(log.q / LSB) * LSB, log.t, axis=0)
    assert chosen(replace(log, v=v)) == "differentiated"
    v = log.v.copy()
    v[:, 2] = v[:, 2].std() * np.random.default_rng(0).standard_normal(len(v))
    assert chosen(replace(log, v=v)) == "differentiated"
    assert chosen(replace(log, v=v), velocity="measured") == "measured"  # as asked


def test_a_velocity_that_predicts_worse_is_not_taken(log):
    # fine, of its position and timely by every rule, but not as good
    assert chosen(noisy(log, 0.05, "v")) == "differentiated"
    assert chosen(late(log, 0.012)) == "differentiated"
    assert chosen(late(log, 0.012), velocity_delay=0.012) == "measured"


def test_a_log_too_short_to_predict_is_judged_by_its_lag(log):
    short = log.window(2.0, 2.7)
    assert chosen(short) == "measured"
    assert chosen(late(short, 0.05)) == "differentiated"


def test_a_part_is_predicted_by_the_fit_to_the_others_joint_by_joint(rng):
    """Every third row counts, in eight parts; the last joint has too few of them."""
    model = arm()
    n, p = 2400, model.support().sum(axis=1)
    q, v, a, tau = rng.standard_normal((4, n, 3))
    motion = Trajectory(np.arange(n) / 50, q, v, a, tau, model.joints, 50.0, np.zeros(n, dtype=int))
    mask = rng.random((n, 3)) < 0.8
    mask[:, 2] &= np.arange(n) % 3 == 1
    error = used_rows._held_out_error(model, motion, mask, 3)
    Y = joint_torque_regressor(model, q, v, a).reshape(n, 3, -1)
    folds = [np.concatenate(np.array_split(np.arange(0, n, 3), 8)[k::2]) for k in (0, 1)]
    for j in (0, 1):
        squares = 0.0
        for one, other in (folds, folds[::-1]):
            one, other = one[mask[one, j]], other[mask[other, j]]
            assert min(len(one), len(other)) >= 3 * p[j]
            W = Y[:, j, model.support()[j]]
            size = np.linalg.norm(W[one], axis=0)
            W = W / np.where(size > 0, size, 1.0)
            theta = np.linalg.pinv(W[one], rcond=1e-3) @ tau[one, j]
            squares += np.sum((tau[other, j] - W[other] @ theta) ** 2)
        wanted = np.sqrt(squares) + 1e-6 * np.linalg.norm(tau[::3, j])
        assert error[j] == pytest.approx(wanted, rel=1e-6)
    assert np.isnan(error[2])


def test_columns_that_hardly_differ_share_their_parameter(rng, monkeypatch):
    """Relative to the largest singular value, theirs is 5e-4; the torque is of their difference."""
    x, y = rng.standard_normal((2, 800))
    W = np.column_stack([x, x + 1e-3 * y])
    monkeypatch.setattr(used_rows, "joint_torque_regressor", lambda *_: W[:, None])
    model = SimpleNamespace(joints=("a",), support=lambda: np.ones((1, 2), dtype=bool))
    q = np.zeros((800, 1))
    motion = Trajectory(
        np.arange(800) / 50, q, q, q, y[:, None], ("a",), 50.0, np.zeros(800, dtype=int)
    )
    (error,) = used_rows._held_out_error(model, motion, np.ones((800, 1), dtype=bool), 1)
    assert error == pytest.approx(np.linalg.norm(y), rel=0.01)  # nothing of it is predicted


def test_both_velocities_are_compared_on_the_rows_that_both_have(monkeypatch):
    masks = {"measured": np.array([[1, 1], [0, 1], [1, 1]] * 700, dtype=bool)}
    masks["differentiated"] = np.array([[1, 0], [1, 1], [1, 1]] * 700, dtype=bool)
    given = []

    def held_out(model, motion, mask, every):
        given.append((motion, mask, every))
        return np.array([2.0, 3.0]) if motion == "measured" else np.array([5.0, 7.0])

    model = SimpleNamespace(joints=("a", "b"), layout=None, free_flyer=False, constraints=())
    monkeypatch.setattr(used_rows, "friction_speeds", lambda layout: None)
    monkeypatch.setattr(used_rows, "process", lambda log, chosen, speeds: chosen.velocity)
    monkeypatch.setattr(used_rows, "row_mask", lambda model, motion, least: masks[motion])
    monkeypatch.setattr(used_rows, "_held_out_error", held_out)
    log = SimpleNamespace(has_torque=True)
    found = used_rows._errors(model, log, SignalSettings())
    np.testing.assert_array_equal(found, [[2.0, 5.0], [3.0, 7.0]])
    assert [motion for motion, *_ in given] == ["measured", "differentiated"]
    for _, mask, every in given:  # at most 1000 of 2100
        np.testing.assert_array_equal(mask, masks["measured"] & masks["differentiated"])
        assert every == 3
    assert np.isnan(used_rows._errors(model, SimpleNamespace(has_torque=False), None)).all()


@pytest.mark.parametrize(("last", "wanted"), [(0.84, False), (0.86, True)])
def test_the_median_joint_of_all_logs_decides(monkeypatch, caplog, last, wanted):
    errors = {
        "a": np.array([[1.0, 0.9], [2.0, np.nan]]),
        "b": np.array([[4.0, 3.2], [5.0, 5 * last]]),
    }
    for name in ("coarse_velocities", "unlike_velocities"):
        monkeypatch.setattr(used_rows, name, lambda log: False)
    monkeypatch.setattr(used_rows, "_errors", lambda model, log, settings: errors[log.name])
    logs = [SimpleNamespace(name=name) for name in "ab"]
    with caplog.at_level("INFO", "robotid"):
        assert used_rows.prefers_measured(None, logs, SignalSettings()) is wanted
    chosen = "measured" if wanted else "differentiated"
    (said,) = caplog.messages
    assert said.startswith(f"a: velocity = 'auto' uses {chosen} velocities: the torque prediction")
    assert f" is {last:.2f} times that with measured velocities" in said
    errors["a"], errors["b"] = np.full((2, 2, 2), np.nan)
    timely = {"a": True, "b": wanted}
    monkeypatch.setattr(used_rows, "is_timely", lambda log, delay: timely[log.name])
    assert used_rows.prefers_measured(None, logs, SignalSettings()) is wanted
