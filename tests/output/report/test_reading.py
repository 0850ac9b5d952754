"""The report in a browser: sorting, filtering, taking away, folding, printing, without script."""

import csv
import io
import itertools
import json
import re
import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.browsing import until, visit
from helpers.paths import ROOT, URDF
from helpers.synthetic import exact_log, truth

from robotid.base.files import write_json
from robotid.base.findings import Finding
from robotid.cli import main
from robotid.cli.identify import identify
from robotid.data.files.read import write_log
from robotid.output.files.entries import build_result
from robotid.output.report.comparison import write_comparison
from robotid.output.report.next_steps import Origin
from robotid.output.report.report_content import write_report
from robotid.robot.model import RobotModel

PARAMETERS = "Parameters of links and drives"


@pytest.fixture(scope="module")
def path(identified, tmp_path_factory):
    target = tmp_path_factory.mktemp("reading") / "report.html"
    return write_report(identified, target, origin=Origin(("arm.toml",), "out"))


@pytest.fixture(scope="module")
def opened(browser, path):
    with visit(browser, path, accept_downloads=True) as seen:
        seen.page.context.grant_permissions(["clipboard-read", "clipboard-write"])
        seen.page.evaluate(
            "window.first = [...document.querySelectorAll('details')].map((fold) => fold.open)"
        )
        yield seen


@pytest.fixture
def seen(opened):
    """The page as it opens, but for the order of rows."""
    opened.page.evaluate(
        """() => {
          document.querySelectorAll('details').forEach((fold, k) => { fold.open = first[k]; });
          document.querySelectorAll('input[type=search]').forEach((box) => {
            box.value = ''; box.dispatchEvent(new Event('input', { bubbles: true })); });
          location.hash = '';
          scrollTo(0, 0);
        }"""
    )
    yield opened
    assert opened.errors == []
    assert opened.requests == []


def table_of(seen, caption=PARAMETERS):
    """Open what holds a table, and return it and its tools."""
    seen.page.evaluate("location.hash = 'parameters'")
    table = seen.page.locator("table.data", has_text=caption).first
    return table, seen.page.locator(f".tools:has(+ .scroll[aria-label='{caption}'])")


def column(table, number):
    return table.locator("tbody tr:visible").locator(f":nth-child({number})").all_inner_texts()


def test_csv_holds_every_number_in_full_with_ascii_minus_signs(seen, identified):
    _table, tools = table_of(seen)
    with seen.page.expect_download() as caught:
        tools.get_by_role("button", name="Save CSV").click()
    text = Path(caught.value.path()).read_bytes().decode("utf-8")
    assert caught.value.suggested_filename == "Parameters_of_links_and_drives.csv"
    assert "\u2212" not in text
    head, *rows = csv.reader(io.StringIO(text))
    assert head == [
        "link or drive", "parameter", "URDF", "identified", "± error", "low", "high", "change",
        "determined by", "unit",
    ]  # fmt: skip
    assert [".".join(row[:2]) for row in rows] == list(identified.model.layout.names)
    for row, prior, value, error in zip(
        rows, identified.prior, identified.standard, identified.standard_error, strict=True
    ):
        assert [float(x) for x in row[2:4]] == pytest.approx([prior, value], rel=1e-9)
        assert float(row[7]) == pytest.approx(value - prior, rel=1e-9)
        assert float(row[4] or "inf") == pytest.approx(error, rel=1e-9)
    assert any(row[3].startswith("-") for row in rows)


def test_a_column_is_sorted_by_its_numbers_by_mouse_and_by_keys(seen, identified):
    table, _ = table_of(seen)
    head = table.locator("thead th").nth(3)
    head.get_by_role("button").click()
    assert head.get_attribute("aria-sort") == "ascending"
    values = table.locator("tbody td:nth-child(4)").evaluate_all(
        "cells => cells.map(cell => Number(cell.dataset.value))"
    )
    assert values == pytest.approx(sorted(identified.standard), rel=1e-9)
    head.get_by_role("button").focus()
    seen.page.keyboard.press("Enter")
    assert head.get_attribute("aria-sort") == "descending"
    first = table.locator("tbody td:nth-child(4)").first.get_attribute("data-value")
    assert float(first) == pytest.approx(max(identified.standard), rel=1e-9)
    error = table.locator("thead th").nth(4)
    for _ in range(2):  # what has no number stays last
        error.get_by_role("button").click()
        assert column(table, 5)[-1] == "–"
    assert table.locator("thead th[aria-sort='none']").count() == 9


def test_a_link_opens_what_it_leads_to(seen):
    page = seen.page
    assert not page.locator("#errors-fold").evaluate("fold => fold.open")
    page.locator("nav a", has_text="Errors").focus()
    page.keyboard.press("Enter")
    until(seen, "document.querySelector('#errors-fold').open")
    page.locator(".bars a").last.click()
    key = page.locator(".bars a").last.get_attribute("href")
    until(seen, f"document.querySelector('{key}').open")
    top = page.locator(key).bounding_box()["y"]
    assert 30 < top < 400  # below the contents, which stay
    assert page.locator("nav").bounding_box()["y"] == 0


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
        folder_width = "document.querySelector('#replay pre i').offsetWidth"
        assert seen.page.evaluate(folder_width) < 30  # "…/" stands for the folders of the URDF
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


AXE = {"runOnly": {"type": "tag", "values": ["wcag2a", "wcag2aa"]}}


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    arm = RobotModel.from_urdf(ROOT / "urdf" / "planar_2r.urdf")  # few joints: axe is not fast
    rng, folder = np.random.default_rng(0), tmp_path_factory.mktemp("pages")
    logs = [exact_log(arm, truth(arm), rng, samples=800, noise=0.1) for _ in range(2)]
    findings = [Finding(s, s, "elbow", f"an example of an {s}") for s in ("note", "error")]
    results = []
    for name in ("consistent", "wls"):
        found = identify(arm, logs[:1], validation=logs[1:], estimator=name)
        found = replace(found, findings=findings)
        results.append(folder / f"{name}.json")
        settings = {"estimator": {"name": name}}
        write_json(build_result(found, settings), results[-1])
    report = write_report(found, folder / "report.html")
    write_comparison(results, folder / "compare.html")
    return {"report": report, "compare": folder / "compare.html"}


# each width and each scheme of each page, though not all four of both: axe takes a second and more
VIEWS = {"report": ((1280, "light"), (360, "dark")), "compare": ((1280, "dark"), (360, "light"))}


@pytest.mark.parametrize("name", VIEWS)
def test_a_page_has_no_fault_that_axe_or_the_console_knows(browser, pages, name):
    from axe_playwright_python.sync_playwright import Axe

    # axe is put in from outside, which the page's own policy forbids
    with visit(browser, pages[name], bypass_csp=True) as seen:
        for width, scheme in VIEWS[name]:
            seen.page.emulate_media(color_scheme=scheme)
            seen.page.set_viewport_size({"width": width, "height": 800})
            found = Axe().run(seen.page, options=AXE).response
            faults = {v["id"]: [n["html"][:200] for n in v["nodes"]] for v in found["violations"]}
            assert faults == {}, json.dumps(faults, indent=1)
            assert len(found["passes"]) > 10
            # charts follow the width after the layout; a page that stays too wide ends in a timeout
            seen.page.wait_for_function("document.documentElement.scrollWidth <= innerWidth")
        assert seen.errors == []
        assert seen.requests == []


def test_headings_are_in_order_and_the_first_tab_skips_to_the_content(browser, pages):
    for path in pages.values():
        with visit(browser, path) as seen:
            levels = seen.page.evaluate(
                "[...document.querySelectorAll('h1,h2,h3,h4')].map(h => Number(h.tagName[1]))"
            )
            assert levels[0] == 1
            assert levels.count(1) == 1
            assert all(b - a <= 1 for a, b in itertools.pairwise(levels))
            seen.page.keyboard.press("Tab")
            focused = "document.activeElement.getBoundingClientRect().left"
            assert seen.page.evaluate("document.activeElement.className") == "skip"
            assert seen.page.evaluate(focused) >= 0
            seen.page.keyboard.press("Enter")
            assert seen.page.evaluate("document.activeElement.id") == "content"
            assert seen.errors == []
