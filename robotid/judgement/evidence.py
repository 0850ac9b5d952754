"""What a verdict depends on: how well torque is predicted, and what the data determine."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from robotid.findings import listed
from robotid.fitting.metrics import JointMetrics, Metrics

__all__ = ["BEATEN", "GOOD", "POOR", "Determined", "Predictions", "error_of", "is_beaten"]

#: [%] a joint predicted within this on validation recordings is predicted well.
GOOD = 15.0
#: [%] a joint predicted worse than this is not usable.
POOR = 50.0
#: A plainer model is better if it misses this many times less ...
BEATEN = 1.05

_TIE = 0.3  # [%] ... and, of the URDF with fitted drives, by this share of the torque
_OPTIMISM = 2.0  # an error this many times the fitted one on validation logs shows over-fitting
_NAMED = 8  # parameters that a reason names


@dataclass(frozen=True)
class Predictions:
    """How well the torque of each joint is predicted.

    Attributes:
        fit: Metrics over the fitted recordings.
        validation: Metrics of each validation log, by its name.
        joints: The model's joints; one without a row in any recording is not evaluated.
        refitted: Validation logs, by name, that are left out since they hold fitted rows.
        hidden: Joints that are not evaluated, as of ``hidden_joints``; metrics of them are ignored.
    """

    fit: Metrics
    validation: Mapping[str, Metrics]
    joints: Sequence[str] = ()
    refitted: Sequence[str] = ()
    hidden: Sequence[str] = ()

    @cached_property
    def fitted(self) -> dict[str, JointMetrics]:
        """Metrics of each joint over the fitted recordings."""
        return self._seen(self.fit)

    @cached_property
    def tested(self) -> dict[str, dict[str, JointMetrics]]:
        """Metrics of each joint on each validation log."""
        return {log: self._seen(metrics) for log, metrics in self.validation.items()}

    def _seen(self, metrics: Metrics) -> dict[str, JointMetrics]:
        return {joint: m for joint, m in metrics.per_joint.items() if joint not in self.hidden}

    def on_each(self) -> dict[str, tuple[list[str], list[str], list[float]]]:
        """Return of each joint what makes it poor, what doubtful, and its errors [%] by log."""
        moved = [joint for m in (self.fitted, *self.tested.values()) for joint in m]
        named = [joint for joint in self.joints if joint not in self.hidden]
        return {joint: self._on(joint) for joint in dict.fromkeys([*named, *moved])}

    def _on(self, joint: str) -> tuple[list[str], list[str], list[float]]:
        poor, warnings, errors = [], [], []
        for log, metrics in self.tested.items():
            measured = metrics.get(joint)
            if measured is not None:
                found = _judge_joint(joint, log, measured, self.fitted.get(joint))
                poor += found[0]
                warnings += found[1]
                errors.append(error_of(measured))
        return poor, warnings, errors

    def untested(self) -> list[str]:
        """Return why no prediction of a new motion was evaluated, if none was."""
        if self.validation:
            return []
        held = f"{listed(self.refitted)} hold rows that were fitted"
        why = held if self.refitted else "no validation log given"
        return [f"the prediction of a new motion was not evaluated: {why}"]

    def left_to_urdf(self) -> list[str]:
        """Return which joints the URDF with fitted drives predicts better, and what to do."""
        worse = [j for own in self.tested.values() for j, m in own.items() if is_beaten(m)]
        if not worse:
            return []
        return [
            f"the URDF with fitted drives predicts {listed(dict.fromkeys(worse))} better than the "
            "identified bodies: leave the links of these joints at the URDF, as pinned in "
            "[estimator.constraints]"
        ]

    def unseen(self) -> list[str]:
        """Return which joints move in no recording, and which in no validation log."""
        fitted, kept = self.fitted, {joint for own in self.tested.values() for joint in own}
        names = [joint for joint in self.on_each() if joint not in kept]
        still = [joint for joint in names if joint not in fitted]
        missing = [joint for joint in names if joint in fitted]
        if still and not fitted:  # measured again without the fitted recordings
            still, missing = [], still
        reasons = []
        if still:
            reasons.append(f"the joints {listed(still)} move in no recording: not evaluated")
        if missing and self.validation:
            reasons.append(
                f"the joints {listed(missing)} do not move in any validation log: not evaluated"
            )
        return reasons

    def why_unseen(self, joint: str) -> str:
        """Return why a joint was evaluated on no validation log.

        Args:
            joint: The joint.
        """
        if joint not in self.fitted:
            return "it does not move in any recording"
        if self.validation:
            return "it does not move in any validation recording"
        return "no recording was kept apart"


@dataclass(frozen=True)
class Determined:
    """What the data determine of the parameters.

    Attributes:
        undetermined: Base parameters that the data do not determine by themselves.
        is_consistent: Whether the parameters are physically possible.
        is_poorly_excited: Whether a richer motion would determine them; else noise hides them.
        is_static: Whether the model is.
    """

    undetermined: Sequence[str] = ()
    is_consistent: bool = True
    is_poorly_excited: bool = True
    is_static: bool = False

    def warnings(self) -> list[str]:
        """Return what keeps the result from being good."""
        reasons = []
        if self.undetermined and self.is_poorly_excited:
            reasons.append(
                f"the data do not determine {len(self.undetermined)} base parameters by "
                f"themselves: {listed(self.undetermined, _NAMED)}"
            )
        if not self.is_consistent:
            reasons.append(
                "the standard parameters are not physically consistent, so no URDF was written; "
                "the base parameters predict torque all the same"
            )
        return reasons

    def notes(self) -> list[str]:
        """Return what does not change the verdict: what noise hides of the parameters."""
        if not self.undetermined or self.is_poorly_excited:
            return []
        return [
            f"{len(self.undetermined)} base parameters are lost in the noise of a rich motion or "
            "known only in sums with others; what the data leave open keeps the URDF's values: "
            f"{listed(self.undetermined, _NAMED)}"
        ]


def is_beaten(measured: JointMetrics) -> bool:
    """Return whether the URDF's bodies with fitted drives predict a joint clearly better.

    Args:
        measured: How well it is predicted.
    """
    driven = measured.baselines.get("urdf_with_drives")
    return driven is not None and error_of(measured) > max(BEATEN * driven, driven + _TIE)


def error_of(measured: JointMetrics) -> float:
    """Return the relative error of a joint [%], inf where nothing was measured.

    Args:
        measured: How well it is predicted.
    """
    value = measured.relative_error_pct
    return float("inf") if value is None else value


def _judge_joint(
    joint: str, log: str, measured: JointMetrics, fitted: JointMetrics | None
) -> tuple[list[str], list[str]]:
    """Return what makes the result poor, and what makes it doubtful, on one joint."""
    error = error_of(measured)
    urdf = measured.baselines.get("urdf")
    if measured.relative_error_pct is None:
        return [f"{joint}: the torque on {log} is 0 throughout: nothing was predicted"], []
    if not measured.better_than_constant:
        constant = error / np.sqrt(1.0 - measured.r2)
        why = f"{error:.1f} % of it is missed, by its mean {constant:.1f} %"
        return [f"{joint}: worse than a constant torque on {log}: {why}"], []
    if urdf is not None and error > urdf:
        return [f"{joint}: {error:.1f} % on {log}, worse than the URDF's {urdf:.1f} %"], []
    if error > POOR:
        return [f"{joint}: predicted to {error:.1f} % only on {log}"], []
    if error > GOOD:
        why = f"predicted to {error:.1f} % on {log} (wanted: {GOOD:g} %)"
        return [], [f"{joint}: {why}; see in the report what its residual holds"]
    if fitted is not None and error > max(_OPTIMISM * error_of(fitted), 5.0):
        return [], [
            f"{joint}: {error:.1f} % on {log} against {error_of(fitted):.1f} % where it was "
            "fitted; record a richer motion to fit"
        ]
    if is_beaten(measured):
        driven = measured.baselines["urdf_with_drives"]
        why = f"{error:.1f} % on {log}, {driven:.1f} % by the URDF with fitted drives"
        return [], [f"{joint}: {why}: leave its link at the URDF"]
    return [], []
