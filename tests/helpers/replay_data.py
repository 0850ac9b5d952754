"""What a replay page holds, read back from its HTML."""

import base64
import json
import re

import numpy as np


def shown(html):
    """Return the data of a page, arrays unpacked."""
    data = json.loads(re.search(r'id="data">(.*?)</script>', html, re.DOTALL)[1])
    return unpacked(data)


def unpacked(value):
    if isinstance(value, dict) and set(value) == {"kind", "shape", "data"}:
        numbers = np.frombuffer(base64.b64decode(value["data"]), value["kind"])
        return numbers.reshape(value["shape"])
    if isinstance(value, dict) and set(value) == {"low", "step", "codes"}:
        codes = unpacked(value["codes"])
        values = np.array(value["low"]) + np.array(value["step"]) * codes
        return np.where(codes == 65_535, np.nan, values)
    if isinstance(value, dict):
        return {key: unpacked(x) for key, x in value.items()}
    return [unpacked(x) for x in value] if isinstance(value, list) else value


def leave_out_meshes(patch):
    """Leave out of pages what a robot looks like, which takes seconds to be thinned."""
    patch.setattr("robotid.output.viewer.scene._thinned", lambda files, _: (None,) * len(files))
