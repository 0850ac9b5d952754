"""Everything that leaves a command, made comparable with what a file holds of it.

Numbers are compared as numbers, those inside sentences and pages, too; texts exactly. What changes
from run to run is left out: times taken, versions, hashes, the folder.
"""

import base64
import io
import json
import math
import os
import re
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from unittest import mock

import lxml.html
import numpy as np
from scipy.spatial.transform import Rotation

from helpers.pages import numbers_of
from robotid.cli import main

HERE = Path(__file__).resolve().parents[1] / "figures"
RELATIVE = 2e-5  # of a figure
_OF_SPREAD = 3e-4  # of a standard error, of the ends of an interval of its width
_OF_MARGIN = 2e-3  # of a limit
#: How often that is allowed where an iteration ends by a tolerance: fits of roll-outs, of gains,
#: the search of a motion.
_TIMES = {"commands": 300.0, "payload": 40.0, "design": 60.0}
FLOOR = 1e-6  # of the largest of a list
_DIGITS = 7
_OF_CHART = 5  # digits: of numbers of 16 bits, or of pixels
_SINGULAR = 1e6  # condition numbers from which on rounding makes them
_LONG = 24  # numbers of a list that is told by a few of its own
_LEFT_OUT = {
    "versions", "sha256", "seconds", "robotid", "urdf_sha256", "log_sha256", "platform",
    "root",  # of a covariance: rounding turns it
}  # fmt: skip
_NUMBER = re.compile(r"(?<![\w.])[-−+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?(?![\w]|\.\d)")
_VARIES = re.compile(
    r"\b\d+(?:\.\d+)? (?:ms|s|min) of (?:processor|wall)|\d+\.\d+\.\d+|\bin \d+\.\d s\b"
    r"|\b\d+\.\d s(?=, \d+ start)|(?<=\| platform \| ).+"
)


# ---- running ---------------------------------------------------------------------------------


class Runs:
    """Commands in a folder, and what they printed and wrote, by name."""

    def __init__(self, folder):
        self.folder = Path(folder)
        self.documents = {}

    def run(self, name, line, code=0):
        """Run what follows ``robotid``, @ being the folder; keep and return what it prints."""
        # The exit code is ``code``; if that is None, it is kept, too.
        words = line.replace("@", f"{self.folder}/").split()
        out, err = io.StringIO(), io.StringIO()
        surroundings = {"COLUMNS": "100", "NO_COLOR": "1"}
        with mock.patch.dict(os.environ, surroundings), redirect_stdout(out), redirect_stderr(err):
            try:
                ended = main(words)
            except SystemExit as end:  # of words that argparse refuses
                ended = f"{end}: {err.getvalue()}"
        if code is None:
            self.documents[f"{name}, exit code"] = ended
        assert code in (None, ended), (
            f"robotid {' '.join(words)} ended with {ended}: {err.getvalue()}"
        )
        text = out.getvalue()
        if "--json" in words or words[0] == "schema":
            content = json.loads(text)
            self.documents[name] = self.scrubbed(content)
        else:
            content = text
            self.documents[name] = self.lines(text)
        if err.getvalue():
            self.documents[f"{name}, stderr"] = self.lines(err.getvalue())
        return content

    def keep(self, name, path, part=lambda content: content):
        """Keep a file that was written, of JSON a part of it, and return its content."""
        path = self.folder / path
        text = path.read_text()
        if path.suffix == ".json":
            content = json.loads(text)
            self.documents[name] = self.scrubbed(part(content))
            return content
        if path.suffix == ".html":
            self.documents[name] = self.scrubbed(page_content(text))
        elif path.suffix == ".csv":
            self.documents[name] = self.scrubbed(table_content(path))
        else:
            self.documents[name] = self.lines(text)
        return text

    def lines(self, text):
        """Return the lines of a text, blanks inside them counting as one."""
        lines = _with_tensors(text).split("\n")
        return [line for line in map(self.line, lines) if line.strip()]

    def line(self, text):
        text = text.replace(str(self.folder), "FOLDER")
        text = re.sub(r"(condition number) (?:\d{7,}|infinite)", r"\1 of a singular matrix", text)
        indent = text[: len(text) - len(text.lstrip())]
        return _shortened(indent + " ".join(_VARIES.sub("...", text).split()))

    def scrubbed(self, value, key=""):
        """Return a JSON value without what changes from run to run, figures rounded."""
        if isinstance(value, dict):
            if "principal_axes" in value:
                moments = [x["nominal"] for x in value["principal_moments"].values()]
                value = value | {"principal_axes": _tensor(value["principal_axes"], moments)}
            return {k: self.scrubbed(x, k) for k, x in value.items() if k not in _LEFT_OUT}
        if key == "condition_number" and (value is None or value > _SINGULAR):
            return "of a singular matrix"
        if isinstance(value, list):
            if key == "history" and all(isinstance(x, list) for x in value):  # when, how good
                value = [row[1:] for row in value]
            if len(value) > _LONG and all(isinstance(x, int | float) for x in value):
                return summary(value)
            return [self.scrubbed(x, key) for x in value]
        if isinstance(value, str):
            return self.line(value)
        return rounded(value)


#: Axes and moments of an inertia. Which axis is which, and whose sign is plus, is a matter of
#: rounding: what is kept is the tensor.
_INERTIA = re.compile(r'<inertial .*?quat="([^"]+)".*? diaginertia="([^"]+)"')
_AXES = re.compile(r'(?<="principal_axes": \[)([^]]+)(?=\]\n(?:.*\n){4}.*principal_moments)')
_MOMENT = re.compile(r'"I(?:xx|yy|zz)": {nominal: ([^,]+)')


def _tensor(axes, moments):
    """Return the inertia (xx, xy, xz, yy, yz, zz) of principal axes w, x, y, z and moments."""
    R = Rotation.from_quat(axes, scalar_first=True).as_matrix()
    tensor = (R * moments) @ R.T
    return tensor[np.triu_indices(3)].tolist()


def _told(axes, moments):
    """Return that inertia as text, to five digits of the largest moment."""
    digits = 4 - math.floor(math.log10(max(moments)))
    return ", ".join(f"{round(x, digits) + 0.0:.{digits}f}" for x in _tensor(axes, moments))


def _numbers(text):
    return [float(word) for word in text.replace(",", " ").split()]


def _with_tensors(text):
    """Return a text whose principal axes are told by the inertia in the link's frame."""

    def of_ranges(found):
        moments = _MOMENT.findall(text, found.end())[:3]
        return _told(_numbers(found[0]), _numbers(" ".join(moments)))

    def of_mjcf(found):
        return found[0].replace(found[1], _told(*map(_numbers, found.groups())))

    return _INERTIA.sub(of_mjcf, _AXES.sub(of_ranges, text))


def rounded(value, digits=_DIGITS):
    """Return a number to a few digits; whole numbers and what is none as they are."""
    if isinstance(value, float) and math.isfinite(value):
        return float(f"{value:.{digits}g}")
    return value if not isinstance(value, float) else str(value)


def _shortened(text):
    """Return a text whose numbers of many digits have fewer."""

    def shorter(found):
        word = found.group()
        return f"{float(word):.{_DIGITS}g}" if len(re.sub(r"[eE].*|\D", "", word)) > 9 else word

    return _NUMBER.sub(shorter, text)


def summary(values, digits=_DIGITS):
    """Return a few figures that tell an array: sizes, ends, weighted means."""
    x = np.array([math.nan if v is None else v for v in values], dtype=float)
    finite = np.isfinite(x)
    told = {"of": [int(finite.sum()), len(x)]}
    if not finite.any():
        return told
    ramp, y = np.linspace(0, 1, len(x))[finite], x[finite]
    size = float(np.sqrt(np.mean(y**2)))
    # first, last, least, most, root mean square, mean, mean along a ramp
    figures = [y[0], y[-1], y.min(), y.max(), size, y.mean(), np.mean(ramp * y)]
    return told | {"are": [rounded(float(f), digits) for f in figures]}


# ---- files -----------------------------------------------------------------------------------


def table_content(path):
    """Return the columns of a CSV, each told by a few figures."""
    head, *rows = path.read_text().splitlines()
    columns = zip(*(row.split(",") for row in rows), strict=True)
    return {
        name: summary([float(x) if x else None for x in column])
        for name, column in zip(head.split(","), columns, strict=True)
    }


_BLOCKS = frozenset((
    "p", "li", "tr", "h1", "h2", "h3", "h4", "figcaption", "summary", "pre", "dd", "dt",
    "figure", "div", "section", "header", "caption", "table", "svg", "ol", "ul", "dl",
))  # fmt: skip
_BREAK = "\u2029"  # between lines of a page
_COORDINATE = re.compile(r"-?\d+\.?\d*")


def page_content(html):
    """Return what a page shows: texts and links, charts' data, a few figures of each drawing."""
    page = lxml.html.fromstring(html)
    lxml.html.etree.strip_tags(page, "wbr")  # which breaks words
    data = page.xpath("//script[@type='application/json' or (@id and not(@type))]/text()")
    drawn = [_coordinates(svg) for svg in page.xpath("//svg[not(ancestor::svg)]")]
    for element in page.xpath("//script | //style | //svg//text()[not(parent::title)]/.."):
        element.text = ""  # words of a drawing are those of its chart's data
    for element in page.iter(lxml.html.etree.Element):
        href = element.get("href", "")
        told = [element.get(key) for key in ("aria-label", "title", "style")]
        told.insert(2, "" if href.startswith("#") else href)
        told += ["open"] * ("open" in element.attrib)
        words = [f"[{word}]" for word in told if word]
        words += ["|"] * (element.tag in ("td", "th"))
        if element.tag in ("tr", "div", "td") and element.get("class"):
            words.append(f"({element.get('class')})")
        edge = _BREAK if element.tag in _BLOCKS else " "
        element.text = f"{edge}{' '.join(words)} {element.text or ''}"
        element.tail = f"{edge}{element.tail or ''}"
    lines = (" ".join(line.split()) for line in page.text_content().split(_BREAK))
    # how long a design took is drawn, too
    shown = [] if "computing time [s]" in html else [x for x in drawn if len(x) > _LONG]
    return {
        "texts": [line for line in lines if line],
        "charts": [unpacked(json.loads(text)) for text in data],
        "drawings": [summary(x, _OF_CHART) for x in shown],
    }


def _coordinates(svg):
    """Return the numbers of a drawing's attributes."""
    texts = [
        value for element in svg.iter(lxml.html.etree.Element)
        for key, value in element.attrib.items()
        if key not in ("id", "href", "viewbox", "aria-labelledby", "class", "role")
    ]  # fmt: skip
    return [float(x) for text in texts for x in _COORDINATE.findall(text)]


def unpacked(value):
    """Return the data of a chart with its packed numbers told by a few figures."""
    if isinstance(value, dict):
        if {"data", "kind", "shape"} <= value.keys():
            if "step" not in value:
                return told_columns(value)
            if len(value["shape"]) > 1:
                return {"low": value["low"], "step": value["step"], "codes": told_columns(value)}
            is_log = {"is_log": True} if "log" in value else {}
            return summary(numbers_of(value), _OF_CHART) | is_log
        usual = {"is_weak": False, "is_hidden": False, "half": None, "marks": [], "logarithmic": "",
                 "x_names": [], "spans": []}  # fmt: skip
        if value.get("x_label") == "computing time [s]":
            value = {key: x for key, x in value.items() if key != "x"}
        return {k: unpacked(x) for k, x in value.items() if k not in usual or x != usual[k]}
    return [unpacked(x) for x in value] if isinstance(value, list) else value


def told_columns(packed):
    """Return a few figures of each column of an array of a replay, at most eight of them."""
    data = np.frombuffer(base64.b64decode(packed["data"]), dtype=packed["kind"]).astype(float)
    columns = data.reshape(packed["shape"][0], -1).T
    told = [summary(column, _OF_CHART) for column in columns[:8]]
    return {"shape": packed["shape"], "columns": told}


# ---- comparing -------------------------------------------------------------------------------


def differences(stored, found, at="", *, times=1.0, room=0.0):
    """Yield where two values differ, and how."""
    # Typical tolerances are allowed ``times``, and a difference of ``room`` whatever the size.
    if isinstance(stored, dict) and isinstance(found, dict):
        beside = room or times * _spread(stored)
        for key in sorted(stored.keys() | found.keys()):
            if key not in found or key not in stored:
                yield f"{at}/{key}: {'gone' if key in stored else 'new'}"
                continue
            place = f"{at}/{key}"
            yield from differences(stored[key], found[key], place, times=times, room=beside)
    elif isinstance(stored, list) and isinstance(found, list):
        if len(stored) != len(found):
            yield f"{at}: {len(stored)} entries stored, {len(found)} found"
        largest = max((abs(x) for x in stored if _is_number(x)), default=0.0)
        of_largest = RELATIVE if at.endswith("/principal_axes") else FLOOR
        floor = room or times * of_largest * largest
        for i, (x, y) in enumerate(zip(stored, found, strict=False)):
            yield from differences(x, y, f"{at}/{i}", times=times, room=floor)
    elif _is_number(stored) and _is_number(found):
        if isinstance(stored, int) and isinstance(found, int):
            is_same = stored == found
        else:
            of_size = _OF_SPREAD if ("std_error" in at or "half_width" in at) else RELATIVE
            is_same = abs(stored - found) <= times * of_size * abs(stored) + room + 1e-12
        if not is_same:
            yield f"{at}: {stored} stored, {found} found"
    elif isinstance(stored, str) and isinstance(found, str):
        if not same_text(stored, found, times):
            yield f"{at}: stored, found\n    {stored}\n    {found}"
    elif stored != found or type(stored) is not type(found):
        yield f"{at}: {stored!r} stored, {found!r} found"


def _spread(entry):
    """Return what values may differ by beside the standard error or interval of an entry."""
    error = entry.get("std_error", entry.get("mass_std_error"))
    if "margin" in entry:
        return _OF_MARGIN
    if isinstance(entry.get("low"), float):
        error = (entry["high"] - entry["low"]) / 2
    return _OF_SPREAD * error if isinstance(error, int | float) else 0.0


def _is_number(x):
    return isinstance(x, int | float) and not isinstance(x, bool)


def same_text(stored, found, times=1.0):
    """Return whether texts are the same but for the last digit of a number with decimals."""
    if stored == found:
        return True
    if _NUMBER.sub("#", stored) != _NUMBER.sub("#", found):
        return False
    spread = 0.0
    if ends := re.search(r"low: (\S+), high: (\S+?)[,}]", stored):
        spread = times * _OF_SPREAD * (float(ends[2]) - float(ends[1]))
    pairs = zip(_NUMBER.finditer(stored), _NUMBER.finditer(found), strict=True)
    return all(_same_number(x, y, times, spread) for x, y in pairs)


def _same_number(stored, found, times, spread):
    a, b = (x.group().replace("−", "-") for x in (stored, found))
    if a == b:
        return True
    if re.fullmatch(r"[-+]?\d+", a) and re.fullmatch(r"[-+]?\d+", b):  # a count, or of few digits
        behind = stored.string[stored.end() : stored.end() + 2]
        is_measured = behind.strip()[:1] in ("%", "°") or (times > 1 and abs(int(a)) >= 100)
        return is_measured and abs(int(a) - int(b)) <= 1
    unit = max(_last_digit(a), _last_digit(b))
    room = (1.01 if times == 1 else 5.0) * unit + times * RELATIVE * abs(float(a)) + spread + 1e-9
    return abs(float(a) - float(b)) <= room


def _last_digit(word):
    """Return what one of the last digit of a printed number is worth."""
    mantissa, _, power = word.lower().partition("e")
    decimals = len(mantissa.partition(".")[2])
    return 10.0 ** (int(power or 0) - decimals)


# ---- storing ---------------------------------------------------------------------------------


def path_of(name):
    return HERE / f"{name}.json"


def write(name, documents):
    """Write the documents of a scenario, keys sorted, a list of numbers on one line."""
    path_of(name).write_text(_dumped(documents) + "\n")


def _dumped(value, indent=""):
    """Return JSON in lines of up to 150 letters where that is possible."""
    whole = json.dumps(value, ensure_ascii=False, sort_keys=True)
    is_deep = isinstance(value, dict | list) and any(
        isinstance(x, dict | list | str) for x in value
    )
    if not is_deep or len(whole) + len(indent) < (150 if isinstance(value, dict) else 100):
        return whole
    more = indent + " "
    if isinstance(value, dict):
        items = [f"{more}{json.dumps(k)}: {_dumped(value[k], more)}" for k in sorted(value)]
        return "{\n" + ",\n".join(items) + "\n" + indent + "}"
    return "[\n" + ",\n".join(more + _dumped(x, more) for x in value) + "\n" + indent + "]"


def check(name, documents):
    """Fail with all that differs from what is stored of a scenario."""
    stored = json.loads(path_of(name).read_text())
    # as a file has them: keys are texts, tuples are lists
    found = json.loads(json.dumps(documents))
    odd = list(differences(stored, found, times=_TIMES.get(name, 1.0)))
    more = f"\n... and {len(odd) - 30} more" if len(odd) > 30 else ""
    assert not odd, (
        f"figures of {name} differ from tests/figures/{name}.json; if the change is meant, run "
        f"`python tests/figures/write.py {name}` and look at the diff:\n"
        + "\n".join(odd[:30])
        + more
    )
