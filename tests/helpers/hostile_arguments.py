"""Hostile arguments of the Python API, and what is done with each: only a RobotIdError may come.

As the kinds of ``hostile_inputs``, beside which these are.
"""

import contextlib
import inspect
import io
import warnings
from collections import UserDict
from functools import cache, partial
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


def _coupled(name, ratios, replaces=False):
    return RobotModel.from_urdf(URDF, couplings=[Coupling(name, ratios, replaces)])


#: By name: a function, and good arguments beside its defaults, from the robot and an empty folder.
CALLS = {
    "Log": (lambda c: Log, lambda c, _: _log_fields(c.log)),
    "Log.window": (lambda c: c.log.window, lambda c, _: {"start": 0.1, "end": 0.9}),
    "Log.select": (lambda c: c.log.select, lambda c, _: {"joints": JOINTS}),
    "Trajectory": (
        lambda c: Trajectory,
        lambda c, _: {"t": c.log.t[:60], "q": c.log.q[:60], "v": c.log.v[:60], "a": c.log.q[:60],
                      "tau": c.log.tau[:60], "joints": JOINTS, "rate": 50.0, "segment": c.segment},
    ),
    "SignalSettings": (lambda c: SignalSettings, lambda c, _: {"rate": 50.0, "min_velocity": 0.02}),
    "LogSource": (lambda c: LogSource, lambda c, _: {}),
    "LogUnits": (lambda c: LogUnits, lambda c, _: {}),
    "EstimatorSettings": (
        lambda c: robotid.EstimatorSettings,
        lambda c, _: {"name": "consistent", "prior_weight": "auto", "constraints": {},
                      "robust": "none"},
    ),
    "from_urdf": (
        lambda c: RobotModel.from_urdf,
        lambda c, _: {"path": URDF, "joints": JOINTS, "locked": {}, "gravity": (0.0, 0.0, -9.81),
                      "terms": ("viscous",)},
    ),
    "Coupling": (lambda c: _coupled, lambda c, _: {"name": "c", "ratios": (("joint_1", 1.0),)}),
    "inspect_urdf": (lambda c: robotid.inspect, lambda c, _: {"path": URDF}),
    "check_logs": (lambda c: robotid.doctor, lambda c, _: {"model": c.model, "logs": c.log}),
    "read_log": (
        lambda c: robotid.read_log,
        lambda c, _: {"path": good_result()[0] / "fit.csv", "joints": JOINTS, "units": LogUnits(),
                      "source": LogSource()},
    ),
    "write_log": (lambda c: robotid.write_log, lambda c, f: {"log": c.log, "path": f / "log.csv"}),
    "identify": (
        lambda c: robotid.identify,
        lambda c, _: {"model": c.model, "logs": c.log, "estimator": "ols", "friction": "none",
                      "doctor": False},
    ),
    "identify_payload": (
        lambda c: robotid.payload,
        lambda c, _: {"model": c.model, "logs": c.log, "reference": c.log, "friction": "none"},
    ),
    "preview": (
        lambda c: robotid.preview,
        lambda c, _: {"model": c.model, "motions": c.log, "noise": {"joint_1": 0.1},
                      "estimator": "ols"},
    ),
    "predict": (
        lambda c: c.found.predict, lambda c, _: {"q": c.log.q, "v": c.log.v, "a": c.log.q}
    ),
    "friction": (
        lambda c: c.found.friction,
        lambda c, _: {"joint": "joint_1", "v": [0.1, 0.2], "q": 0.1, "load": 1.0},
    ),
    "follow_commands": (lambda c: c.result.follow_commands, lambda c, _: {"log": c.log}),
    "save": (
        lambda c: partial(robotid.save_result, c.found),
        lambda c, f: {"folder": f / "saved", "report": False, "replay": False},
    ),
    "load_result": (lambda c: robotid.load_result, lambda c, _: {"path": good_result()[0]}),
    "replay": (
        lambda c: robotid.replay,
        lambda c, _: {"model": c.model, "t": c.log.t[:60], "q": c.log.q[:60]},
    ),
    "OnlineIdentifier": (
        lambda c: _online,
        lambda c, _: {"model": c.model, "t": 0.0, "q": c.log.q[0], "tau": c.log.tau[0]},
    ),
}  # fmt: skip


def good_call(name, folder):
    """Return a function with all of its arguments, by name."""
    call, given = CALLS[name][0](robot()), CALLS[name][1](robot(), folder)
    defaults = {
        key: x.default
        for key, x in inspect.signature(call).parameters.items()
        if x.default is not x.empty and key != "progress"
    }
    return call, defaults | given


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
    keys = sorted(good_call(name, Path())[1])
    odd = st.integers(0, len(odd_arguments(robot())) - 1)
    return name, draw(st.dictionaries(st.sampled_from(keys), odd, min_size=1, max_size=2))


def run_call(example, folder):
    name, changes = example
    odd = odd_arguments(robot())
    call, good = good_call(name, folder)
    arguments = good | {key: odd[place] for key, place in changes.items()}
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
ARGUMENT_KINDS = {"Python arguments": (calls(), run_call)}
