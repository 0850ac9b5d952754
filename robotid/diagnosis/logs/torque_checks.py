"""Checks of the torques against the model: signs, order of columns, gravity, positions."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from robotid.base.findings import Finding, listed, log_finding
from robotid.base.typing import Array
from robotid.diagnosis.logs.hypotheses import HINT, Explanation, explanations
from robotid.diagnosis.logs.loads import NO_GRAVITY, check_loads, counterbalance, holds_gravity
from robotid.diagnosis.logs.mounted import check_unmounted_parts
from robotid.diagnosis.logs.torque_sample import Probe

_CERTAIN = 2.5  # significant decrease of the logarithm of the unexplained share, a factor 12
_EXPLAINED = 0.2  # largest unexplained share of a reading that is accepted
_WRONG = 0.5  # largest unexplained share of a torque with the right sign
_EXCUSED = 0.3  # ... and the largest with a load, at which the sign may still be right
_MUCH_BETTER = 12.0  # ratio of unexplained shares from which the other sign is right nevertheless
_NOISE = 3e-3  # share of a torque's variance that is negligible
_TILT = 5.0  # [deg] angle of gravity from the stated one that is a warning
_WRONG_TILT = 30.0  # [deg] ... and an error
_STILL = 1e-3  # [rad, m] range of a joint at rest, as of the finding "static_joint"
_UNEXPLAINED = 0.25  # unexplained share of a torque's variance that is reported


@dataclass(frozen=True)
class _Reading:
    """The reading of a log that explains its torques best, and the stated one."""

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
        """Return the error that columns contain other quantities than stated."""
        return log_finding(
            self.log, self.best.kind, "error", message, part, gain=self.gain,
            unexplained=self.stated.share.max(), unexplained_so_read=self.best.share.max(),
        )  # fmt: skip


def check_torques(probe: Probe, name: str) -> Iterator[Finding]:
    """Yield the faults of signs, columns, gravity or URDF that keep the torques from fitting.

    Only the reading that explains the torques best is reported; if it is the stated one, the
    URDF's masses are checked.
    """
    probe, balanced = counterbalance(probe, name)
    yield from balanced
    stated, loaded, others = explanations(probe)
    best = min(others, key=lambda e: e.misfit)
    if best.kind not in ("torque_sign", "unsigned_torque") and loaded.misfit < best.misfit:
        best = stated  # a load explains the torques better
    make = _FINDINGS.get(best.kind)
    found = list(make(_Reading(probe, stated, best, name))) if make else []
    for finding in found:
        # a fault that a load on the last link explains as well is only a warning
        yield replace(finding, severity="warning") if _is_excused(best, loaded) else finding
    if not found:
        loads = list(check_loads(probe, loaded.share, name))
        if not {finding.code for finding in loads} - {"payload"}:
            parts = list(check_unmounted_parts(probe, loaded.share, name))
            loads = parts or loads
        yield from loads
        # the friction of a joint at rest has any value: nothing contradicts its torque
        still = np.ptp(probe.motion.q, axis=0) < _STILL
        yield from _unexplained(probe, np.where(still, 0.0, loaded.share), name)


def _sign(reading: _Reading) -> Iterator[Finding]:
    for j, joint in zip(reading.best.joints, reading.joints, strict=True):
        before, after = reading.stated.share[j], reading.best.share[j]
        if before < _WRONG or after > _EXPLAINED:
            continue
        message = (
            f"the torque of {joint} has the opposite sign: {100 * before:.0f} % of its variance "
            f"is unexplained, with the sign reversed {100 * after:.2g} %; negate tau_{joint} (or "
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
            f"the torque of {joint} is logged without its sign: {100 * before:.0f} % of its "
            f"variance is unexplained, with the signs of the model {100 * after:.2g} %; log "
            f"tau_{joint} with its sign"
        )
        evidence = {"unexplained": before, "unexplained_with_signs": after}
        yield log_finding(reading.log, "unsigned_torque", "error", message, joint, **evidence)


def _exchanged(reading: _Reading) -> Iterator[Finding]:
    if not reading.is_certain:
        return
    names, best = reading.joints, reading.best
    if best.kind == "torque_order":
        owners = [reading.probe.model.joints[int(best.values[j])] for j in best.joints]
        pairs = zip(names, owners, strict=True)
        shown = ", ".join(f"tau_{a} is the torque of {b}" for a, b in pairs)
        what, todo = f"torque columns are exchanged: {shown}", "rename these columns"
    elif best.kind == "position_order":
        what, todo = f"the position columns of {listed(names)} are exchanged", "rename them"
    else:
        what, todo = f"all columns of {listed(names)} are exchanged", "correct the joint names"
    message = (
        f"{what}. With these columns exchanged, the largest unexplained share of a torque "
        f"decreases from {100 * reading.stated.share.max():.2g} to "
        f"{100 * best.share.max():.2g} %; {todo}"
    )
    yield reading.finding(message, listed(names))


def _position(reading: _Reading) -> Iterator[Finding]:
    if not reading.is_certain:
        return
    best, (joint,) = reading.best, reading.joints
    if best.kind == "joint_axis":
        what = (
            f"position and torque of {joint} have the opposite sign: its axis is reversed. Reverse "
            f"the joint's axis in the URDF, or negate q_{joint}, dq_{joint} and tau_{joint}"
        )
    elif best.kind == "position_sign":
        what = f"the position of {joint} has the opposite sign. Negate q_{joint} (and dq_{joint})"
    else:
        what = (
            f"the zero position of {joint} has an error of about {best.values[0]:.2g} rad. Correct "
            f"q_{joint} or the joint's origin in the URDF"
        )
    before = reading.stated.share
    worst = int(np.argmax(before - best.share))
    message = (
        f"{what}. The unexplained share of the torque of {reading.probe.model.joints[worst]} then "
        f"decreases from {100 * before[worst]:.3g} to {100 * best.share[worst]:.3g} %"
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
    is_wrong = angle > _WRONG_TILT and reading.is_certain
    if not is_wrong and (angle < _TILT or gain < HINT):
        return
    shown, stated = (", ".join(f"{x:.2f}" for x in vector) for vector in (g, believed))
    message = (
        f"gravity [{shown}] m/s^2 explains the torques best. Its direction is {angle:.0f} degrees "
        f"from the stated [{stated}]; if the robot is mounted on a wall, a ceiling or a slope, "
        f"state gravity = [{shown}] in the job file"
    )
    evidence = {"angle_deg": angle, "x": g[0], "y": g[1], "z": g[2], "gain": gain}
    severity = "error" if is_wrong else "warning"
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
    """Yield torques with a large unexplained share; one finding if these are most of them."""
    bad = np.flatnonzero(share > _UNEXPLAINED)
    if 2 * len(bad) > len(share):
        message = (
            f"the torques of {len(bad)} of {len(share)} joints fit neither gravity, inertia nor "
            "friction of this model. The base may move, the robot may touch its environment, or "
            "the log and the URDF may be of different robots; an identification from this log is "
            "wrong"
        )
        evidence = {"joints": len(bad), "share": float(np.median(share))}
        yield log_finding(name, "unexplained_torque", "warning", message, **evidence)
        return
    for j in bad:
        joint = probe.model.joints[j]
        message = (
            f"{100 * share[j]:.0f} % of the variance of {joint}'s torque fits neither gravity, "
            "inertia nor friction. The channel may contain another quantity or mostly noise; the "
            "joint may have a spring, an eccentric gear or a coupled drive. Parameters that depend "
            "on this torque are not reliable"
        )
        yield log_finding(name, "unexplained_torque", "warning", message, joint, share=share[j])
