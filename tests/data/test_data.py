"""Log and Trajectory hold what they promise, and check_units suspects what is not in SI units."""

import re
from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest

from robotid.base.exceptions import DataError, SettingsError
from robotid.data.log import Log, Trajectory, require_finite, require_increasing
from robotid.data.signal_settings import LogUnits
from robotid.data.units import check_units

JOINTS = ("shoulder", "elbow")


def make_log(**changes):
    t = np.arange(500) / 100  # 5 s at 100 Hz
    phase = t[:, None] * [2.0, 3.0]
    fields = {
        "t": t,
        "q": np.sin(phase),
        "v": np.cos(phase) * [2.0, 3.0],
        "a": -np.sin(phase) * [4.0, 9.0],
        "tau": 10 * np.cos(phase),
        "joints": JOINTS,
        "path": "somewhere/run3.csv",
    }
    return Log(**(fields | changes))


def refused(text):
    return pytest.raises(DataError, match="^" + re.escape(text) + "$")


def spoil(array, row, column, value):
    array = array.copy()
    array[row, column] = value
    return array


# --- Log ------------------------------------------------------------------------------------------


def test_log_keeps_its_arrays_from_being_changed():
    q = np.zeros((500, 2))
    log = make_log(q=q)
    q[0, 0] = 7.0
    assert log.q[0, 0] == 0.0
    for array in (log.t, log.q, log.v, log.a, log.tau):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1.0
    with pytest.raises(FrozenInstanceError):
        log.path = "other.csv"


def test_log_shares_arrays_that_nobody_can_write_to():
    log = make_log()
    assert np.shares_memory(replace(log, path="").q, log.q)


def test_log_takes_lists_and_integers():
    log = Log(t=[0, 1, 2], q=[[0], [1], [2]], tau=[[3], [4], [5]], joints=["elbow"])
    assert log.q.dtype == np.float64
    assert log.joints == ("elbow",)
    assert log.v is None
    assert log.notes == ()


def test_time_that_goes_back_is_refused():
    t = make_log().t.copy()
    t[406] = 4.045
    with refused(
        "run3.csv: t must increase, but t[406] = 4.045 s follows t[405] = 4.050 s; "
        "sort the rows, or correct the recording"
    ):
        make_log(t=t)


def test_duplicate_time_stamp_is_called_so():
    t = make_log().t.copy()
    t[406] = t[405]
    with refused(
        "run3.csv: t must increase, but t[406] = 4.050 s is a duplicate time stamp, the same as "
        "t[405]; remove one of the two rows"
    ):
        make_log(t=t)


def test_time_stamps_that_differ_late_are_printed_in_full():
    with refused(
        "log: t must increase, but t[1] = 1.0000001 s follows t[0] = 1.0000002 s; sort the rows, "
        "or correct the recording"
    ):
        Log(t=[1.0000002, 1.0000001], q=[[0], [0]], tau=[[0], [0]], joints=("elbow",))


@pytest.mark.parametrize(
    ("field", "column"), [("q", "q"), ("v", "dq"), ("a", "ddq"), ("tau", "tau")]
)
@pytest.mark.parametrize(("value", "word"), [(np.nan, "NaN"), (-np.inf, "-inf")])
def test_values_that_are_not_finite_are_refused(field, column, value, word):
    array = spoil(getattr(make_log(), field), 34, 1, value)
    with refused(
        f"run3.csv: {column}_elbow is {word} at row 34 (t = 0.34 s); remove the row or correct the "
        "recording"
    ):
        make_log(**{field: array})


def test_time_that_is_nan_is_refused():
    t = make_log().t.copy()
    t[17] = np.nan
    with refused("run3.csv: time is NaN at row 17; remove the row or correct the recording"):
        make_log(t=t)


def test_shapes_that_do_not_fit_are_refused():
    with refused(
        "run3.csv: tau has shape (500, 3), wanted (500, 2): a row for each time stamp, a column "
        "for each of the joints shoulder, elbow"
    ):
        make_log(tau=np.zeros((500, 3)))
    for kind, values in (("contacts", np.ones((500, 2), bool)), ("wrenches", np.zeros((499,)))):
        with refused(f"run3.csv: 'fz' of {kind} has shape {values.shape}, wanted (500,)"):
            make_log(**{kind: {"mx": np.ones(500, bool), "fz": values}})
    with refused("run3.csv: t has shape (500, 1), wanted (N,)"):
        make_log(t=np.arange(500.0)[:, None])


def test_fewer_than_two_rows_are_refused():
    with refused("log has 1 rows, wanted at least 2; record longer"):
        Log(t=[0.0], q=[[0.0]], tau=[[0.0]], joints=("elbow",))


def test_joints_are_names_each_once():
    with refused("run3.csv: joints contains elbow twice; name each joint once"):
        make_log(joints=("elbow", "elbow"))
    with refused("run3.csv: joints is 'ab', wanted at least one name in a tuple"):
        make_log(joints="ab")
    with refused("run3.csv: joints is (), wanted at least one name in a tuple"):
        make_log(joints=())


def test_window_includes_both_ends_on_the_logs_own_clock():
    log = make_log(t=make_log().t + 100.0, notes=("kept",))
    cut = log.window(101.0, 102.0)
    assert (cut.t[0], cut.t[-1], len(cut.t)) == (101.0, 102.0, 101)
    for name in ("q", "v", "a", "tau"):
        np.testing.assert_array_equal(getattr(cut, name), getattr(log, name)[100:201])
    assert (cut.path, cut.notes, cut.joints) == (log.path, log.notes, log.joints)
    assert len(log.window(start=104.0).t) == 100
    assert len(log.window(end=100.5).t) == 51
    assert len(log.window().t) == 500


@pytest.mark.parametrize(
    ("start", "end", "rows"), [(20.0, 30.0, 0), (3.0, 2.0, 0), (1.0, 1.001, 1)]
)
def test_window_without_rows_names_the_span(start, end, rows):
    with refused(
        f"run3.csv: {rows} rows lie between {start:g} s and {end:g} s; the log spans 0 s to "
        "4.99 s. Choose start and end inside it"
    ):
        make_log().window(start, end)


def test_window_without_velocity_has_none():
    cut = make_log(v=None, a=None).window(1.0, 2.0)
    assert cut.v is None
    assert cut.a is None


def test_select_gives_the_order_asked_for():
    log = make_log()
    swapped = log.select(["elbow", "shoulder"])
    assert swapped.joints == ("elbow", "shoulder")
    for name in ("q", "v", "a", "tau"):
        np.testing.assert_array_equal(getattr(swapped, name), getattr(log, name)[:, ::-1])
    assert log.select(("elbow",)).q.shape == (500, 1)


def test_select_of_an_unknown_joint_names_the_nearest():
    with refused(
        "joint 'elbow2' is not in run3.csv; joints: shoulder, elbow. Did you mean 'elbow'?"
    ):
        make_log().select(["elbow2"])


# --- Trajectory -----------------------------------------------------------------------------------


def make_trajectory(**changes):
    log = make_log()
    fields = {name: getattr(log, name) for name in ("t", "q", "v", "a", "tau", "joints")}
    fields |= {"rate": 100.0, "segment": np.repeat([0, 1], 250)}
    return Trajectory(**(fields | changes))


def test_trajectory_cannot_be_changed():
    trajectory = make_trajectory()
    for name in ("t", "q", "v", "a", "tau", "segment"):
        with pytest.raises(ValueError, match="read-only"):
            getattr(trajectory, name)[0] = 1
    assert make_trajectory(rate=None).rate is None


def test_some_samples_of_a_trajectory_cannot_be_changed_either_and_keep_nothing_of_the_whole():
    memory, direction = np.arange(1000.0).reshape(500, 2), np.ones((500, 3))
    whole = make_trajectory(memory=memory, direction=direction)
    whole.derived["inertial rows"] = "of all"
    rows = {"part": slice(7, 20), "every": slice(None, None, 9), "at": np.array([3, 400])}
    for some, own in zip(
        [whole.part(7, 20), whole.every(9), whole.at(rows["at"])], rows.values(), strict=True
    ):
        assert some.derived == {}
        for name in ("t", "q", "v", "a", "tau", "segment", "direction", "memory"):
            found = getattr(some, name)
            np.testing.assert_array_equal(found, getattr(whole, name)[own])
            with pytest.raises(ValueError, match="read-only"):
                found[0] = 1
    assert (whole.part(7, 20).rate, whole.every(9).rate) == (100.0, None)
    other = whole.with_states(None)
    assert (other.memory, other.derived, whole.memory is memory) == (None, whole.derived, True)


@pytest.mark.parametrize("name", ["q", "v", "a", "tau"])
def test_trajectory_refuses_wrong_shapes_and_nan(name):
    with pytest.raises(DataError, match=rf"trajectory: {name} has shape \(500, 1\), wanted"):
        make_trajectory(**{name: np.zeros((500, 1))})
    array = spoil(make_log().q, 3, 0, np.nan)
    with pytest.raises(DataError, match=rf"trajectory: {name}_shoulder is NaN at row 3"):
        make_trajectory(**{name: array})


@pytest.mark.parametrize("segment", [np.zeros(500), np.zeros(499, dtype=int)])
def test_trajectory_refuses_a_wrong_segment(segment):
    with refused(
        f"trajectory: segment is {segment.dtype} of shape {segment.shape}, wanted integers of "
        "shape (500,)"
    ):
        make_trajectory(segment=segment)


@pytest.mark.parametrize("rate", [0.0, -1.0, np.inf, np.nan])
def test_trajectory_refuses_a_wrong_rate(rate):
    with refused(f"trajectory: rate is {rate}, wanted a positive number or None"):
        make_trajectory(rate=rate)


# --- units ----------------------------------------------------------------------------------------


def test_units_that_do_not_exist_are_refused():
    wanted = re.escape("units: time is 'min', wanted one of s, ms, us, ns")
    with pytest.raises(SettingsError, match=wanted):
        LogUnits(time="min")
    wanted = re.escape("units: angle is 'grad', wanted one of rad, deg")
    with pytest.raises(SettingsError, match=wanted):
        LogUnits(angle="grad")


def test_si_units_pass():
    check_units(make_log(), LogUnits())
    check_units(make_log(v=None, a=None), LogUnits())


@pytest.mark.parametrize(
    ("factor", "text"),
    [
        (1e3, "median step 10 looks like milliseconds (100 Hz); in seconds it would be 0.1 Hz."),
        (1e6, "median step 10000 looks like microseconds (100 Hz); in seconds it would be"),
        (1e9, "median step 1e+07 looks like nanoseconds (100 Hz); in seconds it would be"),
    ],
)
def test_time_in_another_unit_is_suspected(factor, text):
    log = make_log(t=make_log().t * factor, v=None)
    with pytest.raises(DataError, match=re.escape(text)):
        check_units(log, LogUnits())
    check_units(log, LogUnits(time="s"))


def test_suspected_time_tells_how_to_state_it():
    with refused(
        "run3.csv: median step 10 looks like milliseconds (100 Hz); in seconds it would be 0.1 Hz. "
        'State units time = "ms" (job file table [units], CLI --time-unit ms, Python '
        'units=LogUnits(time="ms")), or "s" if this is the unit. To convert it, multiply by '
        "0.001"
    ):
        check_units(make_log(t=make_log().t * 1e3), LogUnits())


def test_ten_hertz_is_still_taken_for_seconds():
    check_units(make_log(t=np.arange(500) * 0.1, v=None), LogUnits())


@pytest.mark.parametrize(
    ("factor", "name"), [(1e3, "milli"), (1e6, "micro"), (1e9, "nano"), (1e-3, None)]
)
def test_velocity_shows_a_wrong_clock(factor, name):
    t = np.arange(500) * 1e-6  # too fast for the median step to tell
    log = make_log(t=t, v=np.gradient(make_log().q, t, axis=0) * factor)
    looks = f"; the time looks like {name}seconds. State units time = " if name else ". To read"
    text = f"run3.csv: dq_shoulder is {factor:.3g} times d(q)/dt{looks}"
    with pytest.raises(DataError, match="^" + re.escape(text)):
        check_units(log, LogUnits())
    check_units(log, LogUnits(time="s"))


def test_positions_beyond_two_turns_are_suspected():
    q = make_log().q * [1.0, 90.0]
    log = make_log(q=q, v=None)
    with refused(
        "run3.csv: q_elbow reaches 90, which looks like degrees (in radians 14.3 revolutions). "
        'State units angle = "deg" (job file table [units], CLI --angle-unit deg, Python '
        'units=LogUnits(angle="deg")), or "rad" if this is the unit'
    ):
        check_units(make_log(q=spoil(q, 157, 1, 90.0), v=None), LogUnits())
    check_units(log, LogUnits(), prismatic=("elbow",))
    check_units(log, LogUnits(angle="rad"))
    check_units(make_log(q=np.full((500, 2), 12.5), v=None), LogUnits())


def test_velocity_in_degrees_is_suspected():
    log = make_log(v=np.degrees(make_log().v))
    with refused(
        "run3.csv: dq_shoulder is 57.3 times d(q)/dt: the velocity looks like degrees, the other "
        "like radians. Convert one of them in the recording. To read the values without "
        'conversion, state units angle = "rad" (job file table [units], CLI --angle-unit rad, '
        'Python units=LogUnits(angle="rad"))'
    ):
        check_units(log, LogUnits())
    check_units(log, LogUnits(angle="rad"))
    check_units(log, LogUnits(), prismatic=JOINTS)


def test_small_positions_in_degrees_are_suspected():
    log = make_log(q=np.degrees(make_log().q * 0.1), v=make_log().v * 0.1)
    text = "dq_shoulder is 0.0175 times d(q)/dt: the position looks like degrees"
    with pytest.raises(DataError, match=re.escape(text)):
        check_units(log, LogUnits())


def test_velocity_of_opposite_sign_is_refused_whatever_is_stated():
    log = make_log(v=make_log().v * [1.0, -1.0])
    with refused(
        "run3.csv: dq_elbow has the opposite sign of d(q)/dt of q_elbow. Negate one of them in the "
        "recording, or leave the dq columns out"
    ):
        check_units(log, LogUnits(time="s", angle="rad"))


def test_late_noisy_and_quantised_velocity_is_not_suspected(rng):
    log = make_log()
    v = np.interp(log.t - 0.19, log.t, log.v[:, 0])[:, None] * [1.0, 1.5]  # as TIAGo's
    check_units(replace(log, v=v), LogUnits())
    check_units(replace(log, v=log.v + rng.normal(0, 5, log.v.shape)), LogUnits())
    still = np.round(rng.normal(0, 1e-5, log.q.shape), 4)  # rest, as encoders give it
    check_units(replace(log, q=still, v=rng.normal(0, 5e-4, log.q.shape)), LogUnits())
    check_units(replace(log, q=log.q * 0, v=log.v * 0), LogUnits())


def test_coarse_encoders_do_not_hide_degrees(rng):
    t = np.arange(5000) / 1000
    q = np.round(np.sin(t)[:, None] / 1e-2) * 1e-2  # [rad] moves in single steps at 1 kHz
    v = np.degrees(np.cos(t)[:, None]) + rng.normal(0, 30, (5000, 1))
    with pytest.raises(DataError, match=r"dq_elbow is 57.* times d\(q\)/dt: the velocity"):
        check_units(Log(t=t, q=q, v=v, tau=q, joints=("elbow",)), LogUnits())


def test_full_turns_and_gaps_do_not_hide_degrees():
    log = make_log(q=np.cumsum(np.full((500, 2), 0.05), axis=0), v=np.full((500, 2), 5.0))
    wrapped = (log.q + np.pi) % (2 * np.pi) - np.pi
    rows = np.r_[0:100, 190:500]
    gappy = replace(
        log, t=log.t[rows], q=wrapped[rows], v=np.degrees(log.v)[rows], a=None, tau=log.tau[rows]
    )
    with pytest.raises(DataError, match=r"dq_shoulder is 57\.3 times"):
        check_units(gappy, LogUnits())
    check_units(replace(gappy, v=log.v[rows]), LogUnits())


def test_a_log_and_a_trajectory_are_one_line():
    t = np.arange(201) * 0.01
    x = np.zeros((201, 2))
    log = Log(t=t, q=x, tau=x, joints=("a", "b"), path="folder/run.csv")
    assert repr(log) == "<Log run.csv: 201 samples of 2 joints (a, b) over 2 s at 100 Hz>"
    segment = np.repeat([0, 1], [100, 101])
    motion = Trajectory(t=t, q=x, v=x, a=x, tau=x, joints=("a", "b"), rate=50.0, segment=segment)
    assert repr(motion) == (
        "<Trajectory: 201 samples of 2 joints (a, b) over 2 s at 50 Hz, in 2 segments>"
    )


@pytest.mark.parametrize("scale", [1e-300, 1e-12])
def test_time_stamps_of_no_clock_are_refused(scale):
    t = scale * np.arange(5) / 100
    with pytest.raises(DataError, match=r"5 rows lie within .* wanted at least 1e-12 s") as caught:
        Log(t=t, q=np.zeros((5, 1)), tau=np.zeros((5, 1)), joints=("a",))
    assert f"within {scale / 25:.3g} s, so the mean time step is {scale / 100:.3g} s" in str(
        caught.value
    )
    assert caught.value.code == "time_unit"


def test_squares_of_a_trajectory_are_of_torque_speed_and_acceleration_in_this_order(rng):
    q, v, a, tau = rng.standard_normal((4, 9, 2)) * [[[1.0]], [[2.0]], [[3.0]], [[5.0]]]
    t, segment = 4.0 + np.arange(9) / 50, np.repeat([0, 1], [4, 5])
    motion = Trajectory(t=t, q=q, v=v, a=a, tau=tau, joints=("a", "b"), rate=50.0, segment=segment)
    np.testing.assert_allclose(motion.squares, [(x**2).sum(axis=0) for x in (tau, v, a)])
    thin = motion.every(2)
    np.testing.assert_allclose(thin.squares, [(x[::2] ** 2).sum(axis=0) for x in (tau, v, a)])
    assert (thin.rate, motion.every(1)) == (None, motion)


def test_windows_selections_and_signs_are_of_all_signals(rng):
    t, arrays = 3.0 + np.arange(6) / 10, rng.standard_normal((7, 6, 3))
    names = ("q", "tau", "v", "a", "q_ref", "v_ref", "tau_ref")
    log = Log(
        t, **dict(zip(names, arrays, strict=True)), joints=("a", "b", "c"),
        contacts={"foot": t > 3.25, "hand": t < 3.15}, wrenches={"fz foot": t**2},
    )  # fmt: skip
    part, some = log.window(3.1, 3.4), log.select(["c", "a"])
    turned = log.turned(np.array([1.0, -1.0, -1.0]))
    for name, values in zip(names, arrays, strict=True):
        np.testing.assert_array_equal(getattr(part, name), values[1:5])
        np.testing.assert_array_equal(getattr(some, name), values[:, [2, 0]])
        np.testing.assert_array_equal(getattr(turned, name), values * [1.0, -1.0, -1.0])
    assert part.contacts["foot"].tolist() == [False, False, True, True]
    assert part.contacts["hand"].tolist() == [True, False, False, False]
    np.testing.assert_array_equal(part.wrenches["fz foot"], t[1:5] ** 2)
    assert some.joints == ("c", "a")


def test_rows_are_numbered_as_in_the_file(rng):
    """Of a block whose first row is row 70."""
    t = 5.0 + np.arange(4) / 10
    values = rng.standard_normal((4, 2))
    values[2, 1] = np.inf
    with pytest.raises(DataError, match=r"x: q_b is inf at row 72 \(t = 5\.2 s\); remove"):
        require_finite(values, t, ["q_a", "q_b"], "x", 70)
    with pytest.raises(DataError, match=r"but t\[73\] = 5\.100 s follows t\[72\] = 5\.200 s"):
        require_increasing(np.array([5.0, 5.1, 5.2, 5.1]), "x", 70)
    with pytest.raises(DataError, match=r"t\[71\] = 5\.000 s is a duplicate .* as t\[70\]"):
        require_increasing(np.array([5.0, 5.0, 5.2]), "x", 70)


def test_the_rate_of_a_log_is_that_of_its_median_step():
    t = np.r_[0.0, 0.1, 0.2, 0.3, 2.3]
    log = Log(t=t, q=np.zeros((5, 1)), tau=np.zeros((5, 1)), joints=("a",))
    assert repr(log) == "<Log in memory: 5 samples of 1 joints (a) over 2.3 s at 10 Hz>"
