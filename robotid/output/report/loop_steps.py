"""Next steps after a closed-loop identification."""

import shlex
from collections.abc import Mapping
from typing import Any

from robotid.base.findings import Finding, grouped, listed
from robotid.output.report.steps import MOST, NAMED, Origin, Step, exports_of, sentence_of


def loop_steps(content: Mapping[str, Any], origin: Origin) -> tuple[Step, ...]:
    """Return the next steps for a result of closed-loop identification.

    They are its uses, if it was written; of a poor result, what to correct, three at most.
    """
    if content["verdict"]["status"] == "poor":
        return _loop_repairs(content, origin)[:MOST]
    exports = exports_of(
        content["robot"], origin, has_gains=content["simulation"]["controller"]["kind"] != "torque"
    )
    return (_loop_replay(content, origin), *exports) if origin.folder else ()


def _loop_repairs(content: Mapping[str, Any], origin: Origin) -> tuple[Step, ...]:
    """Return what to correct for a poor result: logs, causes that findings name, joints."""
    verdict, steps = content["verdict"], []
    again = (origin.again(),) if origin.source else ()
    if errors := verdict["log_errors"]:
        words = f"Correct the logs, then repeat the identification: {errors[0]}."
        doctor = (shlex.join(["robotid", "doctor", *origin.source]),) if origin.source else ()
        return (Step(words, (*doctor, *again)),)
    poor = [name for name, own in verdict["per_joint"].items() if own["status"] == "poor"]
    warnings = [
        Finding(entry["code"], entry["severity"], entry["where"], entry["message"])
        for entry in content["warnings"]
        if entry["severity"] == "warning"
    ]
    causes = grouped(warnings, content["joints"])
    causes = tuple(sorted(causes, key=lambda cause: not set(poor).intersection(cause.joints)))
    steps += [Step(f"{sentence_of(c.messages[0])}.") for c in causes[: MOST - 1]]
    words = (
        f"Do not use the result: the simulated position of {listed(poor, NAMED)} is wrong. Find "
        "out in the replay when, correct gains, limits, encoder zeros or the motion, and repeat "
        "the identification."
    )
    return (*steps, Step(words, (*_loop_replay(content, origin).blocks, *again)))


def _loop_replay(content: Mapping[str, Any], origin: Origin) -> Step:
    """Return the step that plays a result of closed-loop identification."""
    paths = {x["role"]: x["path"] for x in reversed(content["inputs"])}  # the first of each role
    urdf = paths.get("urdf", "")
    log = paths.get("validation", paths.get("identification", ""))
    has_gains = content["simulation"]["controller"]["kind"] != "torque"
    words = "Compare measured and predicted torque in the replay."
    if has_gains:
        words = "Compare the commanded, measured and simulated robot in the replay."
    return Step(words, origin.using("replay", urdf, log, f"{origin.folder}/result.json"))
