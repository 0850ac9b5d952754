"""The report's first screen: verdict, errors by joint, what was found, what to do next."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from robotid.fitting.identified import SOURCES
from robotid.fitting.metrics import JointMetrics
from robotid.identification.result import Identification
from robotid.judgement.verdict import GOOD, POOR, error_of
from robotid.pages.html import facts_html, steps_html, verdict_html
from robotid.report.advice import Origin, Step, next_steps
from robotid.report.bars import Bar, Mark, bars_html

__all__ = ["DETERMINED", "first_screen", "joint_errors", "summary_screen"]

#: In words, what determined a parameter.
DETERMINED = {
    "data": "motion",
    "mixed": "motion and prior",
    "prior": "prior",
    "bound": "at its bound",
}
#: Other predictions of the same torque.
_OTHERS = {
    "wls": Mark("WLS", "M-5 -1h10l-5 6z", "fill"),
    "urdf_with_drives": Mark("URDF + drives", "M-5 19h10l-5 -6z", "fill"),
    "gravity_only": Mark("gravity only", "M-3 6l6 6m0 -6l-6 6", "line"),
    "urdf": Mark("URDF", "M0 0v18", "line"),
}


def first_screen(
    robot: str,
    verdict: Mapping[str, Any],
    facts: Mapping[str, str],
    files: Mapping[str, str],
    bars: str,
    steps: Sequence[Step],
) -> str:
    """Return the HTML of the first screen of any report.

    Args:
        robot: Name of the robot.
        verdict: Status and reasons, as in result.json.
        facts: What is said by its name, both HTML.
        files: Files beside the report, by what they are.
        bars: HTML of the errors of joints.
        steps: What to do next.
    """
    return (
        f"{verdict_html(robot, verdict['status'], verdict['reasons'])}{facts_html(facts, files)}"
        f'<div class="halves">\n<div>{bars}</div>\n'
        f"<div>{steps_html((step.words, step.blocks) for step in steps)}</div>\n</div>\n"
    )


def summary_screen(found: Identification, origin: Origin, files: Mapping[str, str]) -> str:
    """Return the HTML of the first screen of an identification from torques.

    Args:
        found: The identification.
        origin: Where it came from, for commands.
        files: Files beside the report, by what they are.
    """
    verdict, steps = found.verdict.to_dict(), next_steps(found, origin)
    return first_screen(found.model.name, verdict, _facts(found), files, _bars(found), steps)


def joint_errors(found: Identification) -> dict[str, tuple[JointMetrics, float | None]]:
    """Return by joint how it is predicted on the kept recording where it is worst, and by WLS [%].

    Without a kept recording, how it is fitted.

    Args:
        found: The identification.

    Returns:
        The joints that move, the worst first.
    """
    kept = [e for e in found.validation if not e.is_refitted]
    pairs = [(e.metrics["estimate"], e.metrics["wls"]) for e in kept]
    errors: dict[str, tuple[JointMetrics, float | None]] = {}
    for metrics, wls in pairs or [(found.metrics(), found.metrics("wls"))]:
        for joint, measured in metrics.per_joint.items():
            if joint not in errors or error_of(measured) > error_of(errors[joint][0]):
                errors[joint] = measured, wls.per_joint[joint].relative_error_pct
    return dict(sorted(errors.items(), key=lambda item: -error_of(item[1][0])))


def _facts(found: Identification) -> dict[str, str]:
    before, after, _ = found.witness.masses
    change = f" ({100 * (after / before - 1):+.0f} %)".replace("-", "−") if before > 0 else ""
    counts = {kind: found.sources.count(kind) for kind in SOURCES}
    total = len(found.sources)
    shares = "".join(
        f'<i class="{kind}" style="flex: {count}"></i>' for kind, count in counts.items() if count
    )
    words = ", ".join(f"{count} {DETERMINED[kind]}" for kind, count in counts.items() if count)
    return {
        "Total mass": f"<strong>{before:.2f} → {after:.2f} kg</strong>{change}",
        "Base parameters determined": (
            f"<strong>{found.determination.rank} of {len(found.base)}</strong>, condition number "
            f"{found.wls.condition:.3g}"
        ),
        f"{total} parameters, determined by": f'<span class="shares">{shares}</span>{words}',
    }


def _bars(found: Identification) -> str:
    errors, verdicts = joint_errors(found), found.verdict.joints
    # the one recording that was kept apart need not be named
    alone = "" if len(found.predictions) != 1 else f" on {next(iter(found.predictions))}"
    bars = []
    for joint in [*errors, *(joint for joint in verdicts if joint not in errors)]:
        row, verdict, measured = found.model.row_names.index(joint), verdicts[joint], None
        if alone:
            reasons = tuple(reason.replace(alone, "") for reason in verdict.reasons)
            verdict = replace(verdict, reasons=reasons)
        error, others = None, {}
        if joint in errors:
            measured, wls = errors[joint]
            error, others = error_of(measured), {"wls": wls, **measured.baselines}
        why = "" if measured is None else f"why-{row}"
        bars.append(Bar(row, joint, error, others, verdict, f"torque-{row}", why))
    kind = "not fitted" if found.predictions else "fitted rows, for no recording was kept apart"
    note = f"100 |τ − prediction| / |τ|, {kind}"
    return bars_html("Torque prediction error", note, bars, _OTHERS, (GOOD, POOR))
