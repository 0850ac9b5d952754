"""Colours of the pages that differ for readers with protanopia, too."""

import itertools
import re

import numpy as np
import pytest

from robotid.output.pages.html import asset
from robotid.output.report.pictures import why_charts

#: Linear RGB as seen with protanopia and deuteranopia; Machado, Oliveira, Fernandes (2009).
SEEN = {
    "all": np.eye(3),
    "protanopia": np.array([
        [0.152286, 1.052583, -0.204868],
        [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998],
    ]),
    "deuteranopia": np.array([
        [0.367322, 0.860646, -0.227968],
        [0.280085, 0.672501, 0.047413],
        [-0.011820, 0.042940, 0.968881],
    ]),
}  # fmt: skip
TO_XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
WHITE = TO_XYZ.sum(axis=1)
AREA = 0.7  # opacity of an area
LEAST = 20.0  # CIE 1976 colour difference


def tones(part):
    light, dark = asset("tones.css").split("@media")
    pairs = re.findall(r"--([\w-]+): (#[0-9a-f]{3,6})", {"light": light, "dark": dark}[part])
    return {
        name: np.array([int(x, 16) for x in re.findall("..", full(code))]) for name, code in pairs
    }


def full(code):
    return code[1:] if len(code) == 7 else "".join(2 * x for x in code[1:])


def lab(colour, seen):
    c = colour / 255
    linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    x = TO_XYZ @ np.clip(SEEN[seen] @ linear, 0, 1) / WHITE
    f = np.where(x > 0.008856, np.cbrt(x), 7.787 * x + 16 / 116)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


@pytest.mark.parametrize("part", ["light", "dark"])
@pytest.mark.parametrize("seen", SEEN)
def test_friction_and_residual_differ_as_areas_of_one_chart(identified, part, seen):
    from robotid.diagnosis.residual.torque_split import joint_torques

    (torque, *_) = joint_torques(identified)
    chart = why_charts(torque, link="", points=100)["split"]
    tone = {series.label: series.tone for series in chart.series}
    colours = tones(part)
    a, b = (
        lab(AREA * colours[tone[name]] + (1 - AREA) * colours["page"], seen)
        for name in ("friction", "residual")
    )
    assert np.linalg.norm(a - b) > LEAST


@pytest.mark.parametrize("part", ["light", "dark"])
@pytest.mark.parametrize("seen", SEEN)
def test_colours_of_sources_differ(part, seen):
    colours = {name: x for name, x in tones(part).items() if name.startswith("from-")}
    assert len(colours) == 5
    for a, b in itertools.combinations(colours.values(), 2):
        assert np.linalg.norm(lab(a, seen) - lab(b, seen)) > LEAST
