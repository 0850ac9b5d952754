import re

import numpy as np
import pytest
from helpers.browsing import until, visit
from helpers.pages import charts

from robotid.output.pages.html import (
    Chart,
    Section,
    Series,
    asset,
    broken,
    chart_html,
    code,
    command_html,
    number,
    page,
    percent,
    text,
    thin,
    verdict_html,
    with_error,
)

T = 1000.0 + np.arange(5000) / 500  # [s], the log's own time


@pytest.fixture(scope="module")
def lines():
    rng = np.random.default_rng(0)
    tau = 40 * np.sin(3 * T) + rng.normal(size=len(T))
    predicted = 40 * np.sin(3 * T)
    predicted[2000:2500] = np.nan
    return tau, predicted


@pytest.fixture(scope="module")
def torque(lines):
    tau, predicted = lines
    series = (
        Series("measured", tau, "text", is_weak=True),
        Series("identified", predicted, "predicted", half=np.full(len(T), 4.0)),
    )
    spans = ((float(T[2000]), float(T[2500])),)
    return Chart("Torque of elbow", T, series, "time [s]", "torque [N m]", "time", spans)


@pytest.fixture(scope="module")
def demo(torque, lines, tmp_path_factory):
    residual = Series("residual", lines[0] - lines[1], "residual")
    below = Chart("Residual", T, (residual,), "time [s]", "residual [N m]", "time", height=90)
    parts = (np.sin(T[::10]), -np.cos(2 * T[::10]), np.sin(3 * T[::10]))
    areas = tuple(Series(f"part {k}", y, f"tone-{k}", "area") for k, y in enumerate(parts, 1))
    split = Chart("Split", T[::10], areas, "time [s]", "torque [N m]")
    f = np.linspace(0.5, 50.0, 100)
    spectrum = Chart(
        "Spectrum", f, (Series("S", f**-2.0, "text"),), "f [Hz]", "S", logarithmic="xy"
    )
    first, *others = (chart_html(c, c.title) for c in (torque, below, split, spectrum))
    folded = f"<details><summary>more</summary>{''.join(others[1:])}</details>"
    html = page("charts", "<h1>charts</h1>", {"a": ("Torque", first + others[0] + folded)})
    target = tmp_path_factory.mktemp("charts") / "charts.html"
    target.write_text(html, encoding="utf-8")
    return target


def test_what_the_page_holds_is_the_data_to_a_65000th_of_their_range(torque, lines):
    (found,) = charts(chart_html(torque, ""))
    rows = np.searchsorted(T, found["x"] - 1e-4)
    np.testing.assert_allclose(found["x"], T[rows], atol=1e-6)
    for series, y in zip(found["series"], lines, strict=True):
        np.testing.assert_allclose(series["y"], y[rows], atol=np.nanmax(np.abs(y)) / 30_000)
        kept = series["y"][np.isfinite(series["y"])]
        wanted = [np.nanmin(y), np.nanmax(y)]
        np.testing.assert_allclose([kept.min(), kept.max()], wanted, rtol=1e-4)
    assert 1500 < len(rows) < 3000
    np.testing.assert_allclose(found["series"][1]["half"], 4.0)
    assert len(chart_html(torque, "")) < 45_000


@pytest.fixture(scope="module")
def opened(browser, demo):
    with visit(browser, demo) as seen:
        yield seen


@pytest.fixture
def seen(opened):
    """The page with its first charts drawn, all of each shown, the cursor beside them."""
    until(opened, "charts.all[1].plot !== null")
    opened.page.mouse.move(5, 5)
    opened.page.evaluate("scrollTo(0, 0)")
    yield opened
    assert opened.errors == []
    assert opened.requests == []


VALUES = "charts.all.map((c) => c.values.map((v) => v.textContent))"


def shown(value):
    """Return a number as a legend writes it, to four digits."""
    return float(value.replace("−", "-"))


def test_values_under_the_cursor_are_the_data_in_all_linked_charts(seen, lines):
    box = seen.page.locator(".u-over").first.bounding_box()
    seen.page.mouse.move(box["x"] + 0.3 * box["width"], box["y"] + 40)
    until(seen, "charts.all[0].index > 0")
    at = seen.page.evaluate("charts.all[0].x[charts.all[0].index]")
    assert at == pytest.approx(1003.0, abs=0.02)
    row = round((at - 1000) * 500)
    said = seen.page.evaluate(VALUES)
    assert shown(said[0][0]) == pytest.approx(lines[0][row], rel=2e-3, abs=2e-3)
    identified, half = said[0][1].split(" ± ")
    assert shown(identified) == pytest.approx(lines[1][row], rel=2e-3, abs=2e-3)
    assert half == "4"
    # the linked chart has points of its own: the nearest of them
    near = seen.page.evaluate("charts.all[1].x[charts.all[1].index]")
    assert near == pytest.approx(at, abs=0.02)
    other = round((near - 1000) * 500)
    assert shown(said[1][0]) == pytest.approx(lines[0][other] - lines[1][other], abs=2e-3)
    assert said[2] == ["", "", ""]  # a chart of no link
    seen.page.mouse.move(box["x"] + 0.45 * box["width"], box["y"] + 40)  # rows not used
    until(seen, "charts.all[0].x[charts.all[0].index] > 1004")
    assert seen.page.evaluate(VALUES)[0][1] == "–"
    seen.page.mouse.move(5, 5)
    until(seen, "charts.all[0].index === -1")


def test_dragging_zooms_linked_charts_and_keys_lead_back(seen):
    box = seen.page.locator(".u-over").first.bounding_box()
    middle = box["y"] + 40
    seen.page.mouse.move(box["x"] + 0.2 * box["width"], middle)
    seen.page.mouse.down()
    seen.page.mouse.move(box["x"] + 0.4 * box["width"], middle, steps=4)
    seen.page.mouse.up()
    window = "charts.all.map((c) => c.plot ? [c.plot.scales.x.min, c.plot.scales.x.max] : null)"
    until(seen, "charts.all[0].plot.scales.x.max < 1005")
    first, second, *_ = seen.page.evaluate(window)
    assert first == second == pytest.approx([1002.0, 1004.0], abs=0.03)
    assert seen.page.get_by_role("button", name="Show all").count() == 2
    seen.page.locator(".place").first.focus()
    seen.page.keyboard.press("Escape")
    until(seen, "charts.all[1].plot.scales.x.max > 1009")
    assert seen.page.evaluate(window)[0] == pytest.approx([1000.0, 1009.998], abs=0.001)
    for key in ("ArrowRight", "ArrowRight", "+"):
        seen.page.keyboard.press(key)
    low, high = seen.page.evaluate(window)[1]
    assert high - low == pytest.approx(5.0, abs=0.01)
    said = seen.page.locator(".place").first.get_attribute("aria-valuetext")
    assert re.match(r"1005\.00\d+ s: measured −?[\d.]+, identified", said)
    seen.page.keyboard.press("1")  # hides the measured torque
    shown = "charts.all[0].plot.series.map((s) => s.show)"
    assert seen.page.evaluate(shown) == [True, False, True]
    seen.page.keyboard.press("1")
    assert seen.page.evaluate(shown) == [True, True, True]
    seen.page.keyboard.press("Escape")


def test_charts_are_drawn_when_they_come_into_sight_and_areas_are_stacked(seen):
    assert seen.page.evaluate("charts.all.slice(2).every((c) => c.plot === null)")
    seen.page.locator("summary").click()
    until(seen, "charts.all[2].plot !== null")
    low, high = seen.page.evaluate("charts.all[2].extent()")
    parts = np.array([np.sin(T[::10]), -np.cos(2 * T[::10]), np.sin(3 * T[::10])])
    top, bottom = np.maximum(parts, 0).sum(axis=0).max(), np.minimum(parts, 0).sum(axis=0).min()
    room = 0.04 * (top - bottom)
    assert [low, high] == pytest.approx([bottom - room, top + room], abs=1e-3)
    seen.page.evaluate("charts.link('time').set(1007)")  # as the clock of a replay does
    assert seen.page.evaluate("charts.all[1].index") > 0


def test_charts_of_a_group_share_a_legend_with_the_values_of_the_one_pointed_at(browser, tmp_path):
    a, b = (Series(name, k * np.ones(9), f"tone-{k}") for k, name in ((1, "a"), (2, "b")))
    parts = [Chart("", np.arange(9.0), both, "t [s]", "[m]") for both in ((a, b), (b,))]
    html = "".join(chart_html(part, "") for part in parts)
    html = page("", "<h1>x</h1>", {"x": ("x", f'<div class="plots">{html}</div>')})
    (tmp_path / "group.html").write_text(html, encoding="utf-8")
    with visit(browser, tmp_path / "group.html") as seen:
        until(seen, "charts.all.every((c) => c.plot !== null)")
        keys = seen.page.locator(".keys button:visible")
        for chart, values in ((0, ["a1", "b2"]), (1, ["a", "b2"])):
            seen.page.locator(".u-over").nth(chart).click()
            assert keys.all_inner_texts() == values
        keys.last.click()
        assert seen.page.evaluate("charts.all.map((c) => [...c.hidden])") == [[1], [0]]
        assert seen.errors == []


def colours(seen):
    """Return which colours a chart's first canvas holds."""
    return seen.page.evaluate("""(() => {
      const canvas = document.querySelector("canvas");
      const copy = document.createElement("canvas");
      [copy.width, copy.height] = [canvas.width, canvas.height];
      const context = copy.getContext("2d", { willReadFrequently: true });
      context.drawImage(canvas, 0, 0);
      const { data } = context.getImageData(0, 0, copy.width, copy.height);
      let light = 0, dark = 0;
      for (let k = 0; k < data.length; k += 4) {
        if (data[k + 3] < 200) continue;
        const mean = (data[k] + data[k + 1] + data[k + 2]) / 3;
        if (mean > 222) light += 1; else if (mean < 50) dark += 1;
      }
      return [light, dark];
    })()""")


def test_an_open_page_follows_from_dark_to_light_and_prints_all_charts_light(seen):
    for scheme, is_light in (("dark", True), ("light", False)):
        seen.page.emulate_media(color_scheme=scheme)
        for _ in range(60):  # until it is drawn again
            light, dark = colours(seen)
            if (light > dark) == is_light:
                break
            seen.page.wait_for_timeout(50)
        assert max(light, dark) > 10 * min(light, dark)
        assert (light > dark) == is_light
    seen.page.emulate_media(color_scheme="dark", media="print")
    assert seen.page.locator(".explore .place canvas").first.is_visible()
    ink = "getComputedStyle(document.documentElement).getPropertyValue('--predicted').trim()"
    assert seen.page.evaluate(ink) == "#0b63c5"
    seen.page.evaluate("dispatchEvent(new Event('beforeprint'))")
    until(seen, "charts.all.every((c) => c.plot !== null)")
    light, dark = colours(seen)
    assert dark > 10 * light  # dark ink
    seen.page.evaluate("dispatchEvent(new Event('afterprint'))")
    seen.page.emulate_media(color_scheme="light", media="screen")


def test_every_number_and_setting_of_a_chart_is_in_its_data():
    x = np.array([0.1, 1.0, 10.0, 100.0])
    series = (
        Series("a", np.array([1.0, 20.0, np.nan, 3e4]), "text", half=np.array([0.0, 0.5, 1.0, 4])),
        Series("b", np.array([5.0, 6.0, 7.0, 8.0]), "tone-1", "dots", is_weak=True),
        Series("c", np.array([0.2, 0.4, 0.6, 9.0]), "tone-2", is_hidden=True),
    )
    chart = Chart(
        "<t>", x, series, "x [Hz]", "y [N]", link="run 2", spans=((0.2, 0.5), (2.0, 30.0)),
        logarithmic="xy", height=123,
    )  # fmt: skip
    (found,) = charts(chart_html(chart, ""))
    np.testing.assert_allclose(found["x"], x, rtol=1e-6)
    for own, said in zip(series, found["series"], strict=True):
        np.testing.assert_allclose(said["y"], own.y, rtol=1e-3)
        keys = {"label": own.label, "tone": own.tone, "kind": own.kind}
        assert {key: said[key] for key in keys} == keys
        assert (said["is_weak"], said["is_hidden"]) == (own.is_weak, own.is_hidden)
    np.testing.assert_allclose(found["series"][0]["half"], [0.0, 0.5, 1.0, 4.0], atol=1e-4)
    assert [said["half"] is None for said in found["series"]] == [False, True, True]
    assert found["spans"] == [[0.2, 0.5], [2.0, 30.0]]
    keys = ("title", "x_label", "y_label", "link", "logarithmic", "height")
    said = [found[key] for key in keys]
    assert said == ["<t>", "x [Hz]", "y [N]", "run 2", "xy", 123]


def test_of_a_thinned_line_every_extreme_and_both_sides_of_a_break_remain():
    y = np.sin(np.arange(4000) / 7.0) * (1 + np.arange(4000) / 4000)
    y[[600, 2501]] = 30.0, -40.0
    y[1000:1100] = y[3333] = np.nan
    rows = thin(y, 400)
    assert {0, 600, 999, 1000, 1099, 1100, 2501, 3332, 3333, 3334, 3999} <= set(rows.tolist())
    assert len(rows) <= 400 + 10
    for first in range(0, 4000, 20):  # two points of each 20 samples: the largest and the smallest
        own = y[first : first + 20]
        if np.isfinite(own).any():
            kept = y[rows[(rows >= first) & (rows < first + 20)]]
            assert (np.nanmin(kept), np.nanmax(kept)) == (np.nanmin(own), np.nanmax(own))


def test_a_line_is_broken_in_the_middle_of_each_gap():
    x, y = np.array([10.0, 10.5, 11.0, 14.0, 14.5, 20.5]), np.arange(6.0)
    times, one, two = broken(np.array([0, 0, 0, 1, 1, 2]), x, y, -y)
    np.testing.assert_array_equal(times, [10.0, 10.5, 11.0, 12.5, 14.0, 14.5, 17.5, 20.5])
    np.testing.assert_array_equal(one, [0, 1, 2, np.nan, 3, 4, np.nan, 5])
    np.testing.assert_array_equal(two, -one)


def test_a_verdict_shows_three_reasons_and_folds_all_others():
    html = verdict_html("<arm>", "not evaluated", ["a & b", "c", "d", "e", "f"])
    assert html == (
        '<div class="verdict not-evaluated"><h1>&lt;arm&gt; '
        "<span>Verdict: <strong>not evaluated</strong></span></h1>"
        "<ul><li>a &amp; b</li><li>c</li><li>d</li></ul>"
        "<details><summary>2 more reasons</summary><ul><li>e</li><li>f</li></ul></details></div>\n"
    )
    assert "<summary>1 more reason</summary>" in verdict_html("arm", "poor", "abcd")
    assert "<details>" not in verdict_html("arm", "good", "abc")
    expected = '<ul></ul><p class="uses">a &lt; b</p></div>\n'
    assert verdict_html("arm", "good", [], "a < b").endswith(expected)


def test_a_command_breaks_between_arguments_only():
    assert "<i>/my &amp; lab/arm/</i>z.urdf</span> <span>run/a.csv" in command_html(
        "robotid replay '/my & lab/arm/z.urdf' run/a.csv"
    ).replace("&#x27;", "")
    assert command_html("robotid replay 'my log.csv' --lock a=0 <x>") == (
        '<pre class="command"><span>robotid</span> <span>replay</span> '
        "<span>&#x27;my log.csv&#x27;</span> <span>--lock</span> <span>a=0</span> "
        "<span>&lt;x&gt;</span></pre>"
    )
    assert command_html("[locked]\na = 0") == '<pre class="command">[locked]\na = 0</pre>'


def test_a_small_error_of_a_plain_number_is_written_in_full():
    """Powers of ten are for numbers that are small, too, and for errors of 100,000 and more."""
    for value, error, wanted in (
        (1.5, 1.2e-5, ("1.500000", "0.000012")), (0.00123, 2e-4, ("0.00123", "0.00020")),
        (1.5e-4, 0.0012, ("0.0001", "0.0012")), (2e-4, 3e-4, ("2.0e−04", "3.0e−04")),
        (-1e-8, 3e-4, ("0", "3.0e−04")), (-1.5e6, 9.94e4, ("−1500000", "99400")),
        (-1.5e6, 1.2e5, ("−1.50e+06", "1.2e+05")),
    ):  # fmt: skip
        assert tuple(cell.html for cell in with_error(value, error)) == wanted


def test_a_cell_has_the_style_of_its_content_and_its_number_in_full():
    for cell, wanted in (
        (text("<" * 23), ("&lt;" * 23, "text", None)), (text("a" * 24), ("a" * 24, "", None)),
        (text("s^3/m^2"), ("s³/m²", "text", None)), (code("m^2.csv"), ("m^2.csv", "code", None)),
        (text("a", flag=True), ("a", "flag text", None)),
        (code("a.b_c/<" + 10 * "d"), ("a.<wbr>b_<wbr>c/<wbr>&lt;dddddddddd", "code", None)),
        (code("wrist_1_joint/<_"), ("wrist_1_joint/&lt;_", "code", None)),
        (number(-12.3456), ("−12.35", "number", -12.3456)), (number(None), ("–", "number", None)),
        (number(np.nan), ("–", "number", None)), (number(2.0, "+.2f"), ("+2.00", "number", 2.0)),
        (percent(1000.4), ("1000", "number", 1000.4)),
        (percent(999.94), ("999.9", "number", 999.94)),
        (percent(0.995), ("1.0", "number", 0.995)), (percent(0.994), ("0.99", "number", 0.994)),
        (percent(-0.5), ("−0.50", "number", -0.5)), (percent(None), ("–", "number", None)),
    ):  # fmt: skip
        assert (cell.html, cell.kind, cell.value) == wanted


def test_a_page_links_to_its_sections_and_runs_the_scripts_that_they_need():
    plain, folds, still = (
        page("<p>", "<h1>h</h1>", sections)
        for sections in (
            {"a": ("A", "text a"), "b": Section("B", "text b")},
            {
                "a": Section("A", "text", "in short", is_open=False),
                "b": Section("B", "x", "", True),
            },
            {"a": ("A", '<table class="data"><figure class="chart">')},
        )
    )
    assert "<title>&lt;p&gt;</title>" in plain
    assert (
        '<div><a href="#content">&lt;p&gt;</a> <a href="#a">A</a> <a href="#b">B</a> </div>'
        in plain
    )
    assert (
        '<header>\n<h1>h</h1></header>\n<section aria-labelledby="a">\n<h2 id="a">A</h2>\n'
        'text a</section>\n<section aria-labelledby="b">\n<h2 id="b">B</h2>\ntext b</section>\n'
        "</main>" in plain
    )
    assert (
        '<section aria-labelledby="a">\n<details id="a-fold"><summary><h2 id="a">A</h2>'
        "<span>in short</span></summary>\ntext</details>\n</section>\n" in folds
    )
    assert '<details id="b-fold" open><summary><h2 id="b">B</h2></summary>\nx</details>' in folds
    drawn = ["page.js", "tables.js", "uPlot.iife.min.js", "charts.js"]
    for html, names in ((plain, []), (folds, drawn[:1]), (still, drawn)):
        assert [name for name in (*drawn, "dock.js") if asset(name) in html] == names
        assert html.count("sha256-") == len(names)
        assert "frame-src" not in html
        assert asset("tones.css") in html
