"""A delay of the torque is found where there is one, and only where moving it back would help."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pinocchio as pin
import pytest
from helpers.corruptions import clean_log, controlled_log, late, robot, table_of
from helpers.driven import arm
from helpers.synthetic import exact_log, truth
from scipy.interpolate import CubicSpline

from robotid.data.log import Trajectory
from robotid.data.signal_settings import SignalSettings
from robotid.diagnosis.logs import torque_delay
from robotid.diagnosis.logs.torque_delay import _EXACT, _GRID, _common, _Misfit
from robotid.dynamics.torque import carried_columns
from robotid.robot.model import RobotModel

SIGNALS = SignalSettings()
# robot, seed, duration [s]: logs whose every torque the filter alone makes look late or early
CLEAN = [("ur5", 100, 8.0), ("ur5", 101, 8.0), ("ur5", 104, 6.0), ("panda", 100, 6.0)]


def found(model, log, signals=SIGNALS):
    return list(torque_delay.check_torque_delay(model, log, signals, "run.csv"))


def delayed(log, delay):
    table = late("tau_", delay)(table_of(log))
    return replace(log, tau=np.column_stack([table[f"tau_{joint}"] for joint in log.joints]))


@pytest.mark.parametrize(("name", "seed", "duration"), CLEAN)
def test_a_short_clean_log_has_no_late_torque_but_a_delayed_one_has(name, seed, duration):
    model, log = robot(name), controlled_log(name, seed, duration=duration)
    (clean,) = found(model, log)
    assert clean.severity == "note"
    # without the filter on the regressor 6 to 9 ms and 11 to 15 %
    assert abs(clean.evidence["delay"]) < 0.006
    assert clean.evidence["gain"] < 0.09
    for delay in (0.03, -0.03):
        (spoilt,) = found(model, delayed(log, delay))
        assert spoilt.severity == "warning"
        # what was found of the clean log is the bias of the method
        assert spoilt.evidence["delay"] - clean.evidence["delay"] == pytest.approx(delay, abs=2e-3)
        assert spoilt.evidence["gain"] > 0.25


def test_a_stated_delay_is_no_longer_found(ur5):
    log = delayed(controlled_log("ur5", 100, duration=8.0), 0.03)
    (spoilt,) = found(ur5, log)
    delay = spoilt.evidence["delay"]
    (mended,) = found(ur5, log, replace(SIGNALS, torque_delay=delay))
    assert mended.severity == "note"
    assert abs(mended.evidence["delay"]) < 2e-3


def test_a_log_without_a_filter_is_judged_too(ur5):
    signals = replace(SIGNALS, cutoff=None)
    log = exact_log(ur5, truth(ur5), np.random.default_rng(0), samples=800, rate=100.0)
    (clean,) = found(ur5, log, signals)
    (spoilt,) = found(ur5, delayed(log, 0.03), signals)
    assert (clean.severity, spoilt.severity) == ("note", "warning")


def test_noise_of_a_log_without_a_filter_is_no_delay(ur5):
    # half-way between rows a spline of white noise is a quarter smaller: 10 ms here
    log = exact_log(ur5, truth(ur5), np.random.default_rng(1), samples=600, rate=50.0)
    log = replace(log, tau=log.tau + 0.1 * np.random.default_rng(1).standard_normal(log.tau.shape))
    (clean,) = found(ur5, log, replace(SIGNALS, cutoff=None, trim=0.0))
    assert clean.severity == "note"
    assert abs(clean.evidence["delay"]) < 0.005
    assert clean.evidence["gain"] < 0.05


def test_joints_that_hardly_move_have_no_say(ur5):
    log = clean_log(ur5, 100, duration=20.0)
    still = np.abs(log.t - 8.5) > 0.95
    q = log.q.copy()
    q[still, :5] = q[850, :5]
    assert found(ur5, replace(log, q=q)) == []


# gains in ms, s.e. 1 ms (its floor): misfits 1 - share (1 - x^2), x = 0 at the delay; what they
# fall by is the share
@pytest.mark.parametrize("stated", [0.0, 0.01])
@pytest.mark.parametrize(
    ("delay", "share", "severity"),
    [(0.045, 0.05, "note"), (0.045, 0.5, "warning"), (0.005, 0.05, "warning"),
     (0.0025, 0.5, "note"), (-0.005, 0.05, "warning")],
)  # fmt: skip
def test_a_delay_is_said_at_three_sigma_if_it_helps_elsewhere(
    ur5, monkeypatch, delay, share, severity, stated
):
    parabola = ((torque_delay._GRID - delay) / delay) ** 2
    squares = np.tile(1 - share * (1 - parabola), (6, 8, 1))
    misfit = torque_delay._Misfit(squares, np.ones(6), ur5.joints)
    monkeypatch.setattr(torque_delay, "_misfit", lambda *_: misfit)
    signals = replace(SIGNALS, torque_delay=stated)
    (finding,) = found(ur5, clean_log(ur5, 100, duration=2.0), signals)
    assert finding.severity == severity
    assert finding.evidence["delay"] == pytest.approx(delay, abs=1e-9)
    assert finding.evidence["std_error"] == pytest.approx(1e-3)
    assert finding.evidence["gain"] == pytest.approx(share, rel=0.01)
    total = f"{delay + stated:.4f}"
    told = f"set torque_delay = {total} (--torque-delay {total})" in finding.message
    assert told == (severity == "warning")


@pytest.mark.parametrize(("name", "seed"), [("ur5", 100), ("ur5", 102), ("panda", 104)])
def test_a_torque_that_is_periodic_in_the_position_is_no_delay(name, seed):
    model = robot(name)
    log, rng = clean_log(model, seed), np.random.default_rng(seed)
    tau = log.tau.copy()
    for torque, q in zip(tau.T, log.q.T, strict=True):
        phase, size = rng.uniform(0, 2 * np.pi, 4), rng.standard_normal(4)
        waves = [np.cos(k * q + p) for k, p in zip((1, 2, 3, 4), phase, strict=True)]
        ripple = size @ waves
        torque += 0.3 * torque.std() * ripple / ripple.std()
    for finding in found(model, replace(log, tau=tau)):
        assert finding.severity == "note"


def test_a_model_of_one_joint_is_not_judged():
    whole = robot("ur5")
    log = clean_log(whole, 100, duration=8.0)
    model = RobotModel.from_urdf(whole.tree.path, joints=["elbow_joint"])
    assert found(model, log.select(["elbow_joint"])) == []


def test_one_joint_with_a_delay_of_its_own_is_named_and_does_not_count_for_the_others(ur5):
    log = controlled_log("ur5", 100, duration=8.0)
    clean = found(ur5, log)
    assert [f.code for f in clean] == ["torque_delay"]
    tau = log.tau.copy()
    tau[:, 4] = delayed(log, 0.06).tau[:, 4]
    own, common = found(ur5, replace(log, tau=tau))
    assert (own.code, own.severity) == ("joint_torque_delay", "warning")
    assert own.where == "run.csv: wrist_2_joint"
    assert own.evidence["delay"] == pytest.approx(0.06, abs=0.006)
    assert own.evidence["gain"] > 0.8
    assert common.severity == "note"
    # the other five are as in the clean log, whose delay the wrist's moves
    assert common.evidence["delay"] == pytest.approx(clean[0].evidence["delay"], abs=3e-3)
    # all 30 ms late, and one more by 60
    tau = delayed(log, 0.03).tau.copy()
    tau[:, 4] = delayed(log, 0.09).tau[:, 4]
    own, common = found(ur5, replace(log, tau=tau))
    assert own.where == "run.csv: wrist_2_joint"
    assert own.evidence["delay"] == pytest.approx(0.09, abs=0.006)
    assert "the other joints lag it by 2" in own.message
    assert common.evidence["delay"] == pytest.approx(clean[0].evidence["delay"] + 0.03, abs=3e-3)
    tau = log.tau.copy()
    tau[:, 2] = delayed(log, -0.1).tau[:, 2]
    own, _ = found(ur5, replace(log, tau=tau))
    assert own.where == "run.csv: elbow_joint"
    assert "leads the position by 100 ms or more" in own.message


@pytest.mark.parametrize(("joint", "delay"), [("elbow_joint", 0.03), ("wrist_2_joint", -0.03)])
def test_a_joint_is_late_although_friction_hides_half_of_it(ur5, joint, delay):
    log, j = controlled_log("ur5", 100, duration=8.0), ur5.joints.index(joint)
    tau = log.tau.copy()
    tau[:, j] = delayed(log, delay).tau[:, j]
    own, common = found(ur5, replace(log, tau=tau))
    assert (own.code, own.where) == ("joint_torque_delay", f"run.csv: {joint}")
    assert own.evidence["delay"] == pytest.approx(delay, abs=0.006)
    assert 0.35 < own.evidence["gain"] < 0.75
    assert (common.code, common.severity) == ("torque_delay", "note")


def test_the_error_of_a_delay_counts_friction_beside_the_scatter(ur5, monkeypatch):
    squares = np.tile(1 - 0.5 * (1 - (torque_delay._GRID / 0.03 - 1) ** 2), (6, 8, 1))
    misfit = torque_delay._Misfit(squares, np.ones(6), ur5.joints)
    monkeypatch.setattr(torque_delay, "_misfit", lambda *_: misfit)
    monkeypatch.setattr(torque_delay._Misfit, "error", lambda self: 2e-3)
    (finding,) = found(ur5, clean_log(ur5, 100, duration=2.0))
    assert finding.evidence["std_error"] == pytest.approx(np.hypot(2e-3, 1e-3))


def parabolas(rng, joints=3, blocks=4):
    """Return a misfit whose joints leave parabolas of the delay in each block, and these."""
    bottom, bend = rng.uniform(2.0, 5.0, (2, joints, blocks))
    bend *= 1e4  # per s^2
    at = rng.uniform(-0.02, 0.03, (joints, blocks))
    squares = bottom[..., None] + bend[..., None] * (_GRID - at[..., None]) ** 2
    rows = np.array([900, 400, 100])[:joints]
    return _Misfit(squares, rows, ("a", "b", "c")[:joints]), bottom, bend, at


def lowest(misfit, bend, at, kept=slice(None), out=()):
    """Return the delay of the lowest sum of parabolas, each joint's by its own lowest."""
    blocks = [b for b in range(bend.shape[1]) if b not in out]
    squares = misfit.squares[kept][:, blocks].sum(axis=1) + _EXACT
    weight = (misfit.rows[kept] / squares.min(axis=1))[:, None] * bend[kept][:, blocks]
    return float(np.sum(weight * at[kept][:, blocks]) / np.sum(weight))


def test_a_delay_its_error_and_its_gain_are_those_of_jackknifed_parabolas(rng):
    misfit, bottom, bend, at = parabolas(rng)
    assert misfit.delay() == pytest.approx(lowest(misfit, bend, at), abs=1e-9)
    joints = [lowest(misfit, bend, at, [k for k in range(3) if k != j]) for j in range(3)]
    assert misfit.delays_without(0) == pytest.approx(joints, abs=1e-9)
    assert misfit.without({1}).joints == ("a", "c")
    blocks = [lowest(misfit, bend, at, out=(b,)) for b in range(4)]
    assert misfit.delays_without(1) == pytest.approx(blocks, abs=1e-9)
    variance = sum((len(x) - 1) / len(x) * np.sum((x - np.mean(x)) ** 2) for x in (joints, blocks))
    assert misfit.error() == pytest.approx(np.sqrt(variance), rel=1e-6)

    def left(delays):
        below = np.floor(np.asarray(delays) / step) * step  # straight between points of the grid
        share = (np.asarray(delays) - below) / step
        ends = [bottom + bend * (x - at) ** 2 for x in (below, below + step)]
        return np.sum((1 - share) * ends[0] + share * ends[1], axis=1) + _EXACT

    step = _GRID[1] - _GRID[0]
    share = np.mean(left(blocks) / left(np.zeros(4)))
    assert misfit.gain() == pytest.approx(1 - share, rel=1e-6)
    late = replace(misfit, squares=misfit.squares[..., ::-1])
    assert late.delay() == pytest.approx(-misfit.delay(), abs=1e-9)


def test_a_delay_of_one_joint_is_beside_that_of_the_others(rng):
    misfit, bottom, bend, at = parabolas(rng)
    shift = np.array([0.0, 0.04, 0.0])[:, None]
    squares = bottom[..., None] + bend[..., None] * (_GRID - (0.1 * at + shift)[..., None]) ** 2
    own = replace(misfit, squares=squares).own_delay(1, 0.01)
    whole = np.sum(bend[1] * (0.1 * at[1] + 0.04)) / bend[1].sum()
    step = _GRID[1] - _GRID[0]
    assert own.delay == pytest.approx(whole, abs=0.51 * step)
    common = lowest(replace(misfit, squares=squares), bend, 0.1 * at, [0, 2])
    assert own.common == pytest.approx(common, abs=1e-9)
    without = []
    for b in range(4):
        rest = np.delete(np.arange(4), b)
        best = np.sum((bend[1] * (0.1 * at[1] + 0.04))[rest]) / bend[1][rest].sum()
        without.append(_GRID[np.argmin(np.abs(_GRID - best))])
    spread = np.sqrt(3 / 4 * np.sum((without - np.mean(without)) ** 2))
    assert own.error == pytest.approx(np.hypot(step, spread), rel=1e-6)
    now, then = (
        np.sum(bottom[1] + bend[1] * (np.asarray(x) - 0.1 * at[1] - 0.04) ** 2)
        for x in (common, without)
    )
    assert own.explained == pytest.approx(1 - then / now, abs=2e-3)
    assert own.is_significant
    assert not misfit.own_delay(0, 0.01).is_significant


def test_an_instant_is_as_far_from_a_slow_one_as_the_nearest_on_either_side(rng):
    slow, at = np.sort(rng.random(7)), np.sort(rng.uniform(-0.3, 1.4, 60))
    wanted = np.abs(at[:, None] - slow).min(axis=1)
    np.testing.assert_allclose(torque_delay._distance(at, slow), wanted, rtol=1e-12)
    assert np.isinf(torque_delay._distance(at, slow[:0])).all()


def test_what_a_torque_leaves_at_each_delay_is_of_least_squares_in_blocks(rng):
    """Of two windows, the rows far from stiction only; the second joint's own columns."""
    windows = []
    for count in (90, 110):
        inertial, drive = rng.standard_normal((count, 7)), rng.standard_normal((count, 2, 5))
        inertial[:, 5] = 2.0 * inertial[:, 4] - inertial[:, 6]  # dependent
        steady = rng.random((count, 2)) < 0.7
        delayed = rng.standard_normal((2, 81, count)) + 4.0
        load = rng.standard_normal((count, 2))
        windows.append(torque_delay._Window(inertial, drive, steady, delayed, load))
    squares, _, used = torque_delay._squares(windows, 1, slice(3, 7))
    at = [window.steady[:, 1] for window in windows]
    X = np.concatenate(
        [np.column_stack([w.inertial[k, 3:7], w.drive[k, 1], np.ones(k.sum())])
         for w, k in zip(windows, at, strict=True)]
    )  # fmt: skip
    tau = np.concatenate([w.delayed[1][:, k] for w, k in zip(windows, at, strict=True)], axis=1)
    assert used == len(X) == sum(k.sum() for k in at)
    left = tau.T - X @ np.linalg.pinv(X, rcond=1e-8) @ tau.T
    size = np.sum((tau - tau.mean(axis=1, keepdims=True)) ** 2, axis=1)
    wanted = [np.sum(part**2, axis=0) / size for part in np.array_split(left, 8)]
    np.testing.assert_allclose(squares, wanted, rtol=1e-8)
    few = [replace(w, steady=w.steady & (np.arange(len(w.steady))[:, None] < 40)) for w in windows]
    assert torque_delay._squares(few, 1, slice(3, 7)) is None


def test_a_window_has_the_columns_and_delayed_torques_of_its_instants(rng):
    """Without a filter; every second row, away from the ends and from slow instants."""
    model = arm()
    n, step = 161, 0.01
    t = 2.0 + step * np.arange(n)
    q = np.column_stack([np.sin(3 * t), 0.3 * np.cos(2 * t), 0.05 * np.sin(4 * t)])
    v = np.column_stack([3 * np.cos(3 * t), -0.6 * np.sin(2 * t), 0.2 * np.cos(4 * t)])
    a, tau = rng.standard_normal((2, n, 3))
    motion = Trajectory(t, q, v, a, tau, model.joints, 1 / step, np.zeros(n, dtype=int))
    rows, signals = np.arange(11, 151), SignalSettings(cutoff=None)
    found = torque_delay._window(model, motion, rows, step, 2, signals, 0.08)
    at = rows[::2]
    at = at[(t[at] >= t[11] + 0.12 - 1e-9) & (t[at] <= t[150] - 0.12 + 1e-9)]
    top = np.maximum(np.abs(v).max(axis=0), 0.02)
    columns = [a, v, *[np.tanh(v / x) for x in (0.02, 0.1 * top, 0.3 * top)], v * np.abs(v)]
    columns += [wave(k * q) for k in (1, 2, 3, 4) for wave in (np.cos, np.sin)]
    np.testing.assert_allclose(found.drive, np.stack(columns, axis=2)[at], atol=1e-12)
    np.testing.assert_allclose(found.inertial, carried_columns(model, q[at], v[at], a[at]))
    # the URDF's torque by Pinocchio, away from the ends, where splines differ
    data = model.pin_model.createData()
    bodies = [pin.rnea(model.pin_model, data, q[k], v[k], a[k]) for k in at]
    smooth = np.abs(t[at] - t[80]) < 0.4
    wanted = np.abs(bodies) * np.tanh(v[at] / 0.02)
    np.testing.assert_allclose(found.load[smooth], wanted[smooth], atol=1e-3 * np.abs(wanted).max())
    turns = np.vstack([np.diff(np.sign(v[11:151]), axis=0) != 0, np.zeros((1, 3), dtype=bool)])
    slow = turns | (np.abs(v[11:151]) < 0.05)
    for j in range(3):
        near = np.abs(t[at][:, None] - t[11:151][slow[:, j]]).min(axis=1, initial=np.inf)
        np.testing.assert_array_equal(found.steady[:, j], near > 0.75 * 0.08)
    for j in range(3):
        spline = CubicSpline(t[11:151], tau[11:151, j])
        wanted = spline(t[at] + _GRID[:, None])
        inside = np.abs(t[at] - t[80]) < 0.4  # ends of splines differ
        np.testing.assert_allclose(found.delayed[j][:, inside], wanted[:, inside], atol=1e-4)


def test_friction_by_load_explains_what_least_squares_with_its_column_leave_less(rng):
    windows = []
    for count in (90, 110):
        inertial, drive = rng.standard_normal((count, 4)), rng.standard_normal((count, 2, 3))
        load, steady = rng.standard_normal((count, 2)), rng.random((count, 2)) < 0.9
        delayed = rng.standard_normal((2, 81, count))
        delayed[1] += 2.0 * load[:, 1]
        windows.append(torque_delay._Window(inertial, drive, steady, delayed, load))
    plain, loaded, rows = torque_delay._squares(windows, 1, slice(1, 4))
    at = [w.steady[:, 1] for w in windows]
    X = np.concatenate(
        [np.column_stack([w.inertial[k, 1:4], w.drive[k, 1], np.ones(k.sum()), w.load[k, 1]])
         for w, k in zip(windows, at, strict=True)]
    )  # fmt: skip
    tau = np.concatenate([w.delayed[1][:, k] for w, k in zip(windows, at, strict=True)], axis=1).T
    size = np.sum((tau - tau.mean(axis=0)) ** 2, axis=0)
    left, without = (
        np.sum((tau - A @ np.linalg.lstsq(A, tau)[0]) ** 2, axis=0) / size for A in (X, X[:, :-1])
    )
    np.testing.assert_allclose(loaded.sum(axis=0), left, rtol=1e-8)
    misfit = _Misfit(plain[None], np.array([rows]), ("a",), loaded[None])
    k = 52  # of the grid
    wanted = 1 - (left[k] + _EXACT) / (without[k] + _EXACT)
    assert misfit.by_load(_GRID[k]) == pytest.approx([wanted], rel=1e-9)
    assert 0.7 < wanted < 0.9


@pytest.mark.parametrize(("share", "is_late"), [(0.3, False), (0.8, True)])
def test_a_delay_that_friction_by_load_explains_better_is_none(ur5, monkeypatch, share, is_late):
    """The delay of 30 ms leaves half of the torque without it, friction by load a share of it."""
    squares = np.tile(1 - 0.5 * (1 - (_GRID / 0.03 - 1) ** 2), (6, 8, 1))
    misfit = _Misfit(squares, np.ones(6), ur5.joints, share * squares)
    assert misfit.by_load(0.0) == pytest.approx(np.full(6, 1 - share), abs=1e-4)
    monkeypatch.setattr(torque_delay, "_misfit", lambda *_: misfit)
    (finding,) = found(ur5, clean_log(ur5, 100, duration=2.0))
    assert finding.evidence["delay"] == pytest.approx(0.03, abs=1e-6)
    assert (finding.severity == "warning") is is_late


def test_the_delay_of_a_joint_is_compared_with_none_if_the_others_have_friction_by_load():
    squares = np.tile(1 - 0.5 * (1 - (_GRID / 0.03 - 1) ** 2), (3, 8, 1))
    others = _Misfit(squares, np.ones(3), ("a", "b", "c"))
    assert others.own_delay(0, 0.01).common == pytest.approx(0.03, abs=1e-6)
    assert replace(others, loaded=0.3 * squares).own_delay(0, 0.01).common == 0.0


@pytest.mark.parametrize(("share", "is_late"), [(0.05, False), (0.2, True)])
def test_the_delay_of_one_joint_that_friction_by_load_explains_better_is_none(share, is_late):
    """The delay of 30 ms leaves a tenth of its torque, friction by load a share of it."""
    late = 1 - 0.9 * (1 - (_GRID / 0.03 - 1) ** 2)
    squares = np.tile(1 + 100 * _GRID**2, (3, 8, 1))
    squares[1] = late
    loaded = squares.copy()
    loaded[1] *= share
    own = _Misfit(squares, np.ones(3), ("a", "b", "c"), loaded).own_delay(1, 0.01)
    assert own.explained == pytest.approx(0.9, abs=1e-4)
    assert own.is_significant is is_late


def test_a_motion_is_read_where_it_moves_in_pieces_of_one_segment(ur5, monkeypatch):
    monkeypatch.setattr(torque_delay, "_ROWS", 40)
    monkeypatch.setattr(torque_delay, "_WINDOWS", 4)
    v = np.zeros((200, 6))
    motion = SimpleNamespace(v=v, segment=np.repeat([0, 1], [70, 130]))
    assert torque_delay._segments(ur5, motion, 2) == []
    v[60:75, 4] = 0.021
    parts = torque_delay._segments(ur5, motion, 2)
    assert [(part[0], part[-1]) for part in parts] == [(60, 69), (70, 74)]
    v[160:181, 1] = -0.021  # four pieces of twenty rows from 60 to 180
    parts = torque_delay._segments(ur5, motion, 2)
    assert [(part[0], part[-1]) for part in parts] == [
        (60, 69), (70, 79), (93, 112), (127, 146), (161, 180),
    ]  # fmt: skip
    v[:199] = 0.0
    v[199, 0] = 1.0
    (part,) = torque_delay._segments(ur5, motion, 2)
    assert part.tolist() == [199]


def test_values_of_one_instant_are_not_interpolated():
    t, at = np.array([3.0]), np.zeros((81, 5))
    assert torque_delay._interpolated(t, np.ones((1, 2)), at).shape == (81, 5, 2)
    t = 3.0 + np.arange(6) / 10
    found = torque_delay._interpolated(t, np.column_stack([t, 2.0 - t]), np.array([[3.05], [3.41]]))
    np.testing.assert_allclose(found, [[[3.05, -1.05]], [[3.41, -1.41]]])


def test_a_delay_has_the_error_of_the_fit_and_of_samples_that_are_held():
    """A tenth of a sample, at least 1 ms."""
    common = {"error": lambda: 0.003, "gain": lambda: 0.4, "is_of_load": False}
    for delay, step, error, words in (
        (0.012, 0.02, np.hypot(3.0, 2.0), "lags the position by 12.0 +- 3.6 ms"),
        (-0.02, 0.002, np.hypot(3.0, 1.0), "leads the position by 20.0 +- 3.2 ms"),
    ):
        misfit = SimpleNamespace(delay=lambda delay=delay: delay, **common)
        (finding,) = _common(misfit, step, SignalSettings(torque_delay=0.001), "run.csv")
        assert f"the torque {words}. The delay explains 40 % of the torque" in finding.message
        assert f"torque_delay = {delay + 0.001:.4f}" in finding.message
        assert finding.evidence["std_error"] == pytest.approx(1e-3 * error)
