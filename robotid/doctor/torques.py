"""Do the torques fit the model: signs, order of columns, gravity, positions."""

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from robotid.doctor.hypotheses import Explanation, explanations
from robotid.doctor.loads import check_loads
from robotid.doctor.sample import Probe
from robotid.findings import Finding, listed

__all__ = ["check_torques"]

_CERTAIN = 2.5  # gain in the logarithm of the unexplained share, a factor 12, that is no chance
_EXPLAINED = 0.2  # a reading that explains no torque better than this proves nothing
_WRONG = 0.5  # a torque of the right sign is explained at least this well
_EXCUSED = 0.3  # a torque that is explained so well with some load may have the right sign
_TILT = 5.0  # [deg] gravity farther than this off is worth a warning
_TURNED = 30.0  # [deg] ... and farther than this gives wrong answers
_HINT = 0.7  # gain from which a tilt is believed
_UNEXPLAINED = 0.25  # share of a torque's variance that no physics explains


def check_torques(probe: Probe, name: str) -> Iterator[Finding]:
    """Yield what must be otherwise for the torques to fit the model.

    The reading that explains the torques best is named, and only it; where the log is right as it
    stands, the URDF's masses are checked.

    Args:
        probe: The motion.
        name: What the log is called.

    Yields:
        Errors "torque_sign", "torque_order", "joint_order", "joint_axis", "position_order",
        "position_sign", "position_offset" or "gravity", or else what ``check_loads`` yields;
        and "unexplained_torque".
    """
    stated, loaded, others = explanations(probe)
    best = min(others, key=lambda e: e.misfit)
    if best.kind != "torque_sign" and loaded.misfit < best.misfit:
        best = stated  # a load explains it better
    found = list(_FINDINGS[best.kind](probe, stated, best, stated.misfit - best.misfit, name))
    for finding in found:
        # what a load on the last link would explain as well is no error for certain
        excused = _is_excused(best, loaded)
        yield replace(finding, severity="warning") if excused else finding
    if not found:
        yield from check_loads(probe, loaded.share, name)
        yield from _unexplained(probe, loaded, name)


def _no_finding(*_: object) -> Iterator[Finding]:
    yield from ()


def _sign(
    probe: Probe, stated: Explanation, best: Explanation, _gain: float, name: str
) -> Iterator[Finding]:
    for j in best.joints:
        before, after = float(stated.share[j]), float(best.share[j])
        if before < _WRONG or after > _EXPLAINED:
            continue
        joint = probe.model.joints[j]
        message = (
            f"{name}: the torque of {joint} has the opposite sign: as it is, {100 * before:.0f} % "
            f"of its variance cannot be explained, negated {100 * after:.2g} %; negate tau_{joint} "
            "(or its gain), or check the joint's axis in the URDF"
        )
        evidence = {"unexplained": before, "unexplained_if_negated": after}
        yield Finding("torque_sign", "error", f"{name}: {joint}", message, evidence)


def _exchanged(
    probe: Probe, stated: Explanation, best: Explanation, gain: float, name: str
) -> Iterator[Finding]:
    if not _is_certain(best, gain):
        return
    names = [probe.model.joints[j] for j in best.joints]
    if best.kind == "torque_order":
        owners = [probe.model.joints[int(best.values[j])] for j in best.joints]
        shown = ", ".join(f"tau_{a} is that of {b}" for a, b in zip(names, owners, strict=True))
        what, todo = f"torque columns are exchanged: {shown}", "rename these torque columns"
    elif best.kind == "position_order":
        what, todo = f"the position columns of {listed(names)} are exchanged", "rename them"
    else:
        what, todo = f"all columns of {listed(names)} are exchanged", "name the joints rightly"
    message = (
        f"{name}: {what}: so read, the unexplained share of the worst torque falls from "
        f"{100 * stated.share.max():.2g} to {100 * best.share.max():.2g} %; {todo}"
    )
    where = f"{name}: {', '.join(names)}"
    yield Finding(best.kind, "error", where, message, _shares(stated, best, gain))


def _position(
    probe: Probe, stated: Explanation, best: Explanation, gain: float, name: str
) -> Iterator[Finding]:
    if not _is_certain(best, gain):
        return
    joint = probe.model.joints[best.joints[0]]
    if best.kind == "joint_axis":
        what = (
            f"position and torque of {joint} have the opposite sign: its axis is reversed; turn "
            f"the joint's axis in the URDF, or negate q_{joint}, dq_{joint} and tau_{joint}"
        )
    elif best.kind == "position_sign":
        what = f"the position of {joint} has the opposite sign; negate q_{joint} (and dq_{joint})"
    else:
        what = (
            f"the zero of {joint} is off by about {best.values[0]:.2g} rad; correct q_{joint} or "
            "the joint's origin in the URDF"
        )
    worst = int(np.argmax(stated.share - best.share))
    message = (
        f"{name}: {what}: so read, the unexplained share of {probe.model.joints[worst]}'s torque "
        f"falls from {100 * stated.share[worst]:.3g} to {100 * best.share[worst]:.3g} %"
    )
    where = f"{name}: {joint}"
    yield Finding(best.kind, "error", where, message, _shares(stated, best, gain))


def _gravity(
    probe: Probe, stated: Explanation, best: Explanation, gain: float, name: str
) -> Iterator[Finding]:
    g, believed = np.array(best.values), probe.gravity
    size = float(np.linalg.norm(believed))
    if not g.any():
        if size > 0 and _is_certain(best, gain):
            message = (
                f"{name}: the torques hold no gravity: without it they are explained best; they "
                "may be those of a gravity-compensated channel: log the torque of the motor, or "
                "state gravity = [0, 0, 0] for what is left"
            )
            yield Finding("gravity", "error", name, message, {"gain": gain})
        return
    cosine = float(g @ believed) / (float(np.linalg.norm(g)) * size) if size > 0 else 0.0
    angle = float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))
    turned = angle > _TURNED and _is_certain(best, gain)
    if not turned and (angle < _TILT or gain < _HINT):
        return
    shown = ", ".join(f"{x:.2f}" for x in g)
    message = (
        f"{name}: gravity along [{shown}] m/s^2 explains the torques best, {angle:.0f} degrees "
        f"from the stated [{', '.join(f'{x:.2f}' for x in believed)}]; if the robot is mounted on "
        f"a wall, a ceiling or a slope, state gravity = [{shown}] in the job file"
    )
    evidence = {"angle_deg": angle, "x": g[0], "y": g[1], "z": g[2], "gain": gain}
    severity = "error" if turned else "warning"
    yield Finding("gravity", severity, name, message, {k: float(v) for k, v in evidence.items()})


_Maker = Callable[[Probe, Explanation, Explanation, float, str], Iterator[Finding]]
_FINDINGS: dict[str, _Maker] = {
    "stated": _no_finding,
    "torque_sign": _sign,
    "torque_order": _exchanged,
    "joint_order": _exchanged,
    "position_order": _exchanged,
    "joint_axis": _position,
    "position_sign": _position,
    "position_offset": _position,
    "gravity": _gravity,
}


def _is_excused(best: Explanation, loaded: Explanation) -> bool:
    if best.kind == "torque_sign":
        return any(loaded.share[j] < _EXCUSED for j in best.joints)
    return loaded.misfit - best.misfit < _CERTAIN


def _is_certain(best: Explanation, gain: float) -> bool:
    return gain > _CERTAIN and float(np.median(best.share)) < _EXPLAINED


def _shares(stated: Explanation, best: Explanation, gain: float) -> dict[str, float]:
    return {
        "unexplained": float(stated.share.max()),
        "unexplained_so_read": float(best.share.max()),
        "gain": gain,
    }


def _unexplained(probe: Probe, stated: Explanation, name: str) -> Iterator[Finding]:
    bad = np.flatnonzero(stated.share > _UNEXPLAINED)
    if 2 * len(bad) > len(stated.share):
        message = (
            f"{name}: the torques of {len(bad)} of {len(stated.share)} joints fit neither gravity, "
            "inertia nor friction of this model: the base may move or the robot touch something, "
            "the log or the URDF may be of another robot; nothing identified from it can be right"
        )
        evidence = {"joints": len(bad), "share": float(np.median(stated.share))}
        yield Finding("unexplained_torque", "warning", name, message, evidence)
        return
    for j in bad:
        joint, share = probe.model.joints[j], float(stated.share[j])
        message = (
            f"{name}: {100 * share:.0f} % of the variance of {joint}'s torque fits neither "
            "gravity, inertia nor friction: the channel may hold another quantity, little but "
            "noise, or a drive that is coupled to others; what depends on it is not to be trusted"
        )
        where = f"{name}: {joint}"
        yield Finding("unexplained_torque", "warning", where, message, {"share": share})
