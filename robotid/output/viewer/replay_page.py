"""The page of a replay: Meshcat's viewer, uPlot, the page's script and the data, in one file."""

import json
from collections.abc import Mapping
from functools import cache
from html import escape
from pathlib import Path
from typing import Any

from robotid.output.pages.html import asset, scaffold

_ASSETS = Path(__file__).parent / "assets"
_SCRIPTS = (
    *("data", "scene", "masses", "arcs", "strip", "choice", "plots"),
    *("clock", "picking", "controls", "live", "embed", "start"),
)


def page(data: Mapping[str, Any]) -> str:
    """Return the page of a replay. It loads nothing, except events if it is live."""
    title = f"{data['title']}: {'live' if data['live'] else 'replay'}"
    notes = " ".join(f"<p>{escape(note)}</p>" for note in data["notes"])
    policy = "; script-src 'unsafe-inline'; img-src data: blob:"
    policy += "; connect-src 'self'" if data["live"] else ""
    # "<" is an escape in JSON, so no text in it can end the script
    text = json.dumps(data, allow_nan=False).replace("<", "\\u003c")
    return scaffold(
        title,
        '<link rel="icon" href="data:,">\n'
        f"<style>{asset('uPlot.min.css')}\n/*tones*/{asset('charts.css')}"
        f"{_asset('replay.css')}</style>\n",
        f'<header><h1>{escape(title)}</h1>{notes}<p id="state" role="status"></p></header>\n'
        f"{_BODY}\n"
        f'<script type="application/json" id="data">{text}</script>\n'
        f"<script>{_viewer()}</script>\n<script>{asset('uPlot.iife.min.js')}</script>\n"
        f"<script>{asset('charts.js')}</script>\n<script>{_script()}</script>\n",
        policy=policy,
    )


@cache
def _asset(name: str) -> str:
    return (_ASSETS / name).read_text(encoding="utf-8")


@cache
def _script() -> str:
    """Return the sections of the page's script as one script in its own scope."""
    sections = "".join(_asset(f"{name}.js") for name in _SCRIPTS)
    return f'"use strict";\n(() => {{\n{sections}}})();\n'


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
<footer aria-label="playback">
<div id="bar" role="group" aria-label="playback">
<div><button type="button" id="play">Pause</button>
<button type="button" id="live" aria-pressed="false" hidden>Follow</button></div>
<div id="track"><input type="range" id="time" step="any" aria-label="time">
<div id="now"></div></div>
<div id="pace"><output id="clock"></output>
<select id="speed" aria-label="speed">{_OPTIONS}</select>
<label><input type="checkbox" id="loop" checked> loop</label></div>
</div>
<div id="strip" hidden>
<div id="joints"></div>
<div id="sheets"><canvas id="sheet" tabindex="0" role="img"
 aria-label="residual of each joint over time; up and down select a joint"></canvas></div>
<p class="quiet">Residual, <span class="ramp"></span> from 0 to <span id="full"></span>;
<span class="hatched"></span> at rest (not used) or no samples. <output id="reading"></output></p>
</div>
</footer>
<main aria-label="3-D view">
<div id="meshcat-pane" role="img" aria-label="moving robot"></div>
<div id="names" aria-hidden="true" hidden></div>
<output id="picked" hidden></output>
<fieldset id="models" class="segments" hidden><legend>Predicted torque</legend></fieldset>
<div id="tools"><button type="button" id="view">Reset view</button>
<button type="button" id="picture">Picture</button>
<button type="button" id="film" aria-pressed="false">Film</button></div>
</main>
<aside id="side" aria-label="options and plots" hidden>
<section id="events" hidden><h2>Events</h2><ul id="marks"></ul></section>
<div id="switches"></div>
<p id="residuals" class="quiet"><span id="arcs">Outer arcs: measured torque; the tick is zero,
270° is the joint's maximum. Inner arcs: predicted torque, unless the joint is at rest.
</span>Colour: residual, <span class="ramp"></span> from 0 to <span id="most"></span>.</p>
<div id="plots"></div>
</aside>"""
