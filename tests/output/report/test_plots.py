"""The report's charts: the data in the page against the series they claim."""

import pickle
import re
import subprocess
import sys
import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest
from helpers.figures import torques
from helpers.pages import chart, percent

from robotid.diagnosis.residual.residuals import autocorrelation, spectrum
from robotid.output.report import torque_section as torques_module
from robotid.output.report.information_section import information
from robotid.output.report.pictures import QUANTILE, torque_charts
from robotid.output.report.steps import Origin
from robotid.output.report.torque_section import torques_section

JOINTS = range(6)


@pytest.fixture(scope="module")
def kept(identified):
    return identified.validation[0]


@pytest.fixture(scope="module")
def predicted(identified, kept):
    return torques(identified, kept.recording.trajectory)["estimate"]


def close(drawn, wanted):
    """Assert that a series is the data, to what 16 bits tell apart."""
    assert np.isnan(drawn).tolist() == np.isnan(wanted).tolist()
    np.testing.assert_allclose(drawn, wanted, atol=2e-5 * (np.nanmax(wanted) - np.nanmin(wanted)))


@pytest.mark.parametrize("j", JOINTS)
def test_torque_is_drawn_as_measured_identified_urdf_and_residual(
    report, identified, kept, predicted, j
):
    name, motion = identified.model.joints[j], kept.recording.trajectory
    used, tau = kept.recording.mask[:, j].astype(bool), motion.tau[:, j]
    upper = chart(report, f"Torque of {name} over time:")
    lower = chart(report, f"Residual of {name} over time, m")
    # the rows that the page has, between them one that breaks the line at the gap
    t = np.insert(motion.t, np.flatnonzero(np.diff(motion.segment)) + 1, np.nan)
    assert motion.t[0] == pytest.approx(upper["x"][0], abs=1e-6)  # the log's own time
    np.testing.assert_allclose(upper["x"][np.isfinite(t)], motion.t, atol=1e-6)
    blank = np.where(used, 0.0, np.nan)
    urdf, measured, ours = (series["y"][np.isfinite(t)] for series in upper["series"])
    close(measured, tau)
    close(ours, predicted[:, j] + blank)
    close(urdf, kept.torques["urdf"][:, j] + blank)
    close(lower["series"][1]["y"][np.isfinite(t)], tau - predicted[:, j] + blank)
    assert np.isnan(upper["series"][1]["y"]).sum() == np.isnan(t).sum() == 1
    assert upper["link"] == lower["link"] != ""


def test_a_urdf_that_would_dwarf_the_torque_is_hidden_at_first(identified, kept):
    torques = dict(kept.torques)
    for factor, wanted in ((1.0, False), (100.0, True)):
        torques["urdf"] = factor * kept.torques["urdf"]
        upper, _ = torque_charts(identified, replace(kept, torques=torques), 1)
        assert [series.is_hidden for series in upper.series] == [wanted, False, False]


@pytest.mark.parametrize("j", JOINTS)
def test_the_band_is_that_of_the_joint(report, identified, kept, j):
    name, band = identified.model.joints[j], identified.band(kept)
    t = kept.recording.trajectory.t
    for title in ("Torque of {} over time:", "Residual of {} over time, m"):
        what = chart(report, title.format(name))
        (series,) = [series for series in what["series"] if series["half"] is not None]
        known = np.isfinite(series["half"])
        half = np.interp(what["x"][known], t[band.samples], 1.96 * band.total[:, j])
        np.testing.assert_allclose(series["half"][known], half, rtol=0.02)


@pytest.mark.parametrize("j", JOINTS)
def test_the_ground_is_shaded_where_rows_are_not_used(report, identified, kept, j):
    motion, used = kept.recording.trajectory, kept.recording.mask[:, j].astype(bool)
    spans = chart(report, f"Torque of {identified.model.joints[j]} over time:")["spans"]
    t = motion.t
    assert all(any(a <= t[k] <= b for a, b in spans) for k in np.flatnonzero(~used))
    assert not any(a < t[k] < b for a, b in spans for k in np.flatnonzero(used))
    after = np.flatnonzero(np.diff(motion.segment))[0] + 1
    assert any(a <= motion.t[after - 1] and motion.t[after] <= b for a, b in spans)  # the gap


@pytest.mark.parametrize("j", JOINTS)
def test_friction_is_drawn_against_speed(report, identified, kept, predicted, j):
    motion, rows = kept.recording.trajectory, np.flatnonzero(kept.recording.mask[:, j])
    value = dict(zip(identified.model.layout.names, identified.standard, strict=True))
    joint, v = identified.model.joints[j], motion.v[rows, j]
    sign = np.sign(v) if motion.direction is None else motion.direction[rows, j]
    own = [value[f"{joint}.{term}"] for term in ("viscous", "coulomb", "offset")]
    friction = own[0] * v + own[1] * sign + own[2]
    left = motion.tau[rows, j] - predicted[rows, j] + friction
    what = chart(report, f"Friction of {joint} against speed")
    known = np.isfinite(what["series"][0]["y"])
    order = np.argsort(v, kind="stable")
    np.testing.assert_allclose(what["x"][known], v[order], atol=1e-6)
    dots, ours, steady = (series["y"][known] for series in what["series"])
    close(dots, left[order])
    close(ours, friction[order])
    close(steady, own[0] * v[order] + own[1] * np.sign(v[order]) + own[2])
    assert known.sum() == len(known) - 1  # dry friction jumps: the line breaks where it turns


@pytest.mark.parametrize("j", JOINTS)
def test_the_spectrum_is_that_of_torque_and_residual(report, identified, kept, predicted, j):
    recording = kept.recording
    motion, used = recording.trajectory, recording.mask[:, j].astype(bool)
    what = chart(report, f"Spectrum of torque and residual of {identified.model.joints[j]}")
    residual = motion.tau - predicted
    for series, x in zip(what["series"], (motion.tau[:, j], residual[:, j]), strict=True):
        f, density = spectrum(x, used, motion.segment, 0.02)
        shown = (f > 0) & (f <= 24.0)  # twice the cut-off
        np.testing.assert_allclose(what["x"], f[shown], atol=1e-6)
        np.testing.assert_allclose(series["y"], np.sqrt(density[shown]), rtol=1e-3)
    assert what["marks"] == [12.0]
    assert what["logarithmic"] == "y"


@pytest.mark.parametrize("j", JOINTS)
def test_the_autocorrelation_is_that_of_the_residual(report, identified, kept, predicted, j):
    recording = kept.recording
    motion, used = recording.trajectory, recording.mask[:, j].astype(bool)
    r = autocorrelation((motion.tau - predicted)[:, j], used, motion.segment, 99)  # 2 s at 50 Hz
    what = chart(report, f"Autocorrelation of the residual of {identified.model.joints[j]}")
    np.testing.assert_allclose(what["x"], 0.02 * np.arange(100), atol=1e-6)
    close(what["series"][0]["y"], r)


@pytest.mark.parametrize("term", ["armature", "viscous", "coulomb", "offset"])
def test_drives_show_their_values_with_two_standard_errors(report, identified, term):
    joints, names = identified.model.joints, list(identified.model.layout.names)
    part = [names.index(f"{joint}.{term}") for joint in joints]
    what = chart(report, f"{term} of each drive")
    assert what["x_names"] == list(joints)
    (ours,) = what["series"]  # the URDF has no friction to stand beside it
    error = identified.standard_error[part]
    assert np.isinf(error).tolist() == [j == "elbow_joint" and term == "viscous" for j in joints]
    close(ours["y"], identified.standard[part])
    close(ours["half"], np.where(np.isinf(error), np.nan, 2 * error))  # at its bound: no bar


def test_singular_values_are_those_of_the_regressor(report, identified):
    values = information(identified).singular_values
    what = chart(report, "Singular values")
    np.testing.assert_allclose(what["x"], np.arange(1, len(values) + 1), atol=1e-6)
    np.testing.assert_allclose(what["series"][0]["y"], values, rtol=1e-3)
    assert identified.wls.rank == len(values)


def test_a_report_needs_no_matplotlib(identified, tmp_path):
    (tmp_path / "found.pickle").write_bytes(pickle.dumps(identified))
    code = (
        "import pickle, sys\nfrom pathlib import Path\nsys.modules['matplotlib'] = None\n"
        "from robotid.output.report.document import write_report\n"
        "found = pickle.loads(Path('found.pickle').read_bytes())\n"
        "write_report(found, 'report.html')"
    )
    words = [sys.executable, "-c", code]
    run = subprocess.run(words, capture_output=True, text=True, cwd=tmp_path)
    assert run.returncode == 0, run.stderr
    assert '<figure class="chart"' in (tmp_path / "report.html").read_text(encoding="utf-8")


def test_correlations_are_drawn_in_their_cell_with_their_sign_and_strength(report, identified):
    svg = re.search(r'<svg class="map".*?</svg>', report, re.DOTALL)[0]
    r = information(identified).correlation
    b = len(r)
    root = ET.fromstring(svg)
    corner = min(
        float(text.get("x")) for text in root.iter("text") if text.get("text-anchor") is None
    )
    drawn = np.zeros((b, b))
    for path in root.iter("path"):
        sign = {"var(--predicted)": 1, "var(--residual)": -1}[path.get("fill")]
        for x, y in re.findall(r"M(\d+) (\d+)h", path.get("d")):
            i, j = round(int(y) / 11), round((int(x) - corner + 2) / 11)
            drawn[i, j] = sign * float(path.get("fill-opacity"))
    wanted = np.rint(8 * np.tril(r, -1)) / 8
    np.testing.assert_allclose(drawn, wanted, atol=1e-3)
    assert (wanted > 0).sum() != (wanted < 0).sum()


def test_the_shares_of_the_data_are_said_in_the_mean_and_of_the_weakest(identified, report):
    shares = [round(100 * share) for share in information(identified).data_share]
    assert min(shares) < np.mean(shares) < 99.5
    said = f"by {np.mean(shares):.0f} % on average and the weakest by {min(shares)} %"
    assert said in report


def test_captions_say_error_and_how_much_the_band_holds(identified, report):
    """Of each joint in the validation recording, by hand."""
    (kept,) = identified.validation
    motion, band = kept.recording.trajectory, identified.band(kept)
    residual = np.abs(motion.tau - kept.torques["estimate"])[band.samples]
    inside = residual <= 1.959964 * np.sqrt(band.parameters**2 + band.noise**2)
    said = []
    for j, joint in enumerate(identified.model.joints):
        own, used = kept.metrics["estimate"].per_joint[joint], kept.recording.mask[band.samples, j]
        share = 100 * inside[used, j].mean()
        said.append(
            f"error {own.relative_error_pct:.1f} %, RMSE {own.rmse:.3g} N m; "
            f"95 % band contains {share:.0f} %"
        )
    assert all(words in report for words in said), said
    assert len(set(said)) == len(said)


def test_each_recording_has_its_own_band_error_and_share_of_the_points(identified, monkeypatch):
    drawn = []

    def noted(chart, caption, points):
        drawn.append((chart, caption, points))
        return ""

    monkeypatch.setattr(torques_module, "chart_html", noted)
    monkeypatch.setattr("robotid.output.report.curves._ROWS", 9600)
    verdicts = identified.verdict.to_dict()["per_joint"]
    torques_section(replace(identified, validation=()), verdicts, identified.model.joints, Origin())
    fitted, joints = identified.fitted, identified.model.joints
    assert {points for *_, points in drawn} == {9600 // (2 * 6 * 2)}
    above, below = drawn[::2], drawn[1::2]
    assert [caption for _, caption, _ in below] == [""] * 12
    pairs = [(j, k) for j in range(6) for k in range(2)]
    for (j, k), (upper, caption, _) in zip(pairs, above, strict=True):
        evaluation, name = fitted[k], joints[j]
        band, motion = identified.band(evaluation), evaluation.recording.trajectory
        used = evaluation.recording.mask[:, j].astype(bool)
        half = QUANTILE * np.interp(np.arange(len(motion.t)), band.samples, band.total[:, j])
        (series,) = [series for series in upper.series if series.half is not None]
        np.testing.assert_allclose(series.half[np.isfinite(series.half)], half)
        residual = motion.tau[used, j] - evaluation.torques["estimate"][used, j]
        rmse, size = np.sqrt(np.mean(residual**2)), np.sqrt(np.mean(motion.tau[used, j] ** 2))
        held = np.mean(np.abs(residual) <= half[used])
        assert upper.link == f"recording {k}"
        assert caption == (
            f"{evaluation.recording.name}, fitted: error {percent(100 * rmse / size)} %, RMSE "
            f"{rmse:.3g} N m; 95 % band contains {100 * held:.0f} %"
        ), name
