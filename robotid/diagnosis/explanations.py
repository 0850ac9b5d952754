"""Findings that another finding explains.

Findings have stages: 1 the meaning of channels, 2 their values, 3 the torques, 4 what has no named
cause, 5 the residual of a fit, 6 differences between logs. What is found of a fit is evidence only
if every certain reading of a log, which would change that fit, was applied.
"""

from collections.abc import Collection, Iterable, Mapping

import numpy as np

from robotid.base.findings import Finding
from robotid.base.typing import Array
from robotid.diagnosis.catalogue import entries
from robotid.diagnosis.decisions import BETTER
from robotid.robot.model import RobotModel

_UNNAMED, _RESIDUAL = 4, 5  # stages


def explained(
    findings: Iterable[Finding], model: RobotModel, ignore: Collection[str] = ()
) -> list[Finding]:
    """Return findings without those that one of an earlier stage explains; of a fit as notes."""
    carried = model.support[-len(model.joints) :, : model.layout.n_inertial : 10]
    bound = dict(zip(model.joints, carried @ carried.T, strict=True))
    rest, causes = list(findings), list[Finding]()
    for one in sorted((x for x in rest if x.severity != "note" and _stage(x)), key=_stage):
        if any(_explains(cause, one, bound) for cause in causes):
            i, notes = rest.index(one), [one.reworded(severity="note")]
            rest[i : i + 1] = notes if _stage(one) >= _RESIDUAL else []
        elif one.code not in ignore and one.evidence.get("gain", 1.0) > BETTER:
            causes.append(one)
    return rest


def _stage(one: Finding) -> int:
    """Return the stage of a finding; 0 of one that neither explains nor is explained."""
    stage, is_of_fit = int(entries()[one.code].get("stage", 0)), one.severity != "error"
    return _RESIDUAL if 0 < stage < _UNNAMED and not one.log and is_of_fit else stage


def _explains(cause: Finding, one: Finding, bound: Mapping[str, Array]) -> bool:
    """Return whether a finding explains one of its stage or a later one."""
    before, stage, joints = _stage(cause), _stage(one), [*bound]
    if stage < _UNNAMED:  # it is found of one channel, or with the readings before it applied
        is_same = not cause.joints or set(cause.joints) >= set(one.joints) > set()
        return before == stage - 1 and cause.log == one.log and is_same
    if before in (stage, _UNNAMED):
        return False
    # a fit binds the joints that carry a common body
    named = [joint for joint in cause.joints if joint in bound] or joints
    reached = np.any([bound[joint] for joint in named], axis=0)
    return bool((reached & np.isin(joints, one.joints or joints)).any())
