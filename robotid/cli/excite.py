"""robotid excite: design the motion to record, within the robot's limits."""

import argparse
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from robotid.cli.console import terminal_progress
from robotid.cli.flags import ROBOT, add_json, add_progress, add_settings, job_from_flags, pairs
from robotid.cli.printing import say
from robotid.cli.running import show_found
from robotid.exceptions import SettingsError
from robotid.findings import listed

if TYPE_CHECKING:
    from robotid.excitation.clearance import Box
    from robotid.excitation.settings import MotionSettings
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
    for flag, (at, about) in _FLAGS.items():
        add(flag, **about, help=_words(at, is_again=about.get("action") == "append"))
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
    from robotid.excitation.settings import MotionSettings

    stated: dict[str, Any] = {}
    for flag, (at, _) in _FLAGS.items():
        value = getattr(options, flag[2:].replace("-", "_"))
        if value not in (None, []) and at not in _OF_PAYLOAD:
            stated[at] = _READ[at](value, flag) if at in _READ else value
    return MotionSettings(**stated, payload=_load(options))


def _words(at: str, *, is_again: bool) -> str:
    """Return the help of a flag, by the setting that it states."""
    from robotid.excitation.settings import MotionSettings
    from robotid.simulation.settings import Payload

    settings = Payload if at in _OF_PAYLOAD else MotionSettings
    (found, key) = next((f, key) for f, key, path in settings.entries() if path == [at])
    words, default = key.text, found.default
    if isinstance(default, int | float) and default not in (0.0, float("inf")):
        words += f"; default: {default:g}"
    return (words + ("; may be given again" if is_again else "")).replace("%", "%%")


def _boxes(words: Sequence[str], flag: str) -> tuple["Box", ...]:
    """Return boxes that are stated as NAME=x0,y0,z0,x1,y1,z1, two corners [m].

    Raises:
        SettingsError: If a word is another one.
    """
    from robotid.excitation.clearance import Box
    from robotid.excitation.settings import FARTHEST

    boxes = []
    for word in words:
        name, _, numbers = word.partition("=")
        try:
            x = [float(number) for number in numbers.split(",")]
        except ValueError:
            x = []
        if len(x) != 6 or not all(abs(number) <= FARTHEST for number in x):
            raise SettingsError(
                f"{flag} {word!r}: wanted NAME=x0,y0,z0,x1,y1,z1, the lower and the upper corner "
                f"[m], within {FARTHEST:g} m"
            )
        boxes.append(Box(name, (x[0], x[1], x[2]), (x[3], x[4], x[5])))
    return tuple(boxes)


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


def _clearance(word: str, flag: str) -> float | None:
    if word == "none":
        return None
    try:
        return float(word)
    except ValueError as error:
        raise SettingsError(f"{flag} {word!r}: wanted metres, or none") from error


_OF_PAYLOAD = ("link", "mass", "com")
_AGAIN: dict[str, Any] = {"action": "append", "default": []}
#: Field of ``MotionSettings``, or of its payload, that each flag states.
_FLAGS: Mapping[str, tuple[str, dict[str, Any]]] = {
    "--kind": ("kind", {"choices": ("fourier", "bspline", "sweeps", "stands", "payload")}),
    "--link": ("link", {"metavar": "NAME"}),
    "--mass": ("mass", {"metavar": "KG", "type": float}),
    "--com": ("com", {"metavar": "X,Y,Z"}),
    "--moving": ("moving", {"metavar": "JOINTS"}),
    "--duration": ("duration", {"metavar": "S", "type": float}),
    "--harmonics": ("harmonics", {"metavar": "N", "type": int}),
    "--criterion": ("criterion", {"choices": ("D", "A", "E", "condition", "widest")}),
    "--share": ("share", {"metavar": "X", "type": float}),
    "--max-acceleration": ("acceleration", {"metavar": "JOINT=X", **_AGAIN}),
    "--max-jerk": ("jerk", {"metavar": "JOINT=X", **_AGAIN}),
    "--max-power": ("power", {"metavar": "JOINT=X", **_AGAIN}),
    "--clearance": ("clearance", {"metavar": "M"}),
    "--floor": ("floor", {"metavar": "M", "type": float}),
    "--box": ("boxes", {"metavar": "NAME=x0,y0,z0,x1,y1,z1", **_AGAIN}),
    "--noise": ("noise", {"metavar": "JOINT=N_M", **_AGAIN}),
    "--seed": ("seed", {"metavar": "N", "type": int}),
    "--starts": ("starts", {"metavar": "N", "type": int}),
    "--seconds": ("seconds", {"metavar": "S", "type": float}),
    "--points": ("points", {"metavar": "HZ", "type": float}),
}
#: How the words of a flag become the value of its field, where they are not it themselves.
_READ: Mapping[str, Callable[[Any, str], Any]] = {
    "moving": lambda word, _: word.split(","),
    "boxes": _boxes,
    "clearance": _clearance,
    **dict.fromkeys(("acceleration", "jerk", "power", "noise"), pairs),
}


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
