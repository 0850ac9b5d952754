import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from html import unescape

import numpy as np
import pytest
from helpers.browsing import until, visit
from helpers.pages import charts
from PIL import Image

from robotid.base.exceptions import DataError
from robotid.output.pages.charts import (
    Chart,
    Series,
    _Axis,
    _covers,
    _drawn,
    broken,
    chart_html,
    thin,
)
from robotid.output.pages.html import page
from robotid.output.pages.plots import Plot

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
    whiskers = Series("rms", np.array([3.0, -1.0]), "tone-1", "bars", half=np.array([0.5, 0.2]))
    bars = Chart("Bars", np.arange(2.0), (whiskers,), "joint", "rms", x_names=("one", "two"))
    first, *others = (chart_html(c, c.title) for c in (torque, below, split, spectrum, bars))
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
        np.testing.assert_allclose(
            [kept.min(), kept.max()], [np.nanmin(y), np.nanmax(y)], rtol=1e-4
        )
    assert 1500 < len(rows) < 3000
    np.testing.assert_allclose(found["series"][1]["half"], 4.0)
    assert len(chart_html(torque, "")) < 45_000


def test_a_hidden_series_is_in_the_data_alone():
    wild = Series("wild", np.array([0.0, 900.0]), "urdf", is_hidden=True)
    series = (wild, Series("tame", np.array([0.0, 1.0]), "text"))
    html = chart_html(Chart("c", np.arange(2.0), series, "x", "y"), "")
    assert [s["hidden"] for s in charts(html)[0]["series"]] == [True, False]
    svg = html.partition("</svg>")[0]
    assert "wild" not in svg
    assert "tame" in svg
    assert "900" not in svg  # nor is the axis made for it


def test_a_thinned_line_keeps_its_extremes_its_ends_and_both_sides_of_its_breaks(rng):
    y = rng.normal(size=10_000)
    y[[1234, 7777]] = [-40.0, 50.0]
    y[5000:5100] = np.nan
    rows = thin(y, 200)
    assert len(rows) < 250
    assert {0, 1234, 4999, 5000, 5099, 5100, 7777, 9999} <= set(rows.tolist())
    assert (np.diff(rows) > 0).all()
    assert thin(y, 10_000).tolist() == list(range(10_000))


def test_a_line_breaks_between_the_stretches_of_a_recording():
    x, y = broken(np.array([0, 0, 1, 1]), np.array([0.0, 1.0, 5.0, 6.0]), np.arange(4.0))
    np.testing.assert_array_equal(x, [0, 1, 3, 5, 6])
    np.testing.assert_array_equal(y, [0, 1, np.nan, 2, 3])


def test_numbers_on_logarithmic_axes_keep_their_share(rng):
    y = 10.0 ** rng.uniform(-6, 3, size=500)
    y[3] = 0.0  # it has no logarithm
    chart = Chart("S", np.arange(500.0), (Series("S", y, "text"),), "f", "S", logarithmic="y")
    (found,) = charts(chart_html(chart, ""))
    np.testing.assert_allclose(np.delete(found["series"][0]["y"], 3), np.delete(y, 3), rtol=3e-4)
    assert np.isnan(found["series"][0]["y"][3])


@pytest.mark.parametrize(
    ("series", "said"),
    [
        (Series("y", np.zeros(4), "text"), "series 'y' of the chart 'c' has 4 values, its x has 5"),
        (
            Series("y", np.zeros(5), "text", "pie"),
            "is of kind 'pie'; kinds: line, dots, bars, area",
        ),
        (Series("y", np.zeros(5), "text", half=np.zeros(3)), "has 3 half widths, its x has 5"),
    ],
)
def test_a_chart_that_does_not_fit_together_is_refused(series, said):
    with pytest.raises(DataError, match=re.escape(said)):
        Chart("c", np.arange(5.0), (series,), "x", "y")


def test_no_name_ends_the_script_or_the_picture():
    evil = "</script><b>"
    series = (Series(evil, np.arange(2.0), "text"),)
    html = chart_html(Chart(evil, np.arange(2.0), series, evil, evil), "")
    assert html.count("</script>") == 1
    assert "<b>" not in html
    assert charts(html)[0]["series"][0]["label"] == evil


def test_the_still_picture_shows_the_line_in_the_units_of_its_ticks(torque, lines):
    svg = re.search(r"<svg.*?</svg>", chart_html(torque, ""), re.DOTALL)[0]
    root = ET.fromstring(svg)
    ticks = [
        (float(t.get("y")) - 4, t.text) for t in root.iter("text") if t.get("text-anchor") == "end"
    ]
    places, values = zip(*[(y, float(text.replace("−", "-"))) for y, text in ticks], strict=True)
    line = next(p for p in root.iter("path") if p.get("stroke") == "var(--text)" and p.get("fill"))
    points = np.array(re.findall(r"(-?[\d.]+) (-?[\d.]+)", line.get("d")), dtype=float)
    drawn = np.polyval(np.polyfit(places, values, 1), points[:, 1])
    assert len(points) < 300
    np.testing.assert_allclose(
        [drawn.min(), drawn.max()], [lines[0].min(), lines[0].max()], atol=0.3
    )
    assert {"torque [N m]", "time [s]", "measured", "identified"} <= {
        t.text for t in root.iter("text")
    }


ACROSS = _Axis(0.0, 10.0, 0.0, 1000.0, False)  # 100 px each
UP = _Axis(-5.0, 5.0, 200.0, 0.0, False)  # 20 px each, 0 at 100 px


def drawn_of(series, k, x):
    """Return the numbers of the paths of series k, drawn on axes whose pixels are known."""
    chart = Chart("c", x, series, "x", "y")
    items = [(s, s.y, s.half) for s in series]
    html = _drawn(chart, x, items[k], _covers(items)[k], ACROSS, UP, 200)
    paths = re.findall(r'd="([^"]*)"', html)
    return [[float(n) for n in re.findall(r"-?[\d.]+", path)] for path in paths]


def test_bars_stand_beside_each_other_on_zero_with_whiskers_both_ways():
    x = np.array([1.0, 3.0, 5.0])
    first = Series("a", np.array([1.0, -2.0, np.nan]), "text", "bars")
    second = Series("b", np.array([3.0, 2.0, 1.0]), "text", "bars", half=np.array([0.5, 1.0, 0.1]))
    line = Series("c", np.zeros(3), "text")
    (bars,) = drawn_of((first, line, second), 0, x)
    # slots of 0.8 / 2 of 2 between neighbours; bars fill nine tenths of theirs
    assert bars == pytest.approx([60 - 36, 100, 72, 80, -72, 260 - 36, 100, 72, 140, -72])
    bars, whiskers = drawn_of((first, line, second), 2, x)
    left = [140 - 36, 340 - 36, 540 - 36]
    wanted = [[a, 100, 72, y, -72] for a, y in zip(left, (40, 60, 80), strict=True)]
    assert bars == pytest.approx([n for bar in wanted for n in bar])
    ends = [[140, 50, 30], [340, 80, 40], [540, 82, 78]]
    assert whiskers == pytest.approx([n for whisker in ends for n in whisker])


def test_a_line_is_where_its_numbers_are_and_its_band_half_a_width_to_each_side():
    x = np.array([0.0, 1.0, 2.0, 3.0, 4.0])
    y = np.array([0.0, 1.0, np.nan, 2.0, -1.0])
    line = Series("a", y, "text", half=np.full(5, 0.5))
    band, path = drawn_of((line,), 0, x)
    assert path == pytest.approx([0, 100, 100, 80, 300, 60, 400, 120])
    assert band == pytest.approx(
        [0, 90, 100, 70, 100, 90, 0, 110, 300, 50, 400, 110, 400, 130, 300, 70]
    )


def test_ticks_are_round_and_apart_and_their_words_as_long_as_need_be():
    axis = _Axis(-1.2, 2.6, 300.0, 0.0, False)  # 22 px at least: 0.279, so 0.5
    assert axis.step == pytest.approx(0.5)
    assert axis.ticks == pytest.approx([-1.0, -0.5, 0.0, 0.5, 1.0, 1.5, 2.0, 2.5])
    assert axis.words == ["−1.0", "−0.5", "0.0", "0.5", "1.0", "1.5", "2.0", "2.5"]
    wide = _Axis(0.0, 1000.0, 50.0, 800.0, False)  # 80 px at least: 107, so 200
    assert wide.ticks == [0.0, 200.0, 400.0, 600.0, 800.0, 1000.0]
    decades = _Axis(-1.0, 2.2, 0.0, 300.0, True)
    assert decades.ticks == pytest.approx([0.1, 1.0, 10.0, 100.0])
    assert float(decades(10.0)) == pytest.approx(300.0 * 2.0 / 3.2)
    few = _Axis(0.2, 1.1, 0.0, 300.0, True)
    assert few.ticks == pytest.approx([2.0, 5.0, 10.0])
    assert np.isnan(few(0.0))


def test_areas_are_stacked_up_and_down_from_zero():
    x = np.arange(3.0)
    areas = [np.array([1.0, -1.0, 2.0]), np.array([2.0, -3.0, np.nan]), np.array([-4.0, 5.0, 1.0])]
    items = [(Series(str(k), y, "text", "area"), y, None) for k, y in enumerate(areas)]
    found = [np.array(cover) for cover in _covers(items)]  # (2, 2, 3): up and down, low and high
    up = np.cumsum([np.fmax(np.nan_to_num(y), 0) for y in areas], axis=0)
    down = np.cumsum([np.fmin(np.nan_to_num(y), 0) for y in areas], axis=0)
    for k, cover in enumerate(found):
        np.testing.assert_allclose(cover[0], [up[k - 1] if k else 0 * x, up[k]])
        np.testing.assert_allclose(cover[1], [down[k], down[k - 1] if k else 0 * x])


def test_what_is_unknown_has_no_width_and_bars_stand_on_zero():
    y, half = np.array([1.0, -2.0, np.nan]), np.array([0.5, np.nan, 0.5])
    (line,), (bars,) = _covers(
        [(Series("a", y, "text", kind), y, half) for kind in ("line", "bars")]
    )
    np.testing.assert_allclose(line, [[0.5, -2.0, np.nan], [1.5, -2.0, np.nan]])
    np.testing.assert_allclose(bars, [[0.0, -2.0, 0.0], [1.5, 0.0, 0.0]])


def test_a_plot_in_a_notebook_is_as_high_as_its_charts():
    one, two = (Chart("c", np.arange(2.0), (), "x", "y", height=h) for h in (90, 180))
    for charts_of, height in (((one,), 262), ((one, two), 554), ((one,) * 9, 900)):
        cell = Plot("a & b", tuple((chart, "x < y") for chart in charts_of))._repr_html_()
        assert f"height:{height}px" in cell
        assert 'title="a &amp; b"' in cell
        assert unescape(re.search(r'srcdoc="([^"]*)"', cell)[1]).count("x &lt; y") == len(charts_of)


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


def test_an_open_page_follows_from_dark_to_light_and_prints_light(seen):
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
    assert seen.page.locator("figure.chart svg").first.is_visible()
    assert not seen.page.locator(".explore .place").first.is_visible()
    ink = "getComputedStyle(document.documentElement).getPropertyValue('--predicted').trim()"
    assert seen.page.evaluate(ink) == "#0b63c5"


def test_without_scripts_the_still_pictures_stand_in_the_page(browser, demo):
    with visit(browser, demo, java_script_enabled=False) as seen:
        assert seen.page.locator("figure.chart svg").first.is_visible()
        assert seen.page.locator(".explore").count() == 0


def test_labels_of_many_series_stay_inside_the_still_picture():
    x, names = np.arange(3.0), ("gravity", "inertia", "Coriolis", "motor inertia", "friction")
    every = (*names, "offset", "residual", "measured")
    series = tuple(Series(name, x, "text") for name in every)
    html = chart_html(Chart("many", x, series, "time [s]", "torque [N m]"), "")
    _, _, width, height = map(float, re.search(r'viewBox="([^"]*)"', html)[1].split())
    labels = {t: (float(a), float(b)) for a, b, t in re.findall(
        r'<text x="([\d.]+)" y="([\d.]+)">([^<]*)</text>', html)}  # fmt: skip
    assert set(every) < set(labels)
    for name in every:
        place, down = labels[name]
        assert place + 6.2 * len(name) <= width
        assert down < height
    assert labels["measured"][1] > labels["gravity"][1]
    few = chart_html(Chart("few", x, series[:2], "time [s]", "torque [N m]"), "")
    assert float(re.search(r'viewBox="([^"]*)"', few)[1].split()[3]) < height


def still_of(chart):
    html = chart_html(chart, "")
    head, parts = (
        re.search(r"<svg ([^>]*)>(.*)</svg>", html)[1],
        re.findall(r"<(?:path|text) .*?(?:/>|</text>)", html),
    )
    return re.search(r'viewBox="([^"]*)"', head)[1], parts


def outline(*points):
    """Return a path through points [px]."""
    return "M" + "L".join(f"{a:.1f} {b:.1f}" for a, b in points)


def frame(xs, x_words, ys, y_words, bottom, right, label):
    """Return the grid and the words of a plot from x = 54 and y = 20; all in [px]."""
    grid = "".join(f"M54 {y:.1f}H{right}" for y in ys) + "".join(
        f"M{x:.1f} 20V{bottom}" for x in xs
    )
    beside = zip(ys, y_words, strict=True)
    return [
        f'<path d="{grid}" stroke="currentColor" stroke-opacity="0.15"/>',
        *(f'<text x="48" y="{y + 4:.1f}" text-anchor="end">{word}</text>' for y, word in beside),
        *(
            f'<text transform="translate({x:.1f} {bottom + 14})" text-anchor="middle">{word}</text>'
            for x, word in zip(xs, x_words, strict=True)
        ),
    ], f'<text x="{(54 + right) / 2:.0f}" y="{bottom + 29}" text-anchor="middle">{label}</text>'


def key_of(x, tone, label, opacity="1.0"):
    return [
        f'<path d="M{x:.0f} 8h12" stroke="var(--{tone})" stroke-width="4" '
        f'stroke-opacity="{opacity}"/>',
        f'<text x="{x + 16:.0f}" y="12">{label}</text>',
    ]


def test_a_still_picture_of_lines_and_dots_is_drawn_to_scale():
    """x from 10 to 14 on 576 px; y from -3 to 6, with 4 % to each side, on 200 px."""
    x = np.array([10.0, 11.0, 12.0, 13.0, 14.0])
    line = Series("l", np.array([1.0, 2, np.nan, 4, 3]), "text", half=np.array([0.5, 1, 1, 1, 2]))
    dots = Series("dd", np.array([-3.0, 0, 5, np.nan, 6]), "tone-1", "dots", is_weak=True)
    chart = Chart(
        "c", x, (line, dots), "x [m]", "y", spans=((9.0, 11.0), (13.0, 13.001)), marks=(12.5,),
        height=200,
    )  # fmt: skip
    place = dict(zip([*x.tolist(), 12.5], 54 + 144 * (np.append(x, 12.5) - 10), strict=True))

    def up(y):
        return 220 - 200 * (y + 3.36) / 9.72

    ticks = [-2, 0, 2, 4, 6]
    grid, label = frame(
        [place[v] for v in x], ["10", "11", "12", "13", "14"],
        [up(v) for v in ticks], ["−2", "0", "2", "4", "6"], 220, 630, "x [m]",
    )  # fmt: skip
    bands = [[(10, 1.5), (11, 3), (11, 1), (10, 0.5)], [(13, 5), (14, 5), (14, 1), (13, 3)]]
    lines = [[(10, 1), (11, 2)], [(13, 4), (14, 3)]]
    band, path = (
        [outline(*((place[a], up(b)) for a, b in each)) for each in every]
        for every in (bands, lines)
    )
    dotted = "".join(
        f"M{place[a]:.1f} {up(b):.1f}h0" for a, b in ((10, -3), (11, 0), (12, 5), (14, 6))
    )
    box, parts = still_of(chart)
    assert box == "0 0 640 254"
    assert parts == [
        '<path d="M54.0 20H198.0V220H54.0z" fill-opacity="0.09"/>',
        '<path d="M486.0 20H486.5V220H486.0z" fill-opacity="0.09"/>',
        *grid,
        '<path d="M414.0 20V220" stroke="currentColor" stroke-dasharray="1 3"/>',
        label,
        f'<path d="{band[0]}z{band[1]}z" fill="var(--text)" fill-opacity="0.2"/>',
        f'<path d="{"".join(path)}" fill="none" stroke="var(--text)" stroke-width="1.2" '
        'stroke-opacity="1.0"/>',
        f'<path d="{dotted}" stroke="var(--tone-1)" stroke-width="3" stroke-linecap="round" '
        'stroke-opacity="0.5"/>',
        '<text x="4" y="12">y</text>',
        *key_of(4 + 6.2 * 4, "text", "l"),
        *key_of(4 + 6.2 * 4 + 16 + 6.2 * 4, "tone-1", "dd", "0.5"),
    ]


def test_a_still_picture_of_bars_has_its_names_slanted_where_they_are_long():
    """Each bar is 0.9 of half of 0.8 wide; a name of 20 letters is longer than the 118 px of it."""
    one = Series("one", np.array([3.0, -1.0]), "tone-1", "bars", half=np.array([0.5, 0.2]))
    two = Series("two", np.array([1.0, 2.0]), "tone-2", "bars")
    names = ("n" * 20, "b")
    chart = Chart("b", np.arange(2.0), (one, two), "joint", "m", x_names=names, width=300)
    box, parts = still_of(chart)
    assert box == f"0 0 300 {180 + 20 + 34 + 62}"

    def up(y):  # from -1.2 to 3.5, with 4 % to each side, on 180 px
        return 200 - 180 * (y + 1.2 + 0.188) / (4.7 * 1.08)

    def across(x):  # from -0.5 to 1.5
        return 54 + 118 * (x + 0.5)

    assert [p for p in parts if "rotate" in p] == [
        f'<text transform="translate({across(k):.1f} 214) rotate(-30)" text-anchor="end">{n}</text>'
        for k, n in enumerate(names)
    ]
    assert '<text x="172" y="291" text-anchor="middle">joint</text>' in parts
    wide, zero = 0.9 * 0.4 * 118, up(0)
    for series, side in ((one, -0.2), (two, 0.2)):
        bars = "".join(
            f"M{across(k + side) - wide / 2:.1f} {zero:.1f}h{wide:.1f}V{up(y):.1f}h{-wide:.1f}z"
            for k, y in enumerate(series.y)
        )
        assert f'<path d="{bars}" fill="var(--{series.tone})" fill-opacity="1.0"/>' in parts
    whiskers = "".join(
        f"M{across(k - 0.2):.1f} {up(y - h):.1f}V{up(y + h):.1f}"
        for k, (y, h) in enumerate(zip(one.y, one.half, strict=True))
    )
    assert f'<path d="{whiskers}" stroke="currentColor" stroke-width="1.2"/>' in parts
    alone = Series("o", np.ones(1), "tone-1", "bars")  # x from -1 to 1 on 576 px
    _, parts = still_of(Chart("o", np.zeros(1), (alone,), "joint", "m", x_names=("a",)))
    assert any(f"h{0.9 * 0.8 * 288:.1f}V" in part for part in parts)
    short = replace(chart, x_names=("n" * 19, "b"))
    assert still_of(short)[0] == f"0 0 300 {180 + 20 + 34}"


def test_a_still_picture_of_areas_is_drawn_between_their_edges():
    x = np.array([5.0, 6.0, 7.0])
    ys = np.array([1.0, 2, -1]), np.array([2.0, -1, 1])
    areas = tuple(Series(f"a{k}", y, f"tone-{k}", "area") for k, y in enumerate(ys))
    _, parts = still_of(Chart("a", x, areas, "x", "y", height=100))

    def path(*points):  # y from -1 to 3
        places = ((54 + 288 * (a - 5), 120 - 100 * (b + 1.16) / 4.32) for a, b in points)
        return outline(*places) + "z"

    for k, wanted in enumerate((
        path((5, 1), (6, 2), (7, 0), (7, 0), (6, 0), (5, 0))
        + path((6, 0), (7, 0), (7, -1), (6, 0)),
        path((5, 3), (6, 2), (7, 1), (7, 0), (6, 2), (5, 1))
        + path((5, 0), (6, 0), (7, -1), (7, -1), (6, -1), (5, 0)),
    )):  # fmt: skip
        assert f'<path d="{wanted}" fill="var(--tone-{k})" fill-opacity="0.7"/>' in parts
    # one point, one value: half a unit to each side of x, 8 % of the value around y
    _, (*_, label, drawn, _, _, _) = still_of(
        Chart("p", np.array([5.0]), (Series("p", np.array([2.0]), "text", "dots"),), "t", "y")
    )
    assert (label, drawn.split('"')[1]) == (
        '<text x="342" y="229" text-anchor="middle">t</text>',
        "M342.0 110.0h0",
    )


@pytest.mark.parametrize("is_idle", [True, False])
def test_charts_below_the_window_are_there_in_a_capture_of_the_page(
    browser, tmp_path, lines, is_idle
):
    """Drawn as soon as the browser is idle, and as a picture before."""
    chart = Chart("far down", T, (Series("measured", lines[0], "tone-1"),), "time [s]", "y")
    spacer = '<div style="height: 4000px"></div>'
    path = tmp_path / "far.html"
    html = page("far", "<h1>far</h1>", {"a": ("a", f"{spacer}{chart_html(chart, 'below')}")})
    if not is_idle:
        html = html.replace("window.requestIdleCallback ||", "false && 0 || (() => 0) ||")
        html = re.sub(r"script-src [^\"]*", "script-src 'unsafe-inline'", html)
    path.write_text(html, encoding="utf-8")
    with visit(browser, path) as seen:
        if is_idle:
            until(seen, "charts.all[0].plot !== null")
        assert seen.page.evaluate("charts.all[0].plot === null") != is_idle
        assert seen.page.evaluate("scrollY") == 0
        box = seen.page.locator("figure.chart").bounding_box()
        assert box["y"] > 3000
        seen.page.screenshot(path=tmp_path / "far.png", full_page=True)
        image = np.asarray(Image.open(tmp_path / "far.png").convert("RGB")).astype(int)
        picture = image[int(box["y"]) + 60 : int(box["y"] + box["height"]) - 60, 200:-200]
        blue = (picture[..., 2] - picture[..., 0] > 100).sum()  # the line, in tone-1
        assert blue > 500
        height = seen.page.evaluate("document.body.scrollHeight")
        seen.page.evaluate("scrollTo(0, 4000)")
        until(seen, "charts.all[0].plot !== null")
        assert seen.page.evaluate("document.body.scrollHeight") == height
        hidden = "getComputedStyle(document.querySelector('figure svg')).display"
        assert seen.page.evaluate(hidden) == "none"
        seen.page.emulate_media(media="print")
        assert seen.page.evaluate(hidden) == "block"
        assert seen.errors == []


def test_every_number_and_setting_of_a_chart_is_in_its_data():
    x = np.array([0.1, 1.0, 10.0, 100.0])
    series = (
        Series("a", np.array([1.0, 20.0, np.nan, 3e4]), "text", half=np.array([0.0, 0.5, 1.0, 4])),
        Series("b", np.array([5.0, 6.0, 7.0, 8.0]), "tone-1", "dots", is_weak=True),
        Series("c", np.array([0.2, 0.4, 0.6, 9.0]), "tone-2", is_hidden=True),
    )
    chart = Chart(
        "<t>", x, series, "x [Hz]", "y [N]", link="run 2", spans=((0.2, 0.5), (2.0, 30.0)),
        marks=(0.3, 40.0), logarithmic="xy", height=123, x_names=("p", "q"),
    )  # fmt: skip
    (found,) = charts(chart_html(chart, ""))
    np.testing.assert_allclose(found["x"], x, rtol=1e-6)
    for own, said in zip(series, found["series"], strict=True):
        np.testing.assert_allclose(said["y"], own.y, rtol=1e-3)
        keys = {"label": own.label, "tone": own.tone, "kind": own.kind}
        assert {key: said[key] for key in keys} == keys
        assert (said["faint"], said["hidden"]) == (own.is_weak, own.is_hidden)
    np.testing.assert_allclose(found["series"][0]["half"], [0.0, 0.5, 1.0, 4.0], atol=1e-4)
    assert [said["half"] is None for said in found["series"]] == [False, True, True]
    assert found["spans"] == [[0.2, 0.5], [2.0, 30.0]]
    assert found["marks"] == [0.3, 40.0]
    keys = ("title", "x_label", "y_label", "link", "logarithmic", "height", "x_names")
    said = [found[key] for key in keys]
    assert said == ["<t>", "x [Hz]", "y [N]", "run 2", "xy", 123, ["p", "q"]]


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


def test_a_cell_of_a_notebook_is_as_high_as_its_charts():
    def height(*each):
        own = [Chart("a", np.arange(2.0), (), "x", "y", height=h) for h in each]
        plot = Plot("two", tuple((chart, "") for chart in own))
        return int(re.search(r"height:(\d+)px", plot._repr_html_())[1])

    assert (height(100, 150), height(500, 500)) == (100 + 150 + 2 * 112 + 60, 900)
