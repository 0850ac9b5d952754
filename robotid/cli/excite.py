"""robotid excite: design an excitation trajectory within the robot's limits."""

import argparse
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from robotid.base.exceptions import SettingsError
from robotid.base.files import check_file
from robotid.base.findings import listed
from robotid.base.typing import ProgressCallback
from robotid.cli.console import echo, progress_of, show_found
from robotid.cli.job import JOB, ROBOT, Flags, Job, add_shown, as_job, job_from_flags, number
from robotid.cli.logs import result_run
from robotid.data.log import Log
from robotid.design.clearance import Box, Clearance
from robotid.design.design import Design, Designer, FourierBasis, design_stands, design_sweeps
from robotid.design.excitation import (
    FARTHEST,
    ROUTES,
    MotionSettings,
    check_motion_file,
    write_motion,
)
from robotid.design.limits import LIMITS, Course, MotionLimits
from robotid.design.previews import Preview, Run, preview_logs
from robotid.estimation.fitting.recorded import hold_log
from robotid.output.report.motion_page import UNCHECKED, search_figures, write_motion_page
from robotid.robot.model import RobotModel


def excite(
    robot: Job | str | Path,
    target: str | Path,
    settings: MotionSettings | None = None,
    *,
    given: str | Path | None = None,
    report: str | Path | None = None,
    progress: ProgressCallback | None = None,
) -> dict[str, Any]:
    """Design a motion within a robot's limits and write it.

    Args:
        robot: A URDF, all of whose joints move, or a job file.
        target: The motion to write: .csv, .parquet, .yaml (ROS 2 JointTrajectory) or .script (UR).
        settings: Kind, length and limits of the motion; the defaults if None.
        given: A result.json or its folder, whose logs the motion complements.
        report: Page to write about the motion; none if None.
        progress: Called at each start of the search.

    Returns:
        The margins to the limits and the course of the design, as ``robotid excite --json``.

    Raises:
        DataError: If a file cannot be written, or the logs of the result are missing.
        SettingsError: If a setting does not fit the robot, or the limits allow no motion.
    """
    settings, job = settings or MotionSettings(), as_job(robot)
    for file in (target, *([] if report is None else [report])):
        check_file(Path(file), [job.urdf, given])
    check_motion_file(target)
    designer, run = _designer(job, settings, given)
    model = designer.information.model

    def show_start(start: int, _: float) -> None:
        if progress is not None:
            progress("designing", start, settings.starts, "starts")

    initialised = time.monotonic()
    design = _designed(designer, settings, show_start)
    design = replace(design, seconds=time.monotonic() - initialised)
    course = designer.course(design)
    if settings.kind in ROUTES:
        _check_jerk(course, model.joints)
    content = _content(designer, design, course, settings)
    if report is not None:  # first: the motion may be too short for a preview
        expected = _expected(job, model, design, settings, run, str(target))
        write_motion_page(report, model, content, course, expected)
    write_motion(design.motion, model.joints, design.duration, settings.points, target)
    return content if report is None else content | {"report": str(report)}


def _designer(
    job: Job, settings: MotionSettings, given: str | Path | None
) -> tuple[Designer, Run | None]:
    """Return the designer of the motion, and the logs of an earlier result."""
    model, run = job.model(), None
    if given is not None:
        _, _, model, run = result_run(job, given)
    name = settings.criterion or ("D" if run is None else "widest")
    if name == "widest" and run is None:
        words = "criterion is widest, which needs an earlier result"
        raise SettingsError(f"{words}: expected --given RESULT, or another criterion")
    model.require_fixed("motion design")
    limits = MotionLimits.of_model(
        model, share=settings.share, velocity=settings.velocity, torque=settings.torque,
        acceleration=settings.acceleration, jerk=settings.jerk, power=settings.power,
    )  # fmt: skip
    clearance, least = None, settings.clearance
    if least is not None:
        clearance = Clearance(model, least=least, floor=settings.floor, boxes=settings.boxes)
    basis = FourierBasis(settings.duration, settings.harmonics)
    return Designer.of_model(
        model, basis, limits, name=name, clearance=clearance, noise=settings.noise, run=run
    ), run


def _designed(
    designer: Designer, settings: MotionSettings, progress: Callable[[int, float], None]
) -> Design:
    rng = np.random.default_rng(settings.seed)
    if settings.kind in ROUTES:
        design = design_sweeps if settings.kind == "sweeps" else design_stands
        return design(designer, rng)
    return designer.design(rng, starts=settings.starts, seconds=settings.seconds, progress=progress)


def _check_jerk(course: Course, joints: Sequence[str]) -> None:
    """Refuse a motion between poses that exceeds the jerk limit; its design ignores that limit."""
    used = course.largest[LIMITS.index("jerk")]
    joint = int(np.argmax(used))
    if used[joint] > 1.0:
        raise SettingsError(
            f"{joints[joint]} needs {100 * used[joint]:.0f} % of its jerk limit at "
            f"{course.peak('jerk', joint):.2f} s, expected at most 100 %: the design of a motion "
            "between poses ignores jerk limits. Increase --max-jerk or reduce --share"
        )


def _expected(
    job: Job, model: RobotModel, design: Design, settings: MotionSettings, run: Run | None,
    path: str,
) -> Preview:  # fmt: skip
    """Return the expected standard errors of a log of the motion, with those of earlier logs."""
    t = np.arange(round(design.duration * settings.points) + 1) / settings.points
    q, v, a = design.motion.evaluate(np.minimum(t, design.duration))
    log = Log(t, q, np.zeros_like(q), model.joints, v, a, path)
    in_memory = hold_log(model, log, job.signals)
    return preview_logs(model, [in_memory], job.estimator, noise=settings.noise, run=run)


def _content(
    designer: Designer, design: Design, course: Course, settings: MotionSettings
) -> dict[str, Any]:
    model, names = designer.information.model, designer.information.mapping.base_names
    margins: dict[str, Any] = {}
    jerk, most, clearance = LIMITS.index("jerk"), design.used.copy(), course.clearance
    if settings.kind in ROUTES:
        most[jerk] = course.largest[jerk]
    for name, used, sizes in zip(LIMITS, most, course.limits.sizes, strict=True):
        if np.isfinite(sizes).any():
            joint = int(np.argmax(used))
            margins[name] = {"margin": 1.0 - float(used[joint]), "where": model.joints[joint]}
    if clearance is not None:
        near = design.contact
        margins["collision"] = {
            "margin": near and near.margin, "kept": near and near.required,
            "where": near and f"{near.first} and {near.second}", "time": near and near.time,
            "unread": clearance.unread, "left_alone": clearance.made_to,
            "built_near": clearance.built_near,
        }  # fmt: skip
    content = {
        "robot": model.name, "joints": list(model.joints), "criterion": designer.name,
        "objective": design.objective,
        "condition_number": design.condition if np.isfinite(design.condition) else None,
        "seconds": design.seconds, "starts": design.starts, "converged": bool(design.is_converged),
        "feasible": all((m["margin"] or 0.0) >= 0.0 for m in margins.values()),
        "kind": settings.kind, "share": settings.share, "duration": design.duration,
        "points": settings.points, "limits": margins,
    }  # fmt: skip
    if designer.name == "widest":
        content["widest"] = [names[k] for k in designer.widest[::-1]]
    return content


MAIN_FLAGS = (
    "--out", "--report", "--given", "--kind", "--duration", "--share", "--clearance",
    "--floor", "--joints", "--lock",
)  # fmt: skip
EXAMPLES = (
    "robotid excite robot.urdf --out motion.csv --report motion.html",
    "robotid excite robot.urdf --kind sweeps --out sweeps.csv",
)


def add_flags(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("source", metavar="JOB.toml | URDF")
    words = "motion to write: .csv, .parquet, .yaml (ROS 2 JointTrajectory) or .script (UR)"
    add("--out", metavar="FILE", required=True, help=words)
    words = "result.json or its folder: the information of its logs is added"
    add("--given", metavar="RESULT", help=words)
    words = "page to write about the motion: limits over time, expected standard errors"
    add("--report", metavar="PAGE.html", help=words)
    MOTION.add(parser)
    add_shown(parser, "json", "progress")
    JOB.add(parser.add_argument_group("the robot, instead of a job file"), ROBOT[:3])


def run(options: argparse.Namespace) -> None:
    job, settings = job_from_flags(options), MotionSettings.from_dict(MOTION.stated(options))
    with progress_of(options) as progress:
        content = excite(
            job, options.out, settings,
            given=options.given, report=options.report, progress=progress,
        )  # fmt: skip
    show_found(content, options, _show, [x for x in (options.out, options.report) if x])


def _boxes(words: Sequence[str], flag: str) -> tuple[Box, ...]:
    """Return boxes that are given as NAME=x0,y0,z0,x1,y1,z1, two corners [m]."""
    wanted = f"NAME=x0,y0,z0,x1,y1,z1, the lower and the upper corner [m], within {FARTHEST:g} m"
    boxes = []
    for word in words:
        name, _, corners = word.partition("=")
        x = [number(text, flag, wanted, repr(word)) for text in corners.split(",")]
        if len(x) != 6 or not all(abs(place) <= FARTHEST for place in x):
            raise SettingsError(f"{flag} {word!r}: expected {wanted}")
        boxes.append(Box(name, (x[0], x[1], x[2]), (x[3], x[4], x[5])))
    return tuple(boxes)


def _clearance(word: str, flag: str) -> float | None:
    return None if word == "none" else number(word, flag, "metres, or none")


#: Flags of the settings of the motion.
MOTION = Flags(
    MotionSettings(),
    {
        "--kind": ("kind", ""),
        "--duration": ("duration", "S"),
        "--harmonics": ("harmonics", "N"),
        "--criterion": ("criterion", ""),
        "--share": ("share", "X"),
        "--max-velocity": ("velocity", "JOINT=X"),
        "--max-torque": ("torque", "JOINT=X"),
        "--max-acceleration": ("acceleration", "JOINT=X"),
        "--max-jerk": ("jerk", "JOINT=X"),
        "--max-power": ("power", "JOINT=X"),
        "--clearance": ("clearance", "M"),
        "--floor": ("floor", "M"),
        "--box": ("boxes", "NAME=x0,y0,z0,x1,y1,z1"),
        "--noise": ("noise", "JOINT=N_M"),
        "--seed": ("seed", "N"),
        "--starts": ("starts", "N"),
        "--seconds": ("seconds", "S"),
        "--points": ("points", "HZ"),
    },
    {"--box": _boxes, "--clearance": _clearance},
)


def _show(content: dict[str, Any]) -> None:
    condition, how = search_figures(content)
    echo(
        f"{content['robot']}: a motion of {content['duration']:g} s for {len(content['joints'])} "
        f"joints, condition number {condition}; computed in {how}"
    )
    if "widest" in content:
        names = content["widest"]
        echo(f"designed for the parameters with the widest intervals: {listed(names, 5)}", "  ")
    print("\nsmallest margin to each limit")
    for name, margin in content["limits"].items():
        echo(f"  {name:18} {_margin(name, margin)}", 21 * " ")
    if "collision" not in content["limits"]:
        echo(f"  {'collision':18} not checked (--clearance none)")


def _margin(name: str, margin: Mapping[str, Any]) -> str:
    if name != "collision":
        return f"{100 * margin['margin']:5.1f} %  {margin['where']}"
    text = "no pair of links or obstacles comes close"
    if margin["margin"] is not None:
        text = f"{1e3 * margin['margin']:5.1f} mm above the clearance of "
        text += f"{1e3 * margin['kept']:.0f} mm, {margin['where']} at {margin['time']:.2f} s"
    for key, words in UNCHECKED.items():
        text += f"; {words}: {listed(margin[key])}" if margin[key] else ""
    return text
