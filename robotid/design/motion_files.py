"""Files of designed motions: tables like logs, ROS 2 trajectories and URScript programs."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from robotid.base.exceptions import SettingsError
from robotid.base.files import write_text
from robotid.base.text import yaml_name
from robotid.base.typing import Array
from robotid.data.files.read import check_suffix, write_columns
from robotid.dynamics.simulation.motions import Motion

_UR_JOINTS = 6
_UR_STEP = 0.008  # [s] of servoj on every UR
_SETTLES = 1.0  # [s] at rest at the first posture


def check_motion_file(target: str | Path) -> None:
    """Refuse an unknown format of motion files before a design is computed."""
    if Path(target).suffix not in (".yaml", ".script"):
        check_suffix(Path(target), "motions", also=(".yaml", ".script"))


def write_motion(
    motion: Motion, joints: Sequence[str], duration: float, rate: float, target: str | Path
) -> Path:
    """Write a motion: .csv or .parquet, .yaml for ROS 2, .script for Universal Robots.

    A table has the columns time, q_, dq_ and ddq_ of each joint [s, rad or m], like a log. A .yaml
    file is a trajectory_msgs/JointTrajectory. A .script is a URScript function that moves to the
    first posture and then calls servoj every 8 ms.
    """
    path = Path(target)
    if not 0 < rate < np.inf:
        raise SettingsError(f"rate is {rate:g}, wanted a positive number of rows per second")
    texts: Mapping[str, Callable[..., Iterator[str]]] = {".yaml": _ros, ".script": _ur}
    if path.suffix == ".script":
        rate = 1.0 / _UR_STEP
    t = np.arange(round(duration * rate) + 1) / rate
    q, v, a = motion.evaluate(np.minimum(t, duration))
    if path.suffix in texts:
        return write_text("\n".join(texts[path.suffix](joints, t, q, v, a)) + "\n", path)
    table = {"time": t}
    for kind, values in (("q", q), ("dq", v), ("ddq", a)):
        table |= {f"{kind}_{joint}": x for joint, x in zip(joints, values.T, strict=True)}
    write_columns(table, path)
    return path


def _ros(joints: Sequence[str], t: Array, q: Array, v: Array, a: Array) -> Iterator[str]:
    """Yield the lines of a trajectory_msgs/JointTrajectory."""
    yield f"joint_names: [{', '.join(map(yaml_name, joints))}]"
    yield "points:"
    for time, *state in zip(t, q, v, a, strict=True):
        seconds, nanoseconds = divmod(round(time * 1e9), 10**9)
        names = ("positions", "velocities", "accelerations")
        for k, (name, values) in enumerate(zip(names, state, strict=True)):
            yield f"{'  ' if k else '- '}{name}: [{_numbers(values)}]"
        yield f"  time_from_start: {{sec: {seconds}, nanosec: {nanoseconds}}}"


def _ur(joints: Sequence[str], t: Array, q: Array, v: Array, a: Array) -> Iterator[str]:
    """Yield the lines of a URScript program."""
    if len(joints) != _UR_JOINTS:
        raise SettingsError(
            f"a .script is for Universal Robots: this robot has {len(joints)} joints, wanted "
            f"{_UR_JOINTS}; write .csv, .parquet or .yaml"
        )
    yield "def excitation():"
    yield f"  movej([{_numbers(q[0])}], a=0.5, v=0.5)"
    yield f"  sleep({_SETTLES})"
    for row in q:
        yield f"  servoj([{_numbers(row)}], t={_UR_STEP}, lookahead_time=0.1, gain=300)"
    yield "  stopj(2.0)"
    yield "end"
    yield "excitation()"


def _numbers(values: Array) -> str:
    return ", ".join(f"{x:.6f}" for x in values)
