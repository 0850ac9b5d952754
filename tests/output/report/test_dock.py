"""The replay in a report, from files: one clock, and what is said while there is no replay."""

import json
import re
import shlex
from html import unescape

import numpy as np
import pytest
from helpers.browsing import until, visit
from helpers.paths import URDF
from helpers.synthetic import exact_log, truth

from robotid.cli import main
from robotid.data.files.read import write_log
from robotid.output.report.dock import Clip, Dock
from robotid.output.report.steps import Origin
from robotid.robot.model import RobotModel

CURSOR = "charts.link('recording 0').shown"
STATE = "document.querySelector('#dock [role=status]').innerText"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A result of a planar arm with its report, without replay."""
    folder = tmp_path_factory.mktemp("dock")
    model, rng = RobotModel.from_urdf(URDF / "planar_2r.urdf"), np.random.default_rng(0)
    for name in ("first.csv", "second.csv"):
        log = exact_log(model, truth(model), rng, samples=400, rate=50.0, noise=0.2)
        write_log(log, folder / name)
    words = [str(URDF / "planar_2r.urdf"), str(folder / "first.csv")]
    words += ["--validate", str(folder / "second.csv"), "--friction", "none"]
    assert main(["identify", *words, "--out", str(folder / "result")]) == 0
    return folder


def frame(seen):
    """Return the page in the dock."""
    return next(f for f in seen.page.frames if "replay.html" in f.url)


def wait(seen, expression):
    """Wait until the page in the dock says yes."""
    for _ in range(400):
        if frame(seen).evaluate(expression):
            return
        seen.page.wait_for_timeout(50)
    raise AssertionError(f"{expression} is not true")


def test_a_missing_replay_is_written_by_the_command_of_the_report(browser, folder):
    with visit(browser, folder / "result" / "report.html", reduced_motion="reduce") as seen:
        (worst,) = seen.page.locator("details[open] a[data-at]").all()[:1]
        assert worst.get_attribute("href") == "#replay"
        worst.click()
        until(seen, f"{STATE}.includes('missing')")
        command = seen.page.locator("#dock pre").inner_text()
        assert command == seen.page.locator("#replay pre").inner_text()
        program, *words = shlex.split(command)
        assert program == "robotid"
        assert main(words) == 0
        seen.page.get_by_role("button", name="Reload").click()
        until(
            seen,
            f"{STATE} === 'Replay of second.csv'",
        )
        at = float(re.search(r"t=([\d.]+)", worst.get_attribute("data-at"))[1])
        until(seen, f"Math.abs({CURSOR} - {at}) < 1e-9")
        assert frame(seen).evaluate("replay.clock.time") == pytest.approx(at)
        assert frame(seen).evaluate("replay.picked") in ("joint_1", "joint_2")
        assert not frame(seen).locator("header").is_visible()
        seen.page.get_by_role("button", name="Close").click()
        assert seen.page.locator("#dock").count() == 0
        assert seen.page.evaluate(f"Number.isNaN({CURSOR})")
        assert [e for e in seen.errors if "ERR_FILE_NOT_FOUND" not in e] == []


@pytest.fixture(scope="module")
def docked(browser, folder):
    """The report with its replay."""
    words = [str(URDF / "planar_2r.urdf"), str(folder / "second.csv"), str(folder / "result")]
    assert main(["replay", *words]) == 0
    with visit(browser, folder / "result" / "report.html", reduced_motion="reduce") as seen:
        seen.page.get_by_role("button", name="Show the replay").click()
        until(
            seen,
            f"{STATE} === 'Replay of second.csv'",
        )
        yield seen
        assert seen.errors == []


def test_the_cursor_of_the_charts_moves_with_the_replay(docked):
    frame(docked).evaluate("replay.seek(2.5)")
    until(docked, f"{CURSOR} === 2.5")
    frame(docked).evaluate("replay.play()")
    until(docked, f"{CURSOR} > 2.6")
    frame(docked).evaluate("replay.pause()")
    time = frame(docked).evaluate("replay.clock.time")
    until(docked, f"{CURSOR} === {time}")
    # a cursor of the recording that the replay does not show would be wrong
    assert docked.page.evaluate("charts.link('recording 1').listeners.size") == 0


def test_a_click_in_a_chart_sets_the_time_and_a_pointer_that_passes_restores_it(docked):
    chart = docked.page.locator("details[open] .u-over").first
    chart.evaluate("(e) => { e.scrollIntoView(); scrollBy(0, -60); }")  # above the dock
    box = chart.bounding_box()
    frame(docked).evaluate("replay.seek(1)")
    until(docked, f"{CURSOR} === 1")
    x, y = box["x"] + 0.6 * box["width"], box["y"] + 0.2 * box["height"]
    docked.page.mouse.move(x, y)
    until(docked, f"{CURSOR} > 3")
    wait(docked, f"replay.clock.time === {docked.page.evaluate(CURSOR)}")
    docked.page.mouse.move(box["x"] - 30, y)
    wait(docked, "replay.clock.time === 1")
    docked.page.mouse.click(x, y)
    wait(docked, "replay.clock.time > 3")
    docked.page.mouse.move(box["x"] - 30, y)
    docked.page.wait_for_timeout(100)
    assert frame(docked).evaluate("replay.clock.time") == docked.page.evaluate(CURSOR) > 3


def test_a_pointer_that_passes_does_not_stop_the_motion(docked):
    chart = docked.page.locator("details[open] .u-over").first
    box = chart.bounding_box()
    frame(docked).evaluate("replay.seek(0.5); replay.play()")
    docked.page.mouse.move(box["x"] + 0.8 * box["width"], box["y"] + 0.2 * box["height"])
    docked.page.wait_for_timeout(200)
    assert frame(docked).evaluate("replay.clock.playing")
    assert frame(docked).evaluate("replay.clock.time") < 3.0
    docked.page.mouse.move(box["x"] - 30, box["y"])
    frame(docked).evaluate("replay.pause()")


def test_a_replay_of_another_log_has_no_clock_and_the_command_for_this_one(browser, folder):
    page, other = folder / "result" / "replay.html", str(folder / "first.csv")
    words = [str(URDF / "planar_2r.urdf"), other, str(folder / "result")]
    assert main(["replay", *words]) == 0
    with visit(browser, folder / "result" / "report.html", reduced_motion="reduce") as seen:
        seen.page.locator("details[open] a[data-at]").first.click()
        until(seen, f"{STATE}.includes('first.csv')")
        assert "second.csv" in seen.page.locator("#dock [role=status]").inner_text()
        assert f"{folder / 'second.csv'}" in seen.page.locator("#dock pre").inner_text()
        frame(seen).evaluate("replay.seek(2)")
        seen.page.wait_for_timeout(200)
        assert seen.page.evaluate(f"Number.isNaN({CURSOR})")
    page.unlink()


def test_without_folder_or_file_there_is_no_dock():
    clip = Clip("recording 0", "a b.csv", 0.0, 1.0)
    in_memory = clip._replace(log="")
    origin = Origin((), "out", "replay.html")
    for dock in (
        Dock(),
        Dock("", Origin(), "arm.urdf", [clip]),
        Dock("", origin, "arm.urdf", [in_memory]),
    ):
        assert (dock.html, dock.link("Show", 1.0, "j", "a")) == ("", "")
    html = Dock("", origin, "arm.urdf", [in_memory, clip]).html
    assert "<span>arm.urdf</span> <span>&#x27;a b.csv&#x27;</span> <span>out</span></pre>" in html
    clips = json.loads(unescape(re.search(r'data-clips="([^"]*)"', html)[1]))
    assert [c["log"] for c in clips] == ["", "a b.csv"]
    assert "<pre" not in Dock("replay.html", Origin(), "arm.urdf", [in_memory]).html


def test_recordings_have_their_times_and_links_theirs():
    clips = [Clip("recording 0", "day/a b.csv", 1.5, 9.25), Clip("recording 1", "c.csv", 3.0, 4.0)]
    dock = Dock("replay.html", Origin((), "out"), "arm.urdf", clips)
    found = json.loads(unescape(re.search(r'data-clips="([^"]*)"', dock.html)[1]))
    shown = [tuple(clip[key] for key in ("link", "log", "start", "end")) for clip in found]
    assert shown == [("recording 0", "a b.csv", 1.5, 9.25), ("recording 1", "c.csv", 3.0, 4.0)]
    link = unescape(dock.link("Show", 2.34567, "joint 1", "a b.csv"))
    assert 'href="replay.html#t=2.346&joint=joint%201&log=a%20b.csv" target="replay"' in link
