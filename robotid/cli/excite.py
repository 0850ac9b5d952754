"""robotid excite: design the motion to record, within the robot's limits."""

import argparse
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from robotid.cli.console import terminal_progress
from robotid.cli.flags import ROBOT, add_json, add_progress, add_settings, job_from_flags, pairs
from robotid.cli.printing import say
from robotid.cli.running import show_found
from robotid.exceptions import SettingsError
from robotid.findings import listed

if TYPE_CHECKING:
    from robotid.commands.excite import MotionSettings
    from robotid.simulation.settings import Payload


__all__ = ["SUMMARY", "add_flags", "run"]

SUMMARY = "design the motion to record, within the robot's limits"


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of the command.

    Args:
        parser: Its parser.
    """
    add = parser.add_argument
    add("source", metavar="JOB.toml | URDF")
    words = "motion to write: .csv, .parquet, .yaml (ROS 2 JointTrajectory) or .script (UR)"
    add("--out", metavar="FILE", required=True, help=words)
    add("--given", metavar="RESULT", help="a result.json or its folder: what its logs have told")
    words = "page to write about the motion: its limits over time, what it will tell"
    add("--report", metavar="PAGE.html", help=words)
    words = "sweeps show friction, stands gravity, payload what hangs on a link; default: fourier"
    add("--kind", choices=("fourier", "bspline", "sweeps", "stands", "payload"), help=words)
    words = "of the kind payload: link that it hangs on; default: the last moving one"
    add("--link", metavar="NAME", help=words)
    add("--mass", metavar="KG", type=float, help="its mass: limits are kept with it, too")
    words = "its centre of mass in the frame of the link [m]; default: 0,0,0"
    add("--com", metavar="X,Y,Z", help=words)
    words = "joints that move for it, by comma; default: the fewest before the link that suffice"
    add("--moving", metavar="JOINTS", help=words)
    add("--duration", metavar="S", type=float, help="default: 10")
    add("--harmonics", metavar="N", type=int, help="of the series; default: 5")
    words = (
        "of the information: D (volume), A (mean), E (weakest), condition, or widest (the quarter "
        "that RESULT knows the least); default: widest with --given, else D"
    )
    add("--criterion", choices=("D", "A", "E", "condition", "widest"), help=words)
    add("--share", metavar="X", type=float, help="of the URDF's limits; default: 0.9")
    for name, unit in (
        ("acceleration", "rad/s^2 or m/s^2"), ("jerk", "rad/s^3 or m/s^3"), ("power", "W"),
    ):  # fmt: skip
        words = f"largest {name} of a joint [{unit}]; may be given again"
        add(f"--max-{name}", metavar="JOINT=X", action="append", default=[], help=words)
    words = "distance kept from collisions [m], or none to leave them unlooked at; default: 0.02"
    add("--clearance", metavar="M", help=words)
    add("--floor", metavar="M", type=float, help="height of the floor in the root link's frame [m]")
    words = "a box beside the robot, NAME=x0,y0,z0,x1,y1,z1 [m]; may be given again"
    add("--box", metavar="BOX", action="append", default=[], help=words)
    words = "standard deviation of a joint's torque [N m or N]; may be given again"
    add("--noise", metavar="JOINT=N_M", action="append", default=[], help=words)
    add("--seed", metavar="N", type=int, help="of the random starts; default: 0")
    add("--starts", metavar="N", type=int, help="that are followed to the end; default: 3")
    add("--seconds", metavar="S", type=float, help="after which the best so far is taken")
    words = "rows per second that are written; default: 100"
    add("--points", metavar="HZ", type=float, help=words)
    add_json(parser)
    add_progress(parser)
    flags = parser.add_argument_group("the robot, instead of a job file")
    add_settings(flags, ROBOT[:3])


def run(options: argparse.Namespace) -> None:
    """Run the command.

    Args:
        options: Its flags.
    """
    from robotid.commands.excite import design_motion

    options.logs = []
    job = job_from_flags(options, needs_logs=False)
    with terminal_progress(quiet=options.json, force=options.progress) as progress:
        settings = motion_settings(options)
        found = design_motion(
            job, settings, options.out,
            given=options.given, report=options.report, progress=progress,
        )  # fmt: skip
    show_found(found, options, _show)
    if options.report and not options.json:
        print(f"\nwritten to {options.report}")


def motion_settings(options: argparse.Namespace) -> "MotionSettings":
    """Return what motion is wanted.

    Args:
        options: The flags of the command "excite".

    Raises:
        SettingsError: If a flag is not usable.
    """
    from robotid.commands.excite import MotionSettings, stated_boxes

    plain = ("kind", "duration", "harmonics", "criterion", "share", "floor", "seed", "starts",
             "seconds", "points")  # fmt: skip
    stated = {name: getattr(options, name) for name in plain}
    stated = {name: value for name, value in stated.items() if value is not None}
    stated["noise"] = pairs(options.noise, "--noise")
    for name in ("acceleration", "jerk", "power"):
        stated[name] = pairs(getattr(options, f"max_{name}"), f"--max-{name}")
    if options.clearance is not None:
        stated["clearance"] = _clearance(options.clearance)
    if options.moving is not None:
        stated["moving"] = options.moving.split(",")
    return MotionSettings(**stated, boxes=stated_boxes(options.box), payload=_load(options))


def _load(options: argparse.Namespace) -> "Payload":
    """Return what is stated of a payload.

    Raises:
        SettingsError: If a flag is not usable.
    """
    from robotid.simulation.settings import Payload

    load = {"link": options.link, "mass": options.mass}
    if options.com is not None:
        try:
            load["com"] = tuple(float(number) for number in options.com.split(","))
        except ValueError:
            load["com"] = ()
        if len(load["com"]) != 3 or not options.mass:
            raise SettingsError(
                f"--com {options.com!r}: wanted X,Y,Z [m], three numbers, and --mass beside it"
            )
    return Payload(**{key: value for key, value in load.items() if value is not None})


def _clearance(word: str) -> float | None:
    if word == "none":
        return None
    try:
        return float(word)
    except ValueError as error:
        raise SettingsError(f"--clearance {word!r}: wanted metres, or none") from error


def _show(content: dict[str, Any]) -> None:
    done = f"in {content['seconds']:.1f} s"
    if content["starts"]:
        plural = "start" if content["starts"] == 1 else "starts"
        done = f"{content['starts']} {plural} {done}, "
        done += "settled" if content["converged"] else "not settled: more --seconds may improve it"
    condition = content["condition_number"]
    say(
        f"{content['robot']}: a motion of {content['duration']:g} s for {len(content['joints'])} "
        f"joints, condition number {'infinite' if condition is None else format(condition, '.0f')};"
        f" {done}"
    )
    if "widest" in content:
        names = content["widest"]
        say(f"made for what the logs given know the least: {listed(names, 5)}", "  ")
    print("\nwhat it leaves of each limit, least where")
    for name, margin in content["limits"].items():
        say(f"  {name:13} {_margin(name, margin)}", 16 * " ")
    if "payload" in content:
        print()
        for words in content["payload"]["words"]:
            say(words)


def _margin(name: str, margin: Mapping[str, Any]) -> str:
    """Return in words what a motion leaves of a limit."""
    if name != "collision":
        return f"{100 * margin['margin']:5.1f} %  {margin['where']}"
    said = "no links or obstacles come near each other"
    if margin["margin"] is not None:
        apart, time = 1e3 * margin["margin"], margin["time"]
        kept = 1e3 * margin["kept"]
        said = f"{apart:5.1f} mm beyond {kept:.0f} mm, {margin['where']} at {time:.2f} s"
    if margin["unread"]:
        said += f"; not looked at, since no shape can be read: {listed(margin['unread'])}"
    if margin["left_alone"]:
        said += f"; made to touch and not looked at: {listed(margin['left_alone'])}"
    if margin["built_near"]:
        said += f"; built near each other, kept apart by: {listed(margin['built_near'])}"
    return said
