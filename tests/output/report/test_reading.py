"""The report in a browser: sorting, filtering, taking away, folding, printing, without script."""

import csv
import io
from pathlib import Path

import pytest
from helpers.browsing import until, visit

from robotid.output.report.next_steps import Origin
from robotid.output.report.report_content import write_report

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
