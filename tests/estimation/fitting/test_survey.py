"""A log read in pieces gives what the same log in memory gives."""

import pickle
from dataclasses import replace
from functools import partial

import numpy as np
import pinocchio as pin
import pytest
from helpers.closed_chains import four_bar
from helpers.corruptions import table_of
from helpers.synthetic import truth

from robotid.base.exceptions import DataError
from robotid.data.base_motion import BaseColumns, BaseMotion, ImuFrame
from robotid.data.files.read import lay_out, read_log, write_columns, write_log
from robotid.data.log import Log
from robotid.data.signal_settings import LogUnits, SignalSettings
from robotid.dynamics.base_parameters import structural_mapping
from robotid.dynamics.factors import join
from robotid.dynamics.simulation.motions import random_fourier
from robotid.dynamics.torque import joint_torque_regressor
from robotid.estimation.estimators import WLS
from robotid.estimation.fitting import recorded as survey
from robotid.estimation.fitting.recorded import Recordings, hold_log, reduce_piece, survey_log
from robotid.robot.closure import Chains
from robotid.robot.constraints import Contact
from robotid.robot.drives import Cubic
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

LENGTH = 500  # rows per piece


@pytest.fixture(scope="module")
def recording(model):
    """Return a noisy log of three joints with jitter and gaps, one of them where a piece ends."""
    rng = np.random.default_rng(0)
    step = 0.01 * (1 + 0.1 * rng.uniform(-1, 1, 1999))
    step[[2 * LENGTH - 1, 1234]] = [0.5, 0.7]
    t = np.concatenate([[0.0], np.cumsum(step)])
    q, v, a = random_fourier(model, rng, period=7.0).evaluate(t)
    tau = (joint_torque_regressor(model, q, v, a) @ truth(model)).reshape(v.shape)
    noisy = {"q": q + 1e-5 * rng.standard_normal(q.shape), "v": v, "a": a}
    return Log(t=t, tau=tau + 0.1 * rng.standard_normal(q.shape), joints=model.joints, **noisy)


def long_log(model, path, signals, *, start=None, end=None, length=LENGTH, **reading):
    layout, table = lay_out(path, model.joints, **reading)
    return survey_log(layout, table, model, signals, (start, end), length=length)


def pieces_of(log):
    """Return what reduces each piece of a log."""
    mapping = structural_mapping(log.model)
    return [partial(reduce_piece, piece, mapping=mapping) for piece in log.pieces]


def assert_alike(model, path, signals, *, start=None, end=None, **reading):
    """Check pieces against the log in memory; return both."""
    mapping = structural_mapping(model)
    found = long_log(model, path, signals, start=start, end=end, **reading)
    whole = hold_log(model, read_log(path, model.joints, start=start, end=end, **reading), signals)
    wanted = join(Recordings(model, mapping, [whole]).reduce())
    joined = join([reduced() for reduced in pieces_of(found)])
    assert found.signals == whole.signals
    assert joined.samples == wanted.samples
    np.testing.assert_array_equal(joined.factors.rows, wanted.factors.rows)
    np.testing.assert_allclose(joined.squares, wanted.squares, rtol=1e-9)
    one, other = WLS().fit(joined.factors), WLS().fit(wanted.factors)
    size = np.abs(other.theta).max()
    np.testing.assert_allclose(one.theta, other.theta, rtol=1e-9, atol=1e-10 * size)
    np.testing.assert_allclose(one.std_error, other.std_error, rtol=1e-8)
    if signals.cutoff is None:
        assert whole.whole.trajectory.direction is None
    else:
        directions = [piece.read().trajectory.direction for piece in found.pieces]
        wanted = whole.whole.trajectory.direction
        np.testing.assert_allclose(np.concatenate(directions), wanted, rtol=0, atol=1e-10)
    return found, whole


@pytest.mark.parametrize(
    ("suffix", "given"),
    [
        ("csv", {}),
        ("parquet", {"velocity": "differentiated", "cutoff": 12.0, "order": 2}),
        ("csv", {"cutoff": None, "min_velocity": 0.0}),
        ("parquet", {"cutoff": None, "rate": 70.0}),
        ("csv", {"rate": 50.0, "trim": 0.6, "torque_delay": 0.02}),
        ("npz", {}),
        ("npz", {"rate": 50.0, "trim": 0.6, "torque_delay": 0.02}),
    ],
    ids=str,
)
def test_pieces_reduce_to_what_the_whole_log_reduces_to(model, recording, suffix, given, tmp_path):
    path = tmp_path / f"run.{suffix}"
    write_log(recording, path)
    found, _ = assert_alike(model, path, SignalSettings(**given))
    assert len(found.pieces) == (4 if suffix != "npz" else 1)
    assert [p.name for p in found.pieces][:1] in (
        ["run.csv rows 0-500"],
        ["run.parquet rows 0-500"],
        ["run.npz rows 0-2000"],
    )
    assert sum(piece.samples for piece in found.pieces) == len(recording.t)
    assert found.stamps[[found.first, found.stop - 1]].tolist() == [recording.t[0], recording.t[-1]]
    assert found.step == np.median(np.diff(recording.t))


def test_a_window_of_a_file_is_cut_as_in_memory(model, recording, tmp_path):
    path = tmp_path / "run.csv"
    write_log(recording, path)
    found, whole = assert_alike(model, path, SignalSettings(), start=3.3, end=12.01)
    np.testing.assert_array_equal(found.stamps[found.first : found.stop], whole.stamps)
    with pytest.raises(DataError) as in_memory:
        read_log(path, model.joints, start=50.0, end=60.0)
    with pytest.raises(DataError) as in_pieces:
        long_log(model, path, SignalSettings(), start=50.0, end=60.0)
    assert str(in_pieces.value) == str(in_memory.value)


def test_units_and_gains_are_read_as_in_memory(model, recording, tmp_path):
    columns = {"time": 1e3 * recording.t}
    for j, joint in enumerate(model.joints):
        columns[f"q_{joint}"] = np.rad2deg(recording.q[:, j])
        columns[f"dq_{joint}"] = np.rad2deg(recording.v[:, j])
        columns[f"current_{joint}"] = recording.tau[:, j] / (j + 2.0)
    path = tmp_path / "run.parquet"
    write_columns(columns, path)
    gains = {joint: j + 2.0 for j, joint in enumerate(model.joints)}
    assert_alike(model, path, SignalSettings(), gains=gains, units=LogUnits("ms", "deg"))
    with pytest.raises(DataError, match="milliseconds"):
        long_log(model, path, SignalSettings(), gains=gains, units=LogUnits(None, "deg"))
    with pytest.raises(DataError, match=r"q_.* looks like degrees"):
        long_log(model, path, SignalSettings(), gains=gains, units=LogUnits("ms"))


def test_full_turns_are_taken_out_of_each_piece(tmp_path):
    """A turn more or less of a joint without limits changes neither motion nor torque."""
    kinova = RobotModel.from_urdf(example_urdf("kinova.urdf"))
    free = np.array([joint.turns_freely for joint in kinova.limits])
    assert free.any()
    rng = np.random.default_rng(1)
    t = 0.01 * np.arange(1500)
    q, v, a = random_fourier(kinova, rng, period=8.0).evaluate(t)
    turn = np.sin(0.5 * t)[:, None] * 6.0 * free  # [rad] beyond a half turn to both sides
    q, v, a = q + turn, v + 3.0 * np.cos(0.5 * t)[:, None] * free, a - 0.25 * turn
    tau = (joint_torque_regressor(kinova, q, v, a) @ truth(kinova)).reshape(v.shape)
    wrapped = np.where(free, (q + np.pi) % (2 * np.pi) - np.pi, q)
    tau += 0.1 * rng.standard_normal(tau.shape)
    path = tmp_path / "run.parquet"
    write_log(Log(t=t, q=wrapped, tau=tau, joints=kinova.joints), path)
    found, _ = assert_alike(kinova, path, SignalSettings())
    turned = [piece.read().turned for piece in found.pieces]
    assert np.any(turned, axis=0).tolist() == free.tolist()


def test_a_locked_joint_has_the_positions_of_all_windows(model, recording, tmp_path, monkeypatch):
    monkeypatch.setattr(survey, "WINDOW", 100)
    path = tmp_path / "run.csv"
    write_log(recording, path)
    held, *moving = model.joints
    part = RobotModel.from_urdf(model.tree.path, joints=moving, locked={held: 0.0})
    reading = {"robot": part.tree.movable}
    found = long_log(part, path, SignalSettings(), **reading).locked
    rows = np.r_[0:100, 950:1050, 1900:2000]
    np.testing.assert_allclose(found[held], recording.q[rows, 0], rtol=1e-12)


def test_a_hole_in_the_last_piece_is_named_by_its_row_in_the_file(
    model, recording, tmp_path, monkeypatch
):
    table, path = table_of(recording), tmp_path / "run.parquet"
    hole = np.where(np.arange(len(recording.t)) == 1801, np.nan, 0.0)
    write_columns(table | {"tau_elbow_joint": table["tau_elbow_joint"] + hole}, path)
    layout, table = lay_out(path, model.joints)
    short = replace(layout, notes=())
    monkeypatch.setattr(survey, "WINDOW", 100)
    window = (2.0, None)
    log = survey_log(short, table, model, SignalSettings(cutoff=None), window, length=LENGTH)
    pieces = pieces_of(log)
    pieces[-2]()
    with pytest.raises(DataError, match=r"tau_elbow_joint is NaN at row 1801 \(t = ") as found:
        pieces[-1]()
    assert found.value.code == "not_finite"


def test_pieces_travel_as_they_are(model, recording, tmp_path):
    path = tmp_path / "run.parquet"
    write_log(recording, path)
    pieces = pieces_of(long_log(model, path, SignalSettings()))
    for piece, again in zip(pieces, pickle.loads(pickle.dumps(pieces)), strict=True):
        np.testing.assert_array_equal(again().factors.R, piece().factors.R)
    # the model and the mapping go along once
    assert len(pickle.dumps(pieces)) < len(pickle.dumps(pieces[:1])) + 1000 * len(pieces)


def test_the_pieces_of_a_log_have_the_bias_of_all_rests_of_its_windows(monkeypatch, tmp_path):
    """The robot moves in the first window, rests in the middle one and a part of the last one."""
    monkeypatch.setattr(survey, "WINDOW", 200)
    robot = RobotModel.from_urdf(example_urdf("solo12.urdf"), free_flyer=True, terms=())
    t = 3.0 + 0.01 * np.arange(1000)
    rests = ((t > 6.9) & (t < 9.1)) | (t > 11.495)
    q = np.where(rests, 0.0, np.sin(9.0 * t))
    bias, turn = np.array([0.011, -0.02, 0.005]), pin.rpy.rpyToMatrix(0.4, -1.1, 2.9)
    w = bias + np.where(rests, 0.0, np.cos(7.0 * t))[:, None] + 0.002 * (t > 11.495)[:, None]
    columns = {"t": t} | {f"{x}_{j}": q for j in robot.joints for x in ("q", "tau")}
    columns |= {f"imu_{x}": 0.0 * t for x in ("qx", "qy", "qz", "ax", "ay")}
    columns |= {"imu_qw": 1.0 + 0.0 * t, "imu_az": 9.81 + 0.0 * t}
    columns |= {f"imu_{x}": y for x, y in zip(("wx", "wy", "wz"), w.T, strict=True)}
    write_columns(columns, tmp_path / "run.csv")
    frame = ImuFrame(pin.Quaternion(turn).coeffs(), np.zeros(3), np.array([0.0, 0.0, -9.81]))
    base, signals = BaseColumns(True, imu=frame), SignalSettings(cutoff=None, trim=0.0)
    found = long_log(robot, tmp_path / "run.csv", signals, base=base, length=250)
    # whole half seconds at rest: 3 in the middle window from 7 s, 2 in the last one from 11 s
    wanted = turn @ (bias + 0.002 * 2 / 5)
    np.testing.assert_allclose(found.source.base.imu.bias, wanted, atol=1e-6)
    for log in found.windows:
        rows = np.searchsorted(t, log.t)
        values = log.base.imu.values[:, :3]
        np.testing.assert_allclose(values, w[rows] @ turn.T - wanted, atol=1e-6)
        (note,) = [x for x in log.notes if "gyroscopes" in x]
        assert "estimated in 2.5 s at rest" in note
    offset = np.array([0.3, -0.2, 0.1])
    changed = found.with_accelerometer_bias(offset)
    for log in changed.windows:
        np.testing.assert_array_equal(log.base.imu.frame.offset, offset)
    pieces, others = ([x.read().trajectory for x in log.pieces] for log in (found, changed))
    at, own, a = (np.concatenate([getattr(x, name) for x in pieces]) for name in ("t", "v", "a"))
    rows = np.searchsorted(t, at - 1e-6)
    np.testing.assert_allclose(own[:, 3:6], w[rows] @ turn.T - wanted, atol=1e-6)
    biased = np.concatenate([x.a for x in others])
    np.testing.assert_allclose(a[:, :3] - biased[:, :3], np.tile(offset, (len(a), 1)), atol=1e-9)
    np.testing.assert_array_equal(a[:, 3:], biased[:, 3:])


def test_means_of_segments_of_a_static_robot_replace_filter_and_rate(model, recording):
    signals = SignalSettings(
        cutoff=6.0, rate=50.0, velocity="measured", acceleration="measured", max_gap=0.1
    )
    held = hold_log(replace(model, dynamics="static"), recording, signals)
    assert held.signals == replace(
        signals, cutoff=None, rate=None, velocity="differentiated", acceleration="differentiated"
    )
    assert hold_log(model, recording, signals).signals.rate == 50.0


def test_other_drive_terms_keep_the_rows_and_torques_without_contact_forces(rng):
    """A quadruped on two feet; of a log without them, or in another order, nothing is read."""
    feet = ("HR_FOOT", "FL_FOOT")
    model = RobotModel.from_urdf(
        example_urdf("solo12.urdf"), free_flyer=True, terms=("viscous",),
        constraints=[Contact(foot) for foot in feet],
    )  # fmt: skip
    t = np.arange(60) / 50.0
    pose = np.column_stack([np.sin(t), t, 0 * t, 0 * t, 0 * t, np.sin(t / 2), np.cos(t / 2)])
    flags = {foot: (t > 0.5) == (foot == feet[0]) for foot in feet}
    q, tau = np.sin(np.outer(t, rng.uniform(1, 3, 12))), rng.standard_normal((60, 12))
    log = Log(t, q, tau, model.joints, base=BaseMotion(pose), contacts=flags)
    settings = SignalSettings(cutoff=None, trim=0.0, velocity="differentiated")
    held = hold_log(model, log, settings)
    first = held.whole
    assert np.flatnonzero(~first.mask.all(axis=1)).tolist() == [25, 26]  # the feet change
    other = held.with_model(model.with_terms({"FL_KFE": (Cubic(),)})).whole
    np.testing.assert_array_equal(other.mask, first.mask)
    np.testing.assert_array_equal(other.trajectory.basis, first.trajectory.basis)
    np.testing.assert_array_equal(other.trajectory.tau, first.trajectory.tau)
    # nor are rows taken again that a jump of the base without contacts left out
    jumped = replace(
        log, base=BaseMotion(pose + 0.3 * np.outer(t > 0.75, np.eye(7)[2])), contacts={}
    )
    held = hold_log(replace(model, constraints=()), jumped, settings)
    assert held.whole.mask.any(axis=1)[[0, 38, 59]].tolist() == [True, False, True]
    other = held.with_model(held.model.with_terms({"FL_KFE": (Cubic(),)})).whole
    np.testing.assert_array_equal(other.mask, held.whole.mask)
    turned = replace(log, contacts=dict(reversed(flags.items())))
    with pytest.raises(DataError, match="has the contacts FL_FOOT, HR_FOOT, expected the model's"):
        hold_log(model, turned, settings)
    with pytest.raises(DataError, match="log has no pose of the floating base"):
        hold_log(model, replace(log, base=None), settings)


def test_other_drive_terms_keep_the_rows_that_a_closed_chain_leaves(rng, tmp_path):
    """Crank and coupler in line: the rocker cannot move, and the bars hold all of its torque."""
    model = four_bar(tmp_path, terms=("viscous",))
    t = np.arange(41) / 50.0
    given = np.zeros((41, 3))
    given[:, model.joints.index("elbow")] = np.sin(2 * (t - t[20]))
    missing = np.array([joint != "elbow" for joint in model.joints])
    q = Chains(model).closed(given, missing)
    log = Log(t, q, rng.standard_normal(q.shape), model.joints)
    settings = SignalSettings(cutoff=None, trim=0.0, min_velocity=0.0)
    held = hold_log(model, log, settings)
    first, pivot = held.whole, model.joints.index("pivot")
    assert np.argwhere(~first.mask).tolist() == [[20, pivot]]
    other = held.with_model(model.with_terms({"elbow": (Cubic(),)})).whole
    np.testing.assert_array_equal(other.mask, first.mask)
    # read in pieces the torques of the bars are mixed likewise: every row has every column
    write_log(log, tmp_path / "log.csv")
    mapping = structural_mapping(model)
    held, read = (
        Recordings(model, mapping, [own]).problem()
        for own in (held, long_log(model, tmp_path / "log.csv", settings, length=15))
    )
    assert read.is_projected
    np.testing.assert_array_equal(read.support, held.support)
    rows = [[np.concatenate(x) for x in zip(*own.blocks(), strict=True)] for own in (held, read)]
    for one, other in zip(*rows, strict=True):
        np.testing.assert_allclose(other, one, atol=1e-9)
