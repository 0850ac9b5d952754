"""Mass distribution of each link as an ellipsoid, of the URDF and identified."""

from collections.abc import Sequence
from html import escape

import numpy as np

from robotid.base.typing import Array
from robotid.estimation.fitting.fitted import Fit
from robotid.output.pages.html import folded
from robotid.output.viewer.scene import Ellipsoid, ellipsoids
from robotid.robot.geometry import body_points

_WIDTH, _HEIGHT, _MARGIN = 160.0, 104.0, 8.0  # [px] of a picture
_DOT = 3.0  # [px] radius of a centre of mass
_AXES = "xyz"
_LINKS = 12  # more are folded


def ellipsoid_pictures(found: Fit) -> str:
    """Return the equivalent ellipsoids of each link, of the URDF and identified, in a picture.

    An equivalent ellipsoid has uniform density, and mass, centre of mass and inertia of its link.
    More than 12 links are folded.
    """
    size, points = found.model.layout.n_inertial, body_points(found.model)
    before, after = (ellipsoids(pi[:size]) for pi in (found.prior, found.standard))
    bodies = found.model.layout.bodies
    pictures = "".join(
        _picture(body, urdf, identified, points.get(body))
        for body, urdf, identified in zip(bodies, before, after, strict=True)
    )
    html = (
        "<p>The ellipsoid of uniform density with the mass, the centre of mass and the inertia of "
        "each link. Dashed: URDF. Filled: identified. Rectangle: the box around the geometry. The "
        "lengths are those of the axes.</p>\n"
        f'<div class="solids">\n{pictures}</div>\n'
    )
    if len(bodies) > _LINKS:
        return folded("solids", f"Mass distribution of {len(bodies)} links", html)
    return f"<h3>Mass distribution</h3>\n{html}"


def _picture(body: str, urdf: Ellipsoid, identified: Ellipsoid, points: Array | None) -> str:
    """Return a link with its name and sizes, seen along the axis of its frame that it is thin in.

    points (k, 3) [m].
    """
    boxes = [np.array(span) for k in (urdf, identified) if (span := _span(k)) is not None]
    box = None if points is None else np.array([points.min(axis=0), points.max(axis=0)])
    every = np.array([*boxes, *([] if box is None else [box])]).reshape(-1, 3)
    svg = ""
    if len(every):
        low, high = every.min(axis=0), every.max(axis=0)
        plane = sorted(np.argsort(high - low)[1:].tolist(), key=lambda k: -(high - low)[k])
        svg = _drawing(body, plane, (low, high), (urdf, identified), box)
    return (
        f"<figure><figcaption><strong>{escape(body)}</strong><br>{_words(urdf)}<br>→ "
        f"{_words(identified)}</figcaption>{svg}</figure>\n"
    )


def _words(mark: Ellipsoid) -> str:
    """Return mass and lengths of the axes."""
    if mark.semi_axes is None:
        return escape(mark.fault)
    lengths = " × ".join(f"{2 * x:.2g}" for x in sorted(mark.semi_axes.tolist(), reverse=True))
    return f"{mark.mass:.3g} kg, {lengths} m"


def _span(mark: Ellipsoid) -> tuple[Array, Array] | None:
    """Return the corners of the box around an ellipsoid, shape (3,) each [m]."""
    if mark.com is None or mark.semi_axes is None:
        return None
    half = np.linalg.norm(mark.rotation * mark.semi_axes, axis=1)  # (3,), along the frame's axes
    return mark.com - half, mark.com + half


def _drawing(
    body: str,
    plane: Sequence[int],
    ends: tuple[Array, Array],
    marks: tuple[Ellipsoid, Ellipsoid],
    box: Array | None,
) -> str:
    """Return the picture in the plane of two axes of the link's frame."""
    low, high = (end[list(plane)] for end in ends)
    room = np.array([_WIDTH, _HEIGHT - _MARGIN]) - 2 * _MARGIN
    scale = float(np.min(room / np.maximum(high - low, 1e-6)))  # [px/m]
    centre = np.array([_WIDTH, _HEIGHT - _MARGIN]) / 2
    flip = np.array([1.0, -1.0])

    def at(point: Array) -> Array:
        return centre + scale * flip * (point[list(plane)] - (low + high) / 2)

    drawn = ""
    if box is not None:
        (left, bottom), (right, top) = at(box[0]), at(box[1])
        drawn = (
            f'<rect x="{left:.1f}" y="{top:.1f}" width="{right - left:.1f}" '
            f'height="{bottom - top:.1f}"/>'
        )
    for kind, mark in zip(("urdf", "identified"), marks, strict=True):
        if mark.com is None or mark.semi_axes is None:
            continue
        a, b, angle = _ellipse(mark, plane)
        x, y = at(mark.com)
        drawn += (
            f'<g class="{kind}"><ellipse rx="{scale * a:.1f}" ry="{scale * b:.1f}" '
            f'transform="translate({x:.1f} {y:.1f}) rotate({-angle:.1f})"/>'
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{_DOT}"/></g>'
        )
    first, second = (_AXES[k] for k in plane)
    bar = float(f"{0.2 * float(np.max(high - low)):.0e}")  # [m]
    return (
        f'<svg viewBox="0 0 {_WIDTH:.0f} {_HEIGHT:.0f}" role="img" aria-label="Ellipsoids of '
        f'{escape(body)}, {first} to the right, {second} up">{drawn}'
        f'<path class="ruler" d="M{_MARGIN} {_HEIGHT - 2:.0f}h{bar * scale:.1f}"/><text '
        f'x="{_MARGIN + bar * scale + 4:.0f}" y="{_HEIGHT - 1:.0f}">{bar:g} m; {first} →, '
        f"{second} ↑</text></svg>"
    )


def _ellipse(mark: Ellipsoid, plane: Sequence[int]) -> tuple[float, float, float]:
    """Return semi-axes [m] and angle [degrees] of the outline of an ellipsoid along an axis."""
    P = (mark.rotation * mark.semi_axes)[list(plane)]  # (2, 3)
    squares, axes = np.linalg.eigh(P @ P.T)  # of the outline
    a, b = np.sqrt(np.maximum(squares[::-1], 0.0)).tolist()
    return a, b, float(np.degrees(np.arctan2(axes[1, 1], axes[0, 1])))
