"""`robotid payload` and `robotid preview`: what a result and further logs determine."""

import json
import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.synthetic import exact_log, truth

from robotid.base.exceptions import SettingsError
from robotid.base.files import file_sha256
from robotid.cli import main
from robotid.cli.identify import run_job
from robotid.cli.job import Job, LogEntry, job_from_settings
from robotid.cli.logs import job_of_result
from robotid.cli.payload import stated_masses
from robotid.data.files.read import write_columns, write_log
from robotid.output.files.result_file import load_result, stated_scale_check
from robotid.output.report.next_steps import Origin, next_steps
from robotid.robot.bodies import link_transfer
from robotid.robot.examples import example_urdf

LOAD = np.array([2.0, 0.04, 0.06, 0.2, 0.06, 0.0, 0.06, 0.0, 0.0, 0.03])
GAINS = np.array([14.0, 13.0, 11.0, 9.0, 8.0, 7.0])
NOISE = np.array([0.3, 0.4, 0.2, 0.04, 0.03, 0.02])  # [N m]
ARM = str(example_urdf("ur5_robot.urdf"))


@pytest.fixture(scope="module")
def files(ur5, tmp_path_factory):
    """Logs without and with a load on tool0, as torques, as currents and as motions; a result."""
    folder = tmp_path_factory.mktemp("payload")
    pi, (body, transfer) = truth(ur5), link_transfer(ur5, "tool0")
    loaded = pi.copy()
    loaded[10 * body : 10 * body + 10] += transfer @ LOAD
    rng = np.random.default_rng(0)
    for name, x in {"bare": pi, "loaded": loaded}.items():
        log = exact_log(ur5, x, rng, samples=1000, rate=100.0, noise=NOISE)
        log = replace(log, v=None, a=None)
        write_log(log, folder / f"{name}.csv")
        q = {f"q_{joint}": log.q[:, j] for j, joint in enumerate(ur5.joints)}
        currents = {f"current_{x}": log.tau[:, j] / GAINS[j] for j, x in enumerate(ur5.joints)}
        write_columns({"time": log.t} | q | currents, folder / f"{name}_currents.csv")
        write_columns({"time": log.t} | q, folder / f"{name}_motion.csv")
    table = {"urdf": ARM, "identification": [{"log": "bare.csv"}], "estimator": {"name": "wls"}}
    table["output"] = {"report": False}
    run_job(job_from_settings(table, "job.toml", folder), folder / "out")
    return folder


STATED = ("--friction", "viscous+coulomb")  # so that none has to be chosen


def asked(capsys, *words, command="payload", code=0):
    assert main([command, ARM, *map(str, words)]) == code
    printed = capsys.readouterr()
    return printed.out if code == 0 else printed.err


def test_a_log_and_a_result_are_references_alike(files, capsys):
    found = [
        json.loads(asked(capsys, files / "loaded.csv", "--reference", files / reference,
                         "--link", "tool0", "--json"))
        for reference in ("bare.csv", "out", "out/result.json")
    ]  # fmt: skip
    assert found[0] == found[1] == found[2]
    job = files / "loaded.toml"
    job.write_text(f'urdf = "{ARM}"\n[[identification]]\nlog = "loaded.csv"\n')
    words = ["payload", job, "--reference", files / "bare.csv", "--link", "tool0", "--json"]
    assert main([*map(str, words)]) == 0
    assert json.loads(capsys.readouterr().out) == found[0]
    (payload,) = found[0]["payloads"]
    assert payload["link"] == "tool0"
    assert payload["mass"] == pytest.approx(2.0, abs=4 * payload["mass_std_error"])
    assert payload["mass_std_error"] < 0.05
    error = np.array(payload["com"]) - LOAD[1:4] / LOAD[0]
    assert (np.abs(error) < 4 * np.array(payload["com_std_error"])).all()
    assert "gains" not in found[0]
    stated = Job(Path("other.urdf"), identification=(LogEntry(files / "loaded.csv"),))
    job, references = job_of_result(stated, files / "out", "")
    assert (job.urdf, job.identification) == (stated.urdf, stated.identification)
    assert [entry.path for entry in references] == [files / "bare.csv"]


def test_a_job_states_a_check_of_the_scale_in_its_result(files, tmp_path, ur5, capsys, monkeypatch):
    for name in ("bare", "loaded"):  # with a name and gains that only the job states
        text = (files / f"{name}_currents.csv").read_text().replace("time", "stamp", 1)
        (tmp_path / f"{name}.csv").write_text(text)
    files, gains = tmp_path, dict(zip(ur5.joints, GAINS, strict=True))
    table = {
        "urdf": ARM, "identification": [{"log": "bare.csv"}], "columns": {"time": "stamp"},
        "torque": {"gains": gains},
        "model": {"friction": "viscous+coulomb"}, "output": {"report": False},
        "payload_check": [
            {"log": "loaded.csv", "mass": 1.8, "end": 3.0},
            {"log": "loaded.csv", "mass": 1.8, "link": "tool0"},
        ],
    }  # fmt: skip
    found, _ = run_job(job_from_settings(table, "job.toml", files), files / "out")
    check, other = found.scale_check.payloads  # the narrower interval first: the whole log
    widths = [high - low for low, high in (check.interval, other.interval)]
    assert 1.4 * widths[0] < widths[1]
    assert (check.known, check.link, other.link) == (1.8, "tool0", "wrist_3_link")
    assert check.identified == pytest.approx(2.0, abs=0.06)
    assert check.interval[0] < 2.0 < check.interval[1]
    assert check.sha256 == file_sha256(files / "loaded.csv")
    assert found.scale_check.contradicts  # 2 kg are not 1.8 kg
    (reason,) = [r for r in found.verdict.reasons if "payload of known mass" in r]
    assert check.message in reason
    assert f"{other.message[0].upper()}{other.message[1:]}" in reason or other.message in reason
    whole = load_result(files / "out").content
    assert stated_scale_check(whole).payloads == (check, other)
    wanted = found.stated.job.payload_checks
    assert job_from_settings(whole["settings"], "x", files).payload_checks == wanted
    (step,) = [
        s for s in next_steps(found, Origin(("job.toml",), "out")) if "torque scale" in s.words
    ]
    assert step.words.startswith("Correct the torque scale: payload of 1.8 kg on tool0")
    urdf, loaded = found.model.tree.path, files / "loaded.csv"
    wanted = f"robotid payload {urdf} {loaded} --reference out --link tool0 --mass 1.8 --gains"
    assert step.blocks[0] == wanted
    monkeypatch.chdir(files)
    assert main(shlex.split(step.blocks[0])[1:]) == 0
    assert "[N/A]\nshoulder_pan_joint = 1" in capsys.readouterr().out
    typed = Origin((str(urdf), "bare.csv", "--gain", "elbow_joint=3", "--cutoff", "8"), "out")
    (step,) = [s for s in next_steps(found, typed) if "torque scale" in s.words]
    assert step.blocks[1:] == (
        f"robotid identify {urdf} bare.csv --cutoff 8 --gain elbow_joint=GAIN --out out",
    )
    assert "verify them with another log of a payload: this one determines them" in step.words
    rewritten = next_steps(found, Origin((), "out"))  # the report of a result names no source
    assert not any("robotid identify" in block for step in rewritten for block in step.blocks)
    right = replace(check, known=2.0)
    verified = replace(found, payload_checks=(right,))
    assert verified.scale_check.agrees == right.verifies
    steps = next_steps(verified, Origin(("job.toml",), "out"))
    assert right.verifies
    assert not any("torque scale" in step.words for step in steps)


def test_gains_come_from_a_known_mass(files, capsys, ur5):
    words = [files / "loaded_currents.csv", "--reference", files / "bare_currents.csv", "--link",
             "tool0", "--mass", "tool0=2", "--gains"]  # fmt: skip
    found = json.loads(asked(capsys, *words, "--json"))
    assert list(found["gains"]) == list(ur5.joints)
    assert not found.get("mass_checks")  # the known mass was used
    for gain, true in zip(found["gains"].values(), GAINS, strict=True):
        assert gain["gain"] == pytest.approx(true, abs=4 * gain["std_error"])
        assert gain["std_error"] < 0.05 * true
    assert all(entry["std_error"] > 0 for entry in found["base_parameters"])
    said = asked(capsys, *words, *STATED)
    assert "verify them with another payload or another log of it" in " ".join(said.split())
    assert "[N/A]\nshoulder_pan_joint = 1" in said
    stated = f"{ur5.joints[0]}={GAINS[0]}"
    some = json.loads(asked(capsys, *words, "--gain", stated, *STATED, "--json"))
    assert list(some["gains"]) == list(ur5.joints[1:])


def test_what_is_missing_is_named(files, capsys):
    loaded, bare = files / "loaded.csv", files / "bare.csv"
    said = asked(capsys, bare, "--reference", loaded, "--link", "tool0", *STATED, code=1)
    assert "less than in the reference" in said
    said = asked(capsys, loaded, "--reference", files / "out", "--cutoff", "5", code=2)
    assert "a RESULT has the settings of its logs; remove --cutoff" in said
    said = asked(capsys, loaded, "--reference", files / "out", "--reference", bare, code=2)
    assert "expected one result alone, or logs" in said
    said = asked(capsys, loaded, "--reference", bare, "--mass", "heavy", code=2)
    assert "--mass 'heavy': expected KG or LINK=KG" in said
    with pytest.raises(SettingsError, match=r"the link is ambiguous, expected one of a, b"):
        stated_masses(["2"], ["a", "b"])
    content = bare.read_bytes()
    try:
        bare.write_bytes(content + b"\n")
        said = asked(capsys, loaded, "--reference", files / "out", code=1)
    finally:
        bare.write_bytes(content)
    assert "is missing or was changed; give a log without the payload" in said


def previewed(capsys, *words, code=0):
    return asked(capsys, *words, command="preview", code=code)


def base(content, key="std_error"):
    return {entry["name"]: entry[key] for entry in content["base_parameters"]}


def test_a_motion_without_torques_is_previewed(files, ur5, capsys):
    words = [f"--noise={j}={s}" for j, s in zip(ur5.joints, NOISE, strict=True)]
    plain = json.loads(previewed(capsys, files / "bare_motion.csv", "--json", *words[1:]))
    assert plain["noise"]["elbow_joint"] == {
        "std": 0.2, "unit": "N m", "correlation": 0.1, "is": "stated",
    }  # fmt: skip
    assert plain["noise"]["shoulder_pan_joint"]["std"] == pytest.approx(1.5)
    assert plain["noise"]["shoulder_pan_joint"]["is"] == "assumed"
    assert plain["undetermined"] == plain["structure"]["undetermined"]
    for entry in plain["base_parameters"]:
        assert 0 < entry["std_error"] <= entry["plausible"] * 1.001
        assert entry["name"] in entry["expression"]
    assert {e["source"] for e in plain["standard_parameters"]} <= {"data", "mixed", "prior"}
    for torque in plain["torque"].values():
        assert 0 < torque["of_parameters"] < torque["half_width"]
    whole = json.loads(previewed(capsys, files / "bare.csv", "--velocity", "differentiated",
                             "--acceleration", "differentiated", "--json", *words[1:]))  # fmt: skip
    assert base(whole) == base(plain)  # its torques are ignored
    white = json.loads(previewed(capsys, files / "bare_motion.csv", "--correlation", "0", "--json"))
    slow = json.loads(previewed(capsys, files / "bare_motion.csv", "--json"))
    assert sum(base(white).values()) < sum(base(slow).values())
    motions = [files / "bare_motion.csv", files / "loaded_motion.csv"]
    both = json.loads(previewed(capsys, *motions, "--json"))
    assert [motion["path"] for motion in both["motions"]] == list(map(str, motions))


def test_the_window_of_a_job_is_previewed(files, capsys):
    job, log = files / "window.toml", '\n[[identification]]\nlog = "bare_motion.csv"\n'
    job.write_text(f'urdf = "{ARM}"{log}start = 2.0\nend = 7.0\n')
    assert main(["preview", str(job), "--json"]) == 0
    (motion,) = json.loads(capsys.readouterr().out)["motions"]
    assert 2.0 <= motion["start"] < 2.6
    assert 6.4 < motion["end"] <= 7.0


def test_wrong_words_are_answered(files, capsys):
    motion = files / "bare_motion.csv"
    assert "Did you mean 'elbow_joint'" in previewed(capsys, motion, "--noise", "elbow=1", code=2)
    assert "expected JOINT=NUMBER" in previewed(capsys, motion, "--noise", "elbow_joint", code=2)
    error = previewed(capsys, motion, "--given", files / "out", "--cutoff", "5", code=2)
    assert "a RESULT has the settings of its logs" in error
    write_columns({"time": np.arange(9.0), "q_a": np.zeros(9)}, files / "other_robot.csv")
    error = previewed(capsys, files / "other_robot.csv", code=1)
    assert '# q_shoulder_pan_joint = "NAME"' in error
    assert "tau" not in error
