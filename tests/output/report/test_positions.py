"""The page of drives found from commands: its figures are those of the result and the logs."""

import re
from dataclasses import replace

import numpy as np
import pytest
from helpers.commanded_results import by_position, written_result
from helpers.mujoco_plant import LEG, plant
from helpers.pages import bars, chart, charts, tables
from robotid.output.report.report_page import page_of

from robotid.base.exceptions import DataError
from robotid.data.log import Log
from robotid.identification.closed_loop.position_errors import OpenLoop
from robotid.output.files.result_file import load_result
from robotid.output.report.errors import worst_errors
from robotid.output.report.position_page import (
    _charts,
    _controller,
    _fixed,
    _horizons,
    _undetermined,
    shown_positions,
)
from robotid.output.report.steps import Origin

ERRORS = {"rmse": (2e-3, 4e-3, 8e-3), "command_rmse": (0.02, 0.05, 0.08), "urdf_rmse": (0.01,) * 3}
REASON = "the calf is <i>off</i>"


def entry(log, scale):
    per_joint = {
        joint: {"unit": "rad", **{key: scale * xs[j] for key, xs in ERRORS.items()}}
        for j, joint in enumerate(LEG)
    }
    short = {"0.1": dict.fromkeys(LEG, 1e-3 * scale), "0.5": dict.fromkeys(LEG, 2e-3 * scale)}
    window = {"log": f"logs/{log}", "start": 1.0, "end": 5.0}
    return {**window, "per_joint": per_joint, "horizons": short}


@pytest.fixture(scope="module")
def followed():
    t, rng = np.linspace(1.0, 5.0, 400), np.random.default_rng(0)
    q = np.cumsum(rng.standard_normal((400, 3)), axis=0) * 0.01
    log = Log(t, q, 0.0 * q, LEG, path="kept.csv", q_ref=q + 0.03, has_torque=False)
    none = np.zeros(3)
    return OpenLoop(log, q - 0.002 * np.arange(1, 4), none, {"command": none}, {}, none)


@pytest.fixture(scope="module")
def content(tmp_path_factory):
    leg = plant("leg", np.random.default_rng(0), coulomb=0.25)
    simulation = {
        "controller": {"kind": "pd", "effort_limit": {LEG[0]: 23.0}},
        "validation": [entry("kept.csv", 1.0)],
        "identification": [entry("fitted.csv", 0.5)],
    }
    folder = written_result(
        leg,
        tmp_path_factory.mktemp("page") / "leg",
        position={LEG[2]: by_position(0.05, 0.3, -2.5, -1.0)},
        simulation=simulation,
        structure={"base": 0, "undetermined": ["FL_calf.Ixx"]},
        verdict={
            "status": "usable",
            "reasons": [REASON],
            "per_joint": {LEG[2]: {"status": "usable", "reasons": [f"{LEG[2]}: it is soft"]}},
        },
        warnings=[
            {
                "code": "saturation",
                "severity": "warning",
                "where": LEG[2],
                "message": f"{LEG[2]} saturates",
            }
        ],
    )
    per_joint = {
        joint: {
            "relative_error_pct": 2.0 * (j + 1), "rmse": ERRORS["rmse"][j], "unit": "rad",
            "command_relative_error_pct": 40.0, "urdf_relative_error_pct": 10.0, "r2": 0.99,
            "rows": 400, "better_than_constant": True,
        }
        for j, joint in enumerate(LEG)
    }  # fmt: skip
    kept = {"log": "logs/kept.csv", "per_joint": per_joint}
    fitted = {
        joint: {**own, "rmse": 0.5 * own["rmse"], "rows": 800} for joint, own in per_joint.items()
    }
    whole = {"per_joint": fitted}
    return {**load_result(folder).content, "validation": [kept], "identification": whole}


def page_with(content, fitted, kept, robot=None):
    shown = shown_positions(content, fitted, kept, Origin((), "out"), robot)
    return page_of(shown, {"URDF": "a.urdf"})


@pytest.fixture(scope="module")
def page(content, followed):
    return page_with(content, [], [followed])


def test_the_urdf_with_the_stated_gains_is_named_only_where_there_is_one(content, followed, page):
    assert "of the URDF with the stated gains, without friction and delay, and of a" in page
    bare = {
        **content,
        **{
            key: [
                {
                    "log": run.get("log", ""),
                    "per_joint": {
                        joint: {**own, "urdf_relative_error_pct": None}
                        for joint, own in run["per_joint"].items()
                    },
                }
                for run in runs
            ]
            for key, runs in (
                ("validation", content["validation"]),
                ("identification", [content["identification"]]),
            )
        },
    }
    bare["identification"] = bare["identification"][0]
    other = page_with(bare, [], [followed])
    assert "the error of the command as position, and of a second-order model" in other
    assert "stated gains" not in other


def test_errors_are_those_of_the_result(page):
    kept = tables(page)["kept.csv: not fitted"]
    head = ["joint", "error %", "verdict", "RMSE", "unit", "R²", "samples", "URDF %", "command %"]
    assert kept.headers == head
    assert kept.rows[1] == [LEG[1], "4.0", "–", "4", "mrad", "0.990", "400", "10.0", "40.0"]
    assert kept.column("verdict") == ["–", "–", "usable: it is soft"]
    fitted = tables(page)["fitted.csv 1-5 s: fitted"]
    assert fitted.column("RMSE") == ["1", "2", "4"]
    assert "<strong>4 mrad</strong>, geometric mean of 3 joints" in page
    assert "URDF 2.5 ×, command 11 ×" in page  # (20 50 80)^(1/3) / 4
    assert REASON not in page
    assert "&lt;i&gt;off" in page


def test_errors_over_horizons_are_those_of_the_result_in_mrad(page):
    kept = tables(page)["kept.csv 1-5 s, not fitted: error over the horizon, mrad"]
    assert kept.headers == ["joint", "0.1 s", "0.5 s", "4 s"]
    assert kept.rows[1] == [LEG[1], "1.00", "2.00", "4.00"]
    assert kept.foot == ["geometric mean", "1.00", "2.00", "4.00"]  # of 2, 4 and 8


def test_charts_show_commanded_measured_and_simulated(page, followed):
    found = bars(page)
    assert list(found) == [*LEG[::-1]]
    for width, (joint, (end, marks)) in zip((6.0, 4.0, 2.0), found.items(), strict=True):
        assert 1.5 * end**2 / 100 == pytest.approx(width, rel=2e-3), joint
        assert [1.5 * x**2 / 100 for x in marks] == pytest.approx([10.0, 40.0], rel=2e-3)
    assert '<strong>usable</strong><span class="why">it is soft</span>' in page
    assert ">5 good<" in page
    assert ">30 usable<" in page
    horizon = chart(page, "position error over the horizon")
    np.testing.assert_allclose(horizon["x"], [0.1, 0.5, 4.0], rtol=1e-6)
    mean = horizon["series"][-1]
    assert mean["label"] == "geometric mean"
    np.testing.assert_allclose(mean["y"], [1.0, 2.0, 4.0], rtol=1e-4)
    shown = [c for c in charts(page) if c["title"].startswith("position of")]
    assert [c["title"] for c in shown] == [f"position of {joint}" for joint in LEG]
    lines = {series["label"]: series["y"] for series in shown[2]["series"]}
    for label, values in (
        ("commanded", followed.log.q_ref), ("measured", followed.log.q),
        ("simulated", followed.q),
    ):  # fmt: skip
        np.testing.assert_allclose(lines[label], values[:, 2], atol=1e-4)
    error = chart(page, f"position error of {LEG[2]}")
    left = {series["label"]: series["y"] for series in error["series"]}
    np.testing.assert_allclose(left["measured − simulated"], 6.0, atol=1e-3)  # [mrad]
    np.testing.assert_allclose(left["measured − commanded"], -30.0, atol=1e-3)
    assert "kept.csv 1-5 s, not fitted: RMSE 6 mrad" in page


def test_of_two_logs_each_joint_shows_its_worse_error_and_each_log_its_own(content, followed):
    first = content["validation"][0]
    better = {
        joint: {**own, "relative_error_pct": own["relative_error_pct"] * (0.5, 0.5, 3.0)[j]}
        for j, (joint, own) in enumerate(first["per_joint"].items())
    }
    del better[LEG[1]]
    for both in ([first, {"per_joint": better}], [{"per_joint": better}, first]):
        runs = [{"log": f"logs/{k}.csv", **run} for k, run in enumerate(both)]
        shown = shown_positions({**content, "validation": runs}, [], [], Origin((), "out"))
        found = worst_errors(shown.counted)
        assert list(found) == [LEG[2], LEG[1], LEG[0]]
        errors = [own["relative_error_pct"] for own in found.values()]
        assert errors == pytest.approx([18.0, 4.0, 2.0])
        assert [own["command_relative_error_pct"] for own in found.values()] == [40.0] * 3
    # a log whose error is not the same all the time
    q = followed.q + 0.004 * np.sin(np.arange(400.0))[:, None] * [1.0, 2.0, 3.0]
    q[:50] = np.nan
    run = replace(followed, q=q)
    html = _charts(run, "fitted", 1, LEG[1], "rad", link="log 0", points=500)
    rmse = 1e3 * np.sqrt(np.mean((run.log.q - q)[50:, 1] ** 2))
    assert f"kept.csv 1-5 s, fitted: RMSE {rmse:.3g} mrad" in html


def test_what_is_fixed_of_every_joint_is_named_once():
    stated = [("a.kp", 1.0), ("b.kp", 2.0), ("c.kp", 3.0), ("a.kd", 0.1), ("c.kd", 0.2),
              ("b.zero", 0.0), ("c.delay", 0.01)]  # fmt: skip
    entries = [
        {"name": name, "value": x, "std_error": 1e-3 if name == "c.delay" else None}
        for name, x in stated
    ]
    content = {"joints": ["a", "b", "c"], "drive_parameters": entries}
    assert _fixed(content) == "kp of all joints, kd of a, c, masses of the URDF"


def test_the_mean_over_the_horizon_is_of_all_joints_and_the_lines_of_the_worst(content):
    names = [f"j{k}" for k in range(9)]
    size = dict(zip(names, np.arange(9.0, 0.0, -1.0), strict=True))  # [mrad]
    rows = {
        "per_joint": {name: {"rmse": 2e-3 * x, "unit": "rad"} for name, x in size.items()},
        "horizons": {"0.5": {name: 1e-3 * x for name, x in size.items()}},
        "log": "logs/kept.csv",
        "start": 3.0,
        "end": 10.0,
    }
    simulation = {**content["simulation"], "validation": [rows]}
    html = _horizons({**content, "simulation": simulation})
    found = chart(html, "position error over the horizon")
    np.testing.assert_allclose(found["x"], [0.5, 7.0], rtol=1e-6)
    *lines, mean = found["series"]
    assert [line["label"] for line in lines] == names[:7]
    for line, x in zip(lines, size.values(), strict=False):
        np.testing.assert_allclose(line["y"], [x, 2 * x], rtol=1e-3)
    both = np.exp(np.mean(np.log([*size.values()])))
    np.testing.assert_allclose(mean["y"], [both, 2 * both], rtol=1e-3)
    said = "the worst 7 joints, whole recording at the end: kept.csv 3-10 s, not fitted"
    assert f"Error over horizon, {said}" in html


def test_drives_have_their_errors_and_what_cannot_be_told_is_named(page, content):
    drives = tables(page)["Drives, by joint"]
    assert drives.headers == ["term", *LEG]  # with more than 7 terms, a row for each
    terms = drives.column("term")
    assert terms[:3] == ["kp [N m/rad]", "kd [N m s/rad]", "delay [ms]"]
    assert terms[-1] == "coulomb_q2 [N m]"
    rows = drives.by_name()
    assert rows["coulomb [N m]"][LEG[0]] == "0.250 ± 0.025"
    assert rows["coulomb_q1 [N m]"][LEG[0]] == "–"
    assert "±" not in rows["kp [N m/rad]"][LEG[0]]
    late = next(e for e in content["drive_parameters"] if e["name"] == f"{LEG[0]}.delay")
    value, _, error = rows["delay [ms]"][LEG[0]].split()
    assert float(value) == pytest.approx(1e3 * late["value"], rel=0.01)
    assert float(error) == pytest.approx(1e3 * late["std_error"], rel=0.05)
    has_error = [e["std_error"] is not None for e in content["drive_parameters"]]
    assert 0 < has_error.count(True) != has_error.count(False) > 0
    count, every = has_error.count(True), len(has_error)
    assert f"{every} parameters, determined by" in page
    assert f"{count} data, {every - count} stated</dd>" in page
    assert f"{count} of {every} determined by the data, fully or partly" in page
    rows = tables(page)["Parameters of links and drives"].rows
    own = {f"{row[0]}.{row[1]}": row for row in rows}
    assert own[f"{LEG[1]}.kp"][8] == "stated"
    assert own[f"{LEG[1]}.coulomb"][8] == "data"
    said = page[page.index("The logs do not determine:") :]
    assert "FL_calf.Ixx" in said
    assert "kp of all joints, kd of all joints, masses of the URDF" in said
    files = tables(page)["Files read"]
    assert files.column("role") == ["URDF", "fitted"]
    assert files.column("SHA-256") == ["not read from a file"] * 2
    assert tables(page)["Versions that ran"].rows[0] == ["robotid", "0"]


def test_proportional_commands_leave_no_claim_that_all_is_determined():
    alike = {
        "code": "proportional_commands",
        "severity": "warning",
        "where": "log: all",
        "message": "x",
    }
    content = {"structure": {"undetermined": []}, "warnings": []}
    content["simulation"] = {"controller": {"kind": "torque"}}
    claim = "The logs determine all free parameters"
    assert claim in _undetermined(content)
    text = _undetermined({**content, "warnings": [alike]})
    assert claim not in text
    assert "some commands are proportional (proportional_commands: log: all)" in text


def test_findings_and_commands_are_shown(page):
    assert f"<p>{LEG[2]} saturates</p>" in page
    assert 'class="cause warning"' in page
    plain = page.replace("<span>", "").replace("</span>", "")
    commands = re.findall(r'<pre class="command">(.*?)</pre>', plain)
    assert "robotid export out/result.json --format isaac" in commands[2]
    assert [words.split()[1] for words in commands] == ["replay", "export", "export", "export"]


def test_logs_that_do_not_fit_are_refused(content, followed):
    other = replace(followed, q=followed.q[:, :2])
    with pytest.raises(DataError, match=r"kept.csv has 2 joints, the result 3"):
        page_with(content, [other], [])
    assert "The logs are not available" in page_with(content, [], [])
    assert "kept.csv 1-5 s, fitted: RMSE 6 mrad" in page_with(content, [followed], [])
    driven = replace(followed, baselines={"steady": np.zeros(3)})
    shown = chart(page_with(content, [], [driven]), f"position of {LEG[0]}")
    labels = [line["label"] for line in shown["series"]]
    assert labels == ["measured", "simulated"], "the torque drives it, no command"


def test_the_lines_of_the_urdf_that_change_are_shown(content, followed):
    model = plant("leg", np.random.default_rng(0)).model
    pi = model.standard_parameters()
    pi[0] *= 2.0
    page = page_with(content, [], [followed], (model, pi))
    assert (
        f"<ins>+      &lt;mass value=&quot;{pi[0]}" in page or f"mass value=&quot;{pi[0]}" in page
    )
    assert "all other bytes are unchanged" in page
    assert "no longer at its path" in page_with(content, [], [followed])


def test_the_worst_joint_of_the_verdict_is_open(content, followed):
    model = plant("leg", np.random.default_rng(0)).model
    rest = replace(followed.log, q_ref=followed.log.q_ref * [1, 1, 0])  # its noise is no motion
    rmse, spread = np.array([1e-3, 5e-3, 2e-3]), np.full(3, 0.1)
    moved = replace(followed, rmse=rmse, spread=spread)
    still = replace(moved, log=rest, rmse=rmse, spread=np.array([0.1, 0.1, 1e-4]))
    page = page_with(content, [], [moved, still], (model, model.standard_parameters()))
    opened = re.findall(r'<details[^>]*id="joint-(\d)"[^>]* open', page)
    assert opened == ["1"]
    assert next(iter(bars(page))) == LEG[1]
    known = (model, model.standard_parameters())
    for logs, wanted in (
        (([moved], [still]), "not fitted"),
        (([moved, still], []), "fitted samples, without validation log"),
    ):
        assert f"|motion|, {wanted}" in page_with(content, *logs, known)
    assert '<a href="#cause-saturation">saturation</a>' in page.split('id="worst"')[0]


def test_logs_have_their_role_and_the_worst_second_is_of_those_not_fitted(content, followed):
    fitted = replace(followed, log=replace(followed.log, path="fitted.csv"), q=followed.q + 0.2)
    for validation, wanted in (([followed], "kept.csv"), ([], "fitted.csv")):
        shown = shown_positions(content, [fitted], validation, Origin((), "out"))
        assert shown.title.endswith(": drives from commands")
        _, html = shown.curves
        roles = set(re.findall(r"(\w+\.csv) 1-5 s, ([a-z ]+): RMSE", html))
        own = {("kept.csv", "not fitted")} if validation else set()
        assert roles == {*own, ("fitted.csv", "fitted")}
        assert re.findall(r"Largest residual within 1 s: (\S+)", html) == 3 * [wanted]


def test_the_controller_has_its_settings_in_words():
    stated = {"kind": "pd", "effort_limit": {"a": 23.0, "b": 7.12345}, "rate": None}
    html = _controller({"simulation": {"controller": stated}})
    assert tables(html)["Controller"].rows == [
        ["kind", "pd"], ["effort_limit", "a 23, b 7.123"], ["rate", "none"]
    ]  # fmt: skip
