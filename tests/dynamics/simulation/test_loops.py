import re
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pinocchio as pin
import pytest
from helpers.mujoco_plant import LEG
from helpers.single_joint import slider
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from robotid.base.exceptions import DataError, NotConvergedError, SettingsError
from robotid.data.log import Log
from robotid.dynamics.simulation.loops import (
    ClosedLoopRobot,
    Window,
    cut_windows,
    open_loops,
    why_no_solution,
)
from robotid.robot import drives
from robotid.robot.drives import Coulomb, LoadFriction, Viscous
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel
from robotid.robot.parameters import Coupling

RATE = 500.0  # [Hz]
LEGS = (*LEG, *(name.replace("FL", "FR") for name in LEG))
PLAIN = (Viscous(), Coulomb(), drives.Offset())
#: Every term that a roll-out has, the load of the gear last.
TERMS = (
    *PLAIN, *(drives.PositionCoulomb(order=order, centre=0.1) for order in (1, 2)),
    drives.Stribeck(speed=0.2), drives.Asymmetric(), drives.Cubic(), drives.Tanh(speed=0.3),
    drives.Harmonic(order=3), drives.Harmonic(order=2, is_sine=True), drives.Power(exponent=1.3),
    drives.Ramp(low=0.1, high=0.9), drives.Spring(), drives.Hat(at=0.1, before=-0.3, after=0.4),
    drives.Counterbalance(arm=0.5, base=1.2, angle=0.2, rest=0.3), LoadFriction(),
)  # fmt: skip
VALUES = (
    0.1, 0.2, 0.05, 0.1, 0.15, 0.08, 0.03, 0.002, 0.1, 0.04, 0.03, 0.05, 0.1, 0.2, 0.1, 0.2, 0.1,
)  # fmt: skip
#: Terms with a memory, among others.
LASTING = (
    Viscous(), Coulomb(), drives.Presliding(displacement=0.01),
    drives.LuGre(displacement=0.02, speed=0.3, excess=0.5), LoadFriction(),
)  # fmt: skip


@pytest.fixture(scope="module")
def legs():
    """Two legs, which the trunk alone joins."""
    return RobotModel.from_urdf(example_urdf("go2.urdf"), joints=list(LEGS))


def loops_of(model, terms=PLAIN, values=VALUES, *, kp=20.0, **changes):
    n, bare = len(model.joints), open_loops(model, model.standard_parameters())
    found = replace(
        bare, armature=np.linspace(0.01, 0.02, n), kp=np.full(n, kp), kd=np.full(n, 0.06 * kp),
        zero=np.linspace(0.05, -0.05, n), terms=(tuple(terms),) * n,
        values=np.tile(values[: len(terms)], n),
    )  # fmt: skip
    return replace(found, **changes)


def commanded(model, duration=0.4, reach=0.3, seed=0, t=None):
    """Return a log that begins at rest away from its command, and told positions and speeds."""
    rng, n = np.random.default_rng(seed), len(model.joints)
    t = np.arange(round(duration * RATE)) / RATE if t is None else t
    w, phase = 2 * np.pi * rng.uniform(1.5, 3.0, n), rng.uniform(0, 2 * np.pi, n)
    q_ref = reach * np.sin(w * t[:, None] + phase)
    v_ref = 0.3 * reach * w * np.cos(w * t[:, None] + phase)
    q = np.tile(q_ref[0] + 0.05, (len(t), 1))
    commands = {"q_ref": q_ref, "v_ref": v_ref, "tau_ref": 0.2 * v_ref}
    return Log(t, q, 0 * q, model.joints, has_torque=False, **commands)


def rolled(model, loops, log, step=2e-3):
    [out] = ClosedLoopRobot(model, step=step).roll_out(loops, cut_windows(log, np.inf, 0.0))
    return out


def integrated(model, loops, log, friction, share=0.0):
    """Return positions by a stiff integration of Pinocchio's dynamics, command by command."""
    # Gears lose a share of the torque that they pass on to the bodies.
    engine, n = model.pin_model, len(model.joints)
    data, lower, diagonal = engine.createData(), np.tril_indices(n, -1), np.diag_indices(n)

    def change(_, y, k):
        q, v = y[:n] + loops.zero, y[n:]
        M = pin.crba(engine, data, q)
        M[lower] = M.T[lower]
        M[diagonal] += loops.armature
        torque = loops.kp * (log.q_ref[k] - y[:n]) + loops.kd * (log.v_ref[k] - v) + log.tau_ref[k]
        torque = np.clip(torque, -loops.limit, loops.limit)
        h = pin.nonLinearEffects(engine, data, q, v)
        free = torque - h - friction(y[:n], v)
        inverse, s = np.linalg.inv(M), v / np.sqrt(v * v + 1e-8)
        a = inverse @ free
        for _ in range(12 if share else 0):
            load = M @ a - loops.armature * a + h
            a = inverse @ (free - share * s * np.abs(load))
        return np.concatenate([v, a])

    y, found = np.concatenate([log.q[0], np.zeros(n)]), [log.q[0]]
    for k in range(len(log.t) - 1):
        span = (log.t[k], log.t[k + 1])
        y = solve_ivp(change, span, y, "LSODA", rtol=1e-7, atol=1e-9, args=(k,)).y[:, -1]
        found.append(y[:n])
    return np.array(found)


def test_an_arm_moves_as_a_stiff_integration_of_pinocchio_says(ur5):
    log = commanded(ur5, 0.16)
    terms = (*PLAIN, drives.PositionCoulomb(order=2, centre=0.1), drives.Stribeck(speed=0.2))
    loops = loops_of(ur5, terms, (2.0, 3.0, 0.5, 4.0, 1.0), kp=500.0, limit=np.full(6, 60.0))

    def friction(q, v):
        root = np.sqrt(v * v + 1e-8)
        s = v / root
        hook = np.exp(-(root - 1e-4) / 0.2)
        return 2.0 * v + (3.0 + 4.0 * (q - 0.1) ** 2 + 1.0 * hook) * s + 0.5

    exact = integrated(ur5, loops, log, friction)
    told = loops.kp * (log.q_ref - exact)
    assert (np.abs(told) > 60.0).any(), "the limit acts"
    steps = (2e-3, 1e-3, 5e-4)
    errors = [np.abs(rolled(ur5, loops, log, step).q - exact).max() for step in steps]
    assert np.ptp(exact, axis=0).min() > 0.05
    assert errors[1] < 3e-4
    assert errors[2] < 0.7 * errors[1] < 0.7**2 * errors[0]


def test_steps_that_are_solved_once_more_are_exact_to_second_order(planar):
    loops = replace(loops_of(planar, kp=200.0), values=np.zeros(2 * len(VALUES)))
    loops = replace(loops, armature=np.full(2, 0.1), kd=np.full(2, 10.0))
    log = commanded(planar, reach=1.0)
    window = [Window(log, 0, 0, len(log.t))]

    def moved(step, corrects):
        return ClosedLoopRobot(planar, step=step, corrects=corrects).roll_out(loops, window)[0].q

    exact = moved(1e-5, True)
    wrong = {c: [np.abs(moved(h, c) - exact).max() for h in (1e-3, 5e-4)] for c in (True, False)}
    assert wrong[True][0] / wrong[True][1] == pytest.approx(4.0, rel=0.1)
    assert wrong[True][1] < 0.5 * wrong[False][1]


def test_a_gear_loses_a_share_of_its_load(planar):
    log = commanded(planar, 0.1, reach=0.8)
    loops = loops_of(planar, (Viscous(), LoadFriction()), (2.0, 0.2), kp=300.0)
    exact = integrated(planar, loops, log, lambda q, v: 2.0 * v, share=0.2)
    without = integrated(planar, loops, log, lambda q, v: 2.0 * v)
    error = np.abs(rolled(planar, loops, log, 2.5e-4).q - exact).max()
    assert error < 2e-3 * np.abs(exact - without).max() + 1e-4
    assert np.abs(exact - without).max() > 5e-3


@pytest.mark.parametrize(
    "term",
    [drives.Presliding(displacement=0.01), drives.LuGre(displacement=0.01, speed=0.2, excess=0.6)],
)
@pytest.mark.parametrize("rate", [None, 100.0])
def test_friction_is_taken_up_as_its_equation_says(tmp_path, term, rate):
    """A body on a rail that sticks, gives way and slips, beside a stiff integration."""
    model, t = slider(tmp_path), np.arange(130) / RATE
    log = Log(
        t, np.zeros((130, 1)), np.zeros((130, 1)), ("j",),
        q_ref=np.where(t < 0.1, 0.02, 0.15 * np.sin(12 * t))[:, None],
    )  # fmt: skip
    rail = loops_of(
        model, (Viscous(), term), (5.0, 8.0), kp=300.0, kd=np.array([8.0]),
        armature=np.array([0.5]), zero=np.zeros(1), rate=rate,
    )  # fmt: skip

    def change(_, y, r, seen):
        q, v, z = y
        at, speed = (q, v) if seen is None else seen
        g = float(term.level(np.array(v)))
        force = 300.0 * (r - at) - 8.0 * speed - 5.0 * v - 8.0 * z
        return [v, force / 2.5, (v - abs(v) * z / g) / term.displacement]

    z = -float(term.level(np.array(-0.3))) * 0.3 / np.hypot(0.3, term.displacement / 0.1)
    y, exact = np.array([0.0, -0.3, z]), []
    seen = None
    for k in range(130):
        exact.append(y[0])
        if rate is not None and k % 5 == 0:
            seen, told = y[:2], log.q_ref[k, 0]
        r = log.q_ref[k, 0] if rate is None else told
        span, limits = (0.0, 1 / RATE), {"rtol": 1e-10, "atol": 1e-12}
        y = solve_ivp(change, span, y, "Radau", args=(r, seen), **limits).y[:, -1]
    window = Window(log, 0, 0, 130, given=np.array([[0.0], [-0.3]]))
    errors = [
        np.abs(ClosedLoopRobot(model, step=step).roll_out(rail, [window])[0].q[:, 0] - exact).max()
        for step in (1e-3, 2.5e-4)
    ]
    assert errors[1] < 2e-6
    assert errors[1] < errors[0] / 3
    without = replace(rail, terms=((Viscous(), Coulomb()),))
    [out] = ClosedLoopRobot(model, step=2.5e-4).roll_out(without, [window])
    assert np.abs(out.q[:, 0] - exact).max() > 1e-3


def differences(robot, loops, windows, change, h):
    """Return the derivative of positions and speeds by central differences of fourth order."""

    def motion(x):
        [out] = robot.roll_out(change(loops, x), windows)
        return np.stack([out.q, out.v])

    near, far = ([motion(s * x) for s in (1, -1)] for x in (h, 2 * h))
    return (8 * (near[0] - near[1]) - (far[0] - far[1])) / (12 * h)


@pytest.mark.parametrize(
    ("name", "rate", "terms"),
    [("ur5", None, TERMS), ("legs", None, TERMS), ("legs", 330.0, LASTING), ("ur5", None, LASTING)],
)
def test_sensitivities_are_those_of_differences(request, name, rate, terms):
    model = request.getfixturevalue(name)
    log = replace(commanded(model, 0.12), gain_factors=np.array([[1.1], [0.8]]))
    robot, windows = ClosedLoopRobot(model), cut_windows(log, np.inf, 0.0)
    size = 1.0 if name == "legs" else 30.0
    n, kinds = len(model.joints), robot.kinds
    values = VALUES if terms is TERMS else (0.1, 0.05, 0.1, 0.15, 0.1)
    values = size * np.array([*values[:-1], values[-1] / size])
    loops = loops_of(
        model, terms, values, kp=20.0 * size, delay=np.full(n, 0.0047),
        limit=np.full(n, 2.5 * size if name == "legs" else 2.0 * size), rate=rate,
    )  # fmt: skip
    columns, changes = [], []
    joints = (0, 1, n - 1)

    def by(field, j):
        def change(loops, x):
            moved = getattr(loops, field).copy()
            moved[j] += x
            return replace(loops, **{field: moved})

        return change

    for place, j in enumerate(joints):
        for field in ("armature", "kp", "kd", "limit", "delay", "zero"):
            columns.append((kinds[field], j, 0))
            changes.append(by(field, j))
        for k in range(len(terms)):
            if terms is TERMS and (k + place) % 3 != (name == "legs"):
                continue  # each of one joint of either robot
            columns.append((kinds["term"], j, len(terms) * j + k))
            changes.append(by("values", len(terms) * j + k))
    for body, joint in enumerate(robot.joint_of_body):
        k = body % 10
        columns.append((kinds["body"], joint, 10 * body + k))
        changes.append(by("bodies", (body, k)))
    directions = np.tile(np.eye(10), (n, 1))
    [out] = robot.roll_out(loops, windows, columns, directions, with_speeds=True)
    assert len(out.slopes) == (1 if name == "ur5" else 2)
    [plain] = robot.roll_out(loops, windows)
    np.testing.assert_array_equal(out.q, plain.q)
    worst, unseen, seen = {}, set(), set()
    for joints, places, slopes in out.slopes:
        k = len(joints)
        for c, p in enumerate(places):
            size = np.abs(slopes[:, :k, c]).max()
            # friction turns over 1e-5 rad/s, that with a memory at once: no step may be wider
            h = 3e-8 / max(size, 1e-3 if terms is TERMS else 1e-2)
            exact = differences(robot, loops, windows, changes[p], h)
            assert not np.delete(exact, joints, axis=2).any(), "parts move by themselves"
            scale = np.abs(exact[0]).max()
            if scale < 1e-9:
                unseen.add(columns[p][0])
            else:
                seen.add(columns[p])
            parts = zip((slopes[:, :k, c], slopes[:, k:, c]), exact[:, :, joints], strict=True)
            missed = [np.abs(s - x).max() / max(np.abs(x).max(), 1e-9) for s, x in parts]
            worst[columns[p]] = max(missed)
    assert max(worst.values()) < (1e-6 if terms is TERMS else 2e-5), worst
    assert unseen <= {kinds["zero"], kinds["body"], kinds["limit"]}, "about the vertical, or idle"
    assert any(kind == kinds["limit"] for kind, *_ in seen)


def test_a_delay_is_exact_about_held_commands(legs):
    log, n = commanded(legs), len(legs.joints)
    late = rolled(legs, loops_of(legs, delay=np.full(n, 2.3 / RATE)), log)

    def shifted(x):  # over a step, 0.3 of it is still what was told three samples ago
        held = np.vstack([x[:1], x[:1], x[:1], x])
        return 0.3 * held[:-3] + 0.7 * held[1:-2]

    told = {name: shifted(getattr(log, name)) for name in ("q_ref", "v_ref", "tau_ref")}
    same = rolled(legs, loops_of(legs), replace(log, **told))
    np.testing.assert_allclose(late.q, same.q, atol=1e-12)
    assert np.abs(late.q - rolled(legs, loops_of(legs), log).q).max() > 1e-3


def held_slider(t, start, told, rate, begin, *, mass, kp, kd, viscous):
    """Return positions of a mass under a loop that is held between ticks, by its closed form."""
    A = np.zeros((3, 3))  # of position, speed and held force
    A[0, 1], A[1, 1], A[1, 2] = 1.0, -viscous / mass, 1.0 / mass
    ticks = t[0] + np.arange(np.ceil((t[-1] - t[0]) * rate) + 1) / rate
    ticks = np.concatenate([[t[begin]], ticks[ticks > t[begin] + 1e-9], [np.inf]])
    x, found = np.array([*start, 0.0]), []
    for now, then in pairwise(ticks):
        x[2] = kp * (told - x[0]) - kd * x[1]
        rows = t[begin:][(t[begin:] > now - 1e-9) & (t[begin:] < then - 1e-9)]
        found += [(expm(A * (row - now)) @ x)[0] for row in rows]
        x = expm(A * (then - now)) @ x if np.isfinite(then) else x
    return np.array(found)


@pytest.mark.parametrize("rate", [100.0, 130.0, 700.0])
@pytest.mark.parametrize("begin", [0, 52])
def test_a_held_loop_has_the_closed_form_of_its_ticks(tmp_path, rate, begin):
    body = {"mass": 2.0, "kp": 300.0, "kd": 40.0}
    model, t = slider(tmp_path), 7.3 + np.arange(150) / RATE
    rail = loops_of(
        model, (Viscous(),), (0.0,), kp=300.0, kd=np.array([40.0]), armature=np.array([0.5]),
        zero=np.zeros(1), rate=rate,
    )  # fmt: skip
    log = Log(t, np.zeros((150, 1)), np.zeros((150, 1)), ("j",), q_ref=np.full((150, 1), 0.3))
    window = Window(log, begin, begin, 150, given=np.array([[0.1], [-0.4]]))
    exact = held_slider(t, (0.1, -0.4), 0.3, rate, begin, **(body | {"mass": 2.5}), viscous=0.0)
    [out] = ClosedLoopRobot(model).roll_out(rail, [window])
    np.testing.assert_allclose(out.q[:, 0], exact, atol=1e-12)
    assert abs(exact[-1] - 0.3) < 0.07 < abs(exact[10] - 0.3), "it follows"
    damped = held_slider(t, (0.1, -0.4), 0.3, rate, begin, **(body | {"mass": 2.5}), viscous=20.0)
    rough = replace(rail, values=np.array([20.0]))
    [out] = ClosedLoopRobot(model, step=2e-4).roll_out(rough, [window])
    np.testing.assert_allclose(out.q[:, 0], damped, atol=1e-7)
    [free] = ClosedLoopRobot(model).roll_out(replace(rail, rate=None), [window])
    assert np.abs(free.q[:, 0] - exact).max() > 3e-4


def test_a_controller_too_slow_for_its_gains_is_told_the_rate_it_needs(tmp_path):
    model = slider(tmp_path)
    log = Log(
        np.arange(500) / RATE, np.zeros((500, 1)), np.zeros((500, 1)), ("j",),
        q_ref=np.full((500, 1), 0.3),
    )  # fmt: skip
    rail = {"kp": 300.0, "kd": np.array([400.0]), "armature": np.array([0.5])}  # 400 / (2 2.5)
    stiff = rail | {"kp": 3e4, "kd": np.array([100.0])}  # 3e4 / (2 100)
    with pytest.raises(NotConvergedError, match=r"about 150 Hz with kp 3e\+04 and kd 100"):
        rolled(model, loops_of(model, (Viscous(),), zero=np.zeros(1), rate=40.0, **stiff), log)
    words = r"simulation of j is unstable: .* rate is 40 Hz, expected about 80 Hz.*kd 400"
    with pytest.raises(NotConvergedError, match=words):
        rolled(model, loops_of(model, (Viscous(),), zero=np.zeros(1), rate=40.0, **rail), log)
    settled = rolled(model, loops_of(model, (Viscous(),), zero=np.zeros(1), rate=85.0, **rail), log)
    assert np.abs(settled.q).max() < 0.5


def test_windows_cover_each_sample_once_and_cross_no_gap(planar):
    t = np.concatenate([np.arange(60), 80 + np.arange(301), 500 + np.arange(2)]) / RATE
    log = commanded(planar, t=t)
    for length, lead in ((0.1, 0.0), (0.11, 0.03), (0.5, 0.2), (np.inf, 0.0), (1e-9, 0.01)):
        windows = cut_windows(log, length, lead)
        counted = np.concatenate([np.arange(len(t))[w.counted] for w in windows])
        np.testing.assert_array_equal(counted, np.arange(len(t)))
        for w in windows:
            assert np.diff(t[w.start_row : w.stop]).max() < 1.5 / RATE
            edge = max(e for e in (0, 60, 361) if e <= w.first)
            assert w.start_row == max(edge, w.first - round(lead * RATE))
    sizes = [w.stop - w.first for w in cut_windows(log, 0.11, 0.0)]
    assert sizes == [60, *5 * [55], 26, 2] or sizes == [60, *4 * [55], 81, 2]
    t = np.array([0.0, 0.002, 0.004, 0.1, 0.2, 0.202])  # one sample alone is no window
    windows = cut_windows(commanded(planar, t=t), 1.0, 0.0)
    assert [(w.first, w.stop) for w in windows] == [(0, 3), (4, 6)]


def test_a_window_begins_with_the_slope_of_what_was_measured(planar):
    log = commanded(planar, 0.3)
    t = log.t[:, None]
    log = replace(log, q=np.hstack([0.2 + 0.5 * t - 0.3 * t**2, np.cos(5 * t)]))
    [_, w, *_] = cut_windows(log, 0.1, 0.0)
    q, v = w.start
    np.testing.assert_array_equal(q, log.q[50])
    np.testing.assert_allclose(v, [0.5 - 0.6 * 0.1, -5 * np.sin(0.5)], rtol=1e-2)


@pytest.mark.parametrize("rate", [None, 330.0])
def test_sensitivities_by_the_start_are_those_of_differences(legs, rate):
    robot, n = ClosedLoopRobot(legs), len(legs.joints)
    loops = loops_of(legs, LASTING, (0.1, 0.05, 0.1, 0.15, 0.1), rate=rate)
    [window] = cut_windows(commanded(legs, 0.2), np.inf, 0.0)
    columns = [(robot.kinds[what], j, 0) for what in ("start", "speed") for j in range(n)]
    [out] = robot.roll_out(loops, [window], columns, with_speeds=True)
    [plain] = robot.roll_out(loops, [window], columns)
    h = 1e-7
    for joints, places, slopes in out.slopes:
        for c, p in enumerate(places):
            step = np.zeros(2 * n)
            step[p] = h
            ends = [replace(window, given=window.start + s * step.reshape(2, n)) for s in (1, -1)]
            up, down = robot.roll_out(loops, ends)
            exact = (np.hstack([up.q, up.v]) - np.hstack([down.q, down.v])) / (2 * h)
            exact = exact[:, [*joints, *(n + joints)]]
            size = np.abs(exact[:, : len(joints)]).max()
            np.testing.assert_allclose(slopes[:, :, c], exact, atol=1e-5 * np.abs(exact).max())
            assert size > 1e-3
    for (_, _, both), (joints, _, positions) in zip(out.slopes, plain.slopes, strict=True):
        np.testing.assert_array_equal(positions, both[:, : len(joints)])


def test_lanes_know_nothing_of_each_other(legs):
    log = commanded(legs, 0.5)
    stiff = replace(log, gain_factors=np.array([[2.0], [1.4]]))
    robot = ClosedLoopRobot(legs)
    windows = [w for x in (log, stiff, log) for w in cut_windows(x, 0.042, 0.01)]
    assert len(windows) > 8, "more than a block of lanes"
    column = [(robot.kinds["kp"], 4, 0)]
    together = robot.roll_out(loops_of(legs), windows, column)
    for window, out in zip(windows, together, strict=True):
        [alone] = robot.roll_out(loops_of(legs), [window], column)
        np.testing.assert_allclose(alone.q, out.q, atol=1e-13)  # Newton ends with the last lane
        np.testing.assert_allclose(alone.v, out.v, atol=1e-12)
        assert len(out.q) == window.stop - window.first
        for mine, other in zip(alone.slopes, out.slopes, strict=True):
            np.testing.assert_allclose(mine[2], other[2], atol=1e-12)


def test_robots_and_terms_that_cannot_be_rolled_out_are_named(planar):
    motor = Coupling("motor", (("wrist_2_joint", 1.0), ("wrist_3_joint", -0.5)))
    for options, kind, words in (
        ({"free_flyer": True}, DataError, "base floats; the estimator 'simulation'"),
        ({"couplings": (motor,)}, SettingsError, r"cannot be simulated. Leave out \[\[coupling"),
    ):
        with pytest.raises(kind, match=words):
            ClosedLoopRobot(RobotModel.from_urdf(example_urdf("ur5_robot.urdf"), **options))
    loops = loops_of(planar, (*PLAIN, drives.Lag()), (0.1, 0.1, 0.0, 0.01))
    words = r"the term Lag is not possible in a closed-loop simulation: it delays.*set delay in"
    with pytest.raises(SettingsError, match=words):
        rolled(planar, loops, commanded(planar))


@pytest.mark.parametrize(
    ("term", "value", "words"),
    [
        (Coulomb(), -5.0, r"simulation of FL_hip_joint .*joint.coulomb is -5, expected 0 or more"),
        (LoadFriction(), 1.4, r"FL_hip_joint.load is 1.4, expected at most 0.5. Set other"),
        (drives.PositionCoulomb(order=1, centre=0.9), 3.0,
         r"FL_hip_joint .* its Coulomb friction is -3.11 N m at -0.136 rad, expected 0 or more"),
    ],
)  # fmt: skip
def test_friction_without_a_solution_is_named_with_joint_value_and_time(legs, term, value, words):
    loops, log = loops_of(legs, (Viscous(), term), (0.1, value)), commanded(legs)
    with pytest.raises(NotConvergedError, match=words) as caught:
        ClosedLoopRobot(legs).roll_out(loops, [Window(log, 40, 40, len(log.t))])
    name, time = re.fullmatch(r"(\S+) at (\S+) s", caught.value.status).groups()
    assert name == log.name
    assert log.t[40] <= float(time) < log.t[50], "of the log, not of the window"


def test_the_inertia_without_a_solution_is_that_at_the_positions_of_the_urdf(planar):
    loops = loops_of(planar, zero=np.array([0.0, 0.9]))
    M = pin.crba(planar.pin_model, planar.pin_model.createData(), np.array([0.0, 0.5]))
    why = why_no_solution(planar, loops, np.array([0, 1]), np.array([0.0, -0.4]), 0, 2e-3)
    assert f"its gain kp is 20 and its inertia {M[0, 0] + 0.01:.3g}, expected kp below" in why


def test_friction_that_falls_faster_than_inertia_allows_slips_as_in_small_steps(tmp_path):
    """A light joint under a slow ramp sticks and slips: in one step many speeds are possible."""
    model, t = slider(tmp_path), np.arange(200) / RATE
    ramp = 0.05 * t[:, None]
    log = Log(t, 0 * ramp, 0 * ramp, ("j",), q_ref=ramp, has_torque=False)
    loops = loops_of(
        model, (Viscous(), Coulomb(), drives.Stribeck(speed=0.03)), (0.5, 0.05, 0.3),
        zero=np.zeros(1), armature=np.zeros(1), kd=np.zeros(1), kp=50.0,
    )  # fmt: skip
    light = replace(loops, bodies=1e-3 * loops.bodies)
    coarse, fine = (rolled(model, light, log, step=step).q[:, 0] for step in (2e-3, 1e-5))
    slips = [int(np.argmax(np.diff(q) * RATE > 0.1)) for q in (coarse, fine)]
    assert slips[1] > 50, "it sticks, and then slips"
    assert abs(slips[0] - slips[1]) <= 1
    assert np.sqrt(np.mean((coarse - fine) ** 2)) < 0.15 * np.ptp(fine)


def test_ticks_between_rows_take_the_commands_of_their_own_half_row(planar):
    """Two ticks a row, a quarter of a row late: beside a log that has a row for each tick."""
    log = commanded(planar, 0.2)
    loops = loops_of(planar, kp=60.0, rate=2 * RATE, delay=np.full(2, 0.25 / RATE))
    late, N = rolled(planar, loops, log, step=1e-3), len(log.t)

    def told(x):  # of a tick at a row, the half row about it; of one between rows, the last row
        before = np.vstack([x[:1], x[:-1]])
        return np.stack([0.5 * (before + x), x], axis=1).reshape(2 * N, -1)[:-1]

    names = {name: told(getattr(log, name)) for name in ("q_ref", "v_ref", "tau_ref")}
    q = np.tile(log.q[:1], (2 * N - 1, 1))
    fine = Log(np.arange(2 * N - 1) / (2 * RATE), q, 0 * q, log.joints, has_torque=False, **names)
    same = rolled(planar, replace(loops, delay=np.zeros(2)), fine, step=1e-3)
    np.testing.assert_allclose(late.q, same.q[::2], atol=1e-12)
