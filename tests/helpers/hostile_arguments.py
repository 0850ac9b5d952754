"""Hostile arguments of the Python API, and what is done with each: only a RobotIdError may come.

As the kinds of ``hostile_inputs``, beside which these are.
"""

import contextlib
import io
import warnings
from collections import UserDict
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from hypothesis import strategies as st

import robotid
from helpers.hostile_inputs import JOINTS, URDF, good_log, good_result
from robotid import Log, RobotModel, SignalSettings, Trajectory
from robotid.base.exceptions import RobotIdError
from robotid.data.signal_settings import LogSource, LogUnits
from robotid.robot.parameters import Coupling

__all__ = ["ARGUMENT_KINDS"]


@cache
def robot():
    """Return what calls are made with: a model, a log, what was found of it, and its result."""
    model, log = RobotModel.from_urdf(URDF), good_log(200)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = robotid.identify(model, log, estimator="ols", doctor=False, friction="none")
    result = robotid.load_result(good_result()[0])
    steps = np.zeros(60, dtype=int)
    return SimpleNamespace(model=model, log=log, found=found, result=result, segment=steps)


def _log_fields(log):
    return {"t": log.t, "q": log.q, "tau": log.tau, "joints": log.joints, "v": log.v, "a": log.q,
            "path": "", "notes": (), "q_ref": log.q, "v_ref": log.v, "tau_ref": log.tau,
            "has_torque": True}  # fmt: skip


def _online(model, t, q, tau):
    online = robotid.OnlineIdentifier(model)
    online.update(t, q, tau)
    return online.is_ready


#: By name: a function, and what makes its good arguments of the robot and an empty folder.
CALLS = {
    "Log": (Log, lambda c, _: _log_fields(c.log)),
    "Log.window": (
        lambda start, end: robot().log.window(start, end),
        lambda c, _: {"start": 0.1, "end": 0.9},
    ),
    "Log.select": (lambda joints: robot().log.select(joints), lambda c, _: {"joints": JOINTS}),
    "Trajectory": (
        Trajectory,
        lambda c, _: {"t": c.log.t[:60], "q": c.log.q[:60], "v": c.log.v[:60], "a": c.log.q[:60],
                      "tau": c.log.tau[:60], "joints": JOINTS, "rate": 50.0, "segment": c.segment},
    ),
    "SignalSettings": (
        SignalSettings,
        lambda c, _: {"rate": 50.0, "cutoff": 8.0, "order": 4, "velocity": "auto", "trim": 0.1,
                      "min_velocity": 0.02, "friction_band": 0.0, "max_gap": None,
                      "acceleration": "auto", "torque_delay": 0.0, "velocity_delay": 0.0},
    ),
    "LogSource": (
        LogSource,
        lambda c, _: {"topic": None, "command": None, "joints": {}, "effort": "torque",
                      "stamp": "header"},
    ),
    "LogUnits": (LogUnits, lambda c, _: {"time": "s", "angle": "rad"}),
    "EstimatorSettings": (
        robotid.EstimatorSettings,
        lambda c, _: {"name": "consistent", "margin": 1e-4, "prior": "entropic",
                      "prior_weight": "auto", "constraints": {}, "robust": "none"},
    ),
    "from_urdf": (
        RobotModel.from_urdf,
        lambda c, _: {"path": URDF, "joints": JOINTS, "locked": {}, "free_flyer": False,
                      "mimic": "independent", "gravity": (0.0, 0.0, -9.81), "terms": ("viscous",),
                      "couplings": (), "own_terms": {}, "dynamics": "full", "snap_angles": False},
    ),
    "Coupling": (
        lambda **given: RobotModel.from_urdf(URDF, couplings=[Coupling(**given)]),
        lambda c, _: {"name": "c", "ratios": (("joint_1", 1.0),), "replaces": False},
    ),
    "inspect_urdf": (robotid.inspect, lambda c, _: {"path": URDF, "free_flyer": False}),
    "check_logs": (
        robotid.doctor,
        lambda c, _: {"model": c.model, "logs": c.log, "validation": (), "signals": None},
    ),
    "read_log": (
        robotid.read_log,
        lambda c, _: {"path": good_result()[0] / "fit.csv", "joints": JOINTS, "gains": None,
                      "columns": None, "start": None, "end": None, "units": LogUnits(),
                      "prismatic": (), "source": LogSource(), "transmissions": (),
                      "needs": "torque"},
    ),
    "write_log": (robotid.write_log, lambda c, f: {"log": c.log, "path": f / "log.csv"}),
    "identify": (
        robotid.identify,
        lambda c, _: {"model": c.model, "logs": c.log, "validation": (), "signals": None,
                      "estimator": "ols", "controller": None, "friction": "none", "doctor": False,
                      "ignore": ()},
    ),
    "identify_payload": (
        robotid.payload,
        lambda c, _: {"model": c.model, "logs": c.log, "reference": c.log, "links": (),
                      "masses": None, "unknown_gains": (), "signals": None, "friction": "none"},
    ),
    "preview": (
        robotid.preview,
        lambda c, _: {"model": c.model, "motions": c.log, "noise": {"joint_1": 0.1},
                      "signals": None, "estimator": "ols", "given": None},
    ),
    "predict": (
        lambda **given: robot().found.predict(**given),
        lambda c, _: {"q": c.log.q, "v": c.log.v, "a": c.log.q},
    ),
    "friction": (
        lambda **given: robot().found.friction(**given),
        lambda c, _: {"joint": "joint_1", "v": [0.1, 0.2], "q": 0.1, "load": 1.0},
    ),
    "follow_commands": (
        lambda **given: robot().result.follow_commands(**given), lambda c, _: {"log": c.log}
    ),
    "save": (
        lambda **given: robotid.save_result(robot().found, **given),
        lambda c, f: {"folder": f / "saved", "report": False, "replay": False},
    ),
    "load_result": (robotid.load_result, lambda c, _: {"path": good_result()[0]}),
    "replay": (
        robotid.replay,
        lambda c, _: {"model": c.model, "t": c.log.t[:60], "q": c.log.q[:60], "torques": None,
                      "masses": None, "ghosts": None, "bands": None, "marks": (), "notes": (),
                      "rate": 30.0},
    ),
    "OnlineIdentifier": (
        _online,
        lambda c, _: {"model": c.model, "t": 0.0, "q": c.log.q[0], "tau": c.log.tau[0]},
    ),
}  # fmt: skip

MASKED = np.ma.masked_array(np.zeros((200, 2)), mask=np.eye(200, 2, dtype=bool))


def odd_arguments(given):
    """Return what stands where another argument should."""
    return [
        None, 5, -1, 0, 0.5, float("nan"), float("inf"), 1e308, 10**400, True, 2 + 1j, "x", "",
        "joint_1", b"x", "a\0b", "\ud800", "x" * 5000, Path("nowhere"), Path(), [], (), {}, set(),
        ["x"], [None], [5], {1: 2}, [[1.0], [1.0, 2.0]], {"joint_1": None}, {"joint_1": "x"},
        {"joint_1": float("nan")}, {"joint_1": 1.0}, {"x": 1.0}, UserDict(joint_1=1.0), object(),
        SimpleNamespace(joints=JOINTS), int, len, iter(JOINTS), range(2), np.float64(1.0),
        np.array("joint_1"), np.array(["joint_1", "joint_2"]), np.array([b"x"]), np.zeros(0),
        np.zeros(2), np.zeros((200, 2)), np.zeros((2, 200)), np.zeros((200, 3)), np.arange(200),
        np.full((200, 2), np.nan), np.full((200, 2), 1e300), np.full((200, 2), 1j), MASKED,
        MASKED[:, 0], np.array([None, 1.0]), np.zeros(2, dtype="datetime64[s]"), given.model,
        given.log, given.found, given.result, [given.log, None],
        [given.log, given.log.select(["joint_1"])],
    ]  # fmt: skip


@st.composite
def calls(draw, names=tuple(CALLS)):
    """The name of a call, and which of its arguments are what else."""
    name = draw(st.sampled_from(names))
    keys = sorted(CALLS[name][1](robot(), Path()))
    odd = st.integers(0, len(odd_arguments(robot())) - 1)
    return name, draw(st.dictionaries(st.sampled_from(keys), odd, min_size=1, max_size=2))


def run_call(example, folder):
    name, changes = example
    call, good = CALLS[name]
    context = robot()
    odd = odd_arguments(context)
    arguments = good(context, folder) | {key: odd[place] for key, place in changes.items()}
    with (
        contextlib.chdir(folder),
        contextlib.redirect_stdout(io.StringIO()),
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("ignore")
        said = None
        try:
            call(**arguments)
        except RobotIdError as error:
            said = str(error)
        if said is not None:
            assert 0 < len(said) < 20_000, "an error without a word, or of pages"
            left = [path for path in folder.rglob("*") if path.is_file()]
            assert not left, f"half-written: {left}"


#: By name: a strategy of examples, and what is done with one in an empty folder.
ARGUMENT_KINDS = {"Python arguments": (calls, (), run_call)}
