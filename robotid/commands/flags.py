"""The flags of each command, and the job that a command line names or describes."""

import argparse
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robotid._settings import table_in
from robotid.exceptions import SettingsError
from robotid.findings import listed

if TYPE_CHECKING:
    from robotid.commands.excite import MotionSettings
    from robotid.commands.job import Job
    from robotid.simulation.settings import Payload, Simulation

__all__ = [
    "add_flags",
    "job_from_flags",
    "refuse_log_flags",
    "simulation_from_flags",
    "source_settings",
    "source_words",
]


def _pairs(words: Sequence[str], flag: str) -> dict[str, float]:
    pairs = {}
    for word in words:
        name, _, number = word.partition("=")
        try:
            pairs[name] = float(number)
        except ValueError as error:
            raise SettingsError(f"{flag} {word!r}: wanted JOINT=NUMBER") from error
    return pairs


def _of_all_or_pairs(words: Sequence[str], flag: str) -> float | dict[str, float]:
    """Return one number for all joints, or numbers by joint."""
    if len(words) > 1 or "=" in words[0]:
        return _pairs(words, flag)
    try:
        return float(words[0])
    except ValueError as error:
        raise SettingsError(f"{flag} {words[0]!r}: wanted NUMBER or JOINT=NUMBER") from error


def _cutoff(word: str, flag: str) -> float | bool:
    try:
        return False if word == "false" else float(word)
    except ValueError as error:
        raise SettingsError(f"{flag} {word!r}: wanted a frequency [Hz] or false") from error


#: Key of the job file that each flag states, and what argparse is told of it.
_FLAGS: Mapping[str, tuple[str, dict[str, Any]]] = {
    "--estimator": ("estimator.name", {"metavar": "NAME"}),
    "--kp": ("controller.kp", {"metavar": "[JOINT=]N_M_PER_RAD", "action": "append"}),
    "--kd": ("controller.kd", {"metavar": "[JOINT=]N_M_S_PER_RAD", "action": "append"}),
    "--joints": ("joints", {"metavar": "A,B,..."}),
    "--lock": ("locked", {"metavar": "JOINT=POSITION", "action": "append"}),
    "--snap-angles": ("snap_angles", {"action": "store_const", "const": True}),
    "--gain": ("torque.gains", {"metavar": "JOINT=N_M_PER_A", "action": "append"}),
    "--rate": ("signals.rate", {"metavar": "HZ", "type": float}),
    "--cutoff": ("signals.cutoff", {"metavar": "HZ"}),
    "--velocity": ("signals.velocity", {"metavar": "HOW"}),
    "--acceleration": ("signals.acceleration", {"metavar": "HOW"}),
    "--order": ("signals.order", {"metavar": "N", "type": int}),
    "--trim": ("signals.trim", {"metavar": "S", "type": float}),
    "--min-velocity": ("signals.min_velocity", {"metavar": "RAD_PER_S", "type": float}),
    "--friction-band": ("signals.friction_band", {"metavar": "RAD_PER_S", "type": float}),
    "--max-gap": ("signals.max_gap", {"metavar": "S", "type": float}),
    "--torque-delay": ("signals.torque_delay", {"metavar": "S", "type": float}),
    "--velocity-delay": ("signals.velocity_delay", {"metavar": "S", "type": float}),
    "--friction": ("model.friction", {"metavar": "MODEL"}),
    "--dynamics": ("output.dynamics", {"action": "store_const", "const": True}),
    "--no-report": ("output.report", {"action": "store_const", "const": False}),
    "--ignore": ("doctor.ignore", {"metavar": "CODE", "action": "append"}),
    "--time-unit": ("units.time", {"metavar": "UNIT"}),
    "--angle-unit": ("units.angle", {"metavar": "UNIT"}),
    "--topic": ("log.topic", {"metavar": "NAME"}),
    "--command-topic": ("log.command", {"metavar": "NAME"}),
    "--effort": ("log.effort", {"metavar": "MEANING"}),
    "--stamp": ("log.stamp", {"metavar": "CLOCK"}),
}
#: How the words of a flag become the value of its key, where they are not it themselves.
_READ: Mapping[str, Callable[[Any, str], Any]] = {
    "--joints": lambda word, _: word.split(","),
    "--lock": _pairs,
    "--gain": _pairs,
    "--kp": _of_all_or_pairs,
    "--kd": _of_all_or_pairs,
    "--cutoff": _cutoff,
}
_FIT = ("--estimator", "--kp", "--kd")
_LOG = tuple(flag for flag in _FLAGS if flag not in _FIT)
#: Flags that a tracked or replayed log has a use for.
_ONLINE = tuple(
    flag
    for flag, (key, _) in _FLAGS.items()
    if flag in ("--rate", "--cutoff", "--min-velocity")
    or (flag in _LOG and not key.startswith("signals."))
)
_SOURCE = ("--topic", "--command-topic", "--effort", "--stamp")
#: Flags that say which robot it is, and how a table is read.
_ROBOT = ("--joints", "--lock", "--snap-angles", "--time-unit", "--angle-unit")
#: Key of the file of a plant that each flag of "simulate" states.
_SIMULATION: Mapping[str, tuple[str, dict[str, Any]]] = {
    "--seed": ("seed", {"metavar": "N", "type": int}),
    "--rate": ("rate", {"metavar": "HZ", "type": float}),
    "--duration": ("duration", {"metavar": "S", "type": float}),
    "--perturb": ("truth.inertials", {"metavar": "SIZE", "type": float}),
    "--controller": ("controller.kind", {"metavar": "KIND"}),
    "--torque-noise": ("sensors.noise.tau", {"metavar": "SHARE", "type": float}),
    "--limits": ("actuator.effort", {"metavar": "TIMES", "type": float}),
    "--payload": ("payload.mass", {"metavar": "KG", "type": float}),
}
#: Flags that a motion without torques has a use for.
_MOTION = tuple(
    flag
    for flag, (key, _) in _FLAGS.items()
    if flag in _LOG and not key.startswith(("output.", "torque.", "doctor."))
    if flag not in ("--effort", "--torque-delay")
)
_VERBOSE = "print notes, too; say on stderr the stages, what is chosen, and why"


def add_flags(parser: argparse.ArgumentParser, command: str) -> None:
    """Add the flags of a command.

    Args:
        parser: Its parser.
        command: Its name.
    """
    add = parser.add_argument
    match command:
        case "demo":
            _add_out(parser, "robotid-demo")
        case "paper":
            _add_out(parser, "robotid-paper")
            _add_json(parser, "paper.json")
            add("--quick", action="store_true", help="few iterations and motions: a try-out")
            _add_progress(parser)
        case "inspect":
            add("urdf", metavar="URDF")
            add("--free-flyer", action="store_true", help="the base floats")
            add("--base", action="store_true", help="print the base parameters, too")
            _add_json(parser)
            _add_verbose(parser, "print notes, too")
        case "identify":
            _add_job(parser, "result.json")
            _add_out(parser, "robotid-out")
            _add_work(parser)
            _add_progress(parser)
        case "doctor":
            _add_job(parser)
        case "preview":
            _add_preview(parser)
        case "excite":
            _add_excite(parser)
        case "track":
            _add_robot_and_log(parser)
            _add_out(parser, "robotid-track")
            _add_json(parser, "track.json")
            _add_settings(parser.add_argument_group("the log"), _ONLINE)
            _add_verbose(parser)
            _add_serve(parser, "show it in the browser while it runs, in true time")
        case "replay":
            _add_replay(parser)
        case "validate":
            add("result", metavar="RESULT.json")
            add("logs", nargs="+", metavar="LOG")
            _add_json(parser)
        case "payload":
            _add_payload(parser)
        case "report":
            add("result", metavar="RESULT", help="result.json or its folder")
            add("--out", metavar="FILE", help="page to write; default: report.html beside it")
            _add_json(parser)
            _add_verbose(parser)
            _add_progress(parser)
        case "compare":
            add("results", nargs="+", metavar="RESULT.json")
            add("--out", metavar="FILE.html", help="page to write")
            _add_json(parser)
        case "simulate":
            _add_simulation(parser)
        case "export" | "convert":
            _add_conversion(parser, command)


def _add_conversion(parser: argparse.ArgumentParser, command: str) -> None:
    add = parser.add_argument
    if command == "export":
        add("result", metavar="RESULT", help="result.json or its folder")
        kinds = ("urdf", "mjcf", "sdf", "isaac", "ranges")
        words = "isaac: YAML of Isaac Lab's actuators; ranges: YAML of 95 %% intervals"
        add("--format", required=True, choices=kinds, help=words)
        add("--out", required=True, metavar="FILE", help="file to write")
        words = "time step of the simulator; default: 0.001 of mjcf, 0.005 of isaac"
        add("--step", type=float, metavar="S", help=words)
        words = "how mjcf delays commands; default: history, which needs MuJoCo 3.5"
        add("--delay", choices=("history", "filter"), help=words)
        words = "deprecated, without effect: friction that a format lacks is always projected"
        add("--mean-friction", action="store_true", help=words)
    else:
        add("log", metavar="IN", help="a log of any format, or a bag's folder")
        add("out", metavar="OUT", help="file to write; its suffix says the format")
        add("--joints", metavar="A,B,...", help="joints to write; default: all")
        _add_settings(parser, _SOURCE)
    _add_json(parser)


def _add_replay(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    _add_robot_and_log(parser)
    results = "result.json, track.json or their folder"
    add("results", nargs="*", metavar="RESULT", help=results)
    add("--html", metavar="FILE", help="page to write; default: replay.html")
    add("--ghost", metavar="LOG", help="second motion, shown as a ghost")
    _add_serve(parser, "track the log again, in true time, and show it as it goes")
    group = parser.add_argument_group("the log, unless a RESULT says it")
    _add_settings(group, _ONLINE)


def _add_preview(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("source", metavar="JOB.toml | URDF")
    add("logs", nargs="*", metavar="MOTION", help="motions or logs; only positions are read")
    words = "a result.json or its folder: what its logs have said, and their noise"
    add("--given", metavar="RESULT", help=words)
    words = "standard deviation of a joint's torque [N m or N]; may be given again; default: that "
    words += "of RESULT, or 1 %% of the joint's largest torque"
    add("--noise", metavar="JOINT=N_M", action="append", default=[], help=words)
    words = "time over which that is correlated [s]; 0: from sample to sample; default: 0.1"
    add("--correlation", metavar="S", type=float, help=words)
    _add_json(parser)
    words = "print standard parameters and whole expressions, too; say on stderr what is chosen"
    parser.add_argument("--verbose", action="store_true", help=words)
    flags = parser.add_argument_group("instead of a job file or a RESULT, with URDF MOTION")
    flags.add_argument("--estimator", **_FLAGS["--estimator"][1], help="as of identify")
    _add_settings(flags, _MOTION)


def _add_simulation(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("source", metavar="URDF")
    add("motion", metavar="MOTION", help="table of time and q_<joint>, as a log or a design")
    add("--out", required=True, metavar="LOG", help="log to write; its truth goes beside it")
    add("--urdf", metavar="FILE", help="URDF of the true robot to write, too")
    words = "TOML file of the true robot, its controller, actuators, sensors and payload"
    add("--plant", metavar="FILE", help=words)
    add("--cutoff", type=float, metavar="HZ", help="smooth MOTION, a recorded one, to this")
    _add_json(parser)
    group = parser.add_argument_group("instead of, or over, the same in --plant")
    for flag, (key, about) in _SIMULATION.items():
        group.add_argument(flag, **about, help=_simulation_words(key))
    _add_settings(parser.add_argument_group("the robot"), _ROBOT)


def _simulation_words(key: str) -> str:
    from robotid.simulation.settings import Simulation

    return Simulation.paths()[key].words.replace("%", "%%")


def _add_excite(parser: argparse.ArgumentParser) -> None:
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
    _add_json(parser)
    _add_progress(parser)
    flags = parser.add_argument_group("the robot, instead of a job file")
    _add_settings(flags, _ROBOT[:3])


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
    stated["noise"] = _pairs(options.noise, "--noise")
    for name in ("acceleration", "jerk", "power"):
        stated[name] = _pairs(getattr(options, f"max_{name}"), f"--max-{name}")
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


def _add_payload(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("source", metavar="URDF")
    add("logs", nargs="+", metavar="LOG", help="logs with the payload")
    words = "log without the payload, or a result.json or its folder; may be given again"
    again: dict[str, Any] = {"action": "append", "default": []}
    add("--reference", required=True, metavar="LOG | RESULT", help=words, action="append")
    words = "link that it hangs on; default: the last moving one; may be given again"
    add("--link", metavar="NAME", help=words, **again)
    words = "its mass, if it is known; of several: LINK=KG"
    add("--mass", metavar="KG", help=words, **again)
    words = "find the gains of logged currents that no --gain states, from a known mass"
    add("--gains", action="store_true", help=words)
    _add_json(parser)
    _add_settings(parser.add_argument_group("the logs, unless a RESULT says it"), _LOG)


def _add_out(parser: argparse.ArgumentParser, folder: str) -> None:
    parser.add_argument("--out", default=folder, metavar="DIR", help="folder to write to")


def _add_json(parser: argparse.ArgumentParser, what: str = "one JSON object") -> None:
    parser.add_argument("--json", action="store_true", help=f"print {what}")


def _add_verbose(parser: argparse.ArgumentParser, words: str = _VERBOSE) -> None:
    parser.add_argument("--verbose", action="store_true", help=words)


def _add_progress(parser: argparse.ArgumentParser) -> None:
    words = "show progress on stderr although it is no terminal, or beside --json"
    parser.add_argument("--progress", action="store_true", help=words)


def _add_robot_and_log(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("source", metavar="URDF")
    parser.add_argument("logs", nargs=1, metavar="LOG")


def _add_serve(parser: argparse.ArgumentParser, words: str) -> None:
    parser.add_argument("--serve", nargs="?", const=0, type=int, metavar="PORT", help=words)
    speed = "of --serve; 0: as fast as it can"
    parser.add_argument("--speed", type=float, default=1.0, metavar="X", help=speed)


def _add_job(parser: argparse.ArgumentParser, json_: str = "one JSON object") -> None:
    """Add a job file, or the flags that say what it says."""
    from robotid.fitting.settings import ESTIMATORS

    parser.add_argument("source", metavar="JOB.toml | URDF")
    parser.add_argument("logs", nargs="*", metavar="LOG", help="logs to fit")
    _add_json(parser, json_)
    flags = parser.add_argument_group("instead of a job file, with URDF LOG [LOG ...]")
    flags.add_argument("--validate", nargs="+", metavar="LOG", help="logs kept apart")
    names = f"which estimator: consistent (default), {', '.join(ESTIMATORS)}"
    flags.add_argument("--estimator", **_FLAGS["--estimator"][1], help=names)
    _add_settings(flags, (*_FIT[1:], *_LOG))
    _add_verbose(parser)


def _add_settings(flags: "argparse._ActionsContainer", wanted: Sequence[str]) -> None:
    """Add flags of settings; what they are for is said by the keys of the job file."""
    from robotid.commands.job import Job

    keys = Job.paths()
    for flag in wanted:
        at, about = _FLAGS[flag]
        words = keys[at].words if at in keys else "none, viscous or viscous+coulomb"
        flags.add_argument(flag, **about, help=words)


def _add_work(parser: argparse.ArgumentParser) -> None:
    """Add the flags that say who reduces long logs; they never change a result."""
    flags = parser.add_argument_group("long logs; the result has the same bits in any case")
    words = "worker processes; default: that of the job file, else one per core for long logs"
    flags.add_argument("--workers", type=int, metavar="N", help=words)
    words = "of a Dask cluster, as tcp://host:8786"
    flags.add_argument("--scheduler", metavar="ADDRESS", help=words)
    words = "go on from where an interrupted run in --out ended"
    flags.add_argument("--resume", action="store_true", help=words)


def simulation_from_flags(options: argparse.Namespace) -> "tuple[Job, Simulation]":
    """Return the robot and the settings of a simulation.

    Args:
        options: The flags of the command "simulate".

    Raises:
        SettingsError: If the file of the plant cannot be used, or a flag is not usable.
    """
    from robotid.commands.job import job_from_settings
    from robotid.simulation.settings import read_simulation

    given: dict[str, Any] = {}
    for flag, (path, _) in _SIMULATION.items():
        value = getattr(options, flag[2:].replace("-", "_"))
        if value is not None:
            *tables, key = path.split(".")
            table_in(given, tables)[key] = value
    settings, drives = read_simulation(options.plant, given)
    for joint, entries in drives.items():
        if named := [entry for entry in entries if isinstance(entry, str)]:
            raise SettingsError(
                f"{options.plant}: drives.{joint} has {named[0]!r}; a plant states its terms with "
                "their shapes, as { term = 'Stribeck', speed = 0.1 }"
            )
    if options.plant:  # so that what is wrong with its drives is told of it
        job_from_settings({"urdf": options.source, "drives": drives}, options.plant, Path())
    table = {"urdf": options.source, "drives": drives, **_stated(options, _ROBOT)}
    return job_from_settings(table, "command line", Path()), settings


def stated_noise(options: argparse.Namespace) -> dict[str, float]:
    """Return the noise that was stated, by joint [N m or N].

    Args:
        options: The flags of the command "preview".

    Raises:
        SettingsError: If a word is not JOINT=NUMBER.
    """
    return _pairs(options.noise, "--noise")


def source_settings(options: argparse.Namespace) -> dict[str, Any]:
    """Return the settings of a ``LogSource`` that were given, by name.

    Args:
        options: The flags of the command "convert".
    """
    return dict(_stated(options, _SOURCE).get("log", {}))


def job_from_flags(options: argparse.Namespace, *, needs_logs: bool = True) -> "Job":
    """Return the job that a command line names or describes.

    Args:
        options: The flags of the command.
        needs_logs: Whether it is of no use without a log.

    Raises:
        SettingsError: If a job file is given with flags, or a flag is not usable.
    """
    from robotid.commands.job import job_from_settings, read_job

    if Path(options.source).suffix == ".toml":
        given = _given(options)
        if options.logs or given:
            raise SettingsError(
                f"{options.source} is a job file, which states its logs and settings itself; "
                f"leave out {listed(options.logs or given)}"
            )
        return read_job(options.source)
    if not options.logs and needs_logs:
        kind = "motion" if hasattr(options, "given") else "log"  # of preview
        one = kind.upper()
        raise SettingsError(f"no {kind} was given; wanted URDF {one} [{one} ...], or JOB.toml")
    kept = getattr(options, "validate", None) or ()
    table = {
        "urdf": options.source,
        "identification": [{"log": log} for log in options.logs],
        "validation": [{"log": log} for log in kept],
        **_stated(options, list(_FLAGS)),
    }
    return job_from_settings(table, "command line", Path())


def source_words(words: Sequence[str]) -> tuple[str, ...]:
    """Return the words of a command line that say what is identified, and how.

    Args:
        words: The words after ``robotid``.

    Returns:
        Those after the name of the command but for ``--out`` and what is only shown.
    """
    _, *rest = words
    kept, shown = list[str](), ("--json", "--progress", "--verbose", "--resume")
    for before, word in zip(words, rest, strict=False):
        if before != "--out" and word not in (*shown, "--out") and not word.startswith("--out="):
            kept.append(word)
    return tuple(kept)


def refuse_log_flags(options: argparse.Namespace, why: str) -> None:
    """Refuse the flags that say how logs are read.

    Args:
        options: The flags of the command.
        why: What is in their place.

    Raises:
        SettingsError: If one is given.
    """
    if given := _given(options):
        raise SettingsError(f"{why}; leave out {listed(given)}")


def _given(options: argparse.Namespace) -> list[str]:
    flags = ["--validate", *_FLAGS]
    return [flag for flag in flags if getattr(options, _name(flag), None) is not None]


def _name(flag: str) -> str:
    """Return what argparse calls a flag."""
    return flag[2:].replace("-", "_")


def _stated(options: argparse.Namespace, flags: Sequence[str]) -> dict[str, Any]:
    """Return what flags state, as a table of a job file."""
    table: dict[str, Any] = {}
    for flag in flags:
        value = getattr(options, _name(flag), None)
        if value is None:
            continue
        *tables, key = _FLAGS[flag][0].split(".")
        table_in(table, tables)[key] = _READ[flag](value, flag) if flag in _READ else value
    return table
