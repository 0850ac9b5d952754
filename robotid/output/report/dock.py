"""The replay in a report: a frame at the lower edge of the window, on the clock of its charts.

The frame is loaded when it is asked for. Its file may be written after the report: dock.js finds
out whether it is there.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import NamedTuple
from urllib.parse import quote, urlencode

from robotid.output.pages.html import command_html
from robotid.output.report.steps import Origin

_WORDS = "shows the robot in motion, on the clock of these charts"


class Clip(NamedTuple):
    """A recording with charts.

    Attributes:
        link: Name that links its charts.
        log: Path of its file; "" if it is in memory.
        start: Its first time [s].
        end: Its last time [s].
    """

    link: str
    log: str
    start: float
    end: float


@dataclass(frozen=True)
class Dock:
    """The replay of a report.

    Attributes:
        replay: File of the replay in the report's folder; "" if it is not written yet.
        origin: Folder of the results, for the command that writes the replay.
        urdf: The URDF.
        clips: The recordings with charts.
    """

    replay: str = ""
    origin: Origin = field(default_factory=Origin)
    urdf: str = ""
    clips: Sequence[Clip] = ()

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
            {
                "link": clip.link,
                "log": Path(clip.log).name,
                "start": clip.start,
                "end": clip.end,
                "command": self._command(clip),
            }
            for clip in self.clips
        ]
        words, block = f'<a href="{escape(quote(self.replay))}">The replay</a> {_WORDS}.', ""
        if not self.replay:
            words = f"The replay {_WORDS}. This command writes it:"
            command = next(filter(None, map(self._command, self.clips)))
            block = f'<div class="copy">{command_html(command)}</div>'
        return (
            f'<div id="replay" class="dock" data-file="{escape(quote(self.file))}" '
            f'data-clips="{escape(json.dumps(clips))}">'
            f'<p><button type="button" hidden>Show the replay</button> {words}</p>{block}</div>\n'
        )
