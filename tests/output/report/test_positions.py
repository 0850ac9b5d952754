"""The page of an identification that predicts positions: its figures are those of the logs."""

import json
import re
from dataclasses import replace
from html import unescape

import pytest
from helpers.pages import charts, tables

from robotid.base.findings import Finding
from robotid.output.files.entries import build_result
from robotid.output.report.next_steps import Origin
from robotid.output.report.report_content import Clip, Dock, Residual, worst_second, write_report


@pytest.fixture(scope="module")
def found(crane):
    [run] = crane.validation
    held_out = replace(run, log=replace(run.log, path="kept.csv"))
    soft = Finding("saturation", "warning", "turn", "turn <i>saturates</i>")
    return replace(crane, validation=(held_out,), findings=(*crane.findings, soft))


def page_of(found, folder, **options):
    return write_report(found, folder / "page.html", **options).read_text()


def test_delays_are_in_ms_the_worst_second_in_mrad_and_clips_end_with_their_logs(found, tmp_path):
    page = page_of(found, tmp_path, files={"replay": "replay.html"})
    delay = next(
        e for e in build_result(found, {})["drive_parameters"] if e["name"] == "turn.delay"
    )
    value, error = (f"{1e3 * delay[key]:.3f}" for key in ("value", "std_error"))
    drives = tables(page)["Drives, by joint"].by_name()
    assert drives["turn"]["delay [ms]"] == f"{value} ± {error}"
    [run] = found.validation
    left = run.log.q[:, 1] - run.q[:, 1]
    worst = worst_second([Residual(run.name, run.log.name, run.log.t, left)])
    at = f"{worst.start:.2f} to {worst.end:.2f} s, RMS {1e3 * worst.rms:.3g} mrad"
    assert f"Largest residual within 1 s: {run.name}, {at}" in page
    clips = json.loads(unescape(re.search(r'data-clips="(.*?)"', page)[1]))
    ends = [(e.log.t[0], e.log.t[-1]) for e in (*found.validation, *found.fitted)]
    assert [(clip["start"], clip["end"]) for clip in clips] == ends
    shown = [Clip("a", "", 0.0, 1.0), Clip("b", "b.csv", 0.0, 1.0)]  # one of arrays, one of a file
    assert Dock("", Origin((), "out", "replay.html"), "arm.urdf", shown).file == "replay.html"


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
