"""Picture of the parameters of all links: URDF and identified, with intervals and sources."""

from html import escape
from typing import NamedTuple

import numpy as np

from robotid.base.typing import Array
from robotid.diagnosis.verdict.central import CENTRAL_TERMS, central_parameters
from robotid.estimation.fitting.fitted import Fit
from robotid.output.pages.html import folded, number, with_error
from robotid.output.report.tables import SOURCE_NAMES

_ROW = 22  # [px] of a link
_LINKS = 12  # more are folded
_ROOM = 0.06  # of the range, beyond the largest and the smallest value
_NEAR = 15.0  # [%] from the edge, of a tick with its number on the left


class _Group(NamedTuple):
    title: str
    unit: str
    columns: slice
    is_root: bool  # whether the axis is a signed square root


_GROUPS = (
    _Group("Mass", "kg", slice(0, 1), False),
    _Group("Centre of mass", "m", slice(1, 4), False),
    _Group("Moments of inertia about it", "kg m²", slice(4, 7), True),
    _Group("Products of inertia", "kg m²", slice(7, 10), True),
)


def parameter_picture(found: Fit) -> str:
    """Return masses, centres of mass and inertias about them of all links as a picture.

    Each value has a mark for the URDF, one for the identified value, coloured by what determined
    it, and its 95 % interval. More than 12 links are folded.
    """
    central, bodies = central_parameters(found), found.model.layout.bodies
    names = "".join(f"<span>{escape(body)}</span>" for body in bodies)
    groups = ""
    for group in _GROUPS:
        axis = _Axis.around(central.urdf, central.values, group)
        columns = ""
        for k in range(len(CENTRAL_TERMS))[group.columns]:
            marks = "".join(
                _mark(
                    f"{body} {CENTRAL_TERMS[k]}",
                    (central.urdf[i, k], central.values[i, k], central.half[i, k]),
                    central.sources[i, k],
                    group.unit,
                    axis,
                    _ROW * i + _ROW // 2,
                )
                for i, body in enumerate(bodies)
            )
            columns += (
                f'<div><span class="term">{CENTRAL_TERMS[k]}</span>'
                f'<svg height="{_ROW * len(bodies)}" role="img" '
                f'aria-label="{CENTRAL_TERMS[k]} of each link">{axis.lines}{marks}</svg>'
                f"{axis.scale}</div>"
            )
        groups += (
            f'<div class="values"><h3>{group.title} <span class="note">[{group.unit}]</span></h3>'
            f'<div><div class="names">{names}</div>{columns}</div></div>\n'
        )
    picture = f'{_legend()}<div class="inertials">\n{groups}</div>\n'
    if len(bodies) > _LINKS:
        return folded("inertials", f"Parameters of {len(bodies)} links as a picture", picture)
    return picture


class _Axis(NamedTuple):
    """An axis from 0 to 100 % of the width, which all columns of a group have."""

    low: float
    high: float
    is_root: bool

    @classmethod
    def around(cls, urdf: Array, values: Array, group: _Group) -> "_Axis":
        """Return the axis that contains all values, of the URDF and identified, and 0."""
        every = np.concatenate([urdf[:, group.columns].ravel(), values[:, group.columns].ravel()])
        ends = cls._moved(np.append(every[np.isfinite(every)], 0.0), group.is_root)
        low, high = float(ends.min()), float(ends.max())
        room = _ROOM * ((high - low) or 1.0)
        return cls(low - room, high + room, group.is_root)

    @staticmethod
    def _moved(x: Array, is_root: bool) -> Array:
        return np.sign(x) * np.sqrt(np.abs(x)) if is_root else x

    def at(self, x: float) -> float:
        """Return the place of a value [%], at most slightly beyond the edges."""
        moved = float(self._moved(np.asarray(x), self.is_root))
        return float(np.clip(100 * (moved - self.low) / (self.high - self.low), -5, 105))

    @property
    def ticks(self) -> list[float]:
        """0, and a round number near the end that is farthest from it."""
        end = max(self.low, self.high, key=abs)
        return [0.0, _round(np.sign(end) * end**2 if self.is_root else end)]

    @property
    def lines(self) -> str:
        return "".join(
            f'<line class="tick" x1="{self.at(x):.1f}%" x2="{self.at(x):.1f}%" y2="100%"/>'
            for x in self.ticks
        )

    @property
    def scale(self) -> str:
        """The numbers below the axis, those near the right edge on the left of their lines."""
        spans = ""
        for x in self.ticks:
            at, words = self.at(x), number(x, ".3g").html
            place = f"left: {at:.0f}%" if at < 100 - _NEAR else f"right: {100 - at:.0f}%"
            spans += f'<span style="{place}">{words}</span>'
        return f'<div class="ticks" aria-hidden="true">{spans}</div>'


def _round(x: float) -> float:
    """Return the number of one digit next to x, towards zero."""
    power = 10.0 ** np.floor(np.log10(abs(x) or 1.0))
    return float(f"{np.trunc(x / power) * power:.1g}")


def _mark(
    name: str, of: tuple[float, float, float], source: str, unit: str, axis: _Axis, y: int
) -> str:
    """Return the marks of one parameter, with its figures as a title."""
    urdf, value, half = of
    if not np.isfinite(value):
        return ""
    (written, error), before, interval = with_error(value, half), "", ""
    words = written.html
    if np.isfinite(half):
        words += f" ± {error.html}"
        left, right = (f"{axis.at(x):.1f}%" for x in (value - half, value + half))
        interval = f'<line class="half" x1="{left}" x2="{right}" y1="{y}" y2="{y}"/>'
    at = f"{axis.at(value):.1f}%"
    if np.isfinite(urdf):
        words = f"{with_error(urdf, half)[0].html} → {words}"
        was = f"{axis.at(urdf):.1f}%"
        before = (
            f'<line class="way" x1="{was}" x2="{at}" y1="{y}" y2="{y}"/>'
            f'<circle class="urdf" cx="{was}" cy="{y}" r="4"/>'
        )
    title = f"{escape(name)}: {words} {unit}, {SOURCE_NAMES[source]}"
    return (
        f'<g class="from-{source}"><title>{title}</title>{interval}{before}'
        f'<circle cx="{at}" cy="{y}" r="3.5"/></g>'
    )


def _legend() -> str:
    """Return the meaning of marks and colours."""
    dot = _key('<circle cx="5" cy="5" r="3.5"/>')
    dots = "".join(
        f'<span class="from-{source}">{dot}{SOURCE_NAMES[source]}</span>'
        for source in ("data", "mixed", "prior", "bound")
    )
    before = _key('<circle class="urdf" cx="5" cy="5" r="4"/>')
    interval = _key('<path class="half" d="M0 5h24"/>', 24)
    return (
        f'<p class="legend"><span>{before}URDF</span> Identified, by what determined it: {dots}'
        f'<span class="from-data">{interval}95 % interval, cut off at the edge.</span>'
        "Axes of the joint frame; square-root scale of inertias.</p>\n"
    )


def _key(drawn: str, width: int = 10) -> str:
    return f'<svg width="{width}" height="10" aria-hidden="true">{drawn}</svg>'
