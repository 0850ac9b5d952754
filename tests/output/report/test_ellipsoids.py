"""The ellipsoids of the links: sizes in words, outlines, the box of the geometry."""

import re

import numpy as np
import pytest

from robotid.output.report.ellipsoids import _picture, ellipsoid_pictures
from robotid.output.viewer.scene import ellipsoids
from robotid.robot.bodies import principal_moments

#: 2 kg, centre (0.1, 0, 0) m, semi-axes 0.3, 0.1, 0.05 m; turned about z by 30 degrees: y is long.
SEMI = np.array([0.3, 0.1, 0.05])
TURN = np.array([[0.5, -(0.75**0.5), 0.0], [0.75**0.5, 0.5, 0.0], [0.0, 0.0, 1.0]])

STRAIGHT = np.eye(3)


def body(semi, R=STRAIGHT, m=2.0, c=(0.1, 0.0, 0.0)):
    c = np.array(c)
    Sigma = m * (R @ np.diag(semi**2) @ R.T / 5 + np.outer(c, c))
    moments = np.trace(Sigma) * np.eye(3) - Sigma
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = moments.tolist()
    return np.array([m, *(m * c), xx, xy, yy, xz, yz, zz])


def mark(*of, **more):
    return ellipsoids(body(*of, **more))[0]


@pytest.mark.parametrize("i", [1, 4])
def test_mass_and_lengths_are_those_of_the_link(identified, i):
    html = ellipsoid_pictures(identified)
    name = identified.model.layout.bodies[i]
    words = re.search(rf"<strong>{name}</strong><br>(.*?)</figcaption>", html)[1]
    for said, pi in zip(
        words.split("<br>→ "), (identified.prior, identified.standard), strict=True
    ):
        own = pi[10 * i : 10 * i + 10]
        lengths = 2 * np.sqrt(5 * principal_moments(own)[0][::-1] / own[0])
        figures = [float(x) for x in re.findall(r"[\d.]+", said)]
        np.testing.assert_allclose(figures, [own[0], *lengths], rtol=0.05)
        assert re.fullmatch(r"[\d.]+ kg, [\d.]+ × [\d.]+ × [\d.]+ m", said)


def test_an_outline_has_the_axes_and_the_angle_of_the_ellipsoid():
    html = _picture("arm", mark(SEMI), mark(SEMI, TURN), np.array([[-0.1, -0.1, 0], [0.7, 0.1, 0]]))
    found = re.findall(r'rx="([\d.]+)" ry="([\d.]+)" transform=.*? rotate\(([-\d.]+)\)', html)
    (a, b, angle), (c, d, turned) = (map(float, item) for item in found)
    assert b / a == pytest.approx(1 / 3, abs=0.01)
    assert [c, d] == pytest.approx([a, b], abs=0.11)
    # 60 degrees from x to y; a picture of x to the right and y up turns the other way
    assert abs(angle) % 180 == pytest.approx(0.0)
    assert turned % 180 == pytest.approx(120.0, abs=0.1)
    assert "x →, y ↑" in html
    assert '<svg viewBox="0 0 160 104"' in html
    scale = a / 0.3
    # 80 px are high enough for the turned ellipsoid; the middle is x = 0.25 m, at (80, 48) px
    assert scale == pytest.approx(40.0 / np.hypot(0.3 * 0.75**0.5, 0.05), rel=2e-3)
    middle = 80.0 - 0.15 * scale
    placed = np.array(re.findall(r"translate\(([\d.]+) ([\d.]+)\)", html), dtype=float)
    np.testing.assert_allclose(placed, [[middle, 48.0]] * 2, atol=0.1)
    dots = np.array(re.findall(r'<circle cx="([\d.]+)" cy="([\d.]+)" r="3.0"', html), dtype=float)
    np.testing.assert_array_equal(dots, placed)
    rectangle = re.search(r'<rect x="(.*?)" y="(.*?)" width="(.*?)" height="(.*?)"', html)
    wanted = [80 - 0.35 * scale, 48 - 0.1 * scale, 0.8 * scale, 0.2 * scale]
    assert [float(x) for x in rectangle.groups()] == pytest.approx(wanted, abs=0.2)
    ruler, length = re.search(r'h([\d.]+)"/><text.*?>([\d.]+) m;', html).groups()
    assert float(ruler) / float(length) == pytest.approx(scale, rel=0.02)


def test_a_link_without_ellipsoid_has_the_reason():
    html = _picture("arm", mark(SEMI), mark(SEMI, m=-1.0), None)
    assert "<br>→ negative mass</figcaption>" in html
    assert html.count("<ellipse") == 1
    nothing = _picture("arm", *ellipsoids(np.zeros(20)), None)
    assert "no mass<br>→ no mass" in nothing
    assert "<svg" not in nothing
