"""Checks of the base parameters of a URDF: rounded angles (3.1416 for pi), weak parameters."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from robotid.base.findings import Finding, listed
from robotid.dynamics.base_parameters import BaseMapping, structural_mapping
from robotid.robot.model import RobotModel
from robotid.robot.tree import Joint, Tree
from robotid.robot.urdf_text import exact_angle

_NOISE = 1e-10  # smaller pivots, over the largest, are rounding errors
_HARMLESS = "The identifiable parameters do not change"
_ADVICE = "snap_angles = true (--snap-angles) takes the exact angles"


def rounded_angles(model: RobotModel, mapping: BaseMapping) -> Iterator[Finding]:
    """Yield the angles of joints that a URDF rounds."""
    rounded = _rounded(model.tree)
    more, effect = _effect(model, mapping) if rounded else (0, "")
    felt = _carrying(model.tree) if effect else set()
    for is_felt, consequence in ((True, f"{effect}; {_ADVICE}"), (False, _HARMLESS)):
        joints = {name: exact for name, exact in rounded.items() if (name in felt) == is_felt}
        if not joints:
            continue
        exact = {word: angle for angles in joints.values() for word, angle in angles.items()}
        wanted = listed(f"{angle!r} for {word}" for word, angle in exact.items())
        where, subject = f"file {Path(model.tree.path).name}", f"the joints {listed(joints)} have"
        if len(joints) == 1:
            where, subject = f"joint {next(iter(joints))}", f"joint {next(iter(joints))!r} has"
        message = f"{subject} rounded angles in rpy; write {wanted}. {consequence}"
        evidence = {
            "largest_error": max(abs(float(word) - angle) for word, angle in exact.items()),
            "felt": float(is_felt),
        }
        severity = "warning" if is_felt and more else "note"
        yield Finding("rounded_rpy", severity, where, message, evidence)


def rounded_robot(model: RobotModel, mapping: BaseMapping) -> Iterator[Finding]:
    """Yield one finding if the angles that a URDF rounds change the identifiable parameters."""
    joints = [name for name in _rounded(model.tree) if name in _carrying(model.tree)]
    more, effect = _effect(model, mapping) if joints else (0, "")
    if effect:
        where, severity = Path(model.tree.path).name, "warning" if more else "note"
        message = f"{where} rounds angles of the joints {listed(joints, 6)}. {effect}; {_ADVICE}"
        yield Finding("rounded_rpy", severity, where, message, {"joints": float(len(joints))})


def weak_parameters(model: RobotModel, mapping: BaseMapping) -> Iterator[Finding]:
    """Yield a warning if parameters are at the limit between identifiable and unidentifiable."""
    if weak := _between(mapping):
        where = Path(model.tree.path).name
        message = (
            f"{where}: {weak} parameters have less than 1e-4 of the effect of others on the "
            f"torques. They are left out of the {len(mapping.K)} base parameters; identify fewer "
            f"of the {len(model.joints)} joints in one job"
        )
        yield Finding("weak_parameters", "warning", f"file {where}", message, {"faint": weak})


def _between(mapping: BaseMapping) -> int:
    """Return the number of pivots that are neither rounding errors nor large enough."""
    return int(np.sum(mapping.pivots > _NOISE)) - len(mapping.K)


def _rounded(tree: Tree) -> dict[str, dict[str, float]]:
    """Return the rounded angles of each joint, as written, and the exact angles."""
    rounded = {}
    for joint in tree.robot.findall("joint"):
        origin = joint.find("origin")
        words = origin.get("rpy", "").split() if origin is not None else []
        exact = {word: angle for word in words if (angle := exact_angle(word)) is not None}
        if exact:
            rounded[joint.get("name", "")] = exact
    return rounded


def _effect(model: RobotModel, mapping: BaseMapping) -> tuple[int, str]:
    """Return how many base parameters the rounding adds, and a sentence on it, "" if none."""
    options = {
        **model.options, "couplings": model.layout.couplings, "constraints": model.constraints
    }  # fmt: skip
    meant = structural_mapping(RobotModel.from_urdf(model.tree, **options, snap_angles=True))
    more = len(mapping.K) - len(meant.K)
    seeming = _between(mapping) - _between(meant)
    if more:
        return more, (
            f"With the rounding there are {len(mapping.K)} base parameters instead of "
            f"{len(meant.K)}, and noise determines the additional ones"
        )
    if seeming > 0:
        return 0, (
            f"With the rounding, {seeming} more parameters seem identifiable, although noise "
            "determines them. robotid leaves them out, other tools may not"
        )
    return 0, ""


def _carrying(tree: Tree) -> set[str]:
    """Return the joints that move or carry a moving joint: their angles affect the dynamics."""
    arriving = {joint.child: joint for joint in tree.joints}
    carrying: set[str] = set()
    for joint in tree.movable:
        at: Joint | None = joint
        while at is not None and at.name not in carrying:
            carrying.add(at.name)
            at = arriving.get(at.parent)
    return carrying
