"""What a page says, read back from its HTML: tables as text, plots in the units of their axes."""

import base64
import json
import math
import re
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
        what["x"] = numbers_of(what["x"])
        for series in what["series"]:
            series["y"] = numbers_of(series["y"])
            series["half"] = None if series["half"] is None else numbers_of(series["half"])
        found.append(what)
    return found


def chart(html, title):
    """Return the data of the one chart whose title begins so."""
    (found,) = [what for what in charts(html) if what["title"].startswith(title)]
    return found


def numbers_of(packed):
    """Return the numbers of an array in a page; of steps, the last code is NaN."""
    codes = np.frombuffer(base64.b64decode(packed["data"]), packed["kind"])
    codes = codes.reshape(packed["shape"])
    if "step" not in packed:
        return codes
    values = np.array(packed["low"]) + np.array(packed["step"]) * codes
    values = np.where(codes == np.iinfo(codes.dtype).max, np.nan, values)
    return 10.0**values if packed.get("log") else values


def bars(html):
    """Return by joint, in order, where its bar ends and where each mark stands [%]."""
    found = {}
    for row in re.findall(r"<li class=\"[\w-]*\">(<a .*?)</li>", html, flags=re.DOTALL):
        name = re.sub(r"<[^>]*>", "", row[: row.index("</a>")])
        width = re.search(r'<rect y="4" width="([\d.]*)%"', row)
        marks = [float(x) for x in re.findall(r'<svg x="([\d.]*)%"', row)]
        found[name] = (float(width[1]), marks)
    return found
