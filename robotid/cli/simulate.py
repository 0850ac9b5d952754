"""robotid simulate: simulate a log of a motion with a robot of known parameters."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robotid.base.exceptions import SettingsError
from robotid.base.findings import listed
from robotid.base.settings import Settings
from robotid.cli.console import terminal_progress
from robotid.cli.flags import JOB, ROBOT, Flags, add_json
from robotid.cli.printing import echo, print_files
from robotid.cli.running import show_found

if TYPE_CHECKING:
    from robotid.cli.work.job import Job
    from robotid.dynamics.simulation.simulation_settings import Simulation


SUMMARY = "simulate a log of a motion with a robot of known parameters"


_HALF = 0.5  # of the commanded range: a joint that moves less does not follow


def _simulation() -> Settings:
    from robotid.dynamics.simulation.simulation_settings import Simulation

    return Simulation()


#: Flags of the keys of a plant's file.
_PLANT = Flags(
    _simulation,
    {
        "--seed": ("seed", "N"),
        "--rate": ("rate", "HZ"),
        "--duration": ("duration", "S"),
        "--perturb": ("truth.inertials", "SIZE"),
        "--controller": ("controller.kind", "KIND"),
        "--torque-noise": ("sensors.noise.tau", "[JOINT=]SHARE"),
        "--limits": ("actuator.effort", "TIMES"),
        "--payload": ("payload.mass", "KG"),
    },
)


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of the command."""
    add = parser.add_argument
    add("source", metavar="JOB.toml | URDF")
    add("motion", metavar="MOTION", help="table of time and q_<joint>, as a log or a design")
    words = "log to write; the true parameters are written next to it"
    add("--out", required=True, metavar="LOG", help=words)
    add("--urdf", metavar="FILE", help="file for the URDF of the true robot")
    words = "TOML file of the true robot, its controller, actuators, sensors and payload"
    add("--plant", metavar="FILE", help=words)
    words = "cutoff frequency of the low-pass filter of a recorded MOTION"
    add("--cutoff", type=float, metavar="HZ", help=words)
    add_json(parser)
    _PLANT.add(parser.add_argument_group("these take precedence over --plant"))
    JOB.add(parser.add_argument_group("the robot"), ROBOT)


def run(options: argparse.Namespace) -> None:
    """Run the command."""
    from robotid.cli.work.simulate import SimulatedFiles, simulate_log

    job, settings = simulation_from_flags(options)
    urdf = Path(options.urdf) if options.urdf else None
    files = SimulatedFiles(Path(options.motion), Path(options.out), urdf, options.cutoff)
    with terminal_progress(quiet=options.json) as progress:
        content = simulate_log(job, files, settings, progress=progress)
    show_found(content, options, _show)
    if not options.json:
        print_files("", content["outputs"])


def simulation_from_flags(options: argparse.Namespace) -> "tuple[Job, Simulation]":
    """Return the robot and the settings of a simulation."""
    from robotid.cli.work.job import job_from_settings, read_job
    from robotid.dynamics.simulation.simulation_settings import read_simulation

    settings, drives = read_simulation(options.plant, _PLANT.stated(options))
    for joint, entries in drives.items():
        if named := [entry for entry in entries if isinstance(entry, str)]:
            raise SettingsError(
                f"{options.plant}: drives.{joint} has {named[0]!r}, wanted a term with its shape, "
                "as { term = 'Stribeck', speed = 0.1 }"
            )
    if Path(options.source).suffix == ".toml":
        if drives:
            raise SettingsError(f"{options.plant} has drives; state them in {options.source}")
        if given := [flag for flag in JOB.given(options) if flag in ROBOT]:
            raise SettingsError(f"{options.source} is a job file; state {listed(given)} in it")
        return read_job(options.source), settings
    if options.plant:  # errors of its drives then name this file
        job_from_settings({"urdf": options.source, "drives": drives}, options.plant, Path())
    table = {"urdf": options.source, "drives": drives, **JOB.stated(options, ROBOT)}
    return job_from_settings(table, "command line", Path()), settings


def _show(content: dict[str, Any]) -> None:
    print(
        f"{content['robot']}: {content['samples']} samples over {content['duration']:g} s, seed "
        f"{content['settings']['seed']}"
    )
    noise = content["settings"].get("sensors", {}).get("noise", {})
    if not any(noise.get(kind) for kind in ("tau", "torque")):
        echo(
            "the torques have no noise: errors of parameters from this log are smaller than those "
            "from a recorded log, and than those of a preview, which assumes noise. Add noise with "
            "--torque-noise 0.02, a share of the torque"
        )
    head = "position error"
    width = max(len(head), *(len(joint) for joint in content["joints"]))
    print(f"\n{head:{width}}  rms, largest")
    for joint in content["following"]:
        line = f"{joint['joint']:{width}}  {joint['rms']:.2g}, {joint['largest']:.2g}"
        line += f" {joint['unit']}"
        if joint["at_limit"] > 0:
            line += f"; at the effort limit for {100 * joint['at_limit']:.2g} % of the time"
        print(line)
    for joint in content["following"]:
        if joint["range"] < _HALF * joint["commanded"]:
            name, unit = joint["joint"], joint["unit"]
            echo(
                f"warning: {name} moves {joint['range']:.2g} {unit}, wanted the "
                f"{joint['commanded']:.2g} {unit} commanded. If its friction stops it, state it in "
                "the file of --plant: "
                f'[truth] values = {{ "{name}.coulomb" = 0 }}, or larger gains under [controller]',
                "  ",
                "warning",
            )
