"""The section that says why: its sentences, its tables, and its charts in the browser."""

import re
from dataclasses import replace
from html import unescape
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.browsing import until, visit
from helpers.pages import charts, number, percent, tables

from robotid.diagnosis.residual.torque_split import joint_torques
from robotid.output.pages.html import page
from robotid.output.report.why import _caption, why_section


@pytest.fixture(scope="module")
def section(identified):
    return why_section(identified)


@pytest.fixture(scope="module")
def torques(identified):
    return {torque.joint: torque for torque in joint_torques(identified)}


def test_joints_stand_worst_first_with_their_sentence_and_the_worst_is_open(section, torques):
    folds = re.findall(r'<details id="why-(\d+)"( open)?><summary>(.*?)</summary>', section)
    assert [bool(opened) for _, opened, _ in folds] == [True] + [False] * 5
    said = [unescape(re.sub("<.*?>", "", summary)) for *_, summary in folds]
    joints = [text.partition(":")[0] for text in said]
    shares = [torques[j].rms["residual"] / torques[j].rms["measured"] for j in joints]
    assert shares == sorted(shares, reverse=True)
    assert sorted(joints) == sorted(torques)
    assert said == [f"{joint}: {torques[joint].sentence}" for joint in joints]
    names = list(torques)
    assert [names[int(row)] for row, *_ in folds] == joints


def test_the_tables_hold_the_root_mean_squares(section, identified):
    kept, found = identified.validation[0], tables(section)
    for j, joint in enumerate(identified.model.joints):
        (table,) = (t for caption, t in found.items() if caption.startswith(f"{joint}:"))
        rows, measured = table.by_name(), kept.metrics["estimate"].per_joint[joint]
        assert rows["residual"]["RMS N m"] == number(measured.rmse, ".3g")
        assert rows["residual"]["% of torque"] == percent(measured.relative_error_pct)
        mask, motion = kept.recording.mask[:, j], kept.recording.trajectory
        assert table.foot[1] == number(np.sqrt(np.mean(motion.tau[mask, j] ** 2)), ".3g")
        theta = dict(zip(identified.model.layout.names, identified.standard, strict=True))
        inertia = theta[f"{joint}.armature"] * np.sqrt(np.mean(motion.a[mask, j] ** 2))
        if "motor inertia" in rows:
            assert rows["motor inertia"]["RMS N m"] == number(inertia, ".3g")
        viscous = theta[f"{joint}.viscous"] * np.sqrt(np.mean(motion.v[mask, j] ** 2))
        assert f"viscous {viscous:.3g}" in rows["friction"]["terms, RMS"]


def test_stacked_parts_in_the_page_sum_to_the_prediction(section, identified):
    kept, joints = identified.validation[0], identified.model.joints
    motion, predicted = kept.recording.trajectory, kept.torques["estimate"]
    split = [chart for chart in charts(section) if chart["title"].startswith("Torque of")]
    assert len(split) == len(joints)
    for chart in split:
        j = joints.index(chart["title"].split()[2])
        parts = {s["label"]: np.asarray(s["y"]) for s in chart["series"]}
        known = np.isfinite(parts["measured"])
        rows = np.searchsorted(motion.t, np.asarray(chart["x"])[known] - 1e-4)
        stacked = sum(
            parts[s["label"]][known] for s in chart["series"]
            if s["kind"] == "area" and s["label"] != "residual"
        )  # fmt: skip
        # each part is exact to 1/65,000 of its range
        scale = sum(np.ptp(y[known]) for y in parts.values()) / 60_000
        np.testing.assert_allclose(stacked, predicted[rows, j], atol=scale)
        whole = stacked + parts["residual"][known]
        np.testing.assert_allclose(whole, motion.tau[rows, j], atol=scale)
        assert np.isnan(parts["friction"]).sum() == 1, "the gap of the log breaks the areas"
        assert len(rows) > 200


def test_the_browser_draws_what_sums_to_the_prediction(section, browser, tmp_path):
    target = tmp_path / "why.html"
    target.write_text(page("why", "<h1>why</h1>", {"why": ("Why", section)}), encoding="utf-8")
    largest = """charts.all.filter((c) => c.what.title.startsWith("Torque of")).map(({ what }) => {
      const by = Object.fromEntries(what.series.map((s) => [s.label, s.y]));
      const areas = what.series.filter((s) => s.kind === "area");
      const off = what.x.map((_, i) =>
        areas.reduce((sum, s) => sum + s.y[i], 0) - by.measured[i]).filter(Number.isFinite);
      return Math.max(...off.map(Math.abs)) / Math.max(...by.measured.filter(Number.isFinite));
    })"""
    with visit(browser, target) as seen:
        until(seen, "charts.all.some((c) => c.plot)")
        off = seen.page.evaluate(largest)
        assert len(off) == 6
        assert max(off) < 3e-4
        seen.page.locator("summary").nth(1).press("Enter")  # a folded joint opens by keys
        second = 'document.querySelectorAll("details")[1]'
        seen.page.evaluate(f"{second}.scrollIntoView()")
        until(seen, f'{second}.querySelectorAll("figure canvas").length > 0')
        assert seen.page.evaluate("document.documentElement.scrollWidth") <= 1280
        assert not seen.errors
        assert not seen.requests


def test_the_section_stays_small(section):
    assert len(section) < 6 * 90_000


def test_of_many_joints_the_worst_twelve_have_all_charts_and_the_others_the_split(identified):
    many = SimpleNamespace(
        joint_torques=3 * [*identified.joint_torques], model=identified.model,
        validation=identified.validation, fitted=identified.fitted,
    )  # fmt: skip
    counts = [len(charts(part)) for part in why_section(many).split("<details")[1:]]
    assert counts == 12 * [7] + 6 * [1]


def test_the_residual_against_speed_is_drawn_with_its_mean(section, torques):
    joint = "elbow_joint"
    (chart,) = (
        c for c in charts(section) if c["title"].startswith(f"Residual of {joint} against sp")
    )
    (speed,) = (d for d in torques[joint].follows if d.name == "speed")
    mean = next(s for s in chart["series"] if s["label"] == "mean")
    inside = np.isfinite(mean["y"])
    x = np.asarray(chart["x"])[inside]
    np.testing.assert_allclose(
        np.asarray(mean["y"])[inside], np.interp(x, speed.centres, speed.means),
        atol=np.ptp(speed.means) / 1000,
    )  # fmt: skip
    assert chart["x_label"] == "speed [rad/s]"
    assert x[0] >= speed.centres[0] - 1e-6


def test_charts_over_time_share_the_cursor_of_the_torques(report):
    links = {chart["title"]: chart["link"] for chart in charts(report)}
    split = {link for title, link in links.items() if "the sum of" in title}
    measured = {link for title, link in links.items() if "measured, identified" in title}
    assert split == measured == {"recording 0"}


def test_captions_say_what_a_quantity_explains_and_power_what_is_done(torques):
    torque = replace(torques["elbow_joint"])
    dependence = replace(torque.follows[2], share=0.413, p_value=1e-5)
    for change, said in (
        ({}, "<strong>explains 41.3 % of the variance</strong>"),
        ({"p_value": 0.01}, "explains 41.3 % of the variance, not significant"),
        ({"share": 0.05}, "no dependence"),
        ({"share": None}, "too few samples"),
    ):
        torque.__dict__["follows"] = (replace(dependence, **change),)
        assert _caption(torque, "speed") == f"Residual against speed: {said}"
    power = torque.power[torque.used]
    said = f"Mechanical power: mean {power.mean():.3g} W, peak {np.abs(power).max():.3g} W"
    assert _caption(torque, "power") == said.replace("-", "−")
