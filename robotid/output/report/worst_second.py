"""The second of a recording with the largest residual of a joint, with a link to the replay."""

from collections.abc import Iterable
from dataclasses import dataclass
from html import escape
from typing import NamedTuple

import numpy as np

from robotid.base.typing import Array
from robotid.output.report.dock import Dock

_WINDOW = 1.0  # [s]
_USED = 0.5  # smallest share of a window's samples that are used


class Residual(NamedTuple):
    """The residual of a joint in a recording.

    Attributes:
        name: Name of the recording.
        file: Name of its file, which the replay states.
        t: Times, shape (N,), increasing [s].
        values: Residuals, shape (N,), NaN for samples that are not used.
    """

    name: str
    file: str
    t: Array
    values: Array


@dataclass(frozen=True)
class WorstSecond:
    """The window of 1 s with the largest RMS residual.

    Attributes:
        of: The recording.
        start: Start of the window, on the recording's clock [s].
        end: Its end [s].
        rms: RMS residual in the window.
        ratio: The same over the RMS residual of the recording.
    """

    of: Residual
    start: float
    end: float
    rms: float
    ratio: float


def worst_second(residuals: Iterable[Residual]) -> WorstSecond | None:
    """Return the window of 1 s with the largest RMS residual of a joint in its recordings.

    Windows with less than half of their samples used are ignored, as those across gaps. A
    recording shorter than 1 s is one window.
    """
    found = [worst for residual in residuals if (worst := _worst(residual)) is not None]
    return max(found, key=lambda worst: worst.rms, default=None)


def _worst(of: Residual) -> WorstSecond | None:
    t, used = of.t, np.isfinite(of.values)
    if len(t) < 2 or not used.any():
        return None
    squares = np.append(0.0, np.cumsum(np.where(used, of.values, 0.0) ** 2))
    counts = np.append(0, np.cumsum(used))
    step = float(np.median(np.diff(t)))
    first = np.arange(max(1, int(np.searchsorted(t, t[-1] - _WINDOW + 1.5 * step, side="right"))))
    last = np.searchsorted(t, t[first] + _WINDOW - step / 2)  # exclusive
    count = counts[last] - counts[first]
    enough = count >= _USED * min(_WINDOW / step, len(t))
    if not enough.any():
        return None
    mean = np.where(enough, (squares[last] - squares[first]) / np.maximum(count, 1), -1.0)
    k = int(mean.argmax())
    whole = squares[-1] / counts[-1]
    end = min(float(t[k]) + _WINDOW, float(t[-1]))
    ratio = (mean[k] / (whole or 1.0)) ** 0.5
    return WorstSecond(of, float(t[k]), end, float(mean[k] ** 0.5), float(ratio))


def worst_html(
    worst: WorstSecond | None, joint: str, unit: str, dock: Dock, scale: float = 1.0
) -> str:
    """Return a paragraph on the worst second of a joint; nothing without one."""
    if worst is None:
        return ""
    link = dock.link("Show this second in the replay", worst.start, joint, worst.of.file)
    return (
        f'<p class="worst">Largest residual within 1 s: {escape(worst.of.name)}, '
        f"{worst.start:.2f} to {worst.end:.2f} s, RMS {worst.rms / scale:.3g} {unit}, "
        f"{worst.ratio:.2g} times the RMS of the recording. {link}</p>\n"
    )
