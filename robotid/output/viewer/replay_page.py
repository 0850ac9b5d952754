"""The page of a replay: Meshcat's viewer, uPlot, the page's script and the data, in one file."""

import json
from collections.abc import Mapping
from functools import cache
from html import escape
from pathlib import Path
from string import Template
from typing import Any

from robotid.output.pages.html import asset, scaffold

_ASSETS = Path(__file__).parent / "assets"
_SCRIPTS = (
    *("data", "scene", "masses", "arcs", "strip", "choice", "plots"),
    *("clock", "picking", "controls", "live", "embed", "start"),
)
_SPEEDS = (0.1, 0.25, 0.5, 1, 2, 5, 10)


def page(data: Mapping[str, Any]) -> str:
    """Return the page of a replay. It loads nothing, except events if it is live."""
    title = f"{data['title']}: {'live' if data['live'] else 'replay'}"
    policy = "; script-src 'unsafe-inline'; img-src data: blob:"
    policy += "; connect-src 'self'" if data["live"] else ""
    style = f"{asset('uPlot.min.css')}\n/*tones*/{asset('charts.css')}{_asset('replay.css')}"
    body = Template(_asset("replay.html")).substitute(
        title=escape(title),
        notes=" ".join(f"<p>{escape(note)}</p>" for note in data["notes"]),
        options="".join(
            f'<option value="{s}"{" selected" * (s == 1)}>{s}×</option>' for s in _SPEEDS
        ),
        # "<" is an escape in JSON, so no text in it can end the script
        data=json.dumps(data, allow_nan=False).replace("<", "\\u003c"),
        viewer=_viewer(),
        uplot=asset("uPlot.iife.min.js"),
        charts=asset("charts.js"),
        script=_script(),
    )
    head = f'<link rel="icon" href="data:,">\n<style>{style}</style>\n'
    return scaffold(title, head, body, policy=policy)


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
