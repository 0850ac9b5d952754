"""Checks of the torques against the model: signs, order of columns, gravity, positions."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from robotid.base.findings import Finding
from robotid.base.typing import Array
from robotid.diagnosis.catalogue import finding
from robotid.diagnosis.logs.hypotheses import HINT, Explanation, explanations
from robotid.diagnosis.logs.loads import (
    check_loads,
    counterbalance,
    holds_gravity,
)
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

    def finding(self, joints: Sequence[str], **values: float | str) -> Finding:
        """Return the error that columns contain other quantities than stated."""
        return finding(
            self.best.kind, self.log, joints, gain=self.gain,
            unexplained=self.stated.share.max(), unexplained_so_read=self.best.share.max(),
            **values,
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
    for one in found:
        # a fault that a load on the last link explains as well is only a warning
        yield replace(one, severity="warning") if _is_excused(best, loaded) else one
    if not found:
        yield from check_loads(probe, loaded.share, name)
        # the friction of a joint at rest has any value: nothing contradicts its torque
        still = np.ptp(probe.motion.q, axis=0) < _STILL
        yield from _unexplained(probe, np.where(still, 0.0, loaded.share), name)


def _sign(reading: _Reading) -> Iterator[Finding]:
    for j, joint in zip(reading.best.joints, reading.joints, strict=True):
        before, after = reading.stated.share[j], reading.best.share[j]
        if before >= _WRONG and after <= _EXPLAINED:
            evidence = {"unexplained": before, "unexplained_if_negated": after}
            yield finding("torque_sign", reading.log, joint, **evidence)


def _unsigned(reading: _Reading) -> Iterator[Finding]:
    for j, joint in zip(reading.best.joints, reading.joints, strict=True):
        before, after = reading.stated.share[j], reading.best.share[j]
        if after <= _EXPLAINED:
            yield finding(
                "unsigned_torque", reading.log, joint, kind="one", cure="one", unexplained=before,
                unexplained_with_signs=after,
            )  # fmt: skip


def _exchanged(reading: _Reading) -> Iterator[Finding]:
    if not reading.is_certain:
        return
    names, best, owners = reading.joints, reading.best, ""
    if best.kind == "torque_order":
        joints = [reading.probe.model.joints[int(best.values[j])] for j in best.joints]
        pairs = zip(names, joints, strict=True)
        owners = ", ".join(f"tau_{a} is the torque of {b}" for a, b in pairs)
    yield reading.finding(names, owners=owners)


def _position(reading: _Reading) -> Iterator[Finding]:
    if reading.is_certain:
        before, best = reading.stated.share, reading.best
        worst = int(np.argmax(before - best.share))
        offset = {"offset": best.values[0]} if best.values else {}
        yield reading.finding(
            reading.joints, worst=reading.probe.model.joints[worst], before=before[worst],
            after=best.share[worst], what="log", cure="log", **offset,
        )  # fmt: skip


def _gravity(reading: _Reading) -> Iterator[Finding]:
    g, believed, gain = np.array(reading.best.values), reading.probe.gravity, reading.gain
    size = float(np.linalg.norm(believed))
    if not g.any():
        if size > 0 and reading.is_certain and not holds_gravity(reading.probe):
            yield finding("gravity_compensated", reading.log, gain=gain)
        return
    cosine = float(g @ believed) / (float(np.linalg.norm(g)) * size) if size > 0 else 0.0
    angle = float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))
    is_wrong = angle > _WRONG_TILT and reading.is_certain
    if not is_wrong and (angle < _TILT or gain < HINT):
        return
    best, stated = (", ".join(f"{x:.2f}" for x in vector) for vector in (g, believed))
    evidence = {"angle_deg": angle, "x": g[0], "y": g[1], "z": g[2], "gain": gain}
    yield finding(
        "gravity", reading.log, severity="error" if is_wrong else "warning", what="log",
        cure="log", best=best, stated=stated, **evidence,
    )  # fmt: skip


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
    code, bad = "unexplained_torque", np.flatnonzero(share > _UNEXPLAINED)
    if 2 * len(bad) > len(share):
        evidence = {"joints": len(bad), "of": len(share), "share": float(np.median(share))}
        yield finding(code, name, what="robot", **evidence)
        return
    for j in bad:
        yield finding(code, name, probe.model.joints[j], what="joint", share=share[j])
