"""The report's charts: the data in the page against the series they claim."""

import re
from html import unescape

import numpy as np
import pytest
from helpers.figures import torques
from helpers.pages import chart, number, percent, tables
from scipy.stats import norm

from robotid.diagnosis.residual.torque_split import joint_torques
from robotid.output.report import pictures
from robotid.output.report.pictures import why_charts
from robotid.output.report.report_content import why_section

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


def series(chart, label):
    (found,) = [s for s in chart.series if s.label.startswith(label)]
    return found


def test_torques_are_those_of_the_recording_kept_apart_or_of_the_one_asked_for(identified):
    j = identified.model.joints.index("elbow_joint")
    for shown, asked in ((identified.validation[0], None), (identified.fitted[1],) * 2):
        plot = pictures.plot_torques(identified, "elbow_joint", recording=asked)
        assert plot.title == f"Torques of {shown.recording.name}"
        measured = series(plot.charts[0][0], "measured").y
        tau = shown.recording.trajectory.tau[:, j]
        np.testing.assert_array_equal(measured[np.isfinite(measured)], tau)
    assert len(pictures.plot_torques(identified).charts) == 2 * len(identified.model.joints)


def test_friction_and_reasons_are_of_the_joint_named(identified):
    plot = pictures.plot_friction(identified, "elbow_joint", "wrist_1_joint")
    captions = [caption for _, caption in plot.charts]
    assert captions == ["elbow_joint: friction and offset", "wrist_1_joint: friction and offset"]
    assert len(pictures.plot_friction(identified).charts) == 6
    why = pictures.plot_why(identified, "wrist_2_joint")
    assert all(caption.startswith("wrist_2_joint") for _, caption in why.charts)
    split = why.charts[0][0]
    parts = [s for s in split.series if s.kind == "area"]
    whole = np.sum([s.y for s in parts], axis=0)
    np.testing.assert_allclose(whole, series(split, "measured").y, atol=1e-9)


def test_what_a_residual_follows_is_drawn_with_its_interval(identified):
    (j,) = (k for k, n in enumerate(identified.model.joints) if n == "wrist_2_joint")
    torque = joint_torques(identified)[j]
    charts = why_charts(torque)
    assert [d.name for d in torque.follows if d.name in charts] == [
        "position", "speed", "acceleration", "load", "time",
    ]  # fmt: skip
    for dependence in torque.follows[1:]:
        chart = charts[dependence.name]
        x = torque.quantities.get(dependence.name, ("s", torque.rows.time))[1][torque.used]
        left = torque.against_time[0] if dependence.name == "time" else torque.residual
        order = np.argsort(x)
        np.testing.assert_array_equal(chart.x, x[order])
        np.testing.assert_array_equal(series(chart, "residual").y, left[torque.used][order])
        mean = series(chart, "mean")
        own = (dependence.centres, dependence.means, dependence.errors)
        wanted, error = (np.interp(chart.x, own[0], y, np.nan, np.nan) for y in own[1:])
        np.testing.assert_array_equal(mean.y, wanted)
        np.testing.assert_allclose(mean.half, norm.ppf(0.975) * error, rtol=1e-4)


def test_a_line_hides_four_times_as_high_as_the_others_and_gaps_of_a_pixel_are_one():
    flat = np.array([0.0, np.nan, 1.0])
    assert not pictures._dwarfs(np.array([-1.9, 2.0]), flat, flat)
    assert pictures._dwarfs(np.array([-1.9, np.nan, 2.2]), flat, flat)
    t, used = np.arange(1001) / 10, np.ones(1001, dtype=bool)  # a pixel is 0.2 s
    used[[0, 100, 102, 104, 110, 1000]] = False
    spans = pictures.unused_spans(t, used)
    wanted = [(0.0, 0.1), (9.9, 10.5), (10.9, 11.1), (99.9, 100.0)]
    np.testing.assert_allclose(spans, wanted)


@pytest.fixture(scope="module")
def section(identified):
    return why_section(identified)


@pytest.fixture(scope="module")
def torque_of(identified):
    return {torque.joint: torque for torque in joint_torques(identified)}


def test_joints_stand_worst_first_with_their_sentence_and_the_worst_is_open(section, torque_of):
    folds = re.findall(r'<details id="why-(\d+)"( open)?><summary>(.*?)</summary>', section)
    assert [bool(opened) for _, opened, _ in folds] == [True] + [False] * 5
    said = [unescape(re.sub("<.*?>", "", summary)) for *_, summary in folds]
    joints = [text.partition(":")[0] for text in said]
    shares = [torque_of[j].rms["residual"] / torque_of[j].rms["measured"] for j in joints]
    assert shares == sorted(shares, reverse=True)
    assert sorted(joints) == sorted(torque_of)
    assert said == [f"{joint}: {torque_of[joint].sentence}" for joint in joints]
    names = list(torque_of)
    assert [names[int(row)] for row, *_ in folds] == joints


def test_the_tables_hold_the_root_mean_squares(section, identified):
    kept, found = identified.validation[0], tables(section)
    for j, joint in enumerate(identified.model.joints):
        (table,) = (t for caption, t in found.items() if caption.startswith(f"{joint}:"))
        rows, measured = table.by_name(), kept.metrics["estimate"].per_joint[joint]
        assert rows["residual"]["RMS N m"] == number(measured.rmse, ".3g")
        assert rows["residual"]["% of torque"] == percent(measured.relative_error_pct)
        mask, motion = kept.recording.mask[:, j], kept.recording.trajectory
        assert rows["measured"]["RMS N m"] == number(
            np.sqrt(np.mean(motion.tau[mask, j] ** 2)), ".3g"
        )
        theta = dict(zip(identified.model.layout.names, identified.standard, strict=True))
        inertia = theta[f"{joint}.armature"] * np.sqrt(np.mean(motion.a[mask, j] ** 2))
        if "motor inertia" in rows:
            assert rows["motor inertia"]["RMS N m"] == number(inertia, ".3g")
        viscous = theta[f"{joint}.viscous"] * np.sqrt(np.mean(motion.v[mask, j] ** 2))
        assert f"viscous {viscous:.3g}" in rows["friction"]["terms, RMS"]
