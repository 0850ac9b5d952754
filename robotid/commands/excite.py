"""A motion to record: designed for a robot within its limits, and written."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from robotid._files import check_file
from robotid.commands.job import Job
from robotid.commands.logs import result_run
from robotid.exceptions import SettingsError
from robotid.excitation.basis import Basis, BSplineBasis, FourierBasis
from robotid.excitation.clearance import Box, Clearance
from robotid.excitation.course import Course
from robotid.excitation.design import Design, Designer
from robotid.excitation.files import check_motion_file, write_motion
from robotid.excitation.limits import LIMITS, MotionLimits
from robotid.excitation.motion_page import write_motion_page
from robotid.excitation.payload_motion import design_payload
from robotid.excitation.routes import design_stands, design_sweeps
from robotid.fitting.survey import hold_log
from robotid.identification.previews import Preview, Run, preview_logs
from robotid.logs.data import Log
from robotid.regressor.compiled import is_installed, why_not
from robotid.robot.model import RobotModel
from robotid.simulation.settings import Payload

if TYPE_CHECKING:
    from robotid._typing import ProgressCallback

__all__ = ["MotionSettings", "design_motion", "stated_boxes"]

_ROUTES = ("sweeps", "stands")
_START = 2.0  # [s] of design from which compiled code pays
_RANGES = {
    "duration": (0.1, 3600.0, " s"),
    "harmonics": (2, 100, ""),
    "share": (1e-3, 1.0, " of the limits"),
    "starts": (1, 1000, ""),
    "seconds": (1e-3, np.inf, " s"),
    "points": (0.1, 1e5, " rows per second"),
}
_SIZES = 1e-9, 1e12  # of limits and noise, in any unit
_FARTHEST = 1e3  # [m] of what stands around a robot
_KINDS = ("fourier", "bspline", "payload", *_ROUTES)


@dataclass(frozen=True)
class MotionSettings:
    """What motion is wanted.

    Attributes:
        kind: "fourier" or "bspline"; "sweeps", slow ones of joint after joint, which show friction;
            "stands", which show gravity; "payload", one of few joints for what hangs on a link.
        duration: Its length [s]; that of sweeps and stands is what they take.
        harmonics: Harmonics of a Fourier series; pieces of B-splines are twice as many.
        criterion: "D", "A", "E", "condition" or "widest", as of ``criterion``; if None, "widest"
            after logs that were identified, else "D".
        share: How much of the URDF's limits is used, more than 0 and at most 1.
        acceleration: Largest accelerations by joint [rad/s^2 or m/s^2].
        jerk: Largest jerks by joint [rad/s^3 or m/s^3].
        power: Largest mechanical powers by joint [W].
        clearance: Distance that is kept from collisions [m]; None: they are not looked at.
        floor: Height of the floor in the frame of the root link [m]; None: there is none.
        boxes: What stands around the robot.
        noise: Standard deviation of the torque's noise by joint [N m or N].
        seed: Of the random starts.
        starts: How many are followed to the end.
        seconds: Time after which the best motion so far is taken [s].
        points: Rows per second that are written [Hz].
        payload: What hangs on which link, as far as it is known, of the kind "payload".
        moving: Joints that move then; the fewest that suffice if there are none.
    """

    kind: str = "fourier"
    duration: float = 10.0
    harmonics: int = 5
    criterion: str | None = None
    share: float = 0.9
    acceleration: Mapping[str, float] = field(default_factory=dict)
    jerk: Mapping[str, float] = field(default_factory=dict)
    power: Mapping[str, float] = field(default_factory=dict)
    clearance: float | None = 0.02
    floor: float | None = None
    boxes: Sequence[Box] = ()
    noise: Mapping[str, float] = field(default_factory=dict)
    seed: int = 0
    starts: int = 3
    seconds: float = np.inf
    points: float = 100.0
    payload: Payload = field(default_factory=Payload)
    moving: Sequence[str] = ()

    def __post_init__(self) -> None:
        if self.kind not in _KINDS:
            raise SettingsError(f"kind is {self.kind!r}, wanted one of {', '.join(_KINDS)}")
        for name, (least, most, unit) in _RANGES.items():
            value = getattr(self, name)
            if not least <= value <= most:
                wanted = f"{least:g} to {most:g}" if most < np.inf else f"{least:g} or more"
                raise SettingsError(f"{name} is {value:g}, wanted {wanted}{unit}")
        for name in ("acceleration", "jerk", "power", "noise"):
            for joint, value in getattr(self, name).items():
                if not _SIZES[0] <= value <= _SIZES[1]:
                    raise SettingsError(
                        f"{name} of {joint!r} is {value:g}, wanted {_SIZES[0]:g} to {_SIZES[1]:g}"
                    )
        if not 0 <= self.seed < 2**63:
            raise SettingsError(f"seed is {self.seed}, wanted 0 or a positive whole number")
        for name, value in {"clearance": self.clearance, "floor": self.floor}.items():
            if value is not None and not abs(value) <= _FARTHEST:
                raise SettingsError(f"{name} is {value:g} m, wanted at most {_FARTHEST:g} m")
        if self.kind != "payload" and (self.moving or self.payload != Payload()):
            raise SettingsError(
                f"a payload or joints that move are stated, but kind is {self.kind!r}; wanted "
                "payload"
            )

    def basis(self) -> Basis:
        """Return the functions that the motion is a sum of.

        Raises:
            SettingsError: If there are too few.
        """
        if self.kind == "bspline":
            return BSplineBasis(self.duration, 2 * self.harmonics)
        return FourierBasis(self.duration, self.harmonics)


def stated_boxes(words: Sequence[str]) -> tuple[Box, ...]:
    """Return boxes that are stated as NAME=x0,y0,z0,x1,y1,z1, two corners [m].

    Args:
        words: What follows --box.

    Raises:
        SettingsError: If a word is another one.
    """
    boxes = []
    for word in words:
        name, _, numbers = word.partition("=")
        try:
            x = [float(number) for number in numbers.split(",")]
        except ValueError:
            x = []
        if len(x) != 6 or not (np.abs(x) <= _FARTHEST).all():
            raise SettingsError(
                f"--box {word!r}: wanted NAME=x0,y0,z0,x1,y1,z1, the lower and the upper corner "
                f"[m], within {_FARTHEST:g} m"
            )
        boxes.append(Box(name, (x[0], x[1], x[2]), (x[3], x[4], x[5])))
    return tuple(boxes)


def design_motion(
    job: Job,
    settings: MotionSettings,
    target: str | Path,
    *,
    given: str | None = None,
    report: str | Path | None = None,
    progress: "ProgressCallback | None" = None,
) -> dict[str, Any]:
    """Design a motion for a robot and write it.

    Args:
        job: The robot.
        settings: What motion is wanted.
        target: The file, as of ``write_motion``.
        given: A result.json, or its folder: the motion tells what its logs did not.
        report: A page to write about it, if any.
        progress: Told which start is followed.

    Returns:
        What ``robotid excite --json`` prints.

    Raises:
        DataError: If collisions cannot be looked at, the result's logs are gone, or motions are
            not written in the target's format.
        ModelError: If the URDF cannot be used.
        SettingsError: If a setting does not fit, or nothing keeps the limits.
    """
    for file in (target, *([] if report is None else [report])):
        check_file(Path(file))
    check_motion_file(target)
    designer, run = _designer(job, settings, given)
    model = designer.information.model

    def told(start: int, _: float) -> None:
        if progress is not None:
            progress("designing", start, settings.starts, "starts")

    begun, carried = time.monotonic(), None
    if settings.kind == "payload":
        carried = design_payload(
            designer, np.random.default_rng(settings.seed), settings.payload,
            moving=settings.moving, starts=settings.starts, seconds=settings.seconds,
            progress=told,
        )  # fmt: skip
        designer, design = carried.designer, carried.design
    else:
        design = _designed(designer, settings, told)
    design = replace(design, seconds=time.monotonic() - begun)
    course = Course.of_design(designer, design)
    if settings.kind in _ROUTES:
        _check_jerk(course, model.joints)
    expected: Preview | list[str] | None = None
    if report is not None:  # before anything is written: a motion may be too short for it
        expected = (
            _expected(job, model, design, settings, run, str(target))
            if carried is None
            else carried.in_words()
        )
    write_motion(design.motion, model.joints, design.duration, settings.points, target)
    content = _content(designer, design, course, settings)
    if carried is not None:
        content["payload"] = carried.to_dict()
    if report is not None and expected is not None:
        write_motion_page(report, model, content, course, expected)
        content["report"] = str(report)
    return content


def _designer(job: Job, settings: MotionSettings, given: str | None) -> tuple[Designer, Run | None]:
    """Return what looks for the motion, and what was recorded before."""
    model, run = job.model(), None
    if given is not None:
        _, _, model, run = result_run(job, given)
    name = settings.criterion
    if name is None:
        name = "D" if run is None or settings.kind == "payload" else "widest"
    elif name == "widest" and (run is None or settings.kind == "payload"):
        raise SettingsError(
            "criterion is widest, which is about what logs have told of the robot: wanted --given "
            "RESULT, and another kind than payload; or another criterion"
        )
    limits = MotionLimits.of_model(
        model,
        share=settings.share,
        acceleration=settings.acceleration,
        jerk=settings.jerk,
        power=settings.power,
    )
    clearance, is_fast = None, _pays(model, settings)
    if settings.clearance is not None:
        clearance = Clearance(
            model, least=settings.clearance, floor=settings.floor, boxes=settings.boxes,
            is_fast=is_fast,
        )  # fmt: skip
    designer = Designer.of_model(
        model, settings.basis(), limits, name=name, clearance=clearance, noise=settings.noise,
        run=run, is_fast=is_fast,
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


def _pays(model: RobotModel, settings: MotionSettings) -> bool:
    """Return whether compiled code can be used and pays its start of about half a second."""
    is_long = settings.kind not in _ROUTES and settings.seconds > _START
    return is_long and is_installed() and why_not(model) is None


def _check_jerk(course: Course, joints: Sequence[str]) -> None:
    """Refuse a motion from place to place that is too jerky: it is not designed for jerk.

    Raises:
        SettingsError: If it is.
    """
    used = course.largest[LIMITS.index("jerk")]
    joint = int(np.argmax(used))
    if used[joint] > 1.0:
        raise SettingsError(
            f"{joints[joint]} needs {100 * used[joint]:.0f} % of its jerk limit at "
            f"{course.peak('jerk', joint):.2f} s: sweeps and stands do not follow jerk; raise "
            "--max-jerk or lower --share"
        )


def _expected(
    job: Job,
    model: RobotModel,
    design: Design,
    settings: MotionSettings,
    run: Run | None,
    path: str,
) -> Preview:
    """Return what is to be expected of a log of the motion, beside what is known already."""
    t = np.arange(round(design.duration * settings.points) + 1) / settings.points
    q, v, a = design.motion.evaluate(np.minimum(t, design.duration))
    log = Log(t, q, np.zeros_like(q), model.joints, v, a, path)
    held = hold_log(model, log, job.signals)
    return preview_logs(model, [held], job.estimator, noise=settings.noise, run=run)


def _content(
    designer: Designer, design: Design, course: Course, settings: MotionSettings
) -> dict[str, Any]:
    """Return what was designed, for people and programs."""
    model, names = designer.information.model, designer.information.mapping.base_names
    margins: dict[str, Any] = {}
    limits, clearance = course.limits, course.clearance
    jerk = LIMITS.index("jerk")
    most = design.used.copy()
    if settings.kind in _ROUTES:
        most[jerk] = course.largest[jerk]
    for name, used, sizes in zip(LIMITS, most, limits.sizes, strict=True):
        if np.isfinite(sizes).any():
            joint = int(np.argmax(used))
            margins[name] = {"margin": 1.0 - float(used[joint]), "where": model.joints[joint]}
    if clearance is not None:
        contact = design.contact
        margins["collision"] = {
            "margin": None if contact is None else contact.margin,
            "kept": None if contact is None else contact.kept,
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
