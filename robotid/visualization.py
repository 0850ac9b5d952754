"""Replay of a motion: a skeleton of the robot in Meshcat, as one page that needs no network.

Meshcat's own export asks a server process for the page. Here its commands are collected and
written into the page directly, so that no process, no socket and no port is opened.
"""

import base64
import json
import os
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from robotid._typing import Array
from robotid.exceptions import DataError, SettingsError
from robotid.model import RobotModel

__all__ = ["write_replay"]

_BUDGET = 300_000  # keyframes of all joints together: about 15 MB
_LINK, _JOINT, _BASE = 0x9AA7B4, 0xE07B1F, 0x4A5560  # colours
_THICKNESS = 0.035  # radius of a link over the robot's reach
_CELLS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)  # [m] of the grid, 40 by 40
_SHORT = 1e-4  # [m] joints closer than this are one point


@dataclass
class _Page:
    """Takes the commands that Meshcat would send to its server."""

    commands: list[bytes] = field(default_factory=list)

    def send(self, command: Any) -> None:  # noqa: ANN401
        """Keep a command of Meshcat, packed as its viewer reads it."""
        import umsgpack  # type: ignore[import-untyped]

        packed = umsgpack.packb(command.lower(), force_float_precision="single")
        self.commands.append(packed)


def write_replay(
    model: RobotModel, t: Array, q: Array, target: str | Path, *, rate: float = 30.0
) -> Path:
    """Write a page that plays a motion at its true speed, in three dimensions.

    Links are drawn from joint to joint, joints as drums along their axes; meshes are not used.

    Args:
        model: The robot.
        t: Times, shape (N,), strictly increasing [s].
        q: Joint coordinates, shape (N, n), or (N, 7 + n) with a floating base [rad, m].
        target: The HTML file to write.
        rate: Keyframes per second at most [Hz]; fewer for motions so long that the page would
            grow beyond some 15 MB.

    Returns:
        Path of the file.

    Raises:
        DataError: If times and positions do not fit each other or the model, or if the folder of
            the target does not exist.
        SettingsError: If the rate is not positive.
    """
    path = Path(target)
    if not path.parent.is_dir():
        raise DataError(f"there is no folder {str(path.parent)!r} to write {path.name} in")
    _check(t, q, rate)
    configurations = model.configurations(q)
    rows = _keyframes(t, rate, _BUDGET // (model.pin_model.njoints - 1))
    placements, positions = _motion(model, configurations[rows])
    html = _page(model, _scene(model, t[rows] - t[0], placements), positions)
    beside = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        beside.write_text(html, encoding="utf-8")
        os.replace(beside, path)
    finally:
        beside.unlink(missing_ok=True)
    return path


def _check(t: Array, q: Array, rate: float) -> None:
    if not rate > 0 or not np.isfinite(rate):
        raise SettingsError(f"rate is {rate}, wanted a positive number of keyframes per second")
    if t.ndim != 1 or q.ndim != 2 or len(t) != len(q):
        raise DataError(f"t has shape {t.shape} and q {q.shape}, wanted (N,) and (N, n)")
    if len(t) < 2:
        raise DataError(f"the motion has {len(t)} samples, wanted at least 2 to play")
    if not (np.isfinite(t).all() and np.isfinite(q).all()):
        raise DataError("t or q holds values that are not finite; leave those samples out")
    late = np.flatnonzero(np.diff(t) <= 0)
    if len(late):
        k = int(late[0])
        raise DataError(
            f"t must increase, but t[{k + 1}] = {t[k + 1]:.6g} s follows t[{k}] = {t[k]:.6g} s"
        )


def _keyframes(t: Array, rate: float, most: int) -> Array:
    """Return the rows to show: the last sample before each tick of the rate, and the last row."""
    count = min(int((t[-1] - t[0]) * rate) + 2, max(most, 2))
    ticks = np.linspace(t[0], t[-1], count)
    rows: Array = np.unique(np.searchsorted(t, ticks, side="right") - 1)
    return rows


def _motion(model: RobotModel, configurations: Array) -> tuple[list[list[pin.SE3]], Array]:
    """Return each joint's placement in its parent's frame, and all positions in the world."""
    data = model.pin_model.createData()
    placements, positions = [], []
    for configuration in configurations:
        pin.forwardKinematics(model.pin_model, data, configuration)
        placements.append([pin.SE3(M) for M in list(data.liMi)[1:]])
        positions.append([np.array(M.translation) for M in list(data.oMi)[1:]])
    return placements, np.array(positions)  # (N, joints, 3)


def _scene(model: RobotModel, t: Array, placements: list[list[pin.SE3]]) -> list[bytes]:
    """Return Meshcat's commands: the robot's parts, its first pose, its animation."""
    import meshcat
    from meshcat.animation import Animation

    page = _Page()
    root = meshcat.Visualizer(window=page)["robot"]
    animation = Animation(default_framerate=1)  # keys are then in seconds
    nodes = {0: root}
    _draw_parts(root, model, 0)
    for i in range(1, model.pin_model.njoints):
        # a node hangs on its parent's: between keyframes, links stay joined and turn on arcs
        name = f"{i} {model.pin_model.names[i]}".replace("/", "|")
        node = nodes[i] = nodes[model.pin_model.parents[i]][name]
        _draw_parts(node, model, i)
        node.set_transform(placements[0][i - 1].homogeneous)
        _animate(animation, node, t, [pose[i - 1] for pose in placements])
    root.set_animation(animation, play=True, repetitions=1_000_000)
    return page.commands


def _animate(animation: Any, node: Any, t: Array, poses: list[pin.SE3]) -> None:  # noqa: ANN401
    position = np.array([M.translation for M in poses])
    slides = np.ptp(position, axis=0).max() > _SHORT / 100
    for k, (time, M) in enumerate(zip(t.tolist(), poses, strict=True)):
        frame = animation.at_frame(node, time)
        turn = pin.Quaternion(M.rotation).coeffs().tolist()
        frame.set_property("quaternion", "quaternion", turn)
        if slides or k == 0:
            frame.set_property("position", "vector3", position[k].tolist())


def _draw_parts(node: Any, model: RobotModel, joint: int) -> None:  # noqa: ANN401
    """Draw the drum of a joint and the links from it to whatever it carries."""
    from meshcat.geometry import Cylinder, MeshPhongMaterial, Sphere

    radius = _THICKNESS * _reach(model)
    skin = MeshPhongMaterial(color=_LINK if joint else _BASE)
    parts = []
    for end in _ends(model, joint):
        length = float(np.linalg.norm(end))
        if length > _SHORT:
            along = _from_y_axis(end / length, end / 2)
            parts.append((Cylinder(length, 0.7 * radius), skin, along))
        parts.append((Sphere(0.7 * radius), skin, _from_y_axis(np.array([0.0, 1.0, 0.0]), end)))
    if joint:
        motor = MeshPhongMaterial(color=_JOINT)
        for axis in _axes(model, joint):
            drum = _from_y_axis(axis, np.zeros(3))
            parts.append((Cylinder(2.6 * radius, radius), motor, drum))
    elif not model.free_flyer:
        foot = _from_y_axis(np.array([0.0, 0.0, 1.0]), np.zeros(3))
        parts.append((Cylinder(0.6 * radius, 2 * radius), skin, foot))
    for k, (shape, material, M) in enumerate(parts):
        node[f"part {k}"].set_object(shape, material)
        node[f"part {k}"].set_transform(M)


def _ends(model: RobotModel, joint: int) -> list[Array]:
    """Return the points that a joint carries: its children, or else its farthest fixed frame."""
    tree = model.pin_model
    children = [
        np.array(tree.jointPlacements[i].translation)
        for i in range(1, tree.njoints)
        if tree.parents[i] == joint
    ]
    if joint == 0 and model.free_flyer:
        return []
    frames = [np.array(f.placement.translation) for f in tree.frames if f.parentJoint == joint]
    if children or not frames:
        return children or [np.array(tree.inertias[joint].lever)]
    farthest = max(frames, key=lambda point: float(np.linalg.norm(point)))
    is_point = np.linalg.norm(farthest) < _SHORT
    return [np.array(tree.inertias[joint].lever) if is_point else farthest]


def _axes(model: RobotModel, joint: int) -> list[Array]:
    """Return the axis of a joint in its own frame; none for a floating base."""
    kind = model.pin_model.joints[joint]
    if kind.nv != 1:
        return []
    data = kind.createData()
    kind.calc(data, pin.neutral(model.pin_model), np.zeros(model.pin_model.nv))
    S = np.array(data.S).reshape(6)
    return [S[3:] if S[3:].any() else S[:3]]


def _reach(model: RobotModel) -> float:
    """Return the longest way from the root along the joints [m]; 0.1 at least."""
    tree = model.pin_model
    ways = [0.0] * tree.njoints
    for i in range(1, tree.njoints):
        ways[i] = ways[tree.parents[i]] + float(np.linalg.norm(tree.jointPlacements[i].translation))
    return max(0.1, *ways)


def _from_y_axis(axis: Array, position: Array) -> Array:
    """Return the pose that turns the y axis, Meshcat's axis of a cylinder, into an axis."""
    M = np.eye(4)
    M[:3, :3] = pin.Quaternion.FromTwoVectors(np.array([0.0, 1.0, 0.0]), axis).toRotationMatrix()
    M[:3, 3] = position
    return M


def _page(model: RobotModel, commands: list[bytes], positions: Array) -> str:
    """Return the HTML: Meshcat's viewer, the commands, a camera that sees the whole motion."""
    import meshcat

    points = np.vstack([positions.reshape(-1, 3), np.zeros((0 if model.free_flyer else 1, 3))])
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    radius = np.linalg.norm(points - centre, axis=1).max() + 2 * _THICKNESS * _reach(model)
    # the camera stands 2.8 radii off; a grid that ends before it has no line behind it
    cell = max((c for c in _CELLS if 20 * c <= 2.5 * radius), default=_CELLS[0])
    ground = np.r_[cell * np.round(centre[:2] / cell), 0.0]
    view = {
        "centre": centre.tolist(),
        "radius": float(radius),
        "grid": ground.tolist(),
        "cell": cell,
    }
    viewer = Path(meshcat.viewer_assets_path()) / "dist" / "main.min.js"
    packed = [base64.b64encode(command).decode("ascii") for command in commands]
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(model.name)}: replay</title>\n<style>{_STYLE}</style>\n</head>\n<body>\n"
        f'<div id="meshcat-pane"></div>\n<div id="bar"><strong>{escape(model.name)}</strong>'
        f"{_BAR}</div>\n<script>{viewer.read_text(encoding='utf-8')}</script>\n"
        f"<script>\nconst view = {json.dumps(view)};\nconst commands = {json.dumps(packed)};\n"
        f"{_SCRIPT}</script>\n</body>\n</html>\n"
    )


_STYLE = """
body { margin: 0; font: 15px system-ui, sans-serif; }
#meshcat-pane { width: 100vw; height: 100vh; overflow: hidden; }
#bar { position: absolute; left: 0; right: 0; bottom: 0; display: flex; gap: .75rem;
  align-items: center; padding: .5rem .75rem; background: #fffd; color: #1c2126; }
#bar strong { max-width: 30vw; overflow: hidden; text-overflow: ellipsis; white-space: nowrap; }
#bar button { font: inherit; min-width: 4.5rem; padding: .35rem; }
#bar input { flex: 1; min-width: 0; }
#bar output { font-variant-numeric: tabular-nums; white-space: nowrap; }
"""
_BAR = (
    '<button type="button" id="play">Pause</button>'
    '<input type="range" id="time" min="0" step="0.001" value="0" aria-label="time in seconds">'
    '<output id="clock"></output>'
)
_SCRIPT = """
const viewer = new MeshCat.Viewer(document.getElementById("meshcat-pane"));
for (const text of commands)
  viewer.handle_command_bytearray(Uint8Array.from(atob(text), c => c.charCodeAt(0)));
viewer.set_property(["Background"], "top_color", [0.93, 0.95, 0.97]);
viewer.set_property(["Background"], "bottom_color", [0.72, 0.77, 0.82]);

const scale = view.cell / 0.5;  // the viewer's own grid has cells of 0.5 m
viewer.set_property(["Grid"], "scale", [scale, scale, scale]);
viewer.set_property(["Grid"], "position", view.grid);

// the viewer's camera has y upwards: (x, y, z) of the robot is (x, z, -y) there
function frame() {
  const [x, y, z] = view.centre, camera = viewer.camera, half = 20 * Math.PI / 180;
  const aspect = window.innerWidth / window.innerHeight;
  const narrow = Math.min(half, Math.atan(Math.tan(half) * aspect));
  const far = view.radius / Math.sin(narrow);
  camera.fov = 40;
  camera.near = far / 200;
  camera.far = 200 * far;
  camera.position.set(x + 0.76 * far, z + 0.36 * far, -y + 0.54 * far);
  viewer.controls.target.set(x, z, -y);
  viewer.controls.update();
  viewer.set_dirty();
}
frame();

const animator = viewer.animator, play = document.getElementById("play");
const slider = document.getElementById("time"), clock = document.getElementById("clock");
slider.max = animator.duration;
play.onclick = () => animator.playing ? animator.pause() : animator.play();
slider.oninput = () => { animator.pause(); animator.seek(+slider.value);
  animator.display_progress(+slider.value); };
function show() {
  if (animator.playing) slider.value = animator.time;
  play.textContent = animator.playing ? "Pause" : "Play";
  const time = animator.time.toFixed(1), end = animator.duration.toFixed(1);
  clock.textContent = `${time} / ${end} s, grid ${view.cell} m`;
  requestAnimationFrame(show);
}
show();
if (matchMedia("(prefers-reduced-motion: reduce)").matches) animator.pause();
"""
