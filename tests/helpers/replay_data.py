"""What a replay page holds, read back from its HTML."""

import json
import re

from helpers.pages import numbers_of


def shown(html):
    """Return the data of a page, arrays unpacked."""
    data = json.loads(re.search(r'id="data">(.*?)</script>', html, re.DOTALL)[1])
    return unpacked(data)


def unpacked(value):
    if isinstance(value, dict) and "kind" in value and "data" in value:
        return numbers_of(value)
    if isinstance(value, dict):
        return {key: unpacked(x) for key, x in value.items()}
    return [unpacked(x) for x in value] if isinstance(value, list) else value


def leave_out_meshes(patch):
    """Leave out of pages what a robot looks like, which takes seconds to be thinned."""
    patch.setattr("robotid.output.viewer.replays._thinned", lambda files, _: [[] for _ in files])
