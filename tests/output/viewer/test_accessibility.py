"""The report and the page of a comparison in a real browser: axe-core, no noise, no overflow."""

import itertools
import json
from dataclasses import replace

import numpy as np
import pytest
from helpers.browsing import visit
from helpers.paths import ROOT
from helpers.synthetic import exact_log, truth

from robotid.base.files import write_json
from robotid.base.findings import Finding
from robotid.cli.identify import identify
from robotid.output.files.entries import build_result
from robotid.output.report.comparison import write_comparison
from robotid.output.report.report_content import write_report
from robotid.robot.model import RobotModel

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
