"""What a notebook and print() show of a result."""

from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from helpers.paths import ROOT
from helpers.synthetic import exact_log, truth

from robotid.cli.work.identify import run_job
from robotid.cli.work.job import Job, LogEntry
from robotid.data.files.read import write_log
from robotid.identification.pipeline import identify
from robotid.identification.summary import (
    cell,
    error_lines,
    friction_lines,
    joint_reason,
    verdict_lines,
)
from robotid.robot.model import RobotModel


class Words(HTMLParser):
    def __init__(self, html):
        super().__init__()
        self.words, self.tags = [], []
        self.feed(html)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data):
        self.words.append(data)


@pytest.fixture(scope="module")
def arm():
    return RobotModel.from_urdf(ROOT / "urdf" / "planar_2r.urdf")


@pytest.fixture(scope="module")
def logs(arm):
    rng = np.random.default_rng(0)
    return [exact_log(arm, truth(arm), rng, samples=800, noise=0.1) for _ in range(2)]


@pytest.fixture(scope="module")
def reported():
    return []


@pytest.fixture(scope="module")
def found(arm, logs, reported):
    return identify(arm, logs[:1], validation=logs[1:], progress=lambda *x: reported.append(x))


def test_each_drive_has_its_choice_of_friction_though_none_is_added(found):
    assert [drive.joint for drive in found.drives] == list(found.model.joints)
    assert not any(drive.terms for drive in found.drives)


def test_the_start_of_each_stage_is_reported(found, reported):
    assert [x for x in reported if x[3] == "stages"] == [
        (name, k, 5, "stages")
        for k, name in enumerate(
            ["reading logs", "checking logs", "fitting", "errors and intervals"]
        )
    ]


def test_an_identification_is_one_short_line(found):
    status = found.verdict.status
    assert repr(found) == (
        f"<Identification of {found.model.name}: {len(found.base)} base parameters by consistent, "
        f"verdict {status}>"
    )
    assert "array(" not in repr(found.estimate)
    assert repr(found.estimate).startswith(f"<Estimate: {len(found.estimate.names)} parameters")


def test_its_text_has_verdict_reasons_and_every_joint(found):
    text = str(found)
    assert text == found.summary()
    assert text.splitlines()[0].endswith(f"verdict {found.verdict.status}")
    for reason in found.verdict.reasons:
        assert reason in text
    for joint in found.model.joints:
        error = found.validation[0].metrics["estimate"].per_joint[joint].relative_error_pct
        (first, _) = [line.split() for line in text.splitlines() if line.split()[0] == joint]
        assert first[1] == f"{error:.1f}"
        assert text.count(f"  {joint} ") == 2  # kept and fitted rows


def test_its_tables_have_the_errors_of_plainer_predictions(found):
    """Those of weighted least squares made worse than they are, to be another figure."""
    (kept,), (fitted,) = found.validation, found.fitted
    metrics = kept.metrics["wls"].per_joint.items()
    others = {
        joint: replace(m, relative_error_pct=3.0 * m.relative_error_pct) for joint, m in metrics
    }
    worse = {**kept.metrics, "wls": replace(kept.metrics["wls"], per_joint=others)}
    sums = fitted.sums["wls"]
    sums = {**fitted.sums, "wls": replace(sums, residual=4.0 * sums.residual)}
    found = replace(
        found, validation=(replace(kept, metrics=worse),), fitted=(replace(fitted, sums=sums),)
    )
    lines = [line.split() for line in str(found).splitlines()]
    tables = (
        (found.validation[0].metrics["estimate"], found.validation[0].metrics["wls"]),
        (
            found.metrics(),
            found.metrics("wls"),
        ),
    )
    for place, (ours, wls) in enumerate(tables):
        for joint, m in ours.per_joint.items():
            own = [words for words in lines if words and words[0] == joint][place]
            others = [
                m.baselines["urdf_with_drives"], wls.per_joint[joint].relative_error_pct,
                m.baselines["urdf"], m.baselines["gravity_only"],
            ]  # fmt: skip
            assert own[1:] == [
                f"{m.relative_error_pct:.1f}", f"{m.rmse:#.3g}", "N", "m", *map(cell, others),
            ]  # fmt: skip


def test_figures_above_a_thousand_have_no_decimals():
    assert [cell(x) for x in (None, 0.04, 99.96, 123.45, 999.94, 1234.5)] == [
        "-", "0.0", "100.0", "123.5", "999.9", "1234",
    ]  # fmt: skip


def test_joints_worse_than_a_constant_are_marked_wherever_they_stand():
    def lines(*better):
        joints = {
            joint: {
                "rmse": 0.25, "unit": "N m", "relative_error_pct": 120.0,
                "better_than_constant": is_so,
            }
            for joint, is_so in zip("abc", better, strict=True)
        }  # fmt: skip
        return error_lines({"per_joint": joints})

    note = "  * worse than a constant"
    for marked in ((0,), (1,), (0, 2)):
        found = lines(*(k not in marked for k in range(3)))
        assert found[-1] == note
        rows = found[-4:-1]
        assert [row.split()[1] == "*" for row in rows] == [k in marked for k in range(3)]
    assert not any("*" in line for line in lines(True, True, True))


def test_friction_is_said_from_the_first_step_to_the_last_that_was_taken():
    steps = [(20.0, True), (9.0, False), (8.04, True), (5.06, True), (3.0, False)]
    tried = [
        {"held_out_error_pct": error, "is_selected": is_selected} for error, is_selected in steps
    ]
    joints = {
        "a": {"families": ["tanh", "load"], "tried": tried},
        "b": {"families": [], "tried": tried[:2]},
        "c": {"families": ["lag"], "tried": tried[:3]},
    }
    assert friction_lines(joints) == [
        "friction besides viscous and Coulomb:",
        "  a: tanh + load (held-out error 20.0 -> 5.1 %)",
        "  c: lag (held-out error 20.0 -> 8.0 %)",
    ]
    assert friction_lines({"b": joints["b"]}) == []


def test_a_job_s_identification_links_to_its_report(arm, logs, tmp_path):
    write_log(logs[0], tmp_path / "log.csv")
    job = Job(
        urdf=ROOT / "urdf" / "planar_2r.urdf", identification=(LogEntry(tmp_path / "log.csv"),)
    )
    found, _ = run_job(job, tmp_path / "out")
    assert found.report == str(tmp_path / "out" / "report.html")
    assert f"report: {found.report}" in str(found)


def test_an_estimate_lists_every_parameter(found):
    text, html = str(found.wls), found.wls._repr_html_()
    for name, value in zip(found.wls.names, found.wls.theta, strict=True):
        (line,) = [line for line in text.splitlines() if line.split()[0] == name]
        assert float(line.split()[1]) == pytest.approx(value, rel=1e-3)
        assert name in "".join(Words(html).words)


def test_a_reason_of_a_joint_is_shown_once():
    verdict = {
        "status": "poor",
        "reasons": ["a: bad", "c: slow", "a: slow", "no log"],
        "per_joint": {
            "a": {"status": "poor", "reasons": ["a: bad", "a: slow"]},
            "b": {"status": "good", "reasons": ["error 3 %"]},
            "c": {"status": "usable", "reasons": ["c: slow"]},
            "d": {"status": "good", "reasons": ["error 4 %"]},
        },
    }
    assert verdict_lines(verdict) == [
        "verdict: poor", "  a: poor: bad", "  c: usable: slow", "  - a: slow", "  - no log",
        "  b, d: good",
    ]  # fmt: skip
    alone = {"status": "good", "reasons": ["fine"], "per_joint": {"b": verdict["per_joint"]["b"]}}
    assert verdict_lines(alone) == ["verdict: good", "  - fine", "  every joint: good"]


def test_a_reason_loses_the_name_of_its_joint_only():
    assert joint_reason("b", ["a, b: too slow", "b: no"]) == "too slow"
    assert joint_reason("bb", ["a, b: too slow"]) == "a, b: too slow"
    assert joint_reason("b", ["the whole: is wrong"]) == "the whole: is wrong"
    assert joint_reason("b", []) == ""
