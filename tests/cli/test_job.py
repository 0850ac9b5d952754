import re
from pathlib import Path

import numpy as np
import pytest
from helpers.paths import URDF
from helpers.synthetic import sine_log

from robotid.base.exceptions import SettingsError
from robotid.cli.job import Job, LogEntry, job_from_settings, read_job
from robotid.data.files.read import write_log
from robotid.data.signal_settings import LogSource
from robotid.estimation.fitting.estimator_settings import SimulationSettings
from robotid.identification.closed_loop.loop_settings import LogGains, LoopSettings
from robotid.robot.constraints import Loop
from robotid.robot.parameters import Coupling

FULL = """
urdf = "robot.urdf"
joints = ["a", "b"]
locked = { c = 0.8 }
passive = ["b"]
gravity = [0.0, -9.81, 0.0]

[signals]
rate = 200.0
cutoff = 8.0
order = 4
velocity = "auto"
acceleration = "differentiated"
trim = 0.2
min_velocity = 0.02
max_gap = 0.1

[model]
armature = true
friction = "viscous"
offset = false

[torque]
gains = { a = 14.87 }

[log]
topic = "/arm"
joints = { a = "M1" }
effort = "current"
stamp = "log"

[units]
time = "ms"

[[coupling]]
name = "motor"
ratios = { a = 1, b = -1.0 }

[[transmission]]
joints = ["a", "b"]
motors = ["m", "n"]
matrix = [[32, 0], [45, 45]]
efficiency = [0.9, 1.0]

[[loop]]
frames = ["hand", "rod"]
kind = "point"

[estimator]
name = "wls"

[output]
dynamics = true

[[identification]]
log = "ident.parquet"
start = 0.3
end = 13.5
[[validation]]
log = "val.parquet"
"""


def write(tmp_path, text):
    path = tmp_path / "job.toml"
    path.write_text(text)
    return path


def test_every_key_of_a_job_arrives(tmp_path):
    job = read_job(write(tmp_path, FULL))
    assert job.urdf == tmp_path / "robot.urdf"
    assert job.joints == ("a", "b")
    assert job.locked == {"c": 0.8}
    assert job.gravity == (0.0, -9.81, 0.0)
    assert job.signals.rate == 200.0
    assert job.signals.acceleration == "differentiated"
    assert job.terms == ("armature", "viscous")
    assert job.gains == {"a": 14.87}
    assert job.units.time == "ms"
    assert job.source == LogSource("/arm", joints={"a": "M1"}, effort="current", stamp="log")
    assert job.couplings == (Coupling("motor", (("a", 1.0), ("b", -1.0))),)
    assert job.loops == (Loop(("hand", "rod"), "point"),)
    assert job.passive == ("b",)
    (gear,) = job.transmissions
    assert (gear.motors, gear.efficiency) == (("m", "n"), (0.9, 1.0))
    assert gear.T.tolist() == [[32.0, 0.0], [45.0, 45.0]]
    assert job.estimator.name == "wls"
    assert job.dynamics is True
    (entry,) = job.identification
    assert (entry.path, entry.start, entry.end) == (tmp_path / "ident.parquet", 0.3, 13.5)
    assert job.validation[0].end is None


def test_settings_written_into_a_result_are_the_same_job(tmp_path):
    job = read_job(write(tmp_path, FULL))
    assert job_from_settings(job.to_dict(), "result.json", Path()) == job
    off = read_job(write(tmp_path, FULL.replace("cutoff = 8.0", "cutoff = false")))
    assert off.signals.cutoff is None
    assert job_from_settings(off.to_dict(), "result.json", Path()) == off


def test_paths_may_name_environment_variables(tmp_path, monkeypatch):
    path = write(tmp_path, 'urdf = "$SOME_FOLDER/robot.urdf"')
    monkeypatch.setenv("SOME_FOLDER", str(tmp_path / "data"))
    assert read_job(path).urdf == tmp_path / "data" / "robot.urdf"
    monkeypatch.delenv("SOME_FOLDER")
    with pytest.raises(SettingsError, match="names an environment variable that is not set"):
        read_job(path)


CONSTRAINTS = '"consistent"\n[estimator.constraints]\n'
WRONG = {
    "misspelt key": ("order = 4", "ordr = 4", "ordr is not a known key. Did you mean 'order'?"),
    "misspelt table": ("[signals]", "[signal]", "known key. Did you mean 'signals'?"),
    "text for a number": ("trim = 0.2", 'trim = "0.2"', "signals.trim is '0.2', expected a number"),
    "cutoff true": ("cutoff = 8.0", "cutoff = true", "cutoff is true, expected a frequency [Hz]"),
    "negative cutoff": ("cutoff = 8.0", "cutoff = -8.0", "cutoff is -8.0, expected 0.001 to 1e6"),
    "friction model": (
        '"viscous"', '"stribek"', "friction is 'stribek', expected auto, none, or some of viscous",
    ),
    "estimator": ('"wls"', '"magic"', "estimator is 'magic', expected one of"),
    "gain": ("a = 14.87", 'a = "14.87"', "gains.a is '14.87', expected a number"),
    "one bracket": ("[[validation]]", "[validation]", "expected tables written as [[validation]]"),
    "no log": ('log = "val.parquet"', "end = 2.0", "a [[validation]] has no key 'log'"),
    "loop's kind": ('"point"', '"ball"', "loop hand, rod: kind is 'ball', expected one of point"),
    "loop's frames": ('["hand", "rod"]', '["hand"]', "loop.frames has 1 entries, expected 2"),
    "no frames": ('frames = ["hand", "rod"]', "", "a [[loop]] has no key 'frames'"),
    "loop's axis": ('"point"', '"hinge"\naxis = [0, 1]', "loop.axis has 2 entries, expected 3"),
    "passive": ('passive = ["b"]', 'passive = "b"', "passive is 'b', expected a list"),
    "no urdf": ('urdf = "robot.urdf"', "", "has no key 'urdf'"),
    "joints text": ('joints = ["a", "b"]', 'joints = "a"', "joints is 'a', expected a list"),
    "effort": ('effort = "current"', 'effort = "force"', "log: effort is 'force', expected one of"),
    "stamp": ('stamp = "log"', 'stamp = "wall"', "log: stamp is 'wall', expected one of"),
    "joint a number": ('["a", "b"]', "[1]", "joints[0] is 1, expected"),
    "gravity too short": ("-9.81, 0.0]", "-9.81]", "gravity has 2 entries, expected 3"),
    "gravity NaN": ("-9.81", "nan", "gravity[1] is nan, expected a number between -1e30 and 1e30"),
    "ratio": ("a = 1, b", "a = true, b", "ratios.a is True, expected a number"),
    "no matrix": ("matrix = [[32, 0], [45, 45]]", "", "a [[transmission]] has no key 'matrix'"),
    "matrix of text": ("[45, 45]]", '["a", 45]]', "matrix is [[32, 0], ['a', 45]], expected"),
    "singular": ("[45, 45]]", "[45, 0]]", "matrix [[32, 0], [45, 0]] is singular"),
    "motor twice": ('["m", "n"]', '["m", "m"]', "motors contains m twice"),
    "ignore": ("[output]", "[doctor]\nignore = [1]\n[output]", "ignore[0] is 1, expected"),
    "rate too high": ("rate = 200.0", "rate = 1e9", "rate is 1000000000.0, expected 0.001 to 1e6"),
    "cutoff too low": ("cutoff = 8.0", "cutoff = 1e-30", "cutoff is 1e-30, expected 0.001 to 1e6"),
    "band": ("trim = 0.2", "friction_band = 1e-320", "friction_band is 1e-320, expected 0, or"),
    "order of 5000 digits": ("order = 4", f"order = 0x{'f' * 5000}", "is a number of thousands of"),
    "order too large": ("order = 4", f"order = {10**40}", "order is 1000000"),
    "digits": ("order = 4", f"order = {'1' * 5000}", "is not valid TOML: Exceeds the limit"),
    "pinned": ('"wls"', CONSTRAINTS + "pinned = [1]", "pinned[0] is 1"),
    "gearless": ("[estimator]", "[[transmission]]\nmatrix = [[1.0]]\n[estimator]",
                 "a [[transmission]] has no key 'joints'"),
    "term in lists": ("[estimator]", "[drives]\nj1 = [[]]\n[estimator]",
                      "a drive term is [], expected a table, for example { term = 'Stribeck'"),
    "gains of a log": ("start = 0.3", "controller = { kp = 2.0 }", "[controller] is given, but"),
    "gain of a log": ("start = 0.3", "controller = { ki = 2.0 }", "controller.ki is not a known"),
    "group": ('"wls"', '"simulation"\n[controller]\ngroups = { a = "j1" }',
              "groups.a is 'j1', expected a list"),
    "step": ('"wls"', '"simulation"\nstep = 1e-9', "step is 1e-09, expected 2e-5 to 0.1"),
    "window": ('"wls"', '"simulation"\nwindow = 1e-3', "window is 0.001, expected 0.05 s or more"),
    "delay": ('"wls"', '"simulation"\n[controller]\ndelay = 1.5', "is 1.5, expected 0 to 1 s"),
    "clock": ('"wls"', '"simulation"\n[controller]\nrate = 1e9', "rate is 1000000000.0, expected"),
    "stiff": ('"wls"', '"simulation"\n[controller]\nkp = 1e20', "is 1e+20, expected 1e-9 to 1e12"),
    "no bound": ('"wls"', CONSTRAINTS + "mass = { a = 1e300 }", "write 1e+09 for no upper bound"),
    "mass": ('"wls"', CONSTRAINTS + "mass = { a = nan }", "mass of a is nan, expected finite"),
    "huge mass": ('"wls"', CONSTRAINTS + f"mass = {{ a = {10**400} }}", "mass of a"),
    "huge box": ('"wls"', CONSTRAINTS + f"com = {{ a = [{10**400}] }}", "com of a"),
    "step of text": ('"wls"', '"prx"\nstep = "a"', "step is 'a', expected a number"),
    "deep": ("locked = { c = 0.8 }", f"locked = {'[' * 5000}", "is not valid TOML"),
    "NUL in a path": ('"robot.urdf"', '"robot\\u0000.urdf"', "is not a valid path"),
    "long path": ('"robot.urdf"', f'"{"r" * 5000}"', "is not a valid path, expected UTF-8"),
    "misspelt topic": ("topic =", "topics =", "topics is not a known key. Did you mean 'topic'?"),
    "gravity": ("[0.0, -9.81, 0.0]", "9.81", "9.81, expected a list of 3 numbers"),
    "no quotes": (
        'urdf = "robot.urdf"', "urdf = robot.urdf", ": urdf = robot.urdf. Text and paths need",
    ),
    "no TOML": ("[signals]", "[signals", "is not valid TOML"),
}  # fmt: skip


@pytest.mark.parametrize(("old", "new", "message"), WRONG.values(), ids=WRONG)
def test_a_wrong_job_names_what_is_wrong(tmp_path, old, new, message):
    assert old in FULL
    with pytest.raises(SettingsError) as caught:
        read_job(write(tmp_path, FULL.replace(old, new, 1)))
    assert message in str(caught.value)
    assert "job.toml" in str(caught.value)


def test_a_controller_that_the_estimator_does_not_read_is_refused(tmp_path):
    table = {"urdf": "arm.urdf", "controller": {"kp": 20.0}, "estimator": {"name": "wls"}}
    with pytest.raises(SettingsError, match=r"'wls', expected 'simulation'; set \[estimator\]"):
        job_from_settings(table, "job.toml", tmp_path)
    table["estimator"] = {"name": "simulation"}
    job = job_from_settings(table, "job.toml", tmp_path)
    assert job.controller.kp == 20.0
    assert job.to_dict()["controller"]["kp"] == 20.0
    del table["controller"]
    assert "controller" not in job_from_settings(table, "job.toml", tmp_path).to_dict()


def test_a_log_has_its_own_gains(tmp_path):
    gains, path = LogGains(kp={"joint_2": 60.0}, kd=0.8), tmp_path / "a.csv"
    write_log(sine_log(joints=("joint_1", "joint_2"), q_ref=np.zeros((60, 2))), path)
    job = Job(
        URDF / "planar_2r.urdf", estimator=SimulationSettings(), controller=LoopSettings(kp=20.0),
        identification=(LogEntry(path, controller=gains),),
    )  # fmt: skip
    assert job_from_settings(job.to_dict(), "job.toml", tmp_path) == job
    factors = job.read(job.identification[0], job.model(), needs="commands").gain_factors
    assert factors.tolist() == [[1.0, 3.0], [0.8, 0.8]]
    for common, words in (
        (LoopSettings(kp=1.0, kd=0.0), "kd is 0.8, but [controller] has kd = 0"),
        (LoopSettings("torque"), "[controller] has kind 'torque', which no gain of a log changes"),
        (LoopSettings(kp={"j": 1.0}), "controller: kp is given for 'j', which is not a moving"),
    ):
        with pytest.raises(SettingsError, match=re.escape(words)):
            gains.factors(common, ("joint_1", "joint_2"))


def test_friction_that_is_stated_as_selected_is_the_default():
    for friction, terms in (("auto", Job(Path("x")).terms), ("none", ("armature", "offset"))):
        table = {"urdf": "x", "model": {"friction": friction}}
        assert job_from_settings(table, "job.toml", Path()).terms == terms


def test_contacts_couplings_and_loops_are_written_as_they_are_read():
    table = {
        "coupling": [{"name": "c", "ratios": {"a": 1.0, "b": -2.0}, "replaces": True}],
        "contact": [{"frame": "foot", "kind": "surface", "measured": ["fz"], "always": False,
                     "radius": 0.0, "axes": "link", "threshold": 5.0, "uncertainty": 0.01}],
        "loop": [{"frames": ["a", "b"], "kind": "point", "axis": [0.0, 1.0, 0.0]}],
    }  # fmt: skip
    stated = job_from_settings({"urdf": "x", **table}, "job.toml", Path()).to_dict()
    assert {key: stated[key] for key in table} == table
