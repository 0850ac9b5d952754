"""robotid convert: write a log as CSV, Parquet, NPZ, HDF5 or MAT, with standard column names."""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from robotid.base.exceptions import DataError
from robotid.base.files import check_file
from robotid.base.findings import listed, suggestion
from robotid.cli.console import echo, show_found
from robotid.cli.job import JOB, SOURCE, add_shown
from robotid.data.base_motion import ACCELERATION, IMU, POSE, TWIST
from robotid.data.files.columns import KINDS, is_clock, quantity_of
from robotid.data.files.read import open_table, write_columns
from robotid.data.files.table import with_even_stamps
from robotid.data.log import repeated
from robotid.data.signal_settings import LogSource
from robotid.robot.constraints import Contact

_WHOLE = LogSource()
_BASE = {f"base_{x}" for x in (*POSE, "roll", "pitch", "yaw", *TWIST, *ACCELERATION)}
_SENSED = {*_BASE, *(f"imu_{x}" for x in IMU)}
_OF_LINKS = ("contact_", "foot_force_", *(f"wrench_{x}_" for x in Contact.components))


def convert(
    path: str | Path,
    target: str | Path,
    *,
    joints: Sequence[str] | None = None,
    source: LogSource = _WHOLE,
) -> dict[str, Any]:
    """Write a log in another format, with standard column names; no robot model is required."""
    file = Path(path)
    check_file(Path(target), [file])
    opened = open_table(file, source)
    named, by_joint = _standard_names(file.name, opened.names, source)
    wanted = list(by_joint if joints is None else joints)
    if unknown := [joint for joint in wanted if joint not in by_joint]:
        near = suggestion(unknown[0], by_joint)
        raise DataError(
            f"{file.name} has no joint {unknown[0]!r}; joints found: {listed(by_joint)}{near}"
        )
    others = [x for x in opened.names if x in _SENSED or x.startswith(_OF_LINKS)]
    named |= {name: name for name in others}
    chosen = ["time", *(name for joint in wanted for name in by_joint[joint]), *others]
    columns = [name for name in named if name in chosen]
    even = with_even_stamps(opened, named["time"], source.stamp)
    table = even.read([named[name] for name in columns])
    write_columns({name: table[named[name]] for name in columns}, Path(target))
    is_local = opened.axes.get("wrench") == "link" and any(x.startswith("wrench_") for x in others)
    return {
        "path": str(target), "samples": len(table[named["time"]]), "columns": columns,
        "joints": wanted, "local": is_local,  # wrenches with the axes of their links
        "ignored": [name for name in opened.names if name not in named.values()],
    }  # fmt: skip


def _standard_names(
    where: str, names: Sequence[str], source: LogSource
) -> tuple[dict[str, str], dict[str, list[str]]]:
    """Return the columns by standard name, ordered by quantity, and the standard names by joint."""
    joint_of = {name: joint for joint, name in source.joints.items()}
    pairs = [("time", name) for name in names if is_clock(name)]
    by_joint: dict[str, list[str]] = {}
    quantities = [(name, quantity_of(name, source.effort, joint_of)) for name in names]
    for kind in KINDS:
        for name, quantity in quantities:
            if quantity and quantity[0] == kind:
                joint = joint_of.get(quantity[1], quantity[1])
                pairs.append((f"{kind}_{joint}", name))
                by_joint.setdefault(joint, []).append(f"{kind}_{joint}")
    if twice := repeated([key for key, _ in pairs]):
        both = [name for key, name in pairs if key == twice[0]]
        raise DataError(
            f"{where} has several columns for {twice[0]!r}: {listed(both)}; keep one of them"
        )
    standard = dict(pairs)
    for is_there, what, remedy in (
        ("time" in standard, "'time'", "the time column"),
        (by_joint, "of a joint, as 'q_<joint>'", "the columns of the joints"),
    ):
        if not is_there:
            columns = f"columns found: {listed(names)}. Rename {remedy}"
            raise DataError(f"{where} has no column {what}; {columns}")
    return standard, by_joint


def add_flags(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("log", metavar="IN", help="log of any format, or the folder of a bag")
    add("out", metavar="OUT", help="file to write; its suffix determines the format")
    add("--joints", metavar="A,B,...", help="joints to write; default: all")
    add("--sensors", metavar="A,B,...", help="topics of base, IMU and forces; default: all")
    JOB.add(parser, SOURCE)
    add_shown(parser, "json")


def run(options: argparse.Namespace) -> None:
    joints = options.joints.split(",") if options.joints else None
    topics = tuple(options.sensors.split(",")) if options.sensors else ()
    source = LogSource(**JOB.stated(options, SOURCE).get("log", {}), sensors=topics)
    show_found(convert(options.log, options.out, joints=joints, source=source), options, _show)


def _show(done: dict[str, Any]) -> None:
    print(f"{done['path']}: {done['samples']} samples of {len(done['joints'])} joints")
    echo(f"  columns {', '.join(done['columns'])}", "  ")
    if done["local"]:
        echo("  wrenches have the axes of their links: axes = 'link' in [[contact]]")
    if done["ignored"]:
        echo(f"  not written, not of a joint: {', '.join(done['ignored'])}", "  ")
