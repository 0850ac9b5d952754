"""The replay in a report, from files: one clock, and what is said while there is no replay."""

import re
import shlex

import numpy as np
import pytest
from helpers.browsing import until, visit
from helpers.paths import URDF
from helpers.synthetic import exact_log, truth

from robotid.cli import main
from robotid.data.files.read import write_log
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
        until(seen, f"{STATE} === 'Replay of second.csv'")
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
        until(seen, f"{STATE} === 'Replay of second.csv'")
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
