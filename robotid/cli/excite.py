"""robotid excite: design an excitation trajectory within the robot's limits."""

import argparse
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from robotid.base.exceptions import SettingsError
from robotid.base.findings import listed
from robotid.base.settings import Settings
from robotid.cli.console import terminal_progress
from robotid.cli.flags import JOB, ROBOT, Flags, add_json, add_progress, job_from_flags
from robotid.cli.printing import echo, print_files
from robotid.cli.running import show_found

if TYPE_CHECKING:
    from robotid.design.clearance import Box
    from robotid.design.excitation_settings import MotionSettings


SUMMARY = "design an excitation trajectory within the robot's limits"
MAIN_FLAGS = (
    "--out", "--report", "--given", "--kind", "--link", "--mass", "--duration", "--share",
    "--clearance", "--floor", "--joints", "--lock",
)  # fmt: skip
EXAMPLES = (
    "robotid excite robot.urdf --out motion.csv --report motion.html",
    "robotid excite robot.urdf --kind sweeps --out sweeps.csv",
)


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of the command."""
    add = parser.add_argument
    add("source", metavar="JOB.toml | URDF")
    words = "motion to write: .csv, .parquet, .yaml (ROS 2 JointTrajectory) or .script (UR)"
    add("--out", metavar="FILE", required=True, help=words)
    words = "result.json or its folder: the information of its logs is added"
    add("--given", metavar="RESULT", help=words)
    words = "page to write about the motion: limits over time, expected standard errors"
    add("--report", metavar="PAGE.html", help=words)
    _MOTION.add(parser)
    add_json(parser)
    add_progress(parser)
    flags = parser.add_argument_group("the robot, instead of a job file")
    JOB.add(flags, ROBOT[:3])


def run(options: argparse.Namespace) -> None:
    """Run the command."""
    from robotid.cli.work.excite import design_motion

    options.logs = []
    job = job_from_flags(options, needs_logs=False)
    with terminal_progress(quiet=options.json, force=options.progress) as progress:
        settings = motion_settings(options)
        found = design_motion(
            job, settings, options.out,
            given=options.given, report=options.report, progress=progress,
        )  # fmt: skip
    show_found(found, options, _show)
    if not options.json:
        print_files("", [options.out, *([found["report"]] if "report" in found else [])])


def motion_settings(options: argparse.Namespace) -> "MotionSettings":
    """Return the settings of the motion."""
    from robotid.design.excitation_settings import MotionSettings

    if options.com is not None and not options.mass:
        raise SettingsError(_COM.format(options.com))
    return MotionSettings.from_dict(_MOTION.stated(options))


def _numbers(word: str) -> tuple[float, ...]:
    """Return the numbers between commas, none if one of them is no number."""
    try:
        return tuple(float(number) for number in word.split(","))
    except ValueError:
        return ()


def _boxes(words: Sequence[str], flag: str) -> tuple["Box", ...]:
    """Return boxes that are stated as NAME=x0,y0,z0,x1,y1,z1, two corners [m]."""
    from robotid.design.clearance import Box
    from robotid.design.excitation_settings import FARTHEST

    boxes = []
    for word in words:
        name, _, numbers = word.partition("=")
        x = _numbers(numbers)
        if len(x) != 6 or not all(abs(number) <= FARTHEST for number in x):
            raise SettingsError(
                f"{flag} {word!r}: wanted NAME=x0,y0,z0,x1,y1,z1, the lower and the upper corner "
                f"[m], within {FARTHEST:g} m"
            )
        boxes.append(Box(name, (x[0], x[1], x[2]), (x[3], x[4], x[5])))
    return tuple(boxes)


def _centre(word: str, _: str) -> tuple[float, ...]:
    found = _numbers(word)
    if len(found) != 3:
        raise SettingsError(_COM.format(word))
    return found


def _clearance(word: str, flag: str) -> float | None:
    if word == "none":
        return None
    try:
        return float(word)
    except ValueError as error:
        raise SettingsError(f"{flag} {word!r}: wanted metres, or none") from error


def _motion() -> Settings:
    from robotid.design.excitation_settings import MotionSettings

    return MotionSettings()


_COM = "--com {!r}: wanted three numbers X,Y,Z [m], together with --mass"
#: Flags of the settings of the motion.
_MOTION = Flags(
    _motion,
    {
        "--kind": ("kind", ""),
        "--link": ("payload.link", "NAME"),
        "--mass": ("payload.mass", "KG"),
        "--com": ("payload.com", "X,Y,Z"),
        "--moving": ("moving", "JOINTS"),
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
    {"--box": _boxes, "--clearance": _clearance, "--com": _centre},
)


def _show(content: dict[str, Any]) -> None:
    done = f"in {content['seconds']:.1f} s"
    if content["starts"]:
        plural = "start" if content["starts"] == 1 else "starts"
        done = f"{content['starts']} {plural} {done}, "
        done += "converged" if content["converged"] else "not converged: increase --seconds"
    condition = content["condition_number"]
    echo(
        f"{content['robot']}: a motion of {content['duration']:g} s for {len(content['joints'])} "
        f"joints, condition number {'infinite' if condition is None else format(condition, '.0f')} "
        f"(regressor, columns in units of the prior); {done}"
    )
    if "widest" in content:
        names = content["widest"]
        echo(f"designed for the parameters with the widest intervals: {listed(names, 5)}", "  ")
    print("\nsmallest margin to each limit")
    for name, margin in content["limits"].items():
        echo(f"  {name:18} {_margin(name, margin)}", 21 * " ")
    if "payload" in content:
        print()
        for words in content["payload"]["words"]:
            echo(words)


def _margin(name: str, margin: Mapping[str, Any]) -> str:
    """Return the smallest margin of a motion to a limit, as text."""
    if name != "collision":
        return f"{100 * margin['margin']:5.1f} %  {margin['where']}"
    text = "no pair of links or obstacles comes close"
    if margin["margin"] is not None:
        distance, time = 1e3 * margin["margin"], margin["time"]
        clearance = 1e3 * margin["kept"]
        where = f"{margin['where']} at {time:.2f} s"
        text = f"{distance:5.1f} mm above the clearance of {clearance:.0f} mm, {where}"
    if margin["unread"]:
        text += f"; not checked, shapes not readable: {listed(margin['unread'])}"
    if margin["left_alone"]:
        text += f"; not checked, in contact by design: {listed(margin['left_alone'])}"
    if margin["built_near"]:
        text += f"; smaller clearance, close by design: {listed(margin['built_near'])}"
    return text
