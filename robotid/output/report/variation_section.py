"""Section on the variation of drive parameters between logs."""

from collections.abc import Mapping
from html import escape

import numpy as np

from robotid.estimation.variation.variation import Variation, VaryingParameter
from robotid.output.pages.html import Cell, code, table, text, with_error

_ROOM = 0.15  # of the prediction interval, beyond the farthest mark


def variation_section(variation: Variation | None, torques: Mapping[str, str]) -> str:
    """Return the values of drive parameters in each log, and the prediction of the next log."""
    if variation is None:
        return ""
    different = {(each.run, each.name) for each in variation.unlike}
    rows = []
    for each in variation.parameters:
        name, *figures = _figures(each)
        rows.append([name, Cell(_marks(each, variation.runs, different), "text"), *figures])
    new, members, one = ("log of this robot", "logs", "log")
    if variation.units > 1:
        new, members, one = (f"robot (after {variation.units})", "robots", "robot")
    headers = ["parameter", "in each log", "mean", "± error", "spread", "low", "high", "unit",
               "± error with one more", "width with one more"]  # fmt: skip
    caption = f"Drive parameters in {len(variation.runs)} logs; low to high: 95 % of the next {new}"
    intro = (
        f"<p>Mean and its standard error; standard deviation between {members} (spread), median of "
        f"its estimate. The next {new} lies between low and high with 95 % probability: the shaded "
        "range. Links are the same in all logs. Last columns: expected error of the mean, and "
        f"width from low to high, with one more {one}, in % of those of today.</p>\n"
    )
    if torques:
        own = ", ".join(f"{escape(row)} {error}" for row, error in torques.items())
        intro += (
            f"<p>Expected RMS torque error of the next {one}, on motions like these: {own}.</p>\n"
        )
    return intro + table(caption, headers, rows, is_data=True)


def _figures(each: VaryingParameter) -> list[Cell]:
    """Return the cells of numbers of a parameter."""
    found = each.prediction
    mean, error = with_error(found.mean, found.std_error)
    low, high = (with_error(float(x), found.std_error)[0] for x in found.ends)
    spread = with_error(found.spread, found.spread)[1]
    less, narrower = found.after[0] / found.std_error, found.after[1] / float(np.ptp(found.ends))
    more = [text(f"{100 * share:.0f} %") for share in (less, narrower)]
    return [code(each.name), mean, error, spread, low, high, text(each.unit), *more]


def _marks(each: VaryingParameter, runs: tuple[str, ...], different: set[tuple[int, str]]) -> str:
    """Return a mark for the value in each log, over the prediction interval of the next."""
    low, high = (float(x) for x in each.prediction.ends)
    first, last = min(low, *each.values), max(high, *each.values)
    room = _ROOM * (last - first)

    def at(x: float) -> str:
        return f"{100 * (x - first + room) / (last - first + 2 * room):.1f}%"

    dots = ""
    for k, (run, value, error) in enumerate(zip(runs, each.values, each.std_errors, strict=True)):
        (shown, of), kind = with_error(value, error), "data"
        if (k, each.name) in different:
            kind = "bound"
        dots += (
            f'<g class="from-{kind}"><title>{escape(run)}: {shown.html} ± {of.html} {each.unit}'
            f'</title><circle cx="{at(value)}" cy="9" r="3.5"/></g>'
        )
    return (
        '<svg class="logs" height="18" role="img" aria-label="values in each log">'
        f'<line class="half from-prior" x1="{at(low)}" x2="{at(high)}" y1="9" y2="9"/>{dots}</svg>'
    )
