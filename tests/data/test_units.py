"""Units of a log file, and what measured velocities are worth: how late, how coarse."""

import re
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

import robotid
from robotid.base.exceptions import DataError, SettingsError
from robotid.data.log import Log
from robotid.data.signal_settings import LogUnits
from robotid.data.units import (
    _velocity_factor,
    check_units,
    coarse_velocities,
    is_timely,
    is_trustworthy,
    quantum,
    unlike_velocities,
    velocity_lags,
)

T = 5.0 + np.arange(400) * 0.01
Q = np.column_stack([0.8 * np.sin(2 * T), 0.3 * np.cos(3 * T)])
V = np.column_stack([1.6 * np.cos(2 * T), -0.9 * np.sin(3 * T)])
TAU = np.column_stack([5 * Q[:, 0], 2 * Q[:, 1]])


def log(**changes):
    return Log(**{"t": T, "q": Q, "v": V, "tau": TAU, "joints": ("a", "b")} | changes)


#: Logs that look like another unit, the code and fragments of the error.
SUSPECTED = [
    (dict(q=Q * 180 / np.pi / 10, v=V / 10), "angle_unit", "dq_a is 0.0175 times d(q)/dt: the "
     "position looks like degrees"),
    (dict(v=V * 180 / np.pi), "angle_unit", "dq_a is 57.3 times d(q)/dt: the velocity looks like "
     "degrees, the other like radians. Convert one of them in the recording. To read the values "
     'without conversion, set units angle = "rad" (job file table [units], CLI --angle-unit rad'),
    (dict(v=V * [1.0, -1.0]), "velocity_sign", "dq_b has the opposite sign of d(q)/dt of q_b. "
     "Negate one of them in the recording, or leave the dq columns out"),
    (dict(t=T * 1e3, v=None), "time_unit", "median step 10 looks like milliseconds (100 Hz); in "
     'seconds it would be 0.1 Hz. Set units time = "ms" (job file table [units], CLI --time-unit '
     'ms), or "s" if this is the unit. To convert it, multiply'),
    (dict(t=T * 200.0 / 10, v=None), "time_unit", "median step 0.2 looks like milliseconds (5000"),
    (dict(t=T * 1e6, v=None), "time_unit", "median step 10000 looks like microseconds (100 Hz)"),
    (dict(t=T * 1e9, v=None), "time_unit", "median step 1e+07 looks like nanoseconds (100 Hz)"),
    *[(dict(t=T * 1e-4, v=V * 1e4 * factor), "time_unit", f"dq_a is {factor:.3g} times d(q)/dt"
       f"; the time looks like {name}seconds. Set units time")
      for factor, name in ((1e3, "milli"), (1e6, "micro"), (1e9, "nano"))],
    (dict(v=V / 1000), "time_unit", "dq_a is 0.001 times d(q)/dt. To read"),
    (dict(q=Q * [1.0, 90.0 / 0.3], v=None), "angle_unit", "q_b reaches 90, which looks like "
     "degrees (in radians 14.3 revolutions). Set units angle = "),
    (dict(q=Q * [-2.1 * 2 * np.pi / np.abs(Q[:, 0]).max(), 1.0], v=None), "angle_unit",
     "q_a reaches 13.19, which looks like degrees (in radians 2.1 revolutions)"),
    (dict(q_ref=Q * 57.3 * 2), "angle_unit", "qref_a reaches 91."),
    (dict(t=T * 1e3, q=Q * 300.0, v=None), "time_unit", "multiply by 0.001. q_a reaches 240, "),
]  # fmt: skip


@pytest.mark.parametrize(("changes", "code", "fragment"), SUSPECTED)
def test_a_log_in_another_unit_is_refused_unless_it_is_stated(changes, code, fragment):
    with pytest.raises(DataError, match=re.escape(fragment)) as caught:
        check_units(log(**changes), LogUnits())
    assert caught.value.code == code
    stated = LogUnits(time="s", angle="rad")
    if code == "velocity_sign":  # whatever is stated
        with pytest.raises(DataError, match="opposite sign"):
            check_units(log(**changes), stated)
    else:
        check_units(log(**changes), stated)


def test_what_is_no_sign_of_another_unit_passes(rng):
    for changes in (
        {},
        {"v": None},
        {"t": np.arange(400) * 0.1, "v": None},  # 10 Hz
        {"t": 1.7e9 + 0.01 * np.arange(400), "v": None},  # since 1970
        {"q": np.full((400, 2), 12.5), "v": None},  # two revolutions
        {"v": np.column_stack([np.interp(T - 0.19, T, x) for x in V.T])},  # as TIAGo's
        {"v": V + rng.normal(0, 5, V.shape)},
        {"q": np.round(rng.normal(0, 1e-5, Q.shape), 4), "v": rng.normal(0, 5e-4, Q.shape)},
        {"q": 0 * Q, "v": 0 * V},
        {"q": Q, "q_ref": -Q, "v": None},
    ):
        check_units(log(**changes), LogUnits())
    check_units(log(q=Q * [1.0, 300.0], v=None), LogUnits(), prismatic=["b"])
    check_units(log(v=np.degrees(V)), LogUnits(), prismatic=["a", "b"])
    for name, unit, words in (("time", "min", "s, ms, us, ns"), ("angle", "grad", "rad, deg")):
        with pytest.raises(SettingsError, match=f"{name} is '{unit}', expected one of {words}"):
            LogUnits(**{name: unit})


PENDULUM = """<robot name="pendulum"><link name="base"/><link name="rod"><inertial>
<origin xyz="0 0 -0.4"/><mass value="0.7"/><inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0"
izz="0.001"/></inertial></link><joint name="pivot" type="{kind}"><parent link="base"/>
<child link="rod"/><axis xyz="0 1 0"/>{limit}</joint></robot>"""


@pytest.mark.parametrize(
    ("kind", "limit", "turns", "is_read"),
    [
        ("continuous", "", 4.5, True),
        ("revolute", '<limit lower="0" upper="0" velocity="0" effort="0"/>', 2.5, True),
        ("continuous", "", 5.2, False),
        ("revolute", '<limit lower="-3" upper="3" velocity="9" effort="9"/>', 2.5, False),
    ],
)
def test_a_pendulum_that_turns_several_times_is_read_in_radians(
    tmp_path, kind, limit, turns, is_read
):
    path = tmp_path / "pendulum.urdf"
    path.write_text(PENDULUM.format(kind=kind, limit=limit))
    t = np.arange(2000) / 200
    q = 2 * np.pi * turns * np.sin(0.35 * t) ** 2 * np.cos(0.2 * t)
    q *= 2 * np.pi * turns / np.abs(q).max()
    v = np.gradient(q, t)
    tau = 0.122 * np.gradient(v, t) + 0.7 * 9.81 * 0.4 * np.sin(q) + 0.1 * v + 0.2 * np.sign(v)
    frame = pd.DataFrame({"time": t, "q_pivot": q, "tau_pivot": tau})
    if not is_read:
        with pytest.raises(DataError, match=r"q_pivot reaches .* looks like degrees"):
            robotid.identify(path, frame)
        return
    found = robotid.identify(path, frame)
    (assumed,) = [f for f in found.findings if f.code == "log_assumption"]
    assert assumed.severity == "warning"
    assert "more than two revolutions of pivot are read in radians" in assumed.message
    estimated = dict(zip(found.mapping.names, found.standard, strict=True))
    assert estimated["pivot.viscous"] == pytest.approx(0.1, abs=0.005)


def three(scale, **scales):
    """A log from 5 s of three joints; columns in other units by factors (3,), q if not stated."""
    t = 5.0 + T
    q = np.column_stack([0.8 * np.sin(2 * T), 0.3 * np.cos(3 * T), 0.5 + np.sin(T)])
    v = np.column_stack([1.6 * np.cos(2 * T), -0.9 * np.sin(3 * T), np.cos(T)])
    columns = {"v": v, "q_ref": q + 0.01}
    changed = {key: columns[key] * scales[key] for key in scales}
    return Log(t, q * scale, np.zeros_like(q), ("a", "b", "c"), **changed)


def test_one_joint_in_degrees_is_converted_alone():
    """pi / 180 is 0.0174533; the others reach 0.8 (a), 0.3 (b), 1.5 (c)."""
    one, c = np.array([1.0, 1.0, 1.0]), np.array([1.0, 1.0, 180 / np.pi])
    advice = "at most 0.8: c alone may be in degrees. Then multiply {} by 0.0174533"
    for changes, columns in (
        ({"scale": c}, "q_c"),
        ({"scale": c, "v": c}, "q_c and dq_c"),
        ({"scale": c, "v": one}, "q_c"),  # the velocity is in radians
        ({"scale": c, "v": c, "q_ref": c}, "q_c, dq_c and qref_c"),
        ({"scale": c, "q_ref": one}, "q_c"),
        ({"scale": c, "q_ref": c[::-1]}, "q_c"),  # the command of another joint is in degrees
    ):
        with pytest.raises(DataError, match=re.escape(advice.format(columns))) as caught:
            check_units(three(**changes), LogUnits())
        assert "in the recording, because the unit applies to all joints" in str(caught.value)
        assert '. If all joints are in degrees, set units angle = "deg"' in str(caught.value)
    a = 180 / np.pi * np.array([1.0, 0.0, 0.0]) + [0.0, 1.0, 1.0]
    with pytest.raises(DataError, match=r"most 1\.51: a alone .* multiply qref_a by"):
        check_units(three(one, q_ref=a), LogUnits())
    # all in degrees, a joint farther than a revolution, and too few joints to compare
    for log, prismatic in (
        (three(180 / np.pi * one), ()), (three([8.0, 1.0, 180 / np.pi]), ()), (three(c), ("a",))
    ):  # fmt: skip
        with pytest.raises(DataError, match="looks like degrees") as caught:
            check_units(log, LogUnits(), prismatic)
        assert "alone" not in str(caught.value)


@pytest.mark.parametrize(
    ("step", "factor", "unit"),
    # 1 kHz, 5 Hz and 20 kHz since 1970: the step alone would say seconds, us, us
    [(1e-3, 1e3, "ms"), (0.2, 1e3, "ms"), (5e-5, 1e9, "ns"), (0.01, 1e6, "us"), (0.01, 1e9, "ns")],
)
def test_a_date_tells_the_unit_of_the_time(step, factor, unit):
    t = np.round((1.7e9 + step * np.arange(200)) * factor)
    t = t if (np.diff(t) > 0).all() else (1.7e9 + step * np.arange(200)) * factor
    q = np.sin(np.arange(200) * 0.05)[:, None]
    with pytest.raises(DataError) as caught:
        check_units(Log(t, q, q, ("a",)), LogUnits())
    assert caught.value.code == "time_unit"
    assert f'units time = "{unit}"' in str(caught.value)
    assert str(caught.value).endswith(f"multiply by {1 / factor:g}")


@pytest.mark.parametrize("factor", [180 / np.pi, np.pi / 180])
def test_a_command_in_degrees_is_told_from_one_that_goes_far_along_a_slider(factor):
    """Only a revolute joint has degrees."""
    far = log(q=0.5 * Q, q_ref=0.5 * Q * [1.0, factor], v=None)
    check_units(far, LogUnits(), prismatic=["b"])
    for sign in (1.0, -1.0):  # a command that is reversed as well
        far = log(q=0.5 * Q, q_ref=0.5 * Q * [1.0, sign * factor], v=None)
        with pytest.raises(
            DataError, match=rf"qref_b is {sign * factor:.3g} times the motion of q_b: one looks"
        ):
            check_units(far, LogUnits(), prismatic=["a"])
    check_units(log(q=Q, q_ref=-Q, v=None), LogUnits())


def test_a_command_that_is_not_followed_shows_no_unit():
    """57 times as large as the motion, and at another frequency."""
    for share in (0.0, 0.85):  # the correlation from which two signals are alike is 0.9
        y = np.sin(7.3 * T) * np.sqrt(2) * np.std(Q[:, 1])
        other = share * (Q[:, 1] - Q[:, 1].mean()) + np.sqrt(1 - share**2) * y
        q_ref = np.column_stack([Q[:, 0], 180 / np.pi * 0.1 * other])
        check_units(log(q=0.1 * Q, q_ref=q_ref, v=None), LogUnits())
    with pytest.raises(DataError, match=r"qref_b is 57\.3 times the motion of q_b"):
        check_units(log(q=0.1 * Q, q_ref=0.1 * Q * [1.0, 180 / np.pi], v=None), LogUnits())


@pytest.mark.parametrize(("turn", "unit"), [(2 * np.pi, 1.0), (360.0, 180 / np.pi)])
def test_speeds_are_compared_beside_gaps_and_full_turns(turn, unit):
    """The factor of dq by d(q)/dt, of a log with jumps of a turn and a gap with a long way."""
    s = T - 5.0
    t = 6.0 + np.where(s < 2.0, s, s + 9.0) + np.where(np.arange(400) < 250, 0.0, 0.1)
    q = unit * np.column_stack([0.7 * T + 0.02 * np.sin(5 * T), np.cos(3 * T)])
    v = unit * np.column_stack([0.7 + 0.1 * np.cos(5 * T), -3.0 * np.sin(3 * T)])
    q[200:] += [4.0 * unit, -2.0 * unit]  # while nothing was recorded
    q[250:, 0] += unit  # in a gap of 11 steps
    q[60:, 0] -= turn
    q[300:, 1] += turn
    found = _velocity_factor(log(t=t, q=q, v=[2.0, -0.5] * v))
    np.testing.assert_allclose(found, [2.0, -0.5], rtol=2e-3)


def test_coarse_encoders_do_not_hide_degrees(rng):
    t = np.arange(5000) / 1000
    q = np.round(np.sin(t)[:, None] / 1e-2) * 1e-2  # [rad] moves in single steps at 1 kHz
    v = np.degrees(np.cos(t)[:, None]) + rng.normal(0, 30, (5000, 1))
    with pytest.raises(DataError, match=r"dq_elbow is 57.* times d\(q\)/dt: the velocity"):
        check_units(Log(t=t, q=q, v=v, tau=q, joints=("elbow",)), LogUnits())


CLOCK = np.arange(0, 10, 0.01)


def log_of_two(t=CLOCK):
    q = np.column_stack([np.sin(2 * t), np.cos(3 * t)])
    v = np.column_stack([2 * np.cos(2 * t), -3 * np.sin(3 * t)])
    return Log(t, q, np.ones_like(q), ("a", "b"), v=v)


def test_a_gap_or_a_clock_that_was_set_costs_neither_memory_nor_the_lag():
    log = log_of_two()
    late = replace(log, v=np.column_stack([np.interp(log.t - 0.03, log.t, x) for x in log.v.T]))
    jumped = replace(late, t=late.t + np.where(late.t > 5, 1e9, 0.0))
    assert velocity_lags(jumped)[0] == pytest.approx(0.03, abs=2e-3)


def test_full_turns_are_no_motion():
    log = log_of_two()
    far = np.column_stack([3 * CLOCK, np.cos(3 * CLOCK)])
    turned = replace(log, q=(far + np.pi) % (2 * np.pi) - np.pi, v=np.gradient(far, CLOCK, axis=0))
    assert abs(velocity_lags(turned)[0]) < 1e-3
    assert unlike_velocities(turned) == {}


@pytest.mark.parametrize("step", [0.01, 0.013])
def test_lags_of_joints_minimise_the_mean_distance_to_the_delayed_derivative(step):
    log, lags = log_of_two(np.arange(0.0, 4.0, step)), [0.105, -0.048]
    late = np.column_stack(
        [np.interp(log.t - lag, log.t, x) for lag, x in zip(lags, log.v.T, strict=True)]
    )
    log = replace(log, v=late)
    common, single = velocity_lags(log)
    assert single == pytest.approx([velocity_lags(log.select([joint]))[0] for joint in "ab"])
    step = float(np.median(np.diff(log.t)))
    grid = np.arange(log.t[0], log.t[-1], step)
    slopes = [np.gradient(np.interp(grid, log.t, x), step) for x in log.q.T]
    late = [np.interp(grid, log.t, x) for x in late.T]
    pairs = list(zip(slopes, late, strict=True))
    distances = np.array([[distance(*pair, k) for k in range(-20, 21)] for pair in pairs])
    for found, own in zip([common, *single], [distances.sum(axis=0), *distances], strict=True):
        k = int(np.argmin(own))
        square, slope, _ = np.polyfit([-1, 0, 1], own[k - 1 : k + 2], 2)
        assert found == pytest.approx((k - 20 - slope / (2 * square)) * step, abs=1e-9)


def test_stretches_between_gaps_count_by_their_rows_and_the_shortest_not():
    step, rows, lags = 0.01, (160, 520, 100), (0.104, 0.027, 0.2)
    parts = [7.0 * k + step * np.arange(n) for k, n in enumerate(rows)]
    log = log_of_two(np.concatenate(parts))
    v = [
        np.column_stack([2 * np.cos(2 * (t - lag)), -3 * np.sin(3 * (t - lag))])
        for t, lag in zip(parts, lags, strict=True)
    ]
    common, single = velocity_lags(replace(log, v=np.concatenate(v)))
    summed = np.zeros((2, 63))
    for t, x in zip(parts[:2], v[:2], strict=True):
        slopes = np.gradient(np.column_stack([np.sin(2 * t), np.cos(3 * t)]), step, axis=0)
        for own, pair in zip(summed, zip(slopes.T, x.T, strict=True), strict=True):
            own += [len(t) * distance(*pair, k) for k in range(-31, 32)]
    for found, own in zip([common, *single], [summed.sum(axis=0), *summed], strict=True):
        k = int(np.argmin(own))
        square, slope, _ = np.polyfit([-1, 0, 1], own[k - 1 : k + 2], 2)
        # the grid of a segment may lack its last row
        assert found == pytest.approx((k - 31 - slope / (2 * square)) * step, abs=2e-4)
    assert 0.027 < common < 0.06


def distance(slope, v, shift):
    """Return the mean square of v - slope delayed by a number of rows."""
    pairs = [(v[i], slope[i - shift]) for i in range(len(v)) if 0 <= i - shift < len(v)]
    return np.mean([(x - y) ** 2 for x, y in pairs])


@pytest.mark.parametrize("lag", [0.0, 0.1, 0.2])
def test_a_late_velocity_is_its_positions_and_noise_is_not(lag):
    log = log_of_two()
    late = np.column_stack([np.interp(log.t - lag, log.t, x) for x in log.v.T])
    assert unlike_velocities(replace(log, v=late)) == {}
    late[:, 1] = np.random.default_rng(0).standard_normal(len(CLOCK))
    (joint, alike), *others = unlike_velocities(replace(log, v=late)).items()
    assert (joint, others) == ("b", [])
    assert alike < 0.5
    assert not is_trustworthy(replace(log, v=late))


@pytest.mark.parametrize(
    ("lag", "stated", "is_used"),
    [(0.03, 0.0, False), (0.03, 0.005, False), (0.03, 0.02, True), (0.015, 0.0, True),
     (0.0, -0.05, False)],
)  # fmt: skip
def test_what_a_velocity_is_stated_to_be_late_does_not_count(lag, stated, is_used):
    log = log_of_two()
    truth = np.column_stack([2 * np.cos(2 * (CLOCK - lag)), -3 * np.sin(3 * (CLOCK - lag))])
    late = replace(log, v=truth)
    assert is_timely(late, stated) is is_used
    assert is_trustworthy(late, stated) is is_used


def test_a_velocity_of_few_steps_is_coarse():
    log = log_of_two()
    assert coarse_velocities(log) == ()
    v = log.v.copy()
    v[:, 0] = np.round(v[:, 0] / 0.05) * 0.05  # 80 of them
    assert coarse_velocities(replace(log, v=v)) == ("a",)
    assert not is_trustworthy(replace(log, v=v))
    assert is_trustworthy(log)


def test_a_step_is_found_of_values_that_hardly_repeat_if_they_need_not():
    x = np.round(np.sin(CLOCK) / 2e-3) * 2e-3 + 0.1
    assert quantum(x) == 0.0  # most values are there once
    assert quantum(x, repeats=False) == pytest.approx(2e-3)
    assert quantum(np.sin(CLOCK), repeats=False) == 0.0
    coarse = np.round(np.sin(CLOCK) / 0.05) * 0.05
    assert quantum(coarse) == quantum(coarse, repeats=False) == pytest.approx(0.05)
