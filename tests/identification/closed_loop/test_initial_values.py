"""Where a fit begins: typical sizes, first loops and unknowns, by their equations."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pinocchio as pin
import pytest
from helpers.paths import URDF

from robotid.data.log import Log
from robotid.dynamics.prediction import predict_instants
from robotid.dynamics.simulation.loops import ClosedLoopRobot, cut_windows
from robotid.estimation.fitting.estimator_settings import SimulationSettings
from robotid.identification.closed_loop import initial_values as second_order
from robotid.identification.closed_loop import stages as fit
from robotid.identification.closed_loop.encoder_zeros import _Motion, same_encoders
from robotid.identification.closed_loop.initial_values import (
    _FREQUENCIES,
    SecondOrder,
    _better,
    first_loops,
    free_drive_parameters,
    free_zeros,
    is_stated,
    likeness,
    typical_sizes,
    typical_sizes_of_torques,
)
from robotid.identification.closed_loop.loop_settings import LoopSettings
from robotid.identification.closed_loop.stages import stated_loops
from robotid.robot.model import RobotModel

T = 3.0 + np.arange(400) / 200.0


@pytest.fixture(scope="module")
def planar():
    return RobotModel.from_urdf(URDF / "planar_2r.urdf")


def plain_model(
    model, armature, kp, kd=(1.0, 1.0), values=(0.4, 0.3, 0.1, 0.8, 0.6, -0.2), error=0.0
):
    """Return plain loops of two joints: viscous, Coulomb friction and offset of each."""
    loops = replace(
        stated_loops(model, LoopSettings()), armature=np.array(armature), kp=np.array(kp),
        kd=np.array(kd), values=np.array(values), delay=np.array([0.01, 0.02]),
    )  # fmt: skip
    return SecondOrder(None, np.zeros(0), loops, np.array([3.0, 5.0]), error)


@pytest.fixture(scope="module")
def logged(planar):
    """Two windows of a motion whose speeds are known, the errors largest in the second."""
    q = np.column_stack([0.5 * np.sin(6 * T), 0.7 * np.cos(4 * T)])
    q_ref = q + np.column_stack([0.02 * np.sin(T), -0.05 * (T - 3.0)])
    return cut_windows(Log(T, q, 7.0 * q, planar.joints, q_ref=q_ref), 1.0, 0.0)


def inertia_of(model, windows):
    """Return the median of the diagonal of Pinocchio's mass matrices, of every eighth pose."""
    q, data = np.concatenate([w.log.q[w.counted] for w in windows]), model.pin_model.createData()
    return np.median([np.diag(pin.crba(model.pin_model, data, x)) for x in q[::8]], axis=0)


def test_usual_sizes_are_measured_by_known_gains_or_by_the_bodies(planar, logged):
    bodies = inertia_of(planar, logged)
    plain = plain_model(planar, [3 * bodies[0], 0.4], [60.0, 1.0])
    found = typical_sizes(
        SimpleNamespace(model=planar), plain, logged, np.array([True, False]), np.array([2.0, 0.0]),
        planar.joints,
    )  # fmt: skip
    np.testing.assert_allclose(found.bodies, bodies)
    # of the second no gain is known: twice its bodies' inertia, or 0.3 of the first's, measures
    scale = np.array([1.0, 2 * max(bodies[1], 0.3 * bodies[0]) / 0.4])
    np.testing.assert_allclose(found.scale, scale)
    np.testing.assert_allclose(found.inertia, np.maximum([3 * bodies[0], 0.4 * scale[1]], bodies))
    np.testing.assert_allclose(found.torque, scale * [3.0, 5.0])
    error = np.abs(np.concatenate([w.log.q_ref[w.counted] - w.log.q[w.counted] for w in logged]))
    asked = 0.8 * np.array([60.0, 1.0]) * error.max(axis=0)
    taken = 0.4 * 2.0 + 0.3  # by friction at the largest speed of the first
    assert asked[0] < taken
    np.testing.assert_allclose(found.largest, scale * asked)
    quick = replace(plain, loops=replace(plain.loops, kp=np.array([600.0, 1.0])))
    own = typical_sizes(
        SimpleNamespace(model=planar), quick, logged, np.array([True, False]), np.array([2.0, 0.0]),
        planar.joints,
    )  # fmt: skip
    np.testing.assert_allclose(own.largest, scale * [taken, asked[1]])
    v = np.column_stack([3.0 * np.cos(6 * T), -2.8 * np.sin(4 * T)])
    np.testing.assert_allclose(found.speed, np.sqrt(np.mean(v**2, axis=0)), rtol=2e-3)


def test_usual_sizes_of_torques_are_those_of_rows_and_motors(planar, logged):
    pi = planar.standard_parameters()
    names = planar.layout.names
    armature = np.array([0.3, 0.7])
    for joint, x in zip(planar.joints, armature, strict=True):
        pi[names.index(f"{joint}.armature")] = x
    found = typical_sizes_of_torques(planar, pi, armature, logged)
    bodies = inertia_of(planar, logged)
    np.testing.assert_allclose(found.bodies, bodies)
    np.testing.assert_allclose(found.inertia, bodies + armature)
    q = np.concatenate([w.log.q[w.counted] for w in logged])
    np.testing.assert_allclose(found.torque, 7.0 * np.sqrt(np.mean(q**2, axis=0)))
    np.testing.assert_array_equal(found.largest, np.inf)
    np.testing.assert_array_equal(found.scale, 1.0)


def test_first_loops_and_unknowns_begin_with_usual_sizes(planar, logged):
    bodies = inertia_of(planar, logged)
    plain = plain_model(planar, [3 * bodies[0], 0.4], [60.0, 1.0])
    usual = typical_sizes(
        SimpleNamespace(model=planar), plain, logged, np.array([True, False]), np.zeros(2),
        ["both", "both"],
    )  # fmt: skip
    loop = LoopSettings(kp={planar.joints[0]: 60.0}, delays="one")
    stated = stated_loops(planar, loop)
    first = first_loops(planar, stated, plain, usual, np.array([False, True]))
    s = usual.scale[1]
    np.testing.assert_allclose(first.kp, [60.0, s])
    wanted = np.maximum(usual.inertia - bodies, 0.05 * usual.inertia)
    np.testing.assert_allclose(first.armature, wanted)
    np.testing.assert_array_equal(first.delay, [0.01, 0.02])
    np.testing.assert_array_equal(first.limit, [np.inf, usual.largest[1]])
    by_name = [
        {t.name: first.values[first.place(j, t)] for t in own} for j, own in enumerate(first.terms)
    ]
    assert by_name == [
        {"viscous": 0.4, "coulomb": 0.3, "offset": 0.0},
        {"viscous": pytest.approx(0.8 * s), "coulomb": pytest.approx(0.6 * s), "offset": 0.0},
    ]
    found = free_drive_parameters(
        planar, loop, ["both", "both"], first, usual, finds_kd=True,
        finds_limit=np.array([False, True]),
    )  # fmt: skip
    a, b = planar.joints
    table = {u.name: (u.joints, u.prior, u.spread, u.lowest) for u in found}
    torque, speed = usual.torque, usual.speed
    wanted = {
        "both.armature": ((0, 1), np.median(first.armature), 10 * np.median(usual.inertia), 0.0),
        "both.kp": ((1,), s, s, 0.05 * s),
        "both.kd": ((0, 1), 0.0, 10 * np.median(torque / speed), 0.0),
        f"{b}.limit": ((1,), usual.largest[1], 10 * torque[1], 0.05 * usual.largest[1]),
        "robot.delay": ((0, 1), 0.015, 0.1, 0.0),
        "both.viscous": ((0, 1), np.median([0.4, 0.8 * s]), 10 * np.median(torque / speed), 0.0),
        f"{a}.coulomb": ((0,), 0.3, 10 * torque[0], 0.0),
        f"{b}.coulomb": ((1,), 0.6 * s, 10 * torque[1], 0.0),
        f"{a}.offset": ((0,), 0.0, 10 * torque[0], -np.inf),
        f"{b}.offset": ((1,), 0.0, 10 * torque[1], -np.inf),
    }
    assert set(table) == set(wanted)
    for name, (joints, *figures) in wanted.items():
        assert table[name][0] == joints, name
        assert table[name][1:] == pytest.approx(tuple(figures)), name
    bare = free_drive_parameters(
        planar, LoopSettings(kp=1.0, kd=1.0, delay=0.0), ["a", "b"], first, usual, finds_kd=False,
        finds_limit=np.zeros(2, dtype=bool),
    )  # fmt: skip
    kinds = {u.what for u in bare}
    assert kinds == {"armature", "term"}


def test_joints_of_a_group_have_the_scale_of_those_that_show_their_inertia(planar, logged):
    """Friction over the gain stays that of the second-order model, for both joints."""
    bodies = inertia_of(planar, logged)
    measure = 2 * np.maximum(bodies, 0.3 * bodies.max())
    none = np.zeros(2, dtype=bool)

    def sizes(plain, groups, has_gain=none):
        robot = SimpleNamespace(model=planar)
        return typical_sizes(robot, plain, logged, has_gain, np.zeros(2), groups)

    hidden, shown = 1e-5, 0.02  # of 1 / 96**2 = 1.09e-4 and 1 / 6**2 = 0.028
    plain = plain_model(planar, [hidden, shown], [1.0, 1.0], error=np.array([2e-5, 5e-3]))
    for groups, scale in (
        (["both", "both"], [measure[1] / shown] * 2),
        (planar.joints, [measure[0] * 96**2, measure[1] / shown]),
    ):
        found = sizes(plain, groups)
        np.testing.assert_allclose(found.scale, scale)
        np.testing.assert_allclose(found.torque, np.array(scale) * [3.0, 5.0])
        wanted = np.maximum(np.array([1 / 96**2, shown]) * scale, bodies)
        np.testing.assert_allclose(found.inertia, wanted)
        first = first_loops(planar, stated_loops(planar, LoopSettings()), plain, found, none)
        friction = first.values.reshape(2, -1)[:, :2] / first.kp[:, None]
        np.testing.assert_allclose(friction, [[0.4, 0.3], [0.8, 0.6]])
    # neither shows its inertia: the median of both
    plain = plain_model(planar, [1e-9, 1e-9], [1.0, 1.0], error=np.array([2e-4, 1.0]))
    possible = [2e-4, 1 / 6**2]  # the standard error, at most the slowest loop that is tried
    scale = sizes(plain, ["a", "a"]).scale
    np.testing.assert_allclose(scale, np.mean(measure / possible))
    scale = sizes(plain, ["a", "a"], np.array([True, False])).scale
    np.testing.assert_allclose(scale, [1.0, measure[1] / possible[1]])


def test_a_joint_follows_as_slowly_as_its_damping_or_its_swing(planar):
    plain = plain_model(planar, [0.5, 8.0], [50.0, 2.0], kd=(4.6, 0.2))
    # (4.6 + 0.4) / 50 = 0.1 and sqrt(0.5 / 50) = 0.1; (0.2 + 0.8) / 2 and sqrt(8 / 2)
    np.testing.assert_allclose(plain.time_constant, [0.1, 2.0])
    damped = plain_model(planar, [0.125, 0.02], [50.0, 2.0], kd=(4.6, 0.2))
    np.testing.assert_allclose(damped.time_constant, [0.1, 0.5])


def test_joints_are_alike_whose_limits_mass_and_moments_are():
    base = np.array([2.0, 0.1, 0.2, 0.3, 0.5, 0.01, 0.6, 0.02, 0.03, 0.7])

    def of(body=None, **limit):
        own = {"type": "revolute", "effort": 5.0, "velocity": 2.0} | limit
        return (base if body is None else body), SimpleNamespace(**own)

    def changed(k, factor):
        body = base.copy()
        body[k] *= factor
        return of(body)

    same = [
        of(),
        *(changed(k, 3.0) for k in (1, 2, 3, 5, 7, 8)),
        changed(0, 1.01),
        of(effort=5.0001),
    ]
    others = [changed(k, 1.3) for k in (0, 4, 6, 9)]
    others += [of(type="prismatic"), of(effort=6.0), of(velocity=2.1)]
    every = [*same, *others]
    model = SimpleNamespace(
        standard_parameters=lambda: np.concatenate([body for body, _ in every]),
        layout=SimpleNamespace(n_inertial=10 * len(every)),
        limits=[limit for _, limit in every],
    )
    found = likeness(model)
    assert set(found[: len(same)]) == {found[0]}
    assert len(set(found)) == 1 + len(others)


def test_a_number_states_all_joints_and_a_table_those_it_names(planar):
    a, b = planar.joints
    for value, wanted in ((3.0, [1, 1]), (None, [0, 0]), ({b: 1.0}, [0, 1]), ({a: 0.0}, [1, 0])):
        assert is_stated(value, planar).tolist() == [bool(x) for x in wanted]


def test_zeros_other_than_the_urdfs_are_free_about_their_first_estimates(planar):
    """With a standard deviation of 0.3 rad; a sign alone has a gain, too."""
    first = replace(same_encoders(planar), zero=np.array([0.4, -0.2]), gain=np.array([0.0, 0.7]))
    (found,) = free_zeros(planar, first)
    assert (found.name, found.what, found.joints) == (f"{planar.joints[1]}.zero", "zero", (1,))
    assert (found.prior, found.spread, found.lowest) == (-0.2, 0.3, -np.inf)
    both = free_zeros(planar, replace(first, gain=np.array([0.1, 0.7])))
    assert [(x.joints, x.prior) for x in both] == [((0,), 0.4), ((1,), -0.2)]


def test_a_load_that_would_push_a_loop_the_wrong_way_does_not_count(rng):
    model = RobotModel.from_urdf(URDF / "planar_2r.urdf", gravity=(0.0, -9.81, 0.0))
    q, v, a = rng.uniform(-1.0, 1.0, (3, 60, 2))
    sign, zero = np.array([-1.0, 1.0]), np.array([0.3, -0.4])
    torque = predict_instants(
        model, model.standard_parameters(), sign * q + zero, sign * v, sign * a
    )
    sense, noise = np.tanh(v), 1e-3 * rng.standard_normal((60, 2))
    gives = sign * torque * [0.02, 0.05] + 0.1 * v - 0.2 * a + 0.3 * sense + 0.7 + noise
    for way, counts in (([1.0, 1.0], [1, 1]), ([1.0, -1.0], [1, 0]), ([-1.0, 1.0], [0, 1])):
        error = gives - (1.0 - np.array(way)) * sign * torque * [0.02, 0.05]
        motion = _Motion(q, v, a, error, sense)
        left, without = motion.left(model, sign, zero), motion.without
        for j in range(2):
            X = np.column_stack([np.ones(60), v[:, j], sense[:, j], a[:, j]])
            bare = np.linalg.lstsq(X, error[:, j], rcond=None)[1][0]
            X = np.column_stack([X, torque[:, j]])
            best = np.linalg.lstsq(X, error[:, j], rcond=None)[1][0]
            assert without[j] == pytest.approx(bare)
            assert left[j] == pytest.approx(best if counts[j] else bare)
            assert best < 0.5 * bare
        cost = motion.cost(model, sign, zero)
        assert cost == pytest.approx(60 * np.log(left).sum())


def test_each_joint_has_all_of_the_trial_that_suits_it_best(planar, logged):
    """Positions of a trial that are 0.1 off at one joint and 0.3 at the other, against 0.2."""
    first, second = (
        plain_model(planar, [x, x + 1], [1.0, 1.0], values=x + np.arange(6.0)).loops
        for x in (10.0, 20.0)
    )
    second = replace(second, delay=np.array([0.03, 0.04]))
    n = sum(len(w.log.q[w.counted]) for w in logged)
    for j, missed in enumerate(([0.1, 0.3], [0.3, 0.1])):
        outs = [SimpleNamespace(window=w, q=w.log.q[w.counted] + missed) for w in logged]
        robot = SimpleNamespace(roll_out=lambda trial, windows, outs=outs: outs)
        cost, found = _better(robot, logged, second, np.full(2, n * 0.2**2), first)
        better = np.arange(2) == j
        np.testing.assert_allclose(cost, n * np.where(better, 0.1, 0.2) ** 2)
        for name in ("armature", "delay"):
            wanted = np.where(better, getattr(second, name), getattr(first, name))
            np.testing.assert_array_equal(getattr(found, name), wanted)
        own = np.r_[second.values[:3], first.values[3:]], np.r_[first.values[:3], second.values[3:]]
        np.testing.assert_array_equal(found.values, own[j])


def test_inertia_and_time_constant_of_a_second_order_model_are_those_of_each_joint(planar):
    """Of damping 0.7 / 50 or oscillation; an inertia below a thousandth of the fastest is not."""
    plain = plain_model(planar, [0.2, 1e-9], [50.0, 80.0], kd=[0.3, 4.0])
    fastest = 80.0 / _FREQUENCIES[-1] ** 2
    np.testing.assert_allclose(plain.inertia, [0.2, fastest])
    np.testing.assert_allclose(plain.time_constant, [np.sqrt(0.2 / 50), (4.0 + 0.8) / 80])
    found = [plain.friction(name).tolist() for name in ("viscous", "coulomb", "offset")]
    assert found == [[0.4, 0.8], [0.3, 0.6], [0.1, -0.2]]


@pytest.mark.parametrize("speeds", [(True, True), (True, False)])
def test_whitening_and_free_gains_are_those_of_all_logs(planar, monkeypatch, speeds):
    """Logs of 200 and 125 Hz: the longer step counts; kd is free if all logs have speeds."""
    logs = []
    for rate, has_speed in zip((200.0, 125.0), speeds, strict=True):
        t = 3.0 + np.arange(300) / rate
        q = np.column_stack([0.5 * np.sin(6 * t), 0.7 * np.cos(4 * t)])
        logs.append(Log(t, q, 0 * q, planar.joints, q_ref=q + 0.01, has_torque=False,
                        v_ref=0 * q if has_speed else None))  # fmt: skip
    plain = plain_model(planar, [0.2, 0.1], [50.0, 80.0], kd=[0.3, 4.0])
    seen = []
    monkeypatch.setattr(fit, "fit_second_order", lambda *x, **how: seen.append((x, how)) or plain)
    loop, asked = LoopSettings(delay=0.01), SimulationSettings(window=0.5, lead=0.1, bodies=0.0)
    stages = []
    found = fit._initialise_from_commands(
        planar, logs, loop, asked, None, lambda *call: stages.append(call)
    )
    assert stages == [
        (name, fit.STAGES.index(name), len(fit.STAGES), "stages")
        for name in ("trying second-order models", "fitting loops")
    ]
    most = np.exp(-2.0 * 0.008 / plain.time_constant)
    np.testing.assert_allclose(found.estimator.most, np.tile(most, 3))
    names = found.simulator.names
    assert any(name.endswith(".kd") for name in names) == all(speeds)
    assert any(name.endswith(".kp") for name in names)
    assert not any(name.endswith(".delay") for name in names)  # stated
    [(given, how)] = seen
    assert how == {"finds_delay": False, "finds_limit": False}
    np.testing.assert_allclose(given[2].delay, 0.01)
    lengths = {round(float(w.log.t[w.stop - 1] - w.log.t[w.first]), 1) for w in given[1]}
    assert max(lengths) == 0.5
    assert {id(w.log) for w in given[1]} == {id(w.log) for w in found.simulator.windows}
    assert len({id(w.log) for w in given[1]}) == 2


def test_a_fit_by_torques_starts_with_their_rows_and_says_so(planar, monkeypatch):
    stages, pi = [], planar.standard_parameters()
    pi[planar.layout.n_inertial :] = 0.25
    q = np.column_stack([0.5 * np.sin(6 * T), 0.7 * np.cos(4 * T)])
    log = Log(T, q, 7.0 * q, planar.joints)
    rows = SimpleNamespace(standard=pi)
    monkeypatch.setattr(fit, "identified_rows", lambda *_: rows)
    found = fit._initialise_from_torque(
        planar, [log], LoopSettings(kind="torque"), SimulationSettings(torques=False, bodies=0.0),
        None, lambda *call: stages.append(call),
    )  # fmt: skip
    assert stages == [
        (name, fit.STAGES.index(name), len(fit.STAGES), "stages")
        for name in ("fitting torques", "fitting loops")
    ]
    assert found.linear is rows
    assert found.plain is None
    np.testing.assert_allclose(
        found.torque, 7.0 * np.sqrt(np.mean(q[:400] ** 2, axis=0)), rtol=0.02
    )
    free = {x.name: x.prior for x in found.simulator.free_parameters}
    names = {n.rsplit(".", 1)[1] for n in planar.layout.names[planar.layout.n_inertial :]}
    assert {name.rsplit(".", 1)[1] for name in free} == names
    assert set(free.values()) == {0.25}


@pytest.mark.parametrize(("count", "finds_delay"), [(50, True), (30, False)])
def test_a_second_order_model_is_of_some_windows_and_all_position_errors(
    planar, monkeypatch, rng, count, finds_delay
):
    """Eight windows for the coarse search, every third of 50 and all of 30 for the fit."""
    windows = tuple(
        SimpleNamespace(log=SimpleNamespace(q=q, q_ref=q_ref), counted=slice(2, 9))
        for q, q_ref in rng.standard_normal((count, 2, 10, 2))
    )
    stated = replace(
        stated_loops(planar, LoopSettings()), kp=np.array([50.0, 8.0]), kd=np.array([0.3, 0.1]),
        zero=np.array([0.1, 0.2]), limit=np.array([3.0, 4.0]), delay=np.array([0.01, 0.02]),
    )  # fmt: skip
    coarse, fitted = [], []
    start = replace(
        plain_model(planar, [0.2, 0.4], [50.0, 8.0]).loops,
        terms=(second_order._TERMS,) * 2, values=np.arange(6.0),
    )  # fmt: skip

    class Estimator:
        def __init__(self, *, whitens, steps):
            assert (whitens, steps) == (False, 12)

        def fit(self, simulator):
            fitted.append(simulator)
            k = len(simulator.free_parameters)
            return SimpleNamespace(theta=simulator.prior, std_error=np.arange(k) + 1.0)

    monkeypatch.setattr(second_order, "_coarse", lambda *given: coarse.append(given) or start)
    monkeypatch.setattr(second_order, "OutputError", Estimator)
    found = second_order.fit_second_order(
        ClosedLoopRobot(planar), windows, stated, finds_delay=finds_delay
    )
    ((_, tried, bare, torque, _, [limit]),) = coarse
    np.testing.assert_array_equal(limit, np.inf)
    assert tried == windows[:8]
    assert fitted[0].windows == (windows[::3] if count == 50 else windows)
    error = np.concatenate([(w.log.q_ref - w.log.q)[2:9] for w in windows])
    np.testing.assert_allclose(torque, [50.0, 8.0] * np.sqrt(np.mean(error**2, axis=0)))
    np.testing.assert_array_equal(found.torque, torque)
    for zero in (bare.bodies, bare.zero, bare.values):
        np.testing.assert_array_equal(zero, 0.0)
    np.testing.assert_array_equal(bare.limit, np.inf)
    np.testing.assert_array_equal(
        [bare.kp, bare.kd, bare.delay], [stated.kp, stated.kd, stated.delay]
    )
    a, b = planar.joints
    wanted = {f"{a}.armature": (0.2, 2.0, 0.2e-6), f"{b}.armature": (0.4, 4.0, 0.4e-6)}
    for j, joint in enumerate((a, b)):
        for k, term in enumerate(("viscous", "coulomb", "offset")):
            spread = 100.0 * torque[j] * (10.0 if k == 0 else 1.0)
            wanted[f"{joint}.{term}"] = (3.0 * j + k, spread, -np.inf if k == 2 else 0.0)
        if finds_delay:
            wanted[f"{joint}.delay"] = (start.delay[j], 0.1, 0.0)
    free = {x.name: (x.prior, x.spread, x.lowest) for x in fitted[0].free_parameters}
    assert free == {name: pytest.approx(x) for name, x in wanted.items()}
    np.testing.assert_array_equal(found.inertia_error, [1.0, 6.0 if finds_delay else 5.0])


def test_tried_loops_have_a_damping_to_which_the_stated_gain_contributes(planar, monkeypatch):
    kp, kd, torque = np.array([100.0, 40.0]), np.array([2.0, 30.0]), np.array([3.0, 0.5])
    bare = stated_loops(planar, LoopSettings())
    bare = replace(bare, kp=kp, kd=kd, delay=np.array([0.01, 0.02]))
    tried = []
    monkeypatch.setattr(
        second_order, "_better",
        lambda robot, windows, trial, best, found: tried.append(trial) or (np.zeros(2), trial),
    )  # fmt: skip
    second_order._coarse(None, (), bare, torque, False, [bare.limit])
    wanted = iter([(w, z, f) for w in _FREQUENCIES for z in (0.5, 1.5) for f in (0.05, 0.5)])
    for trial, (w, z, f) in zip(tried, wanted, strict=True):
        viscous, coulomb, offset = trial.values.reshape(2, 3).T
        np.testing.assert_allclose(trial.armature * w**2, kp)
        np.testing.assert_allclose(kd + viscous, np.maximum(2 * z * kp / w, kd))
        np.testing.assert_allclose(coulomb, f * torque)
        np.testing.assert_array_equal([offset, trial.delay], [[0.0, 0.0], bare.delay])
