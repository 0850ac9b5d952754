"""Findings on measured forces of the ground: sign, unit, foot, axes, and plates that are missed."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pinocchio as pin
import pytest
from helpers.humans import FEET, PARTS, human_urdf, logged, walk, with_other_segments

from robotid.constrained import wrenches
from robotid.constrained.contacts import check_base
from robotid.constrained.wrench_times import check_delay, check_gains, check_level, check_offsets
from robotid.constrained.wrenches import _Reading, check_wrenches
from robotid.logs.base import BaseMotion
from robotid.logs.settings import SignalSettings
from robotid.logs.signals import process
from robotid.regressor.constraints import constraint_jacobian
from robotid.regressor.prediction import predict
from robotid.robot.constraints import Contact, link_positions
from robotid.robot.model import RobotModel

SLOW = SignalSettings(cutoff=4.0)
PLATES = [
    pin.SE3(pin.rpy.rpyToMatrix(np.pi, 0, yaw), np.array([0.1, y, -0.05]))  # z downwards
    for yaw, y in ((0.3, 0.2), (0.0, -0.25))
]


@cache
def on_no_ground(urdf):
    return RobotModel.from_urdf(urdf, free_flyer=True, terms=())


def human(urdf, *, plates=None, **options):
    own = [{"axes": "link"}, {"axes": "link"}]
    if plates:
        angles = [pin.rpy.matrixToRpy(p.rotation) for p in plates]
        own = [
            {"plate": (*p.translation, *rpy)} for p, rpy in zip(plates, angles, strict=True)
        ]  # fmt: skip
    contacts = [
        Contact(foot, "surface", **{"measured": PARTS, **x, **options})
        for foot, x in zip(FEET, own, strict=True)
    ]
    return replace(on_no_ground(urdf), constraints=tuple(contacts))


@pytest.fixture(scope="module")
def urdf(tmp_path_factory):
    path = tmp_path_factory.mktemp("human") / "human.urdf"
    path.write_text(human_urdf())
    return path


@pytest.fixture(scope="module")
def motion(urdf):
    """Return a walk of a human whose segments differ from those of the URDF by 15 %."""
    model, rng = human(urdf), np.random.default_rng(3)
    return walk(model, with_other_segments(model, rng), rng, duration=6.0, rate=60.0)


@pytest.fixture(scope="module")
def log(urdf, motion):
    return logged(human(urdf), motion, np.random.default_rng(4))


@pytest.fixture(scope="module")
def long_log(urdf):
    model, rng = human(urdf), np.random.default_rng(8)
    motion = walk(model, with_other_segments(model, rng), rng, duration=16.0, rate=60.0)
    return logged(model, motion, rng)


def found(model, log):
    return list(check_wrenches(model, log, process(log, SLOW)))


def parts(model, log):
    """Return J^T f and W pi, shape (N, n_rows)."""
    motion, whole = process(log, SLOW), np.ones((1, 2), dtype=bool)
    torque = predict(replace(model, constraints=()), [model.standard_parameters()], motion)[0]
    J = constraint_jacobian(model, motion.q, np.repeat(whole, len(motion.t), axis=0))
    return np.einsum("kmj,km->kj", J, motion.wrenches), torque


def unexplained(model, log):
    """Return the RMS force and moment of W pi - J^T f of the base."""
    caused, torque = parts(model, log)
    left = (torque - caused)[:, :6]
    return [np.sqrt(np.mean(np.sum(x**2, axis=1))) for x in (left[:, :3], left[:, 3:])]


def exchanged(log):
    names = {foot: other for foot, other in zip(FEET, FEET[::-1], strict=True)}
    wrenches = {x: log.wrenches[f"{x[:2]} {names[x[3:]]}"] for x in log.wrenches}
    return replace(log, wrenches=wrenches)


def scaled(log, factor):
    return replace(log, wrenches={x: factor * y for x, y in log.wrenches.items()})


def test_right_forces_have_no_finding_though_feet_move(urdf, log):
    assert not list(check_base(human(urdf), log, SLOW))


@pytest.mark.parametrize(
    ("change", "words", "factor"),
    [
        (lambda log: scaled(log, -1.0), ["their sign is reversed"], -1.0),
        (exchanged, ["those of LeftFoot, RightFoot are exchanged"], 1.0),
        (lambda log: scaled(exchanged(log), -1.0), ["are exchanged", "sign is reversed"], -1.0),
        (lambda log: scaled(log, 1e-3), ["another unit, kN"], 1e3),
        (lambda log: scaled(log, 1 / 9.81), ["another unit, kgf"], 9.81),
        (lambda log: scaled(log, 0.2), ["another unit. Correct"], 5.0),
    ],
)
def test_a_fault_of_the_columns_is_named(urdf, log, change, words, factor):
    (finding,) = found(human(urdf), change(log))
    assert (finding.code, finding.severity) == ("measured_wrench", "error")
    assert all(text in finding.message for text in words)
    assert ("exchanged" in finding.message) == ("are exchanged" in " ".join(words))
    assert finding.evidence["factor"] == pytest.approx(factor, rel=0.2)
    assert finding.evidence["best"] < 0.2 * 70 * 9.81  # what masses of the URDF leave
    force, moment = unexplained(human(urdf), change(log))
    assert finding.evidence["force"] == pytest.approx(force)
    shown = f"leave {force:.3g} N and {moment:.3g} N m (RMS) of the base unexplained, but only"
    assert shown in finding.message
    right, moment = unexplained(human(urdf), log)
    if factor > 1.0:  # least squares of force and moment together
        caused, left = (x[:, :6] for x in parts(human(urdf), change(log)))
        found_factor = np.sum(caused * left) / np.sum(caused**2)
        assert finding.evidence["factor"] == pytest.approx(found_factor)
        assert f"multiplied by about {found_factor:.2g}" in finding.message
    else:  # as logged, not multiplied by a fitted factor
        assert finding.evidence["factor"] == factor
        assert finding.evidence["best"] == pytest.approx(right)
        assert f"but only {right:.3g} N and {moment:.3g} N m if" in finding.message


def test_moments_in_newton_millimetres_are_named(urdf, log):
    milli = {x: 1e3 * y if x.startswith("m") else y for x, y in log.wrenches.items()}
    (finding,) = found(human(urdf), replace(log, wrenches=milli))
    force, moment = unexplained(human(urdf), log)
    assert (
        f"but only {force:.3g} N and {moment:.3g} N m if their moments are in N mm, wanted N m. "
        "Correct"
    ) in finding.message
    assert finding.evidence["factor"] == 1.0


@pytest.mark.parametrize("delay", [0.05, -0.03])
def test_the_delay_of_forces_is_found_and_corrected(urdf, long_log, delay):
    log = long_log
    assert not found(human(urdf), log)
    late = {x: np.interp(log.t - delay, log.t, y) for x, y in log.wrenches.items()}
    late = replace(log, wrenches=late)
    (finding,) = found(human(urdf), late)
    assert (finding.code, finding.severity) == ("wrench_delay", "warning")
    assert finding.evidence["delay"] == pytest.approx(delay, abs=0.006)
    assert finding.evidence["std_error"] < 0.005
    assert f"lag the motion by {1e3 * finding.evidence['delay']:+.0f} +- " in finding.message
    half = replace(SLOW, wrench_delay=delay / 2)
    (rest,) = check_wrenches(human(urdf), late, process(late, half), delay / 2)
    assert rest.evidence["delay"] == pytest.approx(delay / 2, abs=0.006)
    stated = float(rest.message.partition("wrench_delay = ")[2].partition(" ")[0])
    assert stated == pytest.approx(delay, abs=0.006)
    assert not list(
        check_wrenches(human(urdf), late, process(late, replace(SLOW, wrench_delay=delay)))
    )


def test_what_sensors_measure_in_the_air_is_an_offset(urdf, long_log):
    """A foot of this human is in the air for 1.2 s of 3.3 s."""
    offsets = {"fz LeftFoot": -4.0, "mx LeftFoot": 0.3, "fy RightFoot": 2.0, "my RightFoot": 0.05}
    shifted = {x: y + offsets.get(x, 0.0) for x, y in long_log.wrenches.items()}
    left, right = found(human(urdf), replace(long_log, wrenches=shifted))
    assert {x.code for x in (left, right)} == {"wrench_offset"}
    assert left.evidence == {
        "fz_LeftFoot": pytest.approx(-4.0, abs=0.3), "mx_LeftFoot": pytest.approx(0.3, abs=0.03)
    }  # fmt: skip
    assert right.evidence == {"fy_RightFoot": pytest.approx(2.0, abs=0.3)}  # 0.05 N m is too small
    assert left.message.startswith("log: LeftFoot is in the air ")
    assert f"measures fz {left.evidence['fz_LeftFoot']:+.3g} +- " in left.message


def test_an_offset_has_the_standard_error_of_the_mean_of_its_swings():
    swings = np.array([[3.0, 0.2, 0.5], [5.0, 0.3, 5.0], [4.0, 0.5, -3.0], [6.0, 0.4, 4.0],
                       [4.5, 0.3, 2.5], [5.5, 0.4, 1.5]])  # fmt: skip
    starts, speed, wrench = range(10, 130, 20), np.full(140, 0.01), np.full((140, 3), 300.0)
    for first, own in zip(starts, swings, strict=True):
        speed[first : first + 5], wrench[first : first + 5] = 0.5, own
    speed[130:134] = 0.5  # a swing of less than five rows does not count
    middle, error = np.median(swings, axis=0), swings.std(axis=0, ddof=1) / np.sqrt(6.0)
    assert error[2] < middle[2] < 4.0 * error[2]  # not found
    (finding,) = check_offsets("log", "LeftFoot", speed, wrench, ("fz", "mx", "fy"), 700.0)
    assert finding.evidence == pytest.approx({"fz_LeftFoot": middle[0], "mx_LeftFoot": middle[1]})
    assert (
        f"is in the air 6 times, but its sensor measures fz {middle[0]:+.3g} +- {error[0]:.1g} N, "
        f"mx {middle[1]:+.3g} +- {error[1]:.1g} N m there (median)"
    ) in finding.message


def test_a_time_on_the_other_plate_is_named(urdf, motion):
    plain = logged(human(urdf), motion, np.random.default_rng(5), plates=PLATES)
    own = (plain.t > 2.0) & (plain.t < 4.0)
    other = exchanged(plain).wrenches
    mixed = {x: np.where(own, other[x], y) for x, y in plain.wrenches.items()}
    (finding,) = found(human(urdf, plates=PLATES), replace(plain, wrenches=mixed))
    assert (finding.code, finding.severity) == ("measured_wrench", "error")
    assert "those of LeftFoot, RightFoot are exchanged" in finding.message
    assert finding.evidence["share"] == pytest.approx(2.0 / 5.6, rel=0.15)
    assert finding.evidence["first"] == pytest.approx(2.0, abs=0.15)
    assert finding.evidence["last"] == pytest.approx(4.0, abs=0.15)


def test_axes_in_which_the_vertical_force_is_unknown_explain_nothing(urdf, log):
    """Of feet whose z is level, fz with the axes of the link leaves all of the weight unknown."""
    contacts = [Contact(foot, "point", ("fz",), always=True) for foot in FEET]
    model = replace(human(urdf), constraints=tuple(contacts))
    values = {f"fz {foot}": -log.wrenches[f"fz {foot}"] for foot in FEET}
    toes = replace(log, wrenches=values)
    (finding,) = found(model, toes)
    assert "axes" not in finding.message
    assert "state the plate" not in finding.message  # moments are not measured


def test_forces_of_plates_have_the_origin_and_axes_of_the_plates(urdf, motion):
    rng = np.random.default_rng(5)
    of_plates = logged(human(urdf), motion, rng, plates=PLATES)
    assert not found(human(urdf, plates=PLATES), of_plates)
    (finding,) = found(human(urdf), of_plates)  # read as those of shoes
    assert "their sign is reversed" in finding.message  # the plates' z is downwards
    assert "exchanged" not in finding.message
    assert "state the plate of each foot" in finding.message


def test_the_origin_of_the_world_is_named(urdf, motion):
    at_zero = [pin.SE3.Identity()] * 2
    of_world = logged(human(urdf), motion, np.random.default_rng(5), plates=at_zero)
    assert not found(human(urdf, plates=at_zero), of_world)
    for model in (human(urdf), human(urdf, plates=PLATES)):
        (finding,) = found(model, of_world)
        assert "plate = [0, 0, 0]" in finding.message


def test_steps_beside_the_plates_are_found_with_their_times(urdf, log):
    beside = (log.t > 2.0) & (log.t < 3.0)
    missed = {x: np.where(beside, 0.0, y) for x, y in log.wrenches.items()}
    (finding,) = found(human(urdf), replace(log, wrenches=missed))
    assert (finding.code, finding.severity) == ("measured_wrench", "warning")
    assert finding.evidence["share"] == pytest.approx(1.0 / 5.6, rel=0.1)  # 0.2 s trimmed
    share = finding.evidence["share"]
    assert f"half of the weight in {share:.0%} of the samples" in finding.message
    assert "first at 2.0" in finding.message
    assert ", last at 2.9" in finding.message or ", last at 3 s" in finding.message


def test_vertical_forces_alone_show_their_sign_and_foot(urdf, log):
    contacts = [Contact(foot, "point", ("fz",), always=True) for foot in FEET]
    model = replace(human(urdf), constraints=tuple(contacts))
    # the feet on the ground are level: their z is the world's
    vertical = replace(log, wrenches={f"fz {foot}": log.wrenches[f"fz {foot}"] for foot in FEET})
    assert not found(model, vertical)
    (finding,) = found(model, scaled(vertical, -1.0))
    assert "their sign is reversed" in finding.message


@pytest.mark.parametrize(("noise", "count"), [(2.0, 1), (6.0, 0)])
def test_a_delay_counts_if_a_tenth_of_the_squared_residual_goes_with_it(noise, count):
    """Without the delay of 40 ms the residual has the variance of about 1.0 more."""
    rng = np.random.default_rng(0)
    t = 3.0 + 0.01 * np.arange(4000)
    force = np.cumsum(rng.standard_normal((4000, 1)), axis=0) / 2.0
    late = np.vstack([np.repeat(force[:1], 4, axis=0), force[:-4]])
    slopes = np.zeros((4000, 1, 6))
    slopes[:, 0, 2] = 1.0
    left = np.zeros((4000, 6))
    left[:, 2] = force[:, 0] + noise * rng.standard_normal(4000)
    motion = SimpleNamespace(t=t, wrenches=late, segment=None)
    found = list(check_delay("log", motion, slopes, left, 0.005))
    assert len(found) == count
    for finding in found:
        assert finding.evidence["delay"] == pytest.approx(0.04, abs=0.003)
        assert "lag the motion by +40 +- " in finding.message
        assert "state wrench_delay = 0.045 in [signals]" in finding.message


@pytest.mark.parametrize(("rows", "count"), [(359, 0), (360, 1)])
def test_a_delay_is_searched_in_eight_parts_of_twice_its_largest_size(rows, count):
    """Of 20 rows, which both ends lack; the log has two segments, then the middle lacks 40 more."""
    rng = np.random.default_rng(1)
    for gap in (0, 40):
        t = 3.0 + 0.01 * np.arange(rows + gap)
        force = np.cumsum(rng.standard_normal((len(t), 1)), axis=0)
        late = np.vstack([np.repeat(force[:1], 4, axis=0), force[:-4]])
        slopes, left = np.zeros((len(t), 1, 6)), np.zeros((len(t), 6))
        slopes[:, 0, 2], left[:, 2] = 1.0, force[:, 0]
        segment = (np.arange(len(t)) >= 150).astype(int) if gap else None
        motion = SimpleNamespace(t=t, wrenches=late, segment=segment)
        found = list(check_delay("log", motion, slopes, left, 0.0))
        assert [x.evidence["delay"] for x in found] == count * [pytest.approx(0.04, abs=2e-3)]


def test_the_delay_is_searched_without_the_torques_of_unknown_forces(urdf, log, monkeypatch):
    contacts = tuple(Contact(foot, "point", ("fz",), always=True) for foot in FEET)
    model, given = replace(human(urdf), constraints=contacts), []
    monkeypatch.setattr(wrenches, "check_delay", lambda *args: given.append(args) or [])
    vertical = replace(log, wrenches={f"fz {foot}": log.wrenches[f"fz {foot}"] for foot in FEET})
    list(check_wrenches(model, vertical, process(vertical, SLOW), 0.02))
    ((_, motion, slopes, left, stated),) = given
    J = constraint_jacobian(model, motion.q, np.ones((len(motion.t), 2), dtype=bool))[..., :6]
    feet = link_positions(model.pin_model, model.configurations(motion.q), FEET)
    apart = np.linalg.norm(feet - motion.q[:, None, :3], axis=2)
    scale = np.repeat([1.0, 1.0 / (np.sqrt(np.mean(apart**2)) + 1e-3)], 3)  # equal units
    (torque,) = predict(replace(model, constraints=()), [model.standard_parameters()], motion)
    unknown = J[:, [0, 1, 3, 4]]  # fx and fy of each foot
    for x, whole in ((left, torque[:, :6]), (slopes[:, 0], J[:, 2]), (slopes[:, 1], J[:, 5])):
        own, size = (np.einsum("kmj,kj->km", unknown, y) for y in (x / scale, whole))
        assert np.linalg.norm(own) < 0.02 * np.linalg.norm(size)
    assert stated == 0.02


@pytest.mark.parametrize(
    ("force", "moment", "is_better"),
    [
        (49.0, 10.0, True),  # half of a force that is not small
        (51.0, 10.0, False),
        (100.0, 4.9, True),  # half of a moment that is not small
        (119.0, 4.9, True),
        (121.0, 4.9, False),  # the force is worse by more than 1.2
        (49.0, 12.1, False),  # the moment is worse by more than 1.2, and not small
        (49.0, 11.9, True),
    ],
)
def test_a_better_reading_halves_one_residual_and_keeps_the_other(force, moment, is_better):
    def reading(force, moment):
        directions = np.tile([0.6, 0.0, 0.8, 0.0, -1.0, 0.0], (4, 1))
        return _Reading((), False, 1.0, directions * np.repeat([force, moment], 3), 200.0)

    stated = reading(100.0, 10.0)
    assert stated.sizes == pytest.approx((100.0, 10.0))
    assert reading(force, moment).is_better(stated, (90.0, 9.0)) is is_better
    small = reading(40.0, 4.0).is_better(stated, (101.0, 11.0))  # both are small already
    assert small is False
    assert reading(40.0, 15.0).is_better(stated, (90.0, 16.0)) is True  # a small moment may grow


def test_the_reading_with_the_smallest_force_and_moment_is_named(urdf, log, monkeypatch):
    """Shares of the weight, and of the weight at the distance of the feet; as stated 0.8 and 0.6.

    X exchanges the feet.
    """
    model, motion = human(urdf), process(log, SLOW)
    weight = 9.81 * sum(x.mass for x in model.pin_model.inertias)
    some = motion.every(max(1, len(motion.t) // 400))
    feet = link_positions(model.pin_model, model.configurations(some.q), FEET)
    apart = np.linalg.norm(feet - some.q[:, None, :3], axis=2)
    lever = np.sqrt(np.mean(apart**2)) + 1e-3

    def reading(name, force, moment, known):
        own = np.zeros((len(some.t), 6))
        own[:, 1], own[:, 5] = force * weight, moment * weight * lever
        return _Reading(tuple(name.split()), FEET * (name == "X"), 1.0, own, known * weight)

    for others, wanted in [
        ([("a", 0.45, 0.5, 1.0)], None),  # half of neither
        ([("a", 0.39, 0.5, 1.0), ("b", 0.45, 0.01, 1.0)], "b"),
        ([("a", 0.001, 0.05, 1.0), ("b", 0.004, 0.03, 1.0)], "b"),  # 0.011 0.06 and 0.014 0.04
        ([("a c", 0.2, 0.10, 1.0), ("b", 0.2, 0.115, 1.0)], "b"),  # 1.2 for a second change
        ([("a c", 0.2, 0.08, 1.0), ("b", 0.2, 0.115, 1.0)], "a and c"),
        ([("a", 0.2, 0.01, 0.49), ("b", 0.3, 0.2, 0.51)], "b"),  # most of the force is unknown
        ([("X", 0.1, 0.4, 1.0), ("b", 0.3, 0.4, 1.0)], "b"),  # the force does not show the foot
        ([("X", 0.1, 0.2, 1.0), ("b", 0.3, 0.4, 1.0)], "X"),
    ]:
        every = [reading(*own) for own in [("", 0.8, 0.6, 1.0), *others]]
        monkeypatch.setattr(wrenches, "_readings", lambda *_, every=every: every)
        finding = next(iter(check_wrenches(model, log, motion)), None)
        if wanted is None:
            assert finding is None or "only" not in finding.message
            continue
        best = next(x for x in every if " and ".join(x.changes) == wanted)
        assert f"if {wanted}. Correct the columns" in finding.message
        assert finding.evidence["force"] == pytest.approx(0.8 * weight)
        assert finding.evidence["best"] == pytest.approx(best.sizes[0])
        force, moment = best.sizes
        assert f"but only {force:.3g} N and {moment:.3g} N m if" in finding.message
    # of b the moments remain, for which plates of whole wrenches can be stated
    points = tuple(Contact(foot, "point", PARTS[:3]) for foot in FEET)
    for own, is_asked in (
        (model, True), (human(urdf, measured=PARTS[:3]), False),
        (replace(model, constraints=points), False),
    ):  # fmt: skip
        every = [reading(*x) for x in [("", 0.8, 0.6, 1.0), ("b", 0.3, 0.4, 1.0)]]
        monkeypatch.setattr(wrenches, "_readings", lambda *_, every=every: every)
        (finding,) = check_wrenches(own, log, motion)
        assert ("The moments remain: state the plate" in finding.message) == is_asked


@pytest.mark.parametrize("foot", FEET)
def test_the_gain_of_one_foot_is_named_with_its_factor(urdf, long_log, foot):
    wrong = {x: y * (1.3 if x.endswith(foot) else 1.0) for x, y in long_log.wrenches.items()}
    (finding,) = found(human(urdf), replace(long_log, wrenches=wrong))
    assert (finding.code, finding.severity) == ("wrench_gain", "warning")
    factor = finding.evidence["factor"]
    is_other = f"that of {foot} is multiplied" not in finding.message
    assert (1 / factor if is_other else factor) == pytest.approx(1 / 1.3, rel=0.02)
    assert "The log does not show which of both is wrong" in finding.message


def shifting(rng, gains, count=400):
    """Return loads (N, 3, k) that share a force in motion, measured with gains, and that force."""
    shares = rng.dirichlet(np.full(len(gains), 0.5), 20)
    shares = np.repeat(shares, count // 20, axis=0)
    left = np.array([3.0, -2.0, 500.0]) + rng.normal(size=(count, 3)) * [20.0, 20.0, 10.0]
    loads = left[:, :, None] * shares[:, None] / gains + rng.normal(size=(count, 3, len(gains)))
    return loads, left


def test_the_gain_of_a_foot_is_relative_to_the_median_of_the_others():
    """A mass of the URDF that is wrong by 1.2 is common to all feet."""
    gains, names = np.array([1.0, 1.02, 0.8, 0.99]), ("a", "b", "c", "d")
    loads, left = shifting(np.random.default_rng(0), gains)
    (finding,) = check_gains("log", names, loads, 1.2 * left)
    solved = np.linalg.lstsq(loads.reshape(-1, 4), 1.2 * left.ravel(), rcond=None)[0]
    factor = solved[2] / np.median(solved[[0, 1, 3]])
    assert finding.evidence["factor"] == pytest.approx(factor, rel=2e-3)
    assert factor == pytest.approx(0.8, abs=0.01)
    assert 1e-4 < finding.evidence["std_error"] < 0.01
    assert f"that of c is multiplied by {finding.evidence['factor']:.3g} +-" in finding.message
    assert "relative to a, b, d: the gain" in finding.message
    assert not list(check_gains("log", names[:2], loads[:, :, :2] * 1.1, left))  # not all the load
    assert not list(check_gains("log", ("c",), loads[:, :, 2:3], left))
    for rows, count in ((15, 0), (16, 1)):  # two in each of eight parts
        some = slice(0, 25 * rows, 25)
        assert len(list(check_gains("log", names, loads[some], 1.2 * left[some]))) == count
    noisy = left + 60.0 * np.random.default_rng(2).normal(size=left.shape)
    own, one = (  # of the squared residual a tenth must go
        np.linalg.lstsq(A, noisy.ravel(), rcond=None)[1][0]
        for A in (loads.reshape(-1, 4), loads.sum(axis=2).reshape(-1, 1))
    )
    assert 0.9 * one < own < 0.99 * one
    assert not list(check_gains("log", names, loads, noisy))
    right, same = shifting(np.random.default_rng(1), np.array([1.03, 1.0, 1.0, 0.98]))
    assert not list(check_gains("log", names, right, 1.2 * same))


def test_the_standard_error_of_a_gain_is_its_scatter_over_logs():
    gains, found = np.array([1.0, 1.0, 0.8]), []
    for seed in range(60):
        loads, left = shifting(np.random.default_rng(seed), gains)
        (finding,) = check_gains("log", ("a", "b", "c"), loads, left)
        found.append([finding.evidence["factor"], finding.evidence["std_error"]])
    factors, errors = np.array(found).T
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(factors.std(ddof=1), rel=0.35)


def test_loads_that_do_not_shift_show_no_gain():
    rng = np.random.default_rng(0)
    left = np.array([0.0, 0.0, 500.0]) + rng.normal(size=(400, 3))
    loads = left[:, :, None] * np.array([0.5, 0.5 / 1.3]) + 0.1 * rng.normal(size=(400, 3, 2))
    assert not list(check_gains("log", ("a", "b"), loads, left))


def test_gains_that_the_loads_hardly_determine_are_those_of_equal_feet():
    """Loads of two feet shift by 1 %: their gains have rows of equal gains beside the loads."""
    rng, names = np.random.default_rng(5), ("a", "b")
    left = np.array([0.0, 0.0, 500.0]) + rng.normal(size=(400, 3))
    shares = 0.5 + 0.01 * rng.normal(size=400)
    shared = np.stack([shares, 1.0 - shares], axis=1)[:, None]
    loads = left[:, :, None] * shared / [1.0, 0.4] + 0.01 * rng.normal(size=(400, 3, 2))
    A = loads.reshape(-1, 2)
    equal = np.sqrt(1e-4 * np.sum(A**2) / 2) * np.array([[1.0, -1.0]])
    solved = np.linalg.lstsq(np.vstack([A, equal]), np.append(left, 0.0), rcond=None)[0]
    (finding,) = check_gains("log", names, loads, left)
    shown = f"with the URDF's weight, a needs the factor {solved[0]:.3g}, b {solved[1]:.3g}"
    assert shown in finding.message
    k = names.index(finding.message.split("that of ")[1][0])
    assert finding.evidence["factor"] == pytest.approx(solved[k] / solved[1 - k])
    alone = np.linalg.lstsq(A, left.ravel(), rcond=None)[0]
    assert abs(solved[1] - solved[0]) < 0.9 * abs(alone[1] - alone[0])


def test_a_mean_horizontal_force_is_an_offset_or_a_tilt():
    rng, down = np.random.default_rng(0), np.array([0.0, -9.81, 0.0])
    excess = rng.normal(size=(400, 3)) * [5.0, 50.0, 5.0] + [6.0, 200.0, -8.0]
    (finding,) = check_level("log", excess, down, 700.0)
    mean = excess[:, [0, 2]].mean(axis=0)
    assert (finding.code, finding.severity) == ("wrench_offset", "warning")
    assert finding.evidence["horizontal"] == pytest.approx(np.hypot(*mean))
    assert finding.evidence["angle"] == pytest.approx(np.degrees(np.arctan(10.0 / 700.0)), rel=0.1)
    parts = excess.reshape(8, 50, 3)[:, :, [0, 2]].mean(axis=1)
    error = np.sqrt(np.sum(parts.var(axis=0, ddof=1)) / 8)
    assert finding.evidence["std_error"] == pytest.approx(error)
    assert not list(check_level("log", excess[:15], down, 70.0))
    assert len(list(check_level("log", excess[:16], down, 70.0))) == 1
    assert not list(check_level("log", excess, down, 1100.0))  # below 1 % of the weight
    assert not list(check_level("log", excess - [6.0, 0.0, -8.0], down, 50.0))


def test_an_offset_of_feet_that_stand_is_named(urdf, long_log):
    """A tilt of the axes of the motion by 1.5 deg is like a horizontal force of 2.6 % of it."""
    model = human(urdf)
    assert not found(model, long_log)
    tilt = pin.Quaternion(pin.rpy.rpyToMatrix(np.radians(1.5), 0.0, 0.0))
    pose = long_log.base.pose.copy()
    pose[:, :3] = pose[:, :3] @ tilt.matrix().T
    pose[:, 3:] = [(tilt * pin.Quaternion(x)).coeffs() for x in pose[:, 3:]]
    tilted = replace(long_log, base=BaseMotion(pose))
    (finding,) = found(model, tilted)
    assert finding.code == "wrench_offset"
    assert finding.evidence["angle"] == pytest.approx(1.5, abs=0.3)
    caused, torque = parts(model, tilted)
    turns = [pin.Quaternion(x).matrix() for x in process(tilted, SLOW).q[:, 3:7]]
    excess = np.einsum("kij,kj->ki", turns, (caused - torque)[:, :3])  # with the world's axes
    mean = excess[:: len(excess) // 400, :2].mean(axis=0)
    assert finding.evidence["horizontal"] == pytest.approx(np.hypot(*mean))
