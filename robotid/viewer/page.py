"""The page of a replay: Meshcat's viewer, uPlot, our script and the data, in one file."""

import json
from collections.abc import Mapping
from functools import cache
from html import escape
from pathlib import Path
from typing import Any

from robotid.pages.html import asset, scaffold

__all__ = ["page"]

_ASSETS = Path(__file__).parent / "assets"


def page(data: Mapping[str, Any]) -> str:
    """Return the page of a replay. It fetches nothing, except events if it is live.

    Args:
        data: ``title``, ``notes``, ``live`` and what replay.js draws, in plain finite values.
    """
    title = f"{data['title']}: {'live' if data['live'] else 'replay'}"
    notes = " ".join(f"<p>{escape(note)}</p>" for note in data["notes"])
    policy = "; script-src 'unsafe-inline'; img-src data: blob:"
    policy += "; connect-src 'self'" if data["live"] else ""
    # "<" is an escape in JSON, so no text in it can end the script
    text = json.dumps(data, allow_nan=False).replace("<", "\\u003c")
    return scaffold(
        title,
        '<link rel="icon" href="data:,">\n'
        f"<style>{asset('uPlot.min.css')}\n/*tones*/{_asset('replay.css')}</style>\n",
        f'<header><h1>{escape(title)}</h1>{notes}<p id="state" role="status"></p></header>\n'
        f"{_BODY}\n"
        f'<script type="application/json" id="data">{text}</script>\n'
        f"<script>{_viewer()}</script>\n<script>{asset('uPlot.iife.min.js')}</script>\n"
        f"<script>{_asset('replay.js')}</script>\n",
        policy=policy,
    )


@cache
def _asset(name: str) -> str:
    return (_ASSETS / name).read_text(encoding="utf-8")


@cache
def _viewer() -> str:
    import meshcat

    viewer = Path(meshcat.viewer_assets_path()) / "dist" / "main.min.js"
    return viewer.read_text(encoding="utf-8")


_OPTIONS = "".join(
    f'<option value="{s}"{" selected" * (s == 1)}>{s}×</option>'
    for s in (0.1, 0.25, 0.5, 1, 2, 5, 10)
)
_BODY = f"""\
<main aria-label="3-D view">
<div id="meshcat-pane" role="img" aria-label="the robot in motion"></div>
<button type="button" id="view">Reset view</button>
</main>
<aside id="side" aria-label="what is shown, and plots" hidden>
<div id="switches"></div>
<p id="residuals" class="quiet">Arcs: measured torque, 270° is a joint's largest; the inner one is
predicted, unless the joint stands still. Colour: residual, <span class="ramp"></span> from 0 to
half the torque's rms.</p>
<div id="plots"></div>
</aside>
<footer>
<div id="bar" role="group" aria-label="playback">
<button type="button" id="play">Pause</button>
<button type="button" id="live" aria-pressed="false" hidden>Follow</button>
<div id="track"><input type="range" id="time" min="0" max="1" step="any" value="0"
 aria-label="time"></div>
<output id="clock"></output>
<label>speed <select id="speed">{_OPTIONS}</select></label>
<label><input type="checkbox" id="loop" checked> loop</label>
</div>
<ul id="marks" aria-label="events" hidden></ul>
</footer>"""
