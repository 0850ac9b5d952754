"""The page of an identification that predicts positions: its figures are those of the logs."""

import json
import re
from dataclasses import replace
from html import unescape

import numpy as np
import pytest
from helpers.pages import bars, charts, tables

from robotid.base.findings import Finding
from robotid.output.report.next_steps import Origin
from robotid.output.report.report_content import Residual, worst_second, write_report

JOINTS = ("rail", "turn")


@pytest.fixture(scope="module")
def found(crane):
    [run] = crane.validation
    held_out = replace(run, log=replace(run.log, path="kept.csv"))
    soft = Finding("saturation", "warning", "turn", "turn <i>saturates</i>")
    return replace(crane, validation=(held_out,), findings=(*crane.findings, soft))


def page_of(found, folder, **options):
    return write_report(found, folder / "page.html", **options).read_text()


@pytest.fixture(scope="module")
def page(found, tmp_path_factory):
    return page_of(found, tmp_path_factory.mktemp("page"), origin=Origin((), "out"))


def test_errors_are_those_of_the_logs_in_mrad_and_mm(found, page):
    [run] = found.validation
    error = 1e3 * np.sqrt(np.mean((run.log.q - run.q) ** 2, axis=0))
    motion = 1e3 * run.log.q.std(axis=0)
    rows = tables(page)[f"{run.name}: not fitted"].by_name()
    for j, joint in enumerate(JOINTS):
        assert float(rows[joint]["error %"]) == pytest.approx(100 * error[j] / motion[j], abs=0.06)
        assert float(rows[joint]["RMSE"]) == pytest.approx(error[j], rel=0.01)
        assert rows[joint]["unit"] == ("mm", "mrad")[j]
        assert rows[joint]["samples"] == str(len(run.log.t))
    mean = np.sqrt(error[0] * error[1])
    assert f"<strong>{mean:.3g} mm or mrad</strong>, geometric mean of 2 joints" in page
    assert "fitted samples, without validation log" not in page
    assert [*bars(page)] == sorted(JOINTS, key=lambda joint: -float(rows[joint]["error %"]))


def test_errors_over_the_horizon_are_in_a_table(found, page):
    [run] = found.validation
    whole = run.log.t[-1] - run.log.t[0]
    errors = {**run.horizons, whole: run.rmse}
    held_out = tables(page)[f"{run.name}: error over the horizon, mm or mrad"]
    assert held_out.headers == ["joint", "0.1 s", "0.5 s", f"{whole:.4g} s"]
    figures = np.array([[float(x) for x in row[1:]] for row in held_out.rows])
    np.testing.assert_allclose(figures, 1e3 * np.stack([*errors.values()]).T, rtol=0.01)
    feet = [float(x) for x in held_out.foot[1:]]
    np.testing.assert_allclose(feet, np.sqrt(figures.prod(axis=0)), rtol=0.01)


def test_positions_of_each_log_are_drawn(found, page):
    [run] = found.validation
    drawn = [c for c in charts(page) if c["title"].startswith("position of turn")]
    assert len(drawn) == 3
    lines = {series["label"]: series["y"] for series in drawn[0]["series"]}
    for label, values in (("commanded", run.log.q_ref), ("measured", run.log.q),
                          ("simulated", run.q)):  # fmt: skip
        np.testing.assert_allclose(lines[label], values[:, 1], atol=1e-4)
    below = next(c for c in charts(page) if c["title"] == "position error of turn")
    left = {series["label"]: series["y"] for series in below["series"]}
    np.testing.assert_allclose(
        left["measured − simulated"], 1e3 * (run.log.q - run.q)[:, 1], atol=1e-2
    )
    assert f"{run.name}, not fitted: RMSE {1e3 * run.rmse[1]:.3g} mrad" in page
    assert f"{found.fitted[0].name}, fitted: RMSE" in page


def test_the_worst_second_is_in_mrad_and_the_replay_knows_when_each_log_ends(found, tmp_path):
    page = page_of(found, tmp_path, files={"replay": "replay.html"})
    [run] = found.validation
    left = run.log.q[:, 1] - run.q[:, 1]
    worst = worst_second([Residual(run.name, run.log.name, run.log.t, left)])
    at = f"{worst.start:.2f} to {worst.end:.2f} s, RMS {1e3 * worst.rms:.3g} mrad"
    assert f"Largest residual within 1 s: {run.name}, {at}" in page
    clips = json.loads(unescape(re.search(r'data-clips="(.*?)"', page)[1]))
    ends = [(e.log.t[0], e.log.t[-1]) for e in (*found.validation, *found.fitted)]
    assert [(clip["start"], clip["end"]) for clip in clips] == ends


def test_drives_stand_side_by_side_and_delays_in_milliseconds(found, page):
    estimate, free = found.fit.estimate, found.fit.simulator.free_parameters
    (k,) = (k for k, x in enumerate(free) if x.what == "delay" and 0 in x.joints)
    shown = tables(page)["Drives, by joint"].by_name()["rail"]["delay [ms]"]
    value, error = (float(x) for x in shown.split(" ± "))
    assert value == pytest.approx(1e3 * estimate.theta[k], abs=0.6 * error)
    assert error == pytest.approx(1e3 * estimate.std_error[k], rel=0.05)


def test_parameters_findings_and_commands_are_shown(found, page):
    rows = tables(page)["Parameters of links and drives"].rows
    sources = {f"{row[0]}.{row[1]}": row[8] for row in rows}
    assert sources["rail.kp"] == "stated"
    assert sources["rail.delay"] == "data"
    assert "turn &lt;i&gt;saturates" in page
    assert "Positions and commands determine torques up to a common factor" in page
    plain = page.replace("<span>", "").replace("</span>", "")
    commands = re.findall(r'<pre class="command">(.*?)</pre>', plain)
    assert [words.split()[1] for words in commands[-4:]] == ["replay", "export", "export", "export"]
    assert tables(page)["Files read"].column("role") == ["URDF", "fitted", "fitted", "validation"]


def test_without_validation_the_fitted_logs_are_shown_and_a_torque_is_no_command(found, tmp_path):
    driven = [
        replace(run, baselines={**run.baselines, "steady": run.spread}) for run in found.fitted
    ]
    page = page_of(replace(found, fitted=tuple(driven), validation=()), tmp_path)
    assert "There is no validation log" in page
    assert "fitted samples, without validation log" in page
    drawn = next(c for c in charts(page) if c["title"] == "position of rail")
    labels = [line["label"] for line in drawn["series"]]
    assert labels == ["measured", "simulated"]
    assert "Simulated position error over 0.5 s, fitted" in page
