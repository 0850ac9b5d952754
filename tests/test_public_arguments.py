"""Arguments of another kind than a public function takes are refused in words, not by an accident.

A wrong keyword stays Python's TypeError.
"""

from pathlib import Path

import numpy as np
import pytest
from helpers.paths import URDF as FOLDER
from helpers.synthetic import exact_log, truth

import robotid
from robotid import Log, RobotModel, SignalSettings, identify, identify_payload
from robotid.exceptions import DataError, RobotIdError, SettingsError

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


@pytest.mark.parametrize("column", [0, 1])
def test_a_masked_value_is_no_value(log, column):
    q = np.ma.masked_array(log.q, mask=np.zeros_like(log.q, dtype=bool))
    assert np.array_equal(Log(**fields(log, q=q)).q, log.q)
    q.mask[7, column] = True
    with pytest.raises(DataError, match=rf"q_joint_{column + 1} is NaN at row 7"):
        Log(**fields(log, q=q))
    whole = np.ma.masked_equal(np.arange(60), 7)  # whole numbers have no NaN
    with pytest.raises(DataError, match="time is NaN at row 7"):
        Log(**fields(log, t=whole))


@pytest.mark.parametrize(
    ("other", "words"),
    [
        ({"tau": None}, "tau is None, wanted an array; without torques, give zeros and has_torque"),
        ({"q": None}, "q is None, wanted an array"),
        ({"q": "x"}, "q is no array of real numbers"),
        ({"q": [[1.0, 2.0], [3.0]]}, "wanted one of floats, with rows of equal length"),
        ({"q": np.full((60, 2), 1j)}, "q is no array of real numbers .numbers of kind 'c'"),
        ({"joints": 5}, "joints is 5, wanted at least one name in a tuple"),
        ({"joints": (1, 2)}, "wanted at least one name in a tuple"),
        ({"joints": {"joint_1": 0, "joint_2": 1}}, "wanted at least one name in a tuple"),
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
    "signals ": lambda m, log: identify_payload(m, log, log, signals=5),
    "links": lambda m, log: identify_payload(m, log, log, links=5),
    "masses": lambda m, log: identify_payload(m, log, log, masses=5),
    "unknown_gains": lambda m, log: identify_payload(m, log, log, unknown_gains=None),
    "noise": lambda m, log: robotid.preview(m, log, noise=5),
    "given": lambda m, log: robotid.preview(m, log, given=5),
    "signals  ": lambda m, log: robotid.check_logs(m, log, signals="x"),
    "model": lambda m, log: robotid.check_logs(5, log),
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
    "path   ": lambda m, log: robotid.read_job(5),
    "path    ": lambda m, log: robotid.inspect_urdf(5),
    "job": lambda m, log: robotid.run_job(5, "x"),
    "model ": lambda m, log: robotid.OnlineIdentifier(5),
    "identification": lambda m, log: robotid.write_report(5, "x.html"),
    "found": lambda m, log: robotid.write_ranges(5, "x.yaml"),
    "pi": lambda m, log: robotid.write_urdf(m, 5, "x.urdf"),
    "target": lambda m, log: robotid.write_sdf(m, m.standard_parameters(), 5),
    "model  ": lambda m, log: robotid.write_mjcf(5, m.standard_parameters(), "x.xml"),
    "t": lambda m, log: robotid.replay(m, None, log.q),
}


@pytest.mark.parametrize("name", CALLS)
def test_an_argument_of_another_kind_is_named(model, log, tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SettingsError, match=rf"^{name.strip()} is .*, wanted "):
        CALLS[name](model, log)
    assert not list(Path(tmp_path).iterdir())


@pytest.mark.parametrize("value", [b"x", np.zeros(3), object()])
@pytest.mark.parametrize("name", ["cutoff", "order", "trim", "velocity", "torque_delay"])
def test_settings_of_any_kind_are_refused_in_words(name, value):
    with pytest.raises(RobotIdError, match=rf"^{name} is .*, wanted"):
        SignalSettings(**{name: value})


@pytest.mark.parametrize(("logs", "reference"), [([], "log"), ("log", [])])
def test_a_payload_needs_logs_with_and_without_it(model, log, logs, reference):
    given = [log if some == "log" else some for some in (logs, reference)]
    name = "logs" if not given[0] else "reference"
    with pytest.raises(DataError, match=rf"^{name} has no log, wanted at least one"):
        identify_payload(model, *given)
