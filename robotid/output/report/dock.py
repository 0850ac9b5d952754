"""The replay in a report: a frame at the lower edge of the window, on the clock of its charts.

The frame is loaded when it is asked for. Its file may be written after the report: dock.js finds
out whether it is there. A link leads to the second with the largest residual.
"""

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import NamedTuple
from urllib.parse import quote, urlencode

import numpy as np

from robotid.base.typing import Array
from robotid.output.pages.html import block, command_html
from robotid.output.report.next_steps import Origin

_WORDS = "shows the robot in motion, on the clock of these charts"
_WINDOW = 1.0  # [s]
_USED = 0.5  # smallest share of a window's samples that are used


class Clip(NamedTuple):
    """A recording with charts: the name that links them, its file or "", first and last time."""

    link: str
    log: str
    start: float
    end: float


@dataclass(frozen=True)
class Dock:
    """The replay of a report."""

    replay: str = ""  # file of the replay in the report's folder; "" if it is not written yet
    # folder of the results, for the command that writes the replay
    origin: Origin = field(default_factory=Origin)
    urdf: str = ""
    clips: Sequence[Clip] = ()  # the recordings with charts

    @property
    def file(self) -> str:
        """File of the replay, written or not; "" if there cannot be one."""
        has_command = any(map(self._command, self.clips))
        return self.replay or (self.origin.replay if has_command else "")

    def _command(self, clip: Clip) -> str:
        words = self.origin.using("replay", self.urdf, clip.log, self.origin.folder)
        return "".join(words) if clip.log else ""

    def link(self, words: str, start: float, joint: str, log: str) -> str:
        """Return the HTML of a link to a time of the replay; "" without replay."""
        if not self.file:
            return ""
        there = urlencode({"t": f"{start:.3f}", "joint": joint, "log": log}, quote_via=quote)
        to = f"{quote(self.replay)}#{there}" if self.replay else "#replay"
        return (
            f'<a href="{escape(to)}" target="{"replay" if self.replay else "_self"}" '
            f'data-at="{escape(there)}">{words}</a>'
        )

    @property
    def html(self) -> str:
        """The button that shows the replay, or the command that writes it; "" without replay."""
        if not self.file:
            return ""
        clips = [
            clip._asdict() | {"log": Path(clip.log).name, "command": self._command(clip)}
            for clip in self.clips
        ]
        words, command = f'<a href="{escape(quote(self.replay))}">The replay</a> {_WORDS}.', ""
        if not self.replay:
            words = f"The replay {_WORDS}. This command writes it:"
            command = command_html(next(filter(None, map(self._command, self.clips))))
        return block(
            "report.dock",
            file=escape(quote(self.file)),
            clips=escape(json.dumps(clips)),
            words=words,
            command=command and f'<div class="copy">{command}</div>',
        )


class Residual(NamedTuple):
    """The residual of a joint in a recording."""

    name: str  # name of the recording
    file: str  # name of its file, which the replay states
    t: Array  # times, shape (N,), increasing [s]
    values: Array  # residuals, shape (N,), NaN for samples that are not used


@dataclass(frozen=True)
class WorstSecond:
    """The window of 1 s with the largest RMS residual, and its ratio to the RMS of the log."""

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
    windows = [worst for residual in residuals if (worst := _worst(residual)) is not None]
    return max(windows, key=lambda worst: worst.rms, default=None)


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
    end = min(float(t[k]) + _WINDOW, float(t[-1]))
    ratio = (mean[k] / (squares[-1] / counts[-1] or 1.0)) ** 0.5
    return WorstSecond(of, float(t[k]), end, float(mean[k] ** 0.5), float(ratio))


def worst_html(
    worst: WorstSecond | None, joint: str, unit: str, dock: Dock, scale: float = 1.0
) -> str:
    """Return a paragraph on the worst second of a joint; nothing without one."""
    if worst is None:
        return ""
    return block(
        "report.worst",
        name=escape(worst.of.name),
        start=f"{worst.start:.2f}",
        end=f"{worst.end:.2f}",
        rms=f"{worst.rms / scale:.3g}",
        unit=unit,
        ratio=f"{worst.ratio:.2g}",
        link=dock.link("Show this second in the replay", worst.start, joint, worst.of.file),
    )
