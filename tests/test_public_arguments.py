"""Arguments of another kind are refused in words; a wrong keyword stays Python's TypeError."""

import re
from pathlib import Path

import numpy as np
import pytest
from helpers.paths import URDF as FOLDER
from helpers.synthetic import exact_log, truth

import robotid
from robotid import Log, RobotModel, SignalSettings, identify, payload
from robotid.base.exceptions import DataError, RobotIdError, SettingsError
from robotid.cli.job import read_job
from robotid.data.base_motion import BaseMotion
from robotid.data.signal_settings import LogSource
from robotid.output.files.mjcf import write_mjcf
from robotid.output.files.sdf import write_sdf
from robotid.output.files.urdf import write_urdf
from robotid.output.report import pictures
from robotid.output.report.report_content import write_report
from robotid.robot.constraints import Contact, Loop
from robotid.robot.parameters import Coupling

URDF = FOLDER / "planar_2r.urdf"


@pytest.fixture(scope="module")
def model():
    return RobotModel.from_urdf(URDF)


@pytest.fixture(scope="module")
def log(model):
    return exact_log(model, truth(model), np.random.default_rng(0), samples=60, rate=50.0)


def fields(log, **other):
    return {"t": log.t, "q": log.q, "tau": log.tau, "joints": log.joints} | other


def test_names_in_an_array_are_names(log):
    made = Log(**fields(log, joints=np.array(log.joints)))
    assert made.joints == ("joint_1", "joint_2")
    assert all(type(name) is str for name in made.joints)


def test_a_masked_value_is_no_value(log):
    q = np.ma.masked_array(log.q, mask=np.zeros_like(log.q, dtype=bool))
    assert np.array_equal(Log(**fields(log, q=q)).q, log.q)
    q.mask[7, 1] = True
    with pytest.raises(DataError, match="q_joint_2 is NaN at row 7"):
        Log(**fields(log, q=q))
    whole = np.ma.masked_equal(np.arange(60), 7)  # whole numbers have no NaN
    with pytest.raises(DataError, match="time is NaN at row 7"):
        Log(**fields(log, t=whole))


@pytest.mark.parametrize(
    ("other", "words"),
    [
        ({"tau": None}, "tau is None, expected an array; without torques, pass zeros and"),
        ({"q": None}, "q is None, expected an array"),
        ({"q": "x"}, "q is not an array of real numbers"),
        ({"q": [[1.0, 2.0], [3.0]]}, "expected an array of floats with rows of equal length"),
        ({"q": np.full((60, 2), 1j)}, "q is not an array of real numbers .numbers of kind 'c'"),
        ({"joints": 5}, "joints is 5, expected at least one name in a tuple"),
        ({"t": 10**400}, "t is not an array of real numbers"),
        ({"joints": (1, 2)}, "expected at least one name in a tuple"),
        ({"joints": {"joint_1": 0, "joint_2": 1}}, "expected at least one name in a tuple"),
    ],
)
def test_what_is_no_log_is_refused(log, other, words):
    with pytest.raises(DataError, match=words):
        Log(**fields(log, **other))


CALLS = {
    "signals": lambda m, log: identify(m, log, signals="x"),
    "estimator": lambda m, log: identify(m, log, estimator=5),
    "friction": lambda m, log: identify(m, log, friction=5, doctor=False),
    "friction of joint_2": lambda m, log: identify(m, log, friction={"joint_2": 5}, doctor=False),
    "ignore": lambda m, log: identify(m, log, ignore=None),
    "a code in ignore": lambda m, log: identify(m, log, ignore=[5]),
    "signals ": lambda m, log: payload(m, log, log, signals=5),
    "links": lambda m, log: payload(m, log, log, links=5),
    "masses": lambda m, log: payload(m, log, log, masses=5),
    "unknown_gains": lambda m, log: payload(m, log, log, unknown_gains=None),
    "noise": lambda m, log: robotid.preview(m, log, noise=5),
    "given": lambda m, log: robotid.preview(m, log, given=5),
    "signals  ": lambda m, log: robotid.doctor(m, log, signals="x"),
    "joints": lambda m, log: robotid.read_log("x.csv", 5),
    "columns": lambda m, log: robotid.read_log("x.csv", ["a"], columns=5),
    "gains": lambda m, log: robotid.read_log("x.csv", ["a"], gains=5),
    "source": lambda m, log: robotid.read_log("x.csv", ["a"], source=None),
    "log": lambda m, log: robotid.write_log(5, "x.csv"),
    "path": lambda m, log: robotid.write_log(log, 5),
    "path ": lambda m, log: RobotModel.from_urdf(None),
    "joints ": lambda m, log: RobotModel.from_urdf(URDF, joints=5),
    "locked": lambda m, log: RobotModel.from_urdf(URDF, locked=5),
    "couplings": lambda m, log: RobotModel.from_urdf(URDF, couplings=5),
    "path  ": lambda m, log: robotid.load_result(5),
    "path   ": lambda m, log: read_job(5),
    "path    ": lambda m, log: robotid.inspect(5),
    "model ": lambda m, log: robotid.OnlineIdentifier(5),
    "settings": lambda m, log: robotid.OnlineIdentifier(m, 5),
    "pi": lambda m, log: write_urdf(m, 5, "x.urdf"),
    "target": lambda m, log: write_sdf(m, m.standard_parameters(), 5),
    "model  ": lambda m, log: write_mjcf(5, m.standard_parameters(), "x.xml"),
    "t": lambda m, log: robotid.replay(m, None, log.q),
    "path     ": lambda m, log: Log(**fields(log, path=5)),
    "has_torque": lambda m, log: Log(**fields(log, has_torque="x")),
    "notes": lambda m, log: Log(**fields(log, notes=[5])),
    "joints  ": lambda m, log: log.select(["joint_1", 5]),
    "joints   ": lambda m, log: LogSource(joints=5),
    "command": lambda m, log: LogSource(command=5),
    "estimator ": lambda m, log: robotid.EstimatorSettings(["ols"]),
    "constraints": lambda m, log: robotid.EstimatorSettings(constraints=5),
    "name": lambda m, log: Coupling(5, (("joint_1", 1.0),)),
    "ratios": lambda m, log: Coupling("c", "x"),
    "replaces": lambda m, log: Coupling("c", (("joint_1", 1.0),), 1),
    "free_flyer": lambda m, log: RobotModel.from_urdf(URDF, free_flyer=np.zeros(2)),
    "free_flyer ": lambda m, log: robotid.inspect(URDF, free_flyer="x"),
    "snap_angles": lambda m, log: RobotModel.from_urdf(URDF, snap_angles=None),
    "terms": lambda m, log: RobotModel.from_urdf(URDF, terms=[5]),
    "couplings ": lambda m, log: RobotModel.from_urdf(URDF, couplings=np.array("x")),
    "own_terms of 'joint_2'": lambda m, log: RobotModel.from_urdf(URDF, own_terms={"joint_2": [5]}),
    "prismatic": lambda m, log: robotid.read_log("x.csv", ["a"], prismatic=[["a"]]),
    "transmissions": lambda m, log: robotid.read_log("x.csv", ["a"], transmissions=[None]),
    "a key of columns": lambda m, log: robotid.read_log("x.csv", ["a"], columns={1: "t"}),
    "columns['tau_a']": lambda m, log: robotid.read_log("x.csv", ["a"], columns={"tau_a": 1}),
    "doctor": lambda m, log: identify(m, log, doctor="no"),
    "links ": lambda m, log: payload(m, log, log, links=[5]),
    "unknown_gains ": lambda m, log: payload(m, log, log, unknown_gains="joint_1"),
    "noise of 'joint_2'": lambda m, log: robotid.preview(m, log, noise={"joint_2": "x"}),
    "commanded": lambda m, log: write_mjcf(m, m.standard_parameters(), "x.xml", commanded=["x"]),
    "marks": lambda m, log: robotid.replay(m, log.t, log.q, marks=["x"]),
    "notes ": lambda m, log: robotid.replay(m, log.t, log.q, notes=[5]),
    "masses of 'x'": lambda m, log: robotid.replay(m, log.t, log.q, masses={"x": 5}),
    "ghost 'x'": lambda m, log: robotid.replay(m, log.t, log.q, ghosts={"x": 5}),
    "rate": lambda m, log: robotid.replay(m, log.t, log.q, rate=10**400),
}


@pytest.mark.parametrize("name", CALLS)
def test_an_argument_of_another_kind_is_named(model, log, tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SettingsError, match=rf"^{re.escape(name.strip())} is .*, expected "):
        CALLS[name](model, log)
    assert not list(Path(tmp_path).iterdir())


@pytest.mark.parametrize("value", [b"x", np.zeros(3), object()])
@pytest.mark.parametrize("name", ["cutoff", "order", "trim", "velocity", "torque_delay"])
def test_settings_of_any_kind_are_refused_in_words(name, value):
    with pytest.raises(RobotIdError, match=rf"^{name} is .*, expected"):
        SignalSettings(**{name: value})


def test_a_payload_needs_logs_with_and_without_it(model, log):
    for name, logs in (("logs", ([], log)), ("reference", (log, []))):
        with pytest.raises(DataError, match=rf"^{name} has no log, expected at least one"):
            payload(model, *logs)


@pytest.fixture(scope="module")
def found(model, log):
    return identify(model, log, estimator="ols", doctor=False, friction="none")


CALLS_OF_A_RESULT = {
    "q is not an array of real numbers": lambda found, q: found.predict("x"),
    "v is not an array of real numbers": lambda found, q: found.predict(q, 1j * q),
    "a is not an array of real numbers": lambda found, q: found.predict(q, q, 10**400),
    "joint is 5 (int), expected the name of a joint": lambda found, q: found.friction(5),
    "v is not an array of real": lambda found, q: found.friction("joint_1", "x"),
    "v has shape (3, 2), expected finite speeds": lambda found, q: found.friction("joint_1", q),
    "q is 'x', expected a finite number": lambda found, q: found.friction("joint_1", q="x"),
    "load is 'nan', expected a finite": lambda found, q: found.friction("joint_1", load=np.nan),
    "joint is None (NoneType), expected the name": lambda found, q: pictures.plot_why(found, None),
    "recording is 5 (int), expected": lambda found, q: pictures.plot_torques(
        found, "joint_1", recording=5
    ),
    "name is ['wls'], expected 'estimate' or 'wls'": lambda found, q: found.metrics(["wls"]),
    "'a\\x00b' is not a valid path": lambda found, q: robotid.save_result(found, "a\0b"),
    "'\\ud800' is not a valid path": lambda found, q: write_report(found, "\ud800"),
}


@pytest.mark.parametrize("words", CALLS_OF_A_RESULT)
def test_what_is_asked_of_a_result_is_checked(found, log, tmp_path, monkeypatch, words):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(RobotIdError, match=rf"^{re.escape(words)}"):
        CALLS_OF_A_RESULT[words](found, log.q[:3])
    assert not list(tmp_path.iterdir())


def test_masked_values_are_not_predicted_with(found, log):
    q = np.ma.masked_array(log.q[:3], mask=np.zeros((3, 2), dtype=bool))
    assert np.array_equal(found.predict(q), found.predict(log.q[:3]))
    q.mask[1, 1] = True
    with pytest.raises(DataError, match=r"q is not finite in row 1"):
        found.predict(q)


@pytest.mark.parametrize(
    "path",
    ["x" * 300, f"x/{'y' * 256}/z", f"{'y' * 256}/x.csv", "x/" * 3000 + "x", "a\0b", "\ud800"],
)
def test_a_path_that_no_file_system_takes_is_refused(model, log, path):
    for call in (
        lambda: robotid.read_log(path, ["a"]),
        lambda: identify(model, path),
        lambda: robotid.load_result(path),
        lambda: read_job(path),
        lambda: robotid.write_log(log, f"{path}.csv"),
    ):
        with pytest.raises(SettingsError, match=r"not a valid path|a file has .* bytes, expected"):
            call()


@pytest.mark.parametrize(
    ("t", "q", "tau", "words"),
    [
        ("x", [0, 0], [0, 0], "t = x s is not finite"),
        (0.0, None, [0, 0], "q is None, expected an array"),
        (0.0, [0, 0, 0], [0], r"q, tau have shapes \(3,\), \(1,\), expected \(2,\) each"),
        (0.0, [0, 0], [0, 0, 0], r"q, tau have shapes \(2,\), \(3,\), expected \(2,\) each"),
        (0.0, [0, 0], ["x", 0], "tau is not an array of real numbers"),
    ],
)
def test_a_sample_that_is_none_changes_nothing(model, t, q, tau, words):
    online = robotid.OnlineIdentifier(model)
    with pytest.raises(DataError, match=words):
        online.update(t, q, tau)
    online.update(-1.0, [0.0, 0.0], [0, 0])  # earlier than the one that was refused


REFUSED = {
    "start is ": lambda m, log: log.window(log.q, 1.0),
    "end is ": lambda m, log: log.window(0.0, 10**400),
    "constraints has the key 'weight', expected keys": lambda m, log: robotid.EstimatorSettings(
        constraints={"weight": 1.0}
    ),
    "joint 'joint_2' is locked at": lambda m, log: RobotModel.from_urdf(
        URDF, locked={"joint_2": "x"}
    ),
    "ratios of 'c' has ('joint_2', 'x'), expected pairs": lambda m, log: Coupling(
        "c", (("joint_1", 1.0), ("joint_2", "x"))
    ),
    "the mass of the payload on link_2 is 'x' kg, expected": lambda m, log: payload(
        m, log, log, masses={"link_2": "x"}
    ),
    "masses of 'x' have shape (3,), expected 20 or 28 finite": lambda m, log: robotid.replay(
        m, log.t, log.q, masses={"y": m.standard_parameters(), "x": np.zeros(3)}
    ),
    "ghost 'x' has 3 arrays, expected two": lambda m, log: robotid.replay(
        m, log.t, log.q, ghosts={"x": (log.t, log.q, log.q)}
    ),
    "log: joints.joint_2 is 5, expected a name": lambda m, log: LogSource(
        joints={"joint_1": "a", "joint_2": 5}
    ),
    "gravity is ": lambda m, log: RobotModel.from_urdf(URDF, gravity=(0, 0, 10**400)),
    "trajectory: rate is 'x', expected": lambda m, log: robotid.Trajectory(
        log.t, log.q, log.q, log.q, log.tau, log.joints, "x", np.zeros(60, dtype=int)
    ),
    "trajectory: segment is object of shape (), expected": lambda m, log: robotid.Trajectory(
        log.t, log.q, log.q, log.q, log.tau, log.joints, None, [[1], [1, 2]]
    ),
}


@pytest.mark.parametrize("words", REFUSED)
def test_an_entry_of_another_kind_is_named(model, log, words):
    with pytest.raises(RobotIdError, match=rf"^{re.escape(words)}"):
        REFUSED[words](model, log)


def test_a_gain_that_is_no_number_is_refused(log, tmp_path):
    robotid.write_log(log, tmp_path / "log.csv")
    words = "gain of 'joint_2' is .*, expected a number other than"
    for gain in (None, "x", np.nan, 0):
        gains = {"joint_1": 2.0, "joint_2": gain}
        with pytest.raises(SettingsError, match=words):
            robotid.read_log(tmp_path / "log.csv", log.joints, gains=gains)


def test_flags_and_numbers_of_numpy_are_flags_and_numbers(log):
    assert RobotModel.from_urdf(URDF, free_flyer=np.True_).free_flyer
    part = log.window(np.float32(0.1), np.int64(1))
    assert (part.t[0], part.t[-1]) == (0.12, 1.0)
    assert len(log.window(-np.inf, np.inf).t) == len(log.t)


JUNK = (5, 0.5, "x", [None], {1: 2}, object(), np.zeros(0), np.array(["a", "b", "c"]))


@pytest.fixture(scope="module")
def result(found, tmp_path_factory):
    target = tmp_path_factory.mktemp("result")
    return robotid.load_result(robotid.save_result(found, target, report=False))


@pytest.mark.parametrize("junk", JUNK, ids=lambda x: type(x).__name__)
def test_each_public_boundary_names_the_argument_and_its_type(
    model, log, found, result, junk, tmp_path
):
    """No AttributeError, TypeError, KeyError or IndexError comes out of any of them."""
    pose = np.tile([0.0] * 6 + [1.0], (60, 1))
    segment = np.zeros(60, dtype=int)
    motion = robotid.Trajectory(log.t, log.q, log.q, log.q, log.tau, log.joints, 50.0, segment)
    path = tmp_path / "log.csv"
    robotid.write_log(log, path)
    for name, call in {
        "pose": lambda: BaseMotion(junk),
        "twist": lambda: BaseMotion(pose, twist=junk),
        "contacts": lambda: Log(**fields(log, contacts=junk)),
        "wrenches": lambda: Log(**fields(log, wrenches=junk)),
        "kind": lambda: Contact("x", kind=junk),
        "frames": lambda: Loop(junk),
        "progress": lambda: identify(model, log, progress=junk),
        "identification": lambda: robotid.save_result(junk, tmp_path / "other"),
        "base": lambda: robotid.read_log(path, log.joints, base=junk),
        "log": lambda: result.open_loop(junk),
        "evaluation": lambda: found.band(junk),
        "own": lambda: model.with_terms(junk),
        "gravity": lambda: model.with_gravity(junk),
        "pi": lambda: model.with_parameters(junk),
        "q": lambda: model.configurations(junk),
        "sign": lambda: log.turned(junk),
        "rows": lambda: motion.at(junk),
    }.items():
        with pytest.raises(RobotIdError, match=rf"^(log: )?.*\b{name}\b"):
            call()
    assert not (tmp_path / "other").exists()


def test_a_result_from_torques_has_no_controller(result, log):
    assert result.rate is None
    with pytest.raises(DataError, match=r"result.json is a result from torques, expected one of"):
        result.open_loop(log)


def test_lists_are_arrays(model, log):
    np.testing.assert_array_equal(model.configurations([[0.1, 0.2]]), [[0.1, 0.2]])
    np.testing.assert_array_equal(log.turned([1, -1]).q, log.q * [1, -1])
