"""Flags state what the keys of a job file state."""

import argparse
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import ANY

import pytest

from robotid.base.exceptions import SettingsError
from robotid.cli import doctor, identify, main, preview, track
from robotid.cli.flags import job_from_flags, source_words
from robotid.cli.job import LogEntry, job_from_settings
from robotid.cli.parser import CommandParser
from robotid.data.signal_settings import LogSource, SignalSettings
from robotid.estimation.fitting.estimator_settings import ESTIMATORS
from robotid.estimation.workers.plan import WorkPlan
from robotid.robot.drives import FAMILIES


def job(command, *words):
    parser = argparse.ArgumentParser()
    command.add_flags(parser)
    return job_from_flags(parser.parse_args(["robot.urdf", "run.csv", *words]))


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
        found = job(command, *flags).signals
        assert found == SignalSettings(rate=200.0, max_gap=0.3, **stated)


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


def test_a_name_in_the_log_needs_its_joint():
    for word in ("b", "=2", "b="):
        with pytest.raises(SettingsError, match=rf"^--rename '{word}': wanted JOINT=NAME$"):
            job(identify, "--rename", word)


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
        with pytest.raises(SettingsError, match=f"--payload-check '{word}': wanted LOG=KG"):
            job(identify, "--payload-check", word)
    with pytest.raises(SettingsError, match=r"mass is -1.0, wanted more than 0"):
        job(identify, "--payload-check", "loaded.csv=-1")
    with pytest.raises(SettingsError, match=r"a \[\[payload_check\]\] has no key 'mass'"):
        job_from_settings({"urdf": "x", "payload_check": [{"log": "y"}]}, "job.toml", Path())


def test_gains_are_stated_for_all_joints_or_by_joint():
    fit = ("--estimator", "simulation")
    found = job(identify, *fit, "--kp", "pan=18", "--kp", "lift=25", "--kd", "0.5").controller
    assert (found.kp, found.kd) == ({"pan": 18.0, "lift": 25.0}, 0.5)
    assert job(identify, *fit, "--kp", "18").controller.kp == 18.0
    for words in (("--kp", "stiff"), ("--kd", "pan=soft"), ("--kp", "18", "--kp", "19")):
        with pytest.raises(SettingsError, match=rf"{words[0]} '.*': wanted (NUMBER or )?JOINT="):
            job(identify, *fit, *words)


@pytest.mark.parametrize(("command", "wanted"), [(identify, "URDF LOG"), (preview, "URDF MOT")])
def test_a_command_without_a_log_names_what_it_wants(command, wanted):
    parser = argparse.ArgumentParser()
    command.add_flags(parser)
    with pytest.raises(SettingsError, match=f"no .* is given; wanted {wanted}"):
        job_from_flags(parser.parse_args(["robot.urdf"]))


def test_a_flag_of_zero_is_a_flag_beside_a_job_file(tmp_path):
    parser = argparse.ArgumentParser()
    identify.add_flags(parser)
    options = parser.parse_args([str(tmp_path / "job.toml"), "--min-velocity", "0"])
    with pytest.raises(SettingsError, match="Remove --min-velocity"):
        job_from_flags(options)


@pytest.mark.parametrize(
    ("command", "without"),
    [(track, ("--dynamics", "--no-report", "--ignore")), (doctor, ("--dynamics", "--no-report"))],
)
def test_help_shows_the_flags_that_do_something(command, without):
    parser = argparse.ArgumentParser()
    command.add_flags(parser)
    shown = " ".join(parser.format_help().split())
    assert not [flag for flag in without if flag in shown]
    assert "auto: selected per joint by the error on held-out segments of the fitted logs" in shown
    assert all(family in shown for family in FAMILIES)


def test_help_names_each_estimator_once():
    parser = argparse.ArgumentParser()
    identify.add_flags(parser)
    words = parser.format_help().replace("\n", " ")
    names = words.split("estimator: ")[1].split("--")[0].replace("(default)", "").split(",")
    names = [name.strip() for name in names]
    assert sorted(names) == sorted(ESTIMATORS)
    assert parser.parse_args(["robot.urdf", "--no-report", "--dynamics"]).no_report is False


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--lock", "a=0", "--lock", "a=1"], "--lock states a twice, as 0 and as 1; state it once"),
        (["--rename", "a=1", "--rename", "a=2"], "--rename states a twice, as 1 and as 2"),
    ],
)
def test_two_values_of_a_joint_are_refused(words, message):
    with pytest.raises(SettingsError, match=message):
        job(identify, *words)


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
        assert f"argument {flag}: stated twice, as " in capsys.readouterr().err


class Heard(Exception):
    """What a command hands to the function that does its work."""


JOB_OF_FLAGS = SimpleNamespace(workers=2)
UNSTATED = dict.fromkeys(("step", "delay", "samples", "seed"))
FORWARDED = {
    "validate out a.csv b.csv --unit x --update": (
        "validate.validate",
        ("out", [LogEntry(Path(x), unit="x") for x in ("a.csv", "b.csv")]), {"update": True},
    ),
    "report out --out p.html": ("report.rewrite_report", ("out", "p.html"), {"progress": ANY}),
    "export out --format mjcf --out a.xml --step 0.002 --delay filter": (
        "export.export", ("out", "mjcf", "a.xml"),
        UNSTATED | {"step": 0.002, "delay": "filter"},
    ),
    "export out --format ranges --out a.yaml --samples 5 --seed 3": (
        "export.export", ("out", "ranges", "a.yaml"),
        UNSTATED | {"samples": 5, "seed": 3},
    ),
    "payload u a.csv --reference c --reference d --link x --link y --mass x=2 --gains": (
        "payload.measure_payload", (JOB_OF_FLAGS, ["c", "d"]),
        {"links": ["x", "y"], "masses": ["x=2"], "find_gains": True, "progress": ANY},
    ),
    "preview u a.csv --given out --noise a=0.2 --noise b=3 --correlation 0.3": (
        "preview.preview_job", (JOB_OF_FLAGS, "out"),
        {"noise": {"a": 0.2, "b": 3.0}, "correlation": 0.3},
    ),
    "track u a.csv --out there": ("track.run_track", (JOB_OF_FLAGS, "there"), {}),
    "track u a.csv --out there --serve 8123 --speed 2.5": (
        "track.serve_track", (JOB_OF_FLAGS, "there"),
        {"port": 8123, "speed": 2.5, "announce": ANY, "finished": ANY},
    ),
    "identify u a.csv --out there --workers 3": (
        "identify.run_job", (JOB_OF_FLAGS, "there"),
        {"plan": WorkPlan(3, progress=ANY), "source": ANY},
    ),
    "identify u a.csv --scheduler tcp://host:8786": (
        "identify.run_job", (JOB_OF_FLAGS, "robotid-out"),
        {"plan": WorkPlan(2, "tcp://host:8786", progress=ANY), "source": ANY},  # workers of the job
    ),
    "replay u a.csv --ghost g.csv --html p.html": (
        "replay.replay_files", (JOB_OF_FLAGS, ANY), {"ghost": "g.csv"}
    ),
    "convert in.csv out.npz --joints a,b --sensors x,y": (
        "convert.convert", ("in.csv", "out.npz"),
        {"joints": ["a", "b"], "source": LogSource(sensors=("x", "y"))},
    ),
}  # fmt: skip


@pytest.mark.parametrize("words", FORWARDED)
def test_every_flag_reaches_the_function_that_does_the_work(words, monkeypatch):
    place, wanted, options = FORWARDED[words]

    def heard(*asked, **stated):
        raise Heard(asked, stated)

    monkeypatch.setattr(f"robotid.cli.{place}", heard)
    command = import_module(f"robotid.cli.{words.split()[0]}")
    if hasattr(command, "job_from_flags"):
        monkeypatch.setattr(command, "job_from_flags", lambda options: JOB_OF_FLAGS)
    with pytest.raises(Heard) as caught:
        main(words.split())
    assert caught.value.args == (wanted, options)
