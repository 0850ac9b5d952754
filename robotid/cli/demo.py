"""robotid demo: simulate a Unitree Z1 arm, identify it and write a report; no input is needed."""

import argparse
from pathlib import Path
from typing import Any, cast

import numpy as np

from robotid.base.files import check_folder
from robotid.base.typing import Array, ProgressCallback
from robotid.cli.console import echo, print_files, progress_of
from robotid.cli.identify import run_job, show_result
from robotid.cli.job import Job, LogEntry, add_out, add_shown
from robotid.data.files.read import write_log
from robotid.data.signal_settings import SignalSettings
from robotid.dynamics.simulation.motions import random_fourier
from robotid.dynamics.simulation.simulation_settings import Noise, Truth
from robotid.dynamics.simulation.simulator import draw_parameters, simulate
from robotid.estimation.work_plan import WorkPlan
from robotid.identification.result import TorqueIdentification
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

_RATE = 200.0  # [Hz]
_PERIOD = 10.0  # [s]
_URDF = "z1.urdf"  # Unitree Z1
_LOCKED = {"jointGripper": 0.0}  # [rad]
_NOISE = Noise(q=2e-5, v=2e-4, tau=0.02)  # encoder [rad], its rate [rad/s], 2 % of torque


def run_demo(
    folder: str | Path, *, progress: ProgressCallback | None = None
) -> tuple[TorqueIdentification, dict[str, Any], Array]:
    """Simulate, identify, validate, and write all files."""
    target = Path(folder)
    check_folder(target, ["identification.csv", "validation.csv", "result.json", "replay.html"])
    target.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(0)
    model = RobotModel.from_urdf(example_urdf(_URDF), locked=_LOCKED)
    truth = draw_parameters(model, Truth(), rng)
    entries = []
    for name, duration in (("identification", 2 * _PERIOD), ("validation", _PERIOD)):
        motion = random_fourier(model, rng, period=_PERIOD)
        log = simulate(model, truth, motion, rate=_RATE, duration=duration, rng=rng, noise=_NOISE)
        write_log(log, target / f"{name}.csv")
        entries.append(LogEntry(target / f"{name}.csv"))
    job = Job(
        urdf=Path(model.tree.path), locked=_LOCKED, signals=SignalSettings(cutoff=10.0),
        identification=(entries[0],), validation=(entries[1],), replay=True,
    )  # fmt: skip
    concluded, result = run_job(job, target, plan=WorkPlan(progress=progress))
    identification = cast(TorqueIdentification, concluded)  # of the default estimator
    true = dict(zip(model.layout.names, truth, strict=True))
    # a drive term that the data shows, and the simulated robot does not have, is truly 0
    pi = np.array([true.get(name, 0.0) for name in identification.model.layout.names])
    return identification, result, identification.mapping.to_base(pi)


def add_flags(parser: argparse.ArgumentParser) -> None:
    add_out(parser, "robotid-demo")
    add_shown(parser, "verbose")


def run(options: argparse.Namespace) -> None:
    echo("simulating a Unitree Z1 arm whose masses, armature and friction differ from its URDF ...")
    with progress_of(options) as progress:
        identification, result, truth = run_demo(options.out, progress=progress)
    scale, verdict = identification.scale_check, result["verdict"]
    if scale is not None and not options.verbose:  # the scale of simulated torques is known
        verdict["reasons"] = [x for x in verdict["reasons"] if x != scale.message]
    show_result(result, identification.findings, is_verbose=options.verbose)
    error = identification.base - truth
    within = sum(abs(error) < 3 * identification.base_error)
    echo(f"\n{within} of {len(truth)} base parameters lie within 3 standard errors of the truth")
    print_files([*result["outputs"].values(), "result.json"], options.out)
