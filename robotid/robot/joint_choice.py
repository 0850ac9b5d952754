"""The choice of the joints that move: the others are locked, or follow the joint they mimic."""

import difflib
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from robotid.base.exceptions import ModelError
from robotid.base.findings import listed
from robotid.robot.tree import Tree
from robotid.robot.urdf_text import LARGEST

_MOST_JOINTS = 300  # memory grows with their square, time with their cube: 2 GiB, 75 s


def choose_joints(
    tree: Tree,
    free: Sequence[str],
    joints: Sequence[str] | None,
    locked: Mapping[str, float],
    followers: Mapping[str, tuple[str, float, float]],
) -> tuple[tuple[str, ...], dict[str, float]]:
    """Return the joints that move, in order, and the positions of those that do not [rad or m]."""
    _check_joints(tree, [*(joints or ()), *(name for name in locked if name != "*")], followers)
    if joints is None and "*" in locked:
        raise ModelError(
            "locked has '*' (all joints that are not named), but joints is not stated; list the "
            "joints to identify in joints"
        )
    moving = tuple(name for name in free if name not in locked) if joints is None else tuple(joints)
    both = [name for name in moving if name in locked]
    if both:
        raise ModelError(f"joints {listed(both)} are in both joints and locked; remove them in one")
    if len(set(moving)) != len(moving):
        raise ModelError(f"joints is {listed(moving)}, wanted each name once")
    if len(moving) > _MOST_JOINTS:
        raise ModelError(
            f"{Path(tree.path).name}: {len(moving)} joints move, wanted at most {_MOST_JOINTS}; "
            "list the joints to identify in joints, or lock others"
        )
    for name, position in locked.items():
        is_number = isinstance(position, int | float | np.number)
        if not is_number or not abs(position) <= LARGEST:
            raise ModelError(
                f"joint {name!r} is locked at {position!r}, wanted a number within +-{LARGEST:g} "
                "[rad or m]"
            )
    others = locked.get("*", 0.0)
    positions = {name: float(locked.get(name, others)) for name in free if name not in moving}
    _check_mimic(tree, moving, positions, followers)
    beside = {j.name: j.mimic for j in tree.movable if j.mimic and j.name not in locked}
    for name, (leader, ratio, offset) in {**beside, **followers}.items():
        if leader in positions:
            positions[name] = ratio * positions[leader] + offset
    return moving, positions


def _check_joints(tree: Tree, names: Sequence[str], followers: Mapping[str, object]) -> None:
    known = [joint.name for joint in tree.movable]
    for name in names:
        if name in followers:
            raise ModelError(
                f"joint {name!r} mimics another joint and moves with it (mimic = 'coupled'); omit "
                "it, or use mimic = 'independent'"
            )
        if name not in known:
            if any(joint.name == name for joint in tree.joints):
                raise ModelError(
                    f"joint {name!r} is fixed in {Path(tree.path).name}: it cannot move"
                )
            near = difflib.get_close_matches(name, known, n=1)
            hint = f" Did you mean {near[0]!r}?" if near else ""
            raise ModelError(
                f"joint {name!r} is not in {Path(tree.path).name}; joints: {listed(known)}.{hint}"
            )


def mimic_followers(tree: Tree) -> dict[str, tuple[str, float, float]]:
    """Return each mimic joint with its leading joint, ratio and offset; chains are resolved."""
    by_name = {joint.name: joint for joint in tree.movable}
    resolved = {}
    for joint in tree.movable:
        if joint.mimic is None:
            continue
        leader, ratio, offset = joint.mimic
        seen = {joint.name}
        while True:
            if leader not in by_name or leader in seen:
                raise ModelError(
                    f"joint {joint.name!r} mimics {leader!r}, wanted another movable joint that "
                    "does not mimic it in turn; correct the <mimic>, or use mimic = 'independent'"
                )
            up = by_name[leader].mimic
            if up is None:
                break
            seen.add(leader)
            leader, ratio, offset = up[0], ratio * up[1], ratio * up[2] + offset
        if not max(abs(ratio), abs(offset)) <= LARGEST:
            raise ModelError(
                f"joint {joint.name!r} mimics {leader!r} with a total multiplier of {ratio:g} and "
                f"offset of {offset:g}, wanted numbers within +-{LARGEST:g}; correct the <mimic>"
            )
        resolved[joint.name] = (leader, ratio, offset)
    return resolved


def _check_mimic(
    tree: Tree, moving: Sequence[str], locked: Mapping[str, float], followers: Mapping[str, object]
) -> None:
    for joint in tree.movable:
        if joint.mimic is None or joint.name in followers:
            continue
        leader = joint.mimic[0]
        if (joint.name in locked) != (leader in locked) and leader in (*moving, *locked):
            raise ModelError(
                f"joint {joint.name!r} mimics {leader!r}, but only one of them is locked; list "
                "both in joints, or lock both, or use mimic = 'coupled'"
            )
