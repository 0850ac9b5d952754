"""Flags state what the keys of a job file state; help, schema and completions know them."""

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path

import jsonschema
import pytest

from robotid.base.exceptions import SettingsError
from robotid.cli import CommandParser, doctor, excite, identify, main, preview, track
from robotid.cli.job import job_from_flags, job_from_settings, source_words
from robotid.cli.schema import job_schema
from robotid.data.signal_settings import LogSource, SignalSettings

LOG = {"log": "run.csv"}


def parsed(command, *words):
    parser = argparse.ArgumentParser()
    command.add_flags(parser)
    return parser.parse_args(words)


def job(command, *words):
    return job_from_flags(parsed(command, "robot.urdf", "run.csv", *words))


def test_every_setting_of_the_signals_has_a_flag():
    words = {
        "rate": "200", "cutoff": "5", "order": "2", "velocity": "differentiated",
        "acceleration": "measured", "trim": "0.5", "min_velocity": "0.1", "friction_band": "0.05",
        "max_gap": "0.3", "torque_delay": "-0.005", "velocity_delay": "0.01",
    }  # fmt: skip
    flags = [x for name, word in words.items() for x in (f"--{name.replace('_', '-')}", word)]
    stated = {name: type(getattr(SignalSettings(), name))(word) for name, word in words.items()
              if name not in ("rate", "max_gap")}  # fmt: skip
    assert set(words) == set(SignalSettings.paths())
    for command in (identify, doctor):
        assert job(command, *flags).signals == SignalSettings(rate=200.0, max_gap=0.3, **stated)


def test_every_other_flag_states_its_key_too():
    """Each with a value that is not the default; two where there may be several, out of order."""
    words = [
        *("second.csv", "--validate", "kept.csv", "also.csv"),
        *("--joints", "b,a", "--lock", "d=0.5", "--lock", "c=-1", "--snap-angles"),
        *("--gain", "b=2", "--gain", "a=-3", "--friction", "viscous", "--estimator", "ols"),
        *("--time-unit", "ms", "--angle-unit", "deg", "--topic", "/arm"),
        *("--command-topic", "/wanted", "--effort", "current", "--stamp", "log"),
        *("--rename", "b=2", "--rename", "a=one=1"),
        *("--ignore", "late", "--ignore", "clipped", "--dynamics", "--no-report", "--replay"),
    ]
    found = job(identify, *words)
    assert [entry.path.name for entry in found.identification] == ["run.csv", "second.csv"]
    assert [entry.path.name for entry in found.validation] == ["kept.csv", "also.csv"]
    assert found.joints == ("b", "a")
    assert found.locked == {"d": 0.5, "c": -1.0}
    assert found.snap_angles is True
    assert found.gains == {"b": 2.0, "a": -3.0}
    assert found.terms == ("armature", "viscous", "offset")
    assert found.estimator.name == "ols"
    assert (found.units.time, found.units.angle) == ("ms", "deg")
    assert found.source == LogSource(
        "/arm", command="/wanted", joints={"b": "2", "a": "one=1"}, effort="current", stamp="log"
    )
    assert tuple(found.ignore) == ("late", "clipped")
    assert (found.dynamics, found.report, found.replay) == (True, False, True)
    usual = job(identify)
    assert (usual.joints, usual.locked, usual.gains) == (None, {}, {})
    assert (usual.dynamics, usual.report, usual.snap_angles) == (False, True, False)
    assert usual.source == LogSource()


def test_words_that_identify_again_leave_out_what_is_only_shown():
    words = ["identify", "arm.urdf", "a.csv", "--out", "there", "--json", "--cutoff", "5"]
    words += ["--verbose", "--out=here", "--validate", "b.csv", "--progress"]
    assert source_words(words) == ("arm.urdf", "a.csv", "--cutoff", "5", "--validate", "b.csv")


def test_a_flag_that_a_command_has_no_use_for_is_not_there(capsys):
    with pytest.raises(SystemExit):
        job(track, "--trim", "0.5")
    assert "--trim" in capsys.readouterr().err
    assert job(track, "--min-velocity", "0.1").signals.min_velocity == 0.1


def test_a_payload_of_known_mass_is_stated_with_its_log():
    (check,) = job(identify, "--payload-check", "a=b/loaded.csv=2.5").payload_checks
    assert (check.path.name, check.mass, check.link) == ("loaded.csv", 2.5, "")
    for word in ("loaded.csv", "loaded.csv=heavy"):
        with pytest.raises(SettingsError, match=f"--payload-check '{word}': expected LOG=KG"):
            job(identify, "--payload-check", word)
    with pytest.raises(SettingsError, match=r"mass is -1.0, expected more than 0"):
        job(identify, "--payload-check", "loaded.csv=-1")
    with pytest.raises(SettingsError, match=r"a \[\[payload_check\]\] has no key 'mass'"):
        job_from_settings({"urdf": "x", "payload_check": [{"log": "y"}]}, "job.toml", Path())


def test_gains_are_stated_for_all_joints_or_by_joint():
    fit = ("--estimator", "simulation")
    found = job(identify, *fit, "--kp", "pan=18", "--kp", "lift=25", "--kd", "0.5").controller
    assert (found.kp, found.kd) == ({"pan": 18.0, "lift": 25.0}, 0.5)
    assert job(identify, *fit, "--kp", "18").controller.kp == 18.0
    for words in (("--kp", "stiff"), ("--kd", "pan=soft"), ("--kp", "18", "--kp", "19")):
        with pytest.raises(SettingsError, match=rf"{words[0]} '.*': expected (NUMBER or )?JOINT="):
            job(identify, *fit, *words)


def test_a_job_file_takes_neither_logs_nor_flags_beside_it():
    for words, given in (
        (["run.csv"], "run.csv"),
        (["--cutoff", "5", "--validate", "b.csv"], "--validate, --cutoff"),
    ):
        with pytest.raises(SettingsError, match=f"settings. Remove {given}, and set them in"):
            job_from_flags(parsed(identify, "job.toml", *words))


@pytest.mark.parametrize(("command", "wanted"), [(identify, "URDF LOG"), (preview, "URDF MOT")])
def test_a_command_without_a_log_names_what_it_wants(command, wanted):
    with pytest.raises(SettingsError, match=f"no .* is given; expected {wanted}"):
        job_from_flags(parsed(command, "robot.urdf"))


def test_a_flag_is_stated_once_and_validation_logs_add_up(capsys):
    parser = CommandParser(prog="robotid")
    identify.add_flags(parser)
    found = parser.parse_args(
        [*("r.urdf", "a.csv", "--validate", "b.csv", "--cutoff", "5", "--validate", "c.csv")]
    )
    assert (found.validate, found.cutoff) == (["b.csv", "c.csv"], "5")
    for flag, value in (("--cutoff", "5"), ("--out", "x"), ("--estimator", "ols")):
        with pytest.raises(SystemExit):
            parser.parse_args(
                ["r.urdf", "a.csv", flag, "6" if value == "5" else value, flag, value]
            )
        assert f"argument {flag}: given twice, as " in capsys.readouterr().err


def printed(capsys, *words):
    """Return the exit code and the text of a command line that ends in its parser."""
    with pytest.raises(SystemExit) as ended:
        main(words)
    found = capsys.readouterr()
    return ended.value.code, found.out + found.err


@pytest.mark.parametrize(
    ("words", "near"),
    [
        (
            ["identify", "r.urdf", "l.csv", "--vaildate", "b.csv", "--x"],
            "unknown. Did you mean '--va",
        ),
        (["inspect", "r.urdf", "x"], "'x' is one word too many; a flag takes one word"),
        (["replay", "r.urdf", "l.csv", "--xyz=3"], "--xyz is unknown; see 'robotid replay --help'"),
        (["identfy", "robot.urdf"], "argument COMMAND: 'identfy' is unknown. Did you mean 'ident"),
        (["export", "r.json", "--format", "mjfc", "--out", "x"], "'mjfc' is unknown. Did you mean"),
        (["excite", "r.urdf", "--out", "x", "--kind", "furier"], "Did you mean 'fourier'? Known: "),
    ],
)
def test_a_misspelt_word_is_answered_with_the_nearest_one(capsys, words, near):
    code, said = printed(capsys, *words)
    assert code == 2
    assert near in said


@pytest.mark.parametrize("module", [identify, excite], ids=["identify", "excite"])
def test_the_help_of_large_commands_is_short_and_has_two_examples(capsys, monkeypatch, module):
    monkeypatch.setenv("COLUMNS", "80")
    name = module.__name__.rpartition(".")[2]
    code, short = printed(capsys, name, "--help")
    assert code == 0
    assert len(short.splitlines()) <= 40
    assert max(map(len, short.splitlines())) <= 80
    assert short.count(f"  robotid {name} ") == 2
    assert all(f"  {flag} " in short for flag in module.MAIN_FLAGS)
    assert "--help-all" in short
    code, whole = printed(capsys, name, "--help-all")
    assert code == 0
    assert len(whole.splitlines()) > 60
    assert "--snap-angles" in whole
    assert "--snap-angles" not in short


@pytest.fixture(scope="module")
def check():
    schema = job_schema()
    jsonschema.Draft202012Validator.check_schema(schema)
    return jsonschema.Draft202012Validator(schema).validate


@pytest.mark.parametrize(
    "wrong",
    [
        {"joint": ["a"]}, {"joints": "a"}, {"gravity": [0.0, -9.81]},
        {"gravity": [0.0, 0.0, -9.81, 0.0]}, {"locked": {"a": "here"}},
        {"signals": {"velocity": "guessed"}}, {"signals": {"rate": "fast"}},
        {"estimator": {"name": "magic"}}, {"estimator": {"prior_weight": "heavy"}},
        {"estimator": {"constraints": {"masses": {}}}}, {"identification": [{"start": 1.0}]},
        {"validation": LOG}, {"coupling": [{"name": "motor"}]}, {"reduction": {"workers": 2.5}},
    ],
    ids=lambda wrong: json.dumps(wrong),
)  # fmt: skip
def test_what_a_job_refuses_is_invalid(check, wrong):
    job = {"urdf": "robot.urdf", "identification": [LOG]}
    check(job)
    job_from_settings(job, "job.toml", Path())
    with pytest.raises(jsonschema.ValidationError):
        check(job | wrong)
    with pytest.raises(SettingsError):
        job_from_settings(job | wrong, "job.toml", Path())


def test_a_shell_is_told_what_may_follow(tmp_path):
    answers = {}
    for line in ("robotid exc", "robotid export result --format s"):
        asked = {
            "_ARGCOMPLETE": "1", "_ARGCOMPLETE_IFS": "\n", "COMP_LINE": line,
            "COMP_POINT": str(len(line)), "_ARGCOMPLETE_STDOUT_FILENAME": str(tmp_path / "words"),
        }  # fmt: skip
        words = [sys.executable, "-m", "robotid"]
        done = subprocess.run(words, env=os.environ | asked, capture_output=True, timeout=60)
        assert done.returncode == 0
        answers[line] = (tmp_path / "words").read_text().split()
    assert list(answers.values()) == [["excite"], ["sdf"]]
