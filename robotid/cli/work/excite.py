"""An excitation trajectory: designed for a robot within its limits, and written to a file."""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from robotid.base.exceptions import SettingsError
from robotid.base.files import check_file
from robotid.cli.work.job import Job
from robotid.cli.work.logs import result_run
from robotid.data.log import Log
from robotid.design.basis import Basis, BSplineBasis, FourierBasis
from robotid.design.clearance import Clearance
from robotid.design.design import Design, Designer
from robotid.design.excitation_settings import ROUTES, MotionSettings
from robotid.design.limits import LIMITS, Course, MotionLimits
from robotid.design.motion_files import check_motion_file, write_motion
from robotid.design.payload_motion import design_payload
from robotid.design.previews import Preview, Run, preview_logs
from robotid.design.routes import design_stands, design_sweeps
from robotid.estimation.fitting.survey import hold_log
from robotid.output.report.motion_page import write_motion_page
from robotid.robot.model import RobotModel

if TYPE_CHECKING:
    from robotid.base.typing import ProgressCallback


def design_motion(
    job: Job,
    settings: MotionSettings,
    target: str | Path,
    *,
    given: str | None = None,
    report: str | Path | None = None,
    progress: "ProgressCallback | None" = None,
) -> dict[str, Any]:
    """Design a motion for a robot and write it."""
    for file in (target, *([] if report is None else [report])):
        check_file(Path(file), [job.urdf, given])
    check_motion_file(target)
    designer, run = _designer(job, settings, given)
    model = designer.information.model

    def show_start(start: int, _: float) -> None:
        if progress is not None:
            progress("designing", start, settings.starts, "starts")

    initialised, carried = time.monotonic(), None
    if settings.kind == "payload":
        carried = design_payload(
            designer, np.random.default_rng(settings.seed), settings.payload,
            moving=settings.moving, starts=settings.starts, seconds=settings.seconds,
            progress=show_start,
        )  # fmt: skip
        designer, design = carried.designer, carried.design
    else:
        design = _designed(designer, settings, show_start)
    design = replace(design, seconds=time.monotonic() - initialised)
    course = designer.course(design)
    if settings.kind in ROUTES:
        _check_jerk(course, model.joints)
    expected: Preview | list[str] | None = None
    if report is not None:  # computed before any file is written: the motion may be too short
        expected = (
            _expected(job, model, design, settings, run, str(target))
            if carried is None
            else carried.described()
        )
    content = _content(designer, design, course, settings)
    write_motion(design.motion, model.joints, design.duration, settings.points, target)
    if carried is not None:
        content["payload"] = carried.to_dict()
    if report is not None and expected is not None:
        write_motion_page(report, model, content, course, expected)
        content["report"] = str(report)
    return content


def _basis(settings: MotionSettings) -> Basis:
    """Return the basis functions of the motion."""
    if settings.kind == "bspline":
        return BSplineBasis(settings.duration, 2 * settings.harmonics)
    return FourierBasis(settings.duration, settings.harmonics)


def _designer(job: Job, settings: MotionSettings, given: str | None) -> tuple[Designer, Run | None]:
    """Return the designer of the motion, and the logs of an earlier result."""
    model, run = job.model(), None
    if given is not None:
        _, _, model, run = result_run(job, given)
    name = settings.criterion
    if name is None:
        name = "D" if run is None or settings.kind == "payload" else "widest"
    elif name == "widest" and (run is None or settings.kind == "payload"):
        raise SettingsError(
            "criterion is widest, which needs an earlier result: wanted --given RESULT, and a kind "
            "other than payload; or another criterion"
        )
    model.require_fixed("motion design")
    limits = MotionLimits.of_model(
        model,
        share=settings.share,
        velocity=settings.velocity,
        torque=settings.torque,
        acceleration=settings.acceleration,
        jerk=settings.jerk,
        power=settings.power,
    )
    clearance = None
    if settings.clearance is not None:
        clearance = Clearance(
            model, least=settings.clearance, floor=settings.floor, boxes=settings.boxes
        )
    designer = Designer.of_model(
        model, _basis(settings), limits, name=name, clearance=clearance, noise=settings.noise,
        run=run,
    )  # fmt: skip
    return designer, run


def _designed(
    designer: Designer, settings: MotionSettings, progress: Callable[[int, float], None]
) -> Design:
    """Return a motion of another kind than "payload"."""
    rng = np.random.default_rng(settings.seed)
    if settings.kind == "sweeps":
        return design_sweeps(designer, rng)
    if settings.kind == "stands":
        return design_stands(designer, rng)
    return designer.design(rng, starts=settings.starts, seconds=settings.seconds, progress=progress)


def _check_jerk(course: Course, joints: Sequence[str]) -> None:
    """Refuse a motion between poses that exceeds the jerk limit; its design ignores that limit."""
    used = course.largest[LIMITS.index("jerk")]
    joint = int(np.argmax(used))
    if used[joint] > 1.0:
        raise SettingsError(
            f"{joints[joint]} needs {100 * used[joint]:.0f} % of its jerk limit at "
            f"{course.peak('jerk', joint):.2f} s, wanted at most 100 %: the design of a motion "
            "between poses ignores jerk limits. Increase --max-jerk or reduce --share"
        )


def _expected(
    job: Job,
    model: RobotModel,
    design: Design,
    settings: MotionSettings,
    run: Run | None,
    path: str,
) -> Preview:
    """Return the expected standard errors of a log of the motion, with those of earlier logs."""
    t = np.arange(round(design.duration * settings.points) + 1) / settings.points
    q, v, a = design.motion.evaluate(np.minimum(t, design.duration))
    log = Log(t, q, np.zeros_like(q), model.joints, v, a, path)
    in_memory = hold_log(model, log, job.signals)
    return preview_logs(model, [in_memory], job.estimator, noise=settings.noise, run=run)


def _content(
    designer: Designer, design: Design, course: Course, settings: MotionSettings
) -> dict[str, Any]:
    """Return the design as plain values."""
    model, names = designer.information.model, designer.information.mapping.base_names
    margins: dict[str, Any] = {}
    limits, clearance = course.limits, course.clearance
    jerk = LIMITS.index("jerk")
    most = design.used.copy()
    if settings.kind in ROUTES:
        most[jerk] = course.largest[jerk]
    for name, used, sizes in zip(LIMITS, most, limits.sizes, strict=True):
        if np.isfinite(sizes).any():
            joint = int(np.argmax(used))
            margins[name] = {"margin": 1.0 - float(used[joint]), "where": model.joints[joint]}
    if clearance is not None:
        contact = design.contact
        margins["collision"] = {
            "margin": None if contact is None else contact.margin,
            "kept": None if contact is None else contact.required,
            "where": None if contact is None else f"{contact.first} and {contact.second}",
            "time": None if contact is None else contact.time,
            "unread": clearance.unread,
            "left_alone": clearance.made_to,
            "built_near": clearance.built_near,
        }
    content = {
        "robot": model.name,
        "joints": list(model.joints),
        "criterion": designer.name,
        "objective": design.objective,
        "condition_number": design.condition if np.isfinite(design.condition) else None,
        "seconds": design.seconds,
        "starts": design.starts,
        "converged": bool(design.is_converged),
        "feasible": all((m["margin"] or 0.0) >= 0.0 for m in margins.values()),
        "kind": settings.kind,
        "share": settings.share,
        "duration": design.duration,
        "points": settings.points,
        "limits": margins,
        "history": [list(entry) for entry in design.history],
    }
    if designer.name == "widest":
        content["widest"] = [names[k] for k in designer.widest[::-1]]
    return content
