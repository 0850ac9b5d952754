"""What a user sees on a terminal of 80 columns: progress, wrapped lines, little colour."""

import fcntl
import json
import os
import pty
import re
import shlex
import struct
import subprocess
import sys
import termios
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.paths import ROOT
from helpers.synthetic import exact_log, truth

from robotid.base.typing import STAGES
from robotid.cli import compare, doctor, main
from robotid.cli import console as printing
from robotid.cli.console import terminal_progress
from robotid.cli.job import LogEntry
from robotid.data.files.read import write_log
from robotid.identification.pipeline import identify
from robotid.robot.model import RobotModel

ARM = str(ROOT / "urdf" / "planar_2r.urdf")


@pytest.fixture(scope="module")
def log():
    model, rng = RobotModel.from_urdf(ARM), np.random.default_rng(0)
    return exact_log(model, truth(model), rng, samples=900, rate=100.0, noise=0.1)


def test_python_hears_of_each_stage_of_logs_in_memory(log):
    heard = []
    model = RobotModel.from_urdf(ARM)
    identify(
        model, [log], estimator="wls", friction="viscous", progress=lambda *told: heard.append(told)
    )
    stages = [(name, k, 5, "stages") for k, name in enumerate(STAGES) if k < 4]
    assert heard == [*stages[:3], ("fits", 0, 1, "fits"), stages[3]]


def test_verbose_says_the_stages_where_there_is_no_terminal(log, tmp_path, capsys):
    write_log(log, tmp_path / "fit.csv")
    words = ["identify", ARM, str(tmp_path / "fit.csv"), "--estimator", "wls", "--no-report"]
    words += ["--friction", "viscous"]
    assert main([*words, "--out", str(tmp_path / "out"), "--json", "--verbose"]) == 0
    assert "1/5" not in capsys.readouterr().err, "beside JSON nothing is said"
    assert main([*words, "--out", str(tmp_path / "out"), "--verbose"]) == 0
    printed = capsys.readouterr()
    said = re.findall(r"^robotid: (\d)/5 (.*)$", printed.err, re.MULTILINE)
    assert said == [(str(k + 1), name) for k, name in enumerate(STAGES)]
    assert "/5 " not in printed.out


def test_a_stage_stays_above_the_work_it_consists_of(capsys):
    with terminal_progress(force=True) as show:
        show("fitting", 2, 5, "stages")
        show("reducing", 50, 100, "samples")
    assert re.search(r"3/5 fitting.*\n.*    reducing.*50 %", capsys.readouterr().err)
    with terminal_progress(force=True) as show:
        show("fitting", 2, 5, "stages")
        show("reducing", 50, 100, "samples")
        show("solving", 1, 4, "fits")
    shown = capsys.readouterr().err
    last = shown[shown.rindex("fitting") :]  # only the newest work stays below its stage
    assert "solving" in last
    assert "reducing" not in last
    with terminal_progress(force=True) as show:
        show("fitting", 2, 5, "stages")
        show("writing", 4, 5, "stages")
    assert not re.search(r"fitting.*\n.*writing", capsys.readouterr().err)


def on_a_terminal(words, columns, **environment):
    """Run robotid where both its streams are a terminal; return its code and what that got."""
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 50, columns, 0, 0))
    kept = {k: v for k, v in os.environ.items() if k not in ("COLUMNS", "LINES", "NO_COLOR", "CI")}
    run = subprocess.Popen(
        [sys.executable, "-m", "robotid", *words],
        stdin=theirs, stdout=theirs, stderr=theirs,
        env={**kept, "TERM": "xterm-256color", **environment},
    )  # fmt: skip
    os.close(theirs)
    got = b""
    while True:
        try:
            got += os.read(ours, 65536)
        except OSError:  # its end
            break
    os.close(ours)
    return run.wait(), got.decode()


def test_a_terminal_shows_stages_then_lines_that_fit_and_a_tinted_verdict(arm_logs):
    words = ["identify", ARM, str(arm_logs / "fit.csv"), "--validate", str(arm_logs / "keep.csv")]
    words += ["--estimator", "wls", "--friction", "viscous", "--no-report"]
    code, got = on_a_terminal([*words, "--out", str(arm_logs / "out")], 50)
    assert code == 0
    # the stages, in order, before anything stays on the terminal
    stages = list(dict.fromkeys(re.findall(r"(\d)/5 (\w[a-z ]*\w)", got)))
    assert stages == [(str(k + 1), name) for k, name in enumerate(STAGES)]
    last = got.rindex("5/5 writing")
    assert "verdict" not in got[:last]
    kept = got[last:].replace("\r", "").partition("planar_2r:")[2]
    assert "/5 " not in kept
    assert re.search(r"verdict: \x1b\[3[123]m(good|usable|poor)\x1b\[0m\n", kept)
    lines = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", kept).splitlines()
    long = [line for line in lines if len(line) > 50]
    # paths and commands, which are copied, are not broken
    assert all(str(arm_logs) in line or ARM in line for line in long), long
    assert len(lines) > 30
    assert "  in wider terminals: gravity only %" in lines


def test_a_result_names_recordings_with_their_windows_and_commands_that_work(arm_logs, capsys):
    out = arm_logs / "named"
    words = ["identify", ARM, str(arm_logs / "fit.csv"), "--validate", str(arm_logs / "keep.csv")]
    assert main([*words, "--friction", "viscous", "--no-report", "--out", str(out)]) == 0
    printed = capsys.readouterr()
    said = printed.out
    assert printed.err == ""
    result = json.loads((out / "result.json").read_text())
    _, fit, keep = result["inputs"]
    assert f"\nfitted: fit.csv {fit['start']:.4g}-{fit['end']:.4g} s\n" in said
    assert f"\nnot fitted: keep.csv {keep['start']:.4g}-{keep['end']:.4g} s\n" in said
    notes = sum(warning["severity"] == "note" for warning in result["warnings"])
    assert notes
    flat = " ".join(said.split())
    assert f"{notes} note{'s' * (notes > 1)} hidden (--verbose)" in flat
    assert "\nnote: " not in said
    assert said.count("\x1b") == 0
    commands = re.findall(r"^ {7}(robotid .*)$", said, re.MULTILINE)
    again = shlex.split(commands[0])
    assert any("--gains" in line for line in commands[1:])  # the scale is not verified
    assert again[again.index("--friction") + 1] == "viscous+coulomb"
    assert again[again.index("--out") + 1] == str(out)
    assert main([*again[1:], "--no-report"]) == 0
    assert "\nverdict: good" in capsys.readouterr().out
    page = arm_logs / "page.html"
    replay = ["replay", ARM, str(arm_logs / "keep.csv"), str(out), "--html", str(page)]
    assert main(replay) == 0
    assert page.stat().st_size > 50_000


def test_inspect_says_what_it_found_first_and_a_missing_file_once(tmp_path, capsys):
    assert main(["inspect", str(tmp_path / "none.urdf")]) == 1
    printed = capsys.readouterr()
    missing = f"robotid: there is no URDF file '{tmp_path / 'none.urdf'}'\n"
    assert (printed.out, printed.err) == ("", missing)
    urdf = tmp_path / "two.urdf"
    urdf.write_text(Path(ARM).read_text().replace('value="1.9"', 'value="-1.9"'))
    assert main(["inspect", str(urdf)]) == 1
    printed = capsys.readouterr()
    assert printed.out.startswith("planar_2r: 2 joints: joint_1, joint_2\nerror: negative_mass: ")
    assert printed.err == f"robotid: {urdf} does not give a valid model; see the findings\n"


def test_inspect_shows_base_parameters_where_they_are_asked_for(tmp_path, capsys):
    urdf = tmp_path / "two.urdf"
    inertia = 'ixx="0.02836842105263158"'
    urdf.write_text(Path(ARM).read_text().replace(inertia, 'ixx="-1"'))
    assert main(["inspect", str(urdf)]) == 0
    short = capsys.readouterr().out
    assert main(["inspect", str(urdf), "--base"]) == 0
    long = capsys.readouterr().out
    assert long.index("error: ") < long.index("base parameters, inertial")
    assert short.endswith(f"list of base parameters:\n  robotid inspect {urdf} --base\n")
    assert len(long.splitlines()) >= len(short.splitlines()) + 3


def test_logs_of_one_name_are_named_by_their_paths(arm_logs, tmp_path, capsys):
    other = tmp_path / "fit.csv"
    other.write_bytes((arm_logs / "keep.csv").read_bytes())
    words = ["identify", ARM, str(arm_logs / "fit.csv"), str(other), "--estimator", "wls"]
    words += ["--friction", "viscous", "--no-report", "--out", str(tmp_path / "out")]
    assert main(words) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert re.search(rf"fitted: {arm_logs}/fit.csv 0-7.99 s, {other} 0-7.99 s", said)


def test_compare_keeps_columns_apart_and_files_of_one_name_too(
    arm_logs, tmp_path, capsys, monkeypatch
):
    words = ["identify", ARM, str(arm_logs / "fit.csv"), "--validate", str(arm_logs / "keep.csv")]
    for cutoff in ("8", "9"):
        out = ["--cutoff", cutoff, "--estimator", "wls", "--no-report", "--friction", "viscous"]
        assert main([*words, *out, "--out", str(tmp_path / cutoff)]) == 0
    capsys.readouterr()
    monkeypatch.setenv("COLUMNS", "300")
    results = [str(tmp_path / cutoff / "result.json") for cutoff in ("8", "9")]
    assert main(["compare", *results]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[-1] for line in lines[:2]] == results
    assert "not fitted: keep.csv 0-7.99 s, error %" in lines
    contents = [json.loads(Path(result).read_text()) for result in results]
    by_name = [{e["name"]: e for e in content["base_parameters"]} for content in contents]
    for name, entry in by_name[0].items():
        (line,) = [line for line in lines if line.split()[:1] == [name]]
        _, first, second, *unit, difference = line.split()
        assert float(first) == pytest.approx(entry["value"], abs=0.06 * entry["std_error"])
        found = by_name[1][name]
        assert float(second) == pytest.approx(found["value"], abs=0.06 * found["std_error"])
        assert " ".join(unit) == entry["unit"]
        error = np.hypot(entry["std_error"], found["std_error"])
        assert float(difference) == pytest.approx(
            (found["value"] - entry["value"]) / error, abs=0.06
        )


def finding(joint, code, share, severity="warning"):
    message = f"run.csv: {share:g} % of {joint}'s torque is odd"
    evidence = {"share": share / 100}
    return {"code": code, "severity": severity, "where": f"run.csv: {joint}", "message": message,
            "evidence": evidence}  # fmt: skip


def test_findings_are_told_by_cause_and_the_worst_joint_is_named(capsys):
    joints = ["arm_1", "arm_6", "arm_7"]
    findings = [
        *(finding(joint, "stepped", 20) for joint in ("arm_6", "arm_7")),
        *(finding(joint, "odd", share) for joint, share in (("arm_6", 37), ("arm_7", 68))),
        finding("arm_1", "noise", 1, "note"),
    ]
    content = {"findings": findings, "joints": joints}
    doctor.show(content, is_verbose=False, logs=2)
    assert capsys.readouterr().out.splitlines() == [
        "warning: stepped: run.csv: 20 % of arm_6, arm_7's torque is odd",
        "warning: odd: run.csv: 37 to 68 % of arm_6, arm_7's torque is odd",
        "2 findings, 2 causes; worst: arm_7; 1 note hidden (--verbose)",
    ]
    findings.append(finding("arm_1", "reversed", 1, "error"))  # graver than any two warnings
    doctor.show(content, is_verbose=True, logs=2)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "error: reversed: run.csv: 1 % of arm_1's torque is odd"
    assert lines[-2:] == [
        "note: noise: run.csv: 1 % of arm_1's torque is odd",
        "4 findings, 4 causes; worst: arm_1",
    ]
    wrong = [finding("arm_6", code, 1, "error") for code in ("one", "two")]
    wrong += [finding("arm_7", code, 9) for code in ("three", "four")]
    wrong.append(finding("arm_7", "five", 9, "error"))
    doctor.show({"findings": wrong, "joints": joints}, is_verbose=False, logs=2)
    assert capsys.readouterr().out.splitlines()[-1].endswith("worst: arm_6"), "two errors"


def test_a_clean_doctor_states_the_number_of_logs(capsys):
    doctor.show({"findings": [], "joints": ["a"]}, is_verbose=False, logs=2)
    assert capsys.readouterr().out == "no fault found in 2 logs\n"
    notes = [finding(joint, "noise", 1, "note") for joint in ("a", "b")]  # one line of --verbose
    doctor.show({"findings": notes, "joints": ["a", "b"]}, is_verbose=False, logs=1)
    assert capsys.readouterr().out == "1 note hidden (--verbose)\nno fault found in 1 log\n"


def test_the_doctor_counts_each_file_of_fitted_and_other_logs_once(monkeypatch, capsys):
    windows = [LogEntry(Path("a.csv"), 0.0, 1.0), LogEntry(Path("a.csv"), 2.0, 3.0)]
    others = [LogEntry(Path(name)) for name in ("b.csv", "c.csv", "a.csv")]
    model = SimpleNamespace(joints=("a",))
    job = SimpleNamespace(identification=windows, validation=others, ignore=(), model=lambda: model)
    monkeypatch.setattr(doctor, "job_from_flags", lambda options: job)
    monkeypatch.setattr("robotid.cli.logs.examine", lambda *_, progress: [])
    assert doctor.run(SimpleNamespace(json=False, verbose=False)) == 0
    assert capsys.readouterr().out == "no fault found in 3 logs\n"


def test_the_verdict_has_its_colour_on_a_terminal_only(monkeypatch, capsys):
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.delenv("NO_COLOR", raising=False)
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    verdict = {"status": "poor", "reasons": [], "per_joint": {"a": {"status": "poor"}}}
    printing.print_verdict(verdict | {"per_joint": {}})
    assert "verdict: \x1b[31mpoor\x1b[0m" in capsys.readouterr().out
    monkeypatch.setenv("NO_COLOR", "1")
    printing.print_verdict(verdict | {"per_joint": {}})
    assert "\x1b" not in capsys.readouterr().out


def test_compare_shows_the_largest_differences_and_fits_eighty_columns(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "80")
    entry = {"values": [-1.2345e-5, 1.3], "std_errors": [0.012, 0.12], "unit": "N m s/rad"}
    name = "shoulder_lift_joint.harmonic2_cos"
    result = {"label": "A", "verdict": {"status": "good"}, "estimator": "consistent"}
    content = {
        "results": [result | {"path": "folder/" * 12 + "result.json"}] * 2,
        "notes": ["another robot"], "fitted_alike": True, "validation": [], "fitted": [],
        "base_parameters": [
            entry | {"name": f"{name}_{k}", "differences": [20.0 - k]} for k in range(15)
        ],
        "settings": [], "versions": [], "inputs": [], "changes": [], "findings": [],
    }  # fmt: skip
    compare._show(content)
    lines = capsys.readouterr().out.splitlines()
    assert max(len(line) for line in lines if "folder/" not in line) <= 80
    assert [line.split()[0] for line in lines if name in line] == [f"{name}_{k}" for k in range(12)]
    assert lines[-1] == "  3 more with smaller differences: --verbose"
    compare._show(content, is_verbose=True)
    assert f"{name}_14" in capsys.readouterr().out


CLOSED = {"no output": ">&-", "no errors": "2>&-", "neither": ">&- 2>&-"}


@pytest.mark.parametrize("name", CLOSED)
def test_closed_streams_change_neither_files_nor_the_code(log, tmp_path, name):
    """The next file that is opened gets the number of a closed stream: no word may get into it."""
    write_log(log, tmp_path / "log.csv")
    words = ["convert", tmp_path / "log.csv", tmp_path / "out.npz"]
    close = CLOSED[name]
    command = shlex.join([sys.executable, "-m", "robotid", *map(str, words)])
    done = subprocess.run(f"{command} {close}", shell=True, capture_output=True, check=False)
    assert (done.returncode, done.stderr) == (0, b"")
    assert len(np.load(tmp_path / "out.npz")["time"]) == 900
    missing = command.replace("log.csv", "none.csv")
    done = subprocess.run(f"{missing} {close}", shell=True, capture_output=True, check=False)
    assert done.returncode == 1
    assert (b"there is no log file" in done.stderr) == (name == "no output")


def test_too_little_memory_is_said(log, tmp_path, monkeypatch, capsys):
    def ask(*_, **__):
        raise MemoryError("Unable to allocate 9.1 TiB")

    monkeypatch.setattr("robotid.cli.convert.convert", ask)
    assert main(["convert", str(tmp_path / "a.csv"), str(tmp_path / "b.csv")]) == 1
    said = capsys.readouterr().err
    assert said == (
        "robotid: not enough memory; lower rates, shorten logs, or lock joints (Unable to allocate "
        "9.1 TiB)\n"
    )
