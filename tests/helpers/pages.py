"""What a page says, read back from its HTML: tables as text, plots in the units of their axes."""

import base64
import json
import math
import re
import xml.etree.ElementTree as ET
from dataclasses import dataclass, field
from html.parser import HTMLParser

import numpy as np


@dataclass
class Table:
    headers: list[str] = field(default_factory=list)
    rows: list[list[str]] = field(default_factory=list)
    foot: list[str] = field(default_factory=list)

    def column(self, head):
        return [row[self.headers.index(head)] for row in self.rows]

    def by_name(self):
        """Return each row as a dictionary, by its head."""
        return {row[0]: dict(zip(self.headers, row, strict=True)) for row in self.rows}


class _Tables(HTMLParser):
    def __init__(self):
        super().__init__()
        self.found, self.words, self.part = [], None, ""

    def handle_starttag(self, tag, attrs):
        if tag == "table":
            self.found.append(["", Table()])
        elif tag in ("thead", "tbody", "tfoot"):
            self.part = tag
        elif tag == "tr":
            self.cells = []
        elif tag in ("caption", "th", "td"):
            self.words = []

    def handle_data(self, data):
        if self.words is not None:
            self.words.append(data)

    def handle_endtag(self, tag):
        if tag in ("caption", "th", "td"):
            said, self.words = "".join(self.words), None
            if tag == "caption":
                self.found[-1][0] = said
            else:
                self.cells.append(said)
        elif tag == "tr":
            table = self.found[-1][1]
            if self.part == "thead":
                table.headers = self.cells
            elif self.part == "tbody":
                table.rows.append(self.cells)
            else:
                table.foot = self.cells


def tables(html):
    """Return the tables of a page by their captions."""
    reader = _Tables()
    reader.feed(html)
    found = dict(reader.found)
    assert len(found) == len(reader.found), "two tables have one caption"
    return found


def number(value, spec=".4g"):
    """Return a number as a page writes it."""
    if value is None or not math.isfinite(value):
        return "–"
    return format(value, spec).replace("-", "−")


def percent(value):
    """Return a percentage as a page writes it."""
    if value is None or not math.isfinite(value):
        return "–"
    return number(value, ".0f" if value >= 1000 else ".1f" if value >= 1 else ".2f")


def charts(html):
    """Return the data of a page's charts, decoded: what charts.js draws."""
    found = []
    for text in re.findall(
        r'<figure class="chart">.*?<script type="application/json">(.*?)</script>', html, re.DOTALL
    ):
        what = json.loads(text)
        what["x"] = _unpacked(what["x"])
        for series in what["series"]:
            series["y"] = _unpacked(series["y"])
            series["half"] = None if series["half"] is None else _unpacked(series["half"])
        found.append(what)
    return found


def _unpacked(packed):
    """Return the numbers of an array in a page, the last code as NaN."""
    codes = np.frombuffer(base64.b64decode(packed["data"]), f"<u{packed['bits'] // 8}")
    last = 2 ** packed["bits"] - 1
    values = packed["low"] + codes / (last - 1) * (packed["high"] - packed["low"])
    values = np.where(codes == last, np.nan, values)
    return 10.0**values if packed["log"] else values


@dataclass
class Line:
    """A line of a plot in the units of its axes: stretches that are joined, and single marks."""

    colour: str
    opacity: float
    parts: list
    marks: np.ndarray


class Axes:
    """Axes of a plot: what is drawn in them, read back in their units."""

    def __init__(self, element, key, x=None, log_y=False):
        self.element, self.key = element, key
        scales = [child for child in element if "matplotlib.axis_" in child.get("id", "")]
        self.x = x or _Scale(scales[0], "x")
        self.y = _Scale(scales[1], "y", log_y)

    def children(self, kind):
        return [c for c in self.element if c.get("id", "").startswith(f"{self.key}-{kind}_")]

    def to_data(self, points):
        points = np.reshape(np.array(points, dtype=float), (-1, 2))
        return np.column_stack([self.x(points[:, 0]), self.y(points[:, 1])])

    def lines(self):
        """Return the lines, in the order in which they were drawn."""
        found = []
        for group in self.children("line2d"):
            path, uses = group.find("path"), group.findall(".//use")
            if path is None and not uses:
                continue  # a line without points
            style = _style((uses[0] if uses else path).get("style"))
            paint = style.get("stroke", "none")
            found.append(
                Line(
                    colour=paint if paint != "none" else style["fill"],
                    opacity=float(style.get("stroke-opacity", 1.0)),
                    parts=[] if path is None else [self.to_data(p) for p in _parts(path)],
                    marks=self.to_data([[use.get("x"), use.get("y")] for use in uses]),
                )
            )
        return found

    def line(self, colour, opacity=1.0):
        """Return the one line of a colour and opacity that has more than two points."""
        (found,) = [
            line
            for line in self.lines()
            if line.colour == colour
            and line.opacity == opacity
            and (len(line.marks) or sum(map(len, line.parts)) > 2)
        ]
        return found

    def patches(self, kind="patch"):
        """Return the corners of the patches, but for the ground of the axes."""
        found = []
        for group in self.children(kind):
            for path in group.iter("path"):
                (use,) = group.findall(".//use") or [None]
                shift = [float(use.get("x")), float(use.get("y"))] if use is not None else [0, 0]
                found += [self.to_data(np.array(part) + shift) for part in _parts(path)]
        return found[1:] if kind == "patch" else found


class _Scale:
    """The scale of one axis: pixels to numbers by its ticks, or the names at its ticks."""

    def __init__(self, axis, letter, is_log=False):
        self.is_log = is_log
        ticks = [g for g in axis if re.search(f"-{letter}tick_", g.get("id", ""))]
        pairs = [
            (float(g.find(".//use").get(letter)), "".join(g.find(".//text").itertext()))
            for g in ticks
            if g.find(".//text") is not None and g.find(".//use") is not None
        ]
        self.names = {label: place for place, label in pairs}
        values = []
        for _, label in pairs:
            try:
                values.append(float(label.replace("−", "-")))
            except ValueError:
                values, self.fit = None, None
                break
        if values is None:
            return
        places, values = np.array([place for place, _ in pairs]), np.array(values)
        assert len(values) >= 2, "an axis with one tick has no scale"
        self.fit = np.polyfit(places, np.log10(values) if is_log else values, 1)

    def __call__(self, places):
        if self.fit is None:
            return places
        found = np.polyval(self.fit, places)
        return 10.0**found if self.is_log else found


def plot(html, key, number=1, *, x_of=None, log_y=False):
    """Return axes of a plot; ``x_of`` numbers those that share their x axis and label it."""
    end = html.index(f'<title id="{key}-title"')
    svg = html[html.rindex("<svg", 0, end) : html.index("</svg>", end) + len("</svg>")]
    root = ET.fromstring(svg)
    groups = {g.get("id"): g for g in root.iter("g")}
    axes = groups[f"{key}-axes_{number}"]
    x = None
    if x_of is not None:
        x = Axes(groups[f"{key}-axes_{x_of}"], key).x
    return Axes(axes, key, x=x, log_y=log_y)


def assert_drawn(line, t, y, *, parts=None):
    """Assert that a line is a series: at each of its points, at its ends and at its extremes."""
    points = np.vstack(line.parts)
    size = np.ptp(y)
    # a pixel is 1/150 of the height; lines are simplified by a quarter of one
    wanted = np.interp(points[:, 0], t, y)
    np.testing.assert_allclose(points[:, 1], wanted, atol=0.02 * size + _slope(t, y))
    np.testing.assert_allclose(points[[0, -1], 0], t[[0, -1]], atol=2e-3 * np.ptp(t))
    np.testing.assert_allclose(
        [points[:, 1].min(), points[:, 1].max()], [y.min(), y.max()], atol=0.01 * size
    )
    if parts is not None:
        assert len(line.parts) == parts


def _slope(t, y):
    """Return how far a value may move in a hundredth of a pixel of 400."""
    return np.abs(np.diff(y) / np.diff(t)).max() * np.ptp(t) / 4e4


def _style(text):
    return dict(part.strip().split(": ", 1) for part in text.split(";") if part.strip())


def _parts(path):
    """Return the points of a path's stretches."""
    found = []
    for part in path.get("d").replace("z", " ").split("M")[1:]:
        numbers = [float(x) for x in re.findall(r"-?\d+\.?\d*(?:e-?\d+)?", part)]
        found.append(np.reshape(numbers, (-1, 2)))
    return found
