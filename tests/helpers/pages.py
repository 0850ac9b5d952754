"""What a page says, read back from its HTML: tables as text, plots in the units of their axes."""

import base64
import json
import math
from dataclasses import dataclass

import lxml.html
import numpy as np


@dataclass
class Table:
    headers: list[str]
    rows: list[list[str]]
    foot: list[str]

    def column(self, head):
        return [row[self.headers.index(head)] for row in self.rows]

    def by_name(self):
        """Return each row as a dictionary, by its head."""
        return {row[0]: dict(zip(self.headers, row, strict=True)) for row in self.rows}


def tables(html):
    """Return the tables of a page by their captions."""
    found = {}
    for table in lxml.html.fromstring(html).iter("table"):
        caption = str(table.xpath("string(caption)"))
        assert caption not in found, "two tables have one caption"
        head, body, foot = (
            [[cell.text_content() for cell in row.iter("th", "td")] for row in table.iterfind(path)]
            for path in ("thead/tr", "tbody/tr", "tfoot/tr")
        )
        found[caption] = Table(head[-1] if head else [], body, foot[-1] if foot else [])
    return found


def number(value, spec=".4g"):
    """Return a number as a page writes it."""
    if value is None or not math.isfinite(value):
        return "–"
    return format(value, spec).replace("-", "−")


def charts(html):
    """Return the data of a page's charts, decoded: what charts.js draws."""
    found = []
    scripts = "//figure[@class='chart']//script[@type='application/json']"
    for script in lxml.html.fromstring(html).xpath(scripts):
        chart = json.loads(script.text)
        chart["x"] = numbers_of(chart["x"])
        for series in chart["series"]:
            series["y"] = numbers_of(series["y"])
            series["half"] = None if series["half"] is None else numbers_of(series["half"])
        found.append(chart)
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
