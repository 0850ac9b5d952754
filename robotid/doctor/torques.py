"""Do the torques fit the model: signs, order of columns, gravity, positions."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from robotid._typing import Array
from robotid.doctor.hypotheses import Explanation, explanations
from robotid.doctor.loads import NO_GRAVITY, check_loads, counterbalance, holds_gravity
from robotid.doctor.mounted import check_unmounted_parts
from robotid.doctor.sample import Probe
from robotid.findings import Finding, listed, log_finding

__all__ = ["check_torques"]

_CERTAIN = 2.5  # gain in the logarithm of the unexplained share, a factor 12, that is no chance
_EXPLAINED = 0.2  # a reading that explains no torque better than this proves nothing
_WRONG = 0.5  # a torque of the right sign is explained at least this well
_EXCUSED = 0.3  # a torque that is explained so well with some load may have the right sign
_MUCH_BETTER = 12.0  # ... unless the other sign explains it that many times better
_NOISE = 3e-3  # share of a torque's variance that is as good as explained
_TILT = 5.0  # [deg] gravity farther than this off is worth a warning
_TURNED = 30.0  # [deg] ... and farther than this gives wrong answers
_HINT = 0.7  # gain from which a tilt is believed
_UNEXPLAINED = 0.25  # share of a torque's variance that no physics explains


@dataclass(frozen=True)
class _Reading:
    """The reading that explains the torques of a log best, beside the stated one."""

    probe: Probe
    stated: Explanation
    best: Explanation
    log: str

    @property
    def gain(self) -> float:
        return self.stated.misfit - self.best.misfit

    @property
    def is_certain(self) -> bool:
        return self.gain > _CERTAIN and float(np.median(self.best.share)) < _EXPLAINED

    @property
    def joints(self) -> list[str]:
        return [self.probe.model.joints[j] for j in self.best.joints]

    def finding(self, message: str, part: str) -> Finding:
        """Return that columns hold something else than is stated."""
        return log_finding(
            self.log, self.best.kind, "error", message, part, gain=self.gain,
            unexplained=self.stated.share.max(), unexplained_so_read=self.best.share.max(),
        )  # fmt: skip


def check_torques(probe: Probe, name: str) -> Iterator[Finding]:
    """Yield what must be otherwise for the torques to fit the model.

    The reading that explains the torques best is named, and only it; where the log is right as it
    stands, the URDF's masses are checked.

    Args:
        probe: The motion.
        name: What the log is called.

    Yields:
        Errors "torque_sign", "unsigned_torque", "torque_order", "joint_order", "joint_axis",
        "position_order", "position_sign", "position_offset", "gravity" or "gravity_compensated",
        or else what ``check_unmounted_parts`` or ``check_loads`` yields; and "unexplained_torque";
        beside these a warning "counterbalance".
    """
    probe, balanced = counterbalance(probe, name)
    yield from balanced
    stated, loaded, others = explanations(probe)
    best = min(others, key=lambda e: e.misfit)
    if best.kind not in ("torque_sign", "unsigned_torque") and loaded.misfit < best.misfit:
        best = stated  # a load explains it better
    make = _FINDINGS.get(best.kind)
    found = list(make(_Reading(probe, stated, best, name))) if make else []
    for finding in found:
        # what a load on the last link would explain as well is no error for certain
        yield replace(finding, severity="warning") if _is_excused(best, loaded) else finding
    if not found:
        loads = list(check_loads(probe, loaded.share, name))
        if not {finding.code for finding in loads} - {"payload"}:
            parts = list(check_unmounted_parts(probe, loaded.share, name))
            loads = parts or loads
        yield from loads
        yield from _unexplained(probe, loaded.share, name)


def _sign(reading: _Reading) -> Iterator[Finding]:
    for j, joint in zip(reading.best.joints, reading.joints, strict=True):
        before, after = reading.stated.share[j], reading.best.share[j]
        if before < _WRONG or after > _EXPLAINED:
            continue
        message = (
            f"the torque of {joint} has the opposite sign: as it is, {100 * before:.0f} % of its "
            f"variance cannot be explained, negated {100 * after:.2g} %; negate tau_{joint} (or "
            "its gain), or check the joint's axis in the URDF"
        )
        evidence = {"unexplained": before, "unexplained_if_negated": after}
        yield log_finding(reading.log, "torque_sign", "error", message, joint, **evidence)


def _unsigned(reading: _Reading) -> Iterator[Finding]:
    for j, joint in zip(reading.best.joints, reading.joints, strict=True):
        before, after = reading.stated.share[j], reading.best.share[j]
        if after > _EXPLAINED:
            continue
        message = (
            f"the torque of {joint} is a size without its sign: as it is, {100 * before:.0f} % of "
            f"its variance cannot be explained, with the signs of the motion {100 * after:.2g} %; "
            f"log tau_{joint} with its sign"
        )
        evidence = {"unexplained": before, "unexplained_with_signs": after}
        yield log_finding(reading.log, "unsigned_torque", "error", message, joint, **evidence)


def _exchanged(reading: _Reading) -> Iterator[Finding]:
    if not reading.is_certain:
        return
    names, best = reading.joints, reading.best
    if best.kind == "torque_order":
        owners = [reading.probe.model.joints[int(best.values[j])] for j in best.joints]
        shown = ", ".join(f"tau_{a} is that of {b}" for a, b in zip(names, owners, strict=True))
        what, todo = f"torque columns are exchanged: {shown}", "rename these torque columns"
    elif best.kind == "position_order":
        what, todo = f"the position columns of {listed(names)} are exchanged", "rename them"
    else:
        what, todo = f"all columns of {listed(names)} are exchanged", "name the joints rightly"
    message = (
        f"{what}: so read, the unexplained share of the worst torque falls from "
        f"{100 * reading.stated.share.max():.2g} to {100 * best.share.max():.2g} %; {todo}"
    )
    yield reading.finding(message, listed(names))


def _position(reading: _Reading) -> Iterator[Finding]:
    if not reading.is_certain:
        return
    best, (joint,) = reading.best, reading.joints
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
    before = reading.stated.share
    worst = int(np.argmax(before - best.share))
    message = (
        f"{what}: so read, the unexplained share of {reading.probe.model.joints[worst]}'s torque "
        f"falls from {100 * before[worst]:.3g} to {100 * best.share[worst]:.3g} %"
    )
    yield reading.finding(message, joint)


def _gravity(reading: _Reading) -> Iterator[Finding]:
    g, believed, gain = np.array(reading.best.values), reading.probe.gravity, reading.gain
    size = float(np.linalg.norm(believed))
    if not g.any():
        if size > 0 and reading.is_certain and not holds_gravity(reading.probe):
            code = "gravity_compensated"
            yield log_finding(reading.log, code, "error", NO_GRAVITY, gain=gain)
        return
    cosine = float(g @ believed) / (float(np.linalg.norm(g)) * size) if size > 0 else 0.0
    angle = float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))
    turned = angle > _TURNED and reading.is_certain
    if not turned and (angle < _TILT or gain < _HINT):
        return
    shown, stated = (", ".join(f"{x:.2f}" for x in vector) for vector in (g, believed))
    message = (
        f"gravity along [{shown}] m/s^2 explains the torques best, {angle:.0f} degrees from the "
        f"stated [{stated}]; if the robot is mounted on a wall, a ceiling or a slope, state "
        f"gravity = [{shown}] in the job file"
    )
    evidence = {"angle_deg": angle, "x": g[0], "y": g[1], "z": g[2], "gain": gain}
    severity = "error" if turned else "warning"
    yield log_finding(reading.log, "gravity", severity, message, **evidence)


_FINDINGS: dict[str, Callable[[_Reading], Iterator[Finding]]] = {
    "torque_sign": _sign,
    "unsigned_torque": _unsigned,
    "torque_order": _exchanged,
    "joint_order": _exchanged,
    "position_order": _exchanged,
    "joint_axis": _position,
    "position_sign": _position,
    "position_offset": _position,
    "gravity": _gravity,
}


def _is_excused(best: Explanation, loaded: Explanation) -> bool:
    if best.kind in ("torque_sign", "unsigned_torque"):
        excused = (
            loaded.share[j] < min(_EXCUSED, _MUCH_BETTER * (best.share[j] + _NOISE))
            for j in best.joints
        )
        return all(excused)
    return loaded.misfit - best.misfit < _CERTAIN


def _unexplained(probe: Probe, share: Array, name: str) -> Iterator[Finding]:
    """Yield torques of which physics leaves too much, or once that most of them are so."""
    bad = np.flatnonzero(share > _UNEXPLAINED)
    if 2 * len(bad) > len(share):
        message = (
            f"the torques of {len(bad)} of {len(share)} joints fit neither gravity, inertia nor "
            "friction of this model: the base may move or the robot touch something, the log or "
            "the URDF may be of another robot; nothing identified from it can be right"
        )
        evidence = {"joints": len(bad), "share": float(np.median(share))}
        yield log_finding(name, "unexplained_torque", "warning", message, **evidence)
        return
    for j in bad:
        joint = probe.model.joints[j]
        message = (
            f"{100 * share[j]:.0f} % of the variance of {joint}'s torque fits neither gravity, "
            "inertia nor friction: the channel may hold another quantity, little but noise, a "
            "spring, a gear that is not round, or a drive that is coupled to others; what depends "
            "on it is not to be trusted"
        )
        yield log_finding(name, "unexplained_torque", "warning", message, joint, share=share[j])
