"""Uses of a result: what it can be used for, and what it cannot, in one line."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from robotid.base.findings import listed

if TYPE_CHECKING:
    from robotid.diagnosis.verdict.scale_check import ScaleCheck

_NAMED = 3  # joints that the line names
_NOT_VERIFIED = "not verified, no validation log"
_UNSCALED = "torque scale not verified"


def uses_of_torques(
    joints: Mapping[str, str],
    *,
    is_consistent: bool,
    is_static: bool,
    log_errors: Sequence[str],
    scale_check: ScaleCheck | None,
) -> dict[str, str]:
    """Return what a result with predicted torques can be used for: "yes" or "no", and why.

    Torque feed-forward needs the predicted torque of its joints. Inertials in a simulation need
    physical consistency and the torque scale, too. The mass of a payload is that of the gravity
    torque: it needs the joints that gravity loads, and the torque scale.
    """
    predicted = _predicted(joints)
    loaded = (
        {} if scale_check is None else {j: s for j, s in joints.items() if j in scale_check.gravity}
    )
    if log_errors:
        predicted = inertials = payload = "no, errors of the recordings"
    elif scale_check is not None and scale_check.contradicts:
        inertials = payload = "no, the torque scale is contradicted"
    else:
        is_scaled = scale_check is not None and scale_check.agrees
        inertials = predicted if is_scaled else _with(predicted, _UNSCALED)
        payload = _predicted(loaded) if loaded else "no, no joint determines its gravity"
        payload = payload if is_scaled else _with(payload, _UNSCALED)
        if not is_consistent:
            inertials = "no, not physically consistent"
        elif "poor" in joints.values():
            inertials = f"no, torques of {_named(joints, 'poor')} are poor"
    if is_static:
        predicted = _with(predicted, "at rest and in slow motion")
        inertials = "no, inertias are the URDF's" if inertials.startswith("yes") else inertials
    return {
        "torque feed-forward": predicted,
        "inertials in simulation": inertials,
        "payload estimation": payload,
    }


def uses_of_motion(
    joints: Mapping[str, str], *, log_errors: Sequence[str], is_scaled: bool
) -> dict[str, str]:
    """Return what a result with simulated positions can be used for: "yes" or "no", and why."""
    simulated = "no, errors of the recordings" if log_errors else _predicted(joints)
    torque = simulated if is_scaled else _with(simulated, "scale not verified by a torque")
    return {
        "simulation of drives and controllers": simulated,
        "torque feed-forward": torque,
        "payload estimation": "no, it needs a result from logged torques",
    }


def uses_line(uses: Mapping[str, str]) -> str:
    """Return the uses as one line of text; "" if there are none."""
    return f"use for: {'; '.join(f'{what}: {is_so}' for what, is_so in uses.items())}" * bool(uses)


def _predicted(joints: Mapping[str, str]) -> str:
    """Return whether the predictions of joints can be used."""
    tested = {joint: status for joint, status in joints.items() if status != "not evaluated"}
    if not tested:
        return _NOT_VERIFIED
    poor = [joint for joint, status in tested.items() if status == "poor"]
    if len(poor) == len(tested):
        return "no, the errors on validation logs are large"
    if poor:
        return f"yes, without {_named(joints, 'poor')}"
    if len(tested) < len(joints):
        return f"yes, without {_named(joints, 'not evaluated')} (not evaluated)"
    return "yes, with the warnings" if "usable" in tested.values() else "yes"


def _named(joints: Mapping[str, str], status: str) -> str:
    """Return the joints with a status, as part of a sentence."""
    return listed([joint for joint, found in joints.items() if found == status], _NAMED)


def _with(use: str, condition: str) -> str:
    """Return a use under a condition; a "no" remains."""
    return f"{use}, {condition}" if use.startswith("yes") else use
