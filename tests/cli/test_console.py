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

from robotid.base.findings import Finding
from robotid.base.typing import STAGES
from robotid.cli import compare, doctor, main, paper, payload
from robotid.cli.console import progress_of, recordings_of

ARM = str(ROOT / "urdf" / "planar_2r.urdf")


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
    assert "  in wider terminals: URDF %, gravity only %" in lines


def test_a_result_names_recordings_with_their_windows_and_commands_that_work(arm_logs, capsys):
    out = arm_logs / "named"
    words = ["identify", ARM, str(arm_logs / "fit.csv"), "--validate", str(arm_logs / "keep.csv")]
    assert main([*words, "--friction", "viscous", "--no-report", "--out", str(out)]) == 0
    printed = capsys.readouterr()
    said = printed.out
    assert printed.err == ""
    result = json.loads((out / "result.json").read_text())
    notes = sum(warning["severity"] == "note" for warning in result["warnings"])
    assert notes
    flat = " ".join(said.split())
    assert f"{notes} note{'s' * (notes > 1)} (--verbose)" in flat
    assert "\nnote: " not in said
    assert said.count("\x1b") == 0
    assert re.search(r"\nnext steps:\n  1\. [^\n]+\n", said)
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
    assert main(["inspect", ARM, "--free-flyer"]) == 0
    printed = capsys.readouterr().out
    assert printed.endswith(f"\n  robotid inspect {shlex.quote(ARM)} --free-flyer --base\n")
    urdf = tmp_path / "two.urdf"
    urdf.write_text(Path(ARM).read_text().replace('value="1.9"', 'value="-1.9"'))
    assert main(["inspect", str(urdf)]) == 1
    printed = capsys.readouterr()
    assert printed.out.startswith("planar_2r: 2 joints: joint_1, joint_2\nerror: negative_mass: ")
    assert printed.err == f"robotid: {urdf} does not give a valid model; see the findings\n"


def finding(joint, code, share, severity="warning"):
    odd = Finding(
        code, severity, f"run.csv: {joint}", "", {"share": share / 100}, log="run.csv",
        joints=(joint,), words={"joint": joint}, fault="{share:.0f %} of {joint}'s torque is odd",
    )  # fmt: skip
    return odd.reworded()


def test_findings_are_told_by_cause_and_the_worst_joint_is_named(capsys):
    joints = ["arm_1", "arm_6", "arm_7"]
    findings = [
        *(finding(joint, "stepped", 20) for joint in ("arm_6", "arm_7")),
        *(finding(joint, "odd", share) for joint, share in (("arm_6", 37), ("arm_7", 68))),
        finding("arm_1", "noise", 1, "note"),
    ]
    doctor._show(findings, joints, {}, is_verbose=False, count=2)
    assert capsys.readouterr().out.splitlines() == [
        "warning: stepped: run.csv: 20 % of arm_6, arm_7's torque is odd",
        "warning: odd: run.csv: 37 to 68 % of arm_6, arm_7's torque is odd",
        "2 warnings, 1 note (--verbose); worst: arm_7",
    ]
    findings.append(finding("arm_1", "reversed", 1, "error"))  # graver than any two warnings
    doctor._show(findings, joints, {}, is_verbose=True, count=2)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "error: reversed: run.csv: 1 % of arm_1's torque is odd"
    assert lines[-2:] == [
        "note: noise: run.csv: 1 % of arm_1's torque is odd",
        "1 error, 2 warnings, 1 note; worst: arm_1",
    ]
    wrong = [finding("arm_6", code, 1, "error") for code in ("one", "two")]
    wrong += [finding("arm_7", code, 9) for code in ("three", "four")]
    wrong.append(finding("arm_7", "five", 9, "error"))
    doctor._show(wrong, joints, {}, is_verbose=False, count=2)
    assert capsys.readouterr().out.splitlines()[-1].endswith("worst: arm_6"), "two errors"


def test_a_stage_is_printed_once_and_files_of_one_name_with_their_folders(capsys):
    with progress_of(SimpleNamespace(verbose=True)) as show:
        for what, done, unit in (
            ("fitting", 2, "stages"),
            ("pieces", 0, "pieces"),
            ("fitting", 2, "stages"),
        ):
            show(what, done, 5, unit)
    assert capsys.readouterr().err == "robotid: 3/5 fitting\n"
    paths = ["a/run.csv", "b/run.csv", "a/run.csv", "c/one.csv", ""]
    logs = [{"path": x, "role": "fit", "start": k, "end": k + 2} for k, x in enumerate(paths)]
    assert recordings_of([*logs, {"path": "c/one.csv", "role": "other"}], "fit") == [
        "a/run.csv 0-2 s", "b/run.csv 1-3 s", "a/run.csv 2-4 s", "one.csv 3-5 s", "log 4-6 s",
    ]  # fmt: skip


def test_the_paper_and_base_parameters_are_printed_in_columns(capsys):
    model = {"relative_error": [0.5, 0.25, 0.125], "NA": 7}
    cases = {case: {"linear": {"relative_error": [1.0, 0.1 * k]}}
             for k, case in enumerate(("disturbed", "noisy", "on_program"), 1)}  # fmt: skip
    runs = {"linear": {"converged": 3, "runs": 4}}
    paper._show({"models": {"linear": model}, "trajectories": runs, **cases})
    _, _, row, *_, last = capsys.readouterr().out.splitlines()
    assert row.split() == ["linear", "0.5", "0.25", "0.12", "0.1", "0.2", "0.3", "7"]
    assert last.split() == ["linear", "3", "of", "4"]
    entries = [
        {"name": f"p{k}", "values": [1.0, k], "std_errors": [0.1, 0.01], "unit": "kg",
         "differences": [k]} for k in range(4)
    ]  # fmt: skip
    for limit, shown in ((2, 2), (3, 4), (None, 4)):
        compare._print_base_parameters({"base_parameters": entries}, ["A", "B"], limit)
        printed = capsys.readouterr().out
        assert printed.count(" kg ") == shown
        assert ("  2 more with smaller differences: --verbose" in printed) == (limit == 2)
    assert "\n  p3  1.00  3.000  kg  3.0\n" in printed
    inertia, errors = np.array([[[1.0, 2.0, 3.0], [2.0, 4.0, 5.0], [3.0, 5.0, 6.0]]] * 2)
    errors = 0.1 * errors
    load = {"link": "tool", "mass": 2.0, "mass_std_error": 0.01, "mass_interval": [1.98, 2.02],
            "com": None, "inertia": inertia, "inertia_std_error": errors, "reasons": {},
            "inertia_at_link": 10 * inertia}  # fmt: skip
    payload._print_one_payload(load, None)
    printed = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert ["Ixy", "2.00", "+-", "0.20"] in printed
    assert ["Iyz", "5.00", "+-", "0.50"] in printed
    assert ["Iyz", "50"] in printed


CLOSED = {"no output": ">&-", "no errors": "2>&-", "neither": ">&- 2>&-"}


@pytest.mark.parametrize("name", CLOSED)
def test_closed_streams_change_neither_files_nor_the_code(arm_logs, tmp_path, name):
    """The next file that is opened gets the number of a closed stream: no word may get into it."""
    words = ["convert", arm_logs / "fit.csv", tmp_path / "out.npz"]
    close = CLOSED[name]
    command = shlex.join([sys.executable, "-m", "robotid", *map(str, words)])
    done = subprocess.run(f"{command} {close}", shell=True, capture_output=True, check=False)
    assert (done.returncode, done.stderr) == (0, b"")
    assert len(np.load(tmp_path / "out.npz")["time"]) == 800
    missing = command.replace("fit.csv", "none.csv")
    done = subprocess.run(f"{missing} {close}", shell=True, capture_output=True, check=False)
    assert done.returncode == 1
    assert (b"there is no log file" in done.stderr) == (name == "no output")
