"""Logs as the model needs them: joints of closed chains that are not logged, pose of the root."""

from dataclasses import replace

import numpy as np
import pinocchio as pin

from robotid.base.exceptions import DataError
from robotid.base.findings import listed
from robotid.base.text import seconds
from robotid.base.typing import Array
from robotid.data.base_motion import BaseMotion
from robotid.data.log import Log
from robotid.robot.closure import Chains
from robotid.robot.constraints import frame_id
from robotid.robot.model import RobotModel

_OPEN = 0.02  # largest error of a loop at logged positions, relative to the length of the robot
_COMPUTED = 1e-5  # ... at computed ones


def closed_log(model: RobotModel, log: Log) -> Log:
    """Return the log of all joints of a robot, with positions of passive joints from its loops.

    The torques of passive joints are 0. Velocities, accelerations and commands of a log without the
    position of a passive joint are not used. The pose of the base becomes that of the root link.
    """
    if model.passive or model.loops:
        log = _with_passive(model, log)
    if log.base is None or not log.base.link:
        return log
    pose = _root_poses(model, log.q, log.base.pose, log.base.link)
    if not log.base.has_position:
        pose[:, :3] = 0.0
    note = f"the pose of the base is computed from that of {log.base.link}"
    base = BaseMotion(pose, imu=log.base.imu)
    return replace(log, base=base, notes=(*log.notes, note))


def _with_passive(model: RobotModel, log: Log) -> Log:
    """Return the log with the positions of all joints, and no torque of passive ones."""
    missing = np.array([joint not in log.joints for joint in model.joints])
    q, tau = np.zeros((2, len(log.t), len(missing)))
    logged = np.flatnonzero(~missing)
    places = [log.joints.index(model.joints[j]) for j in logged]
    q[:, logged], tau[:, logged] = log.q[:, places], log.tau[:, places]
    tau[:, np.isin(model.joints, model.passive)] = 0.0
    absent = [joint for joint in model.joints if joint not in log.joints]
    if absent and not model.loops:
        raise DataError(
            f"{log.name} has no position of {listed(absent)}, and no loop determines it; log it, "
            "or state [[loop]]"
        )
    if model.loops:
        q = _closed(model, log, q, missing)
    if not absent:
        return replace(log, tau=tau)
    note = f"positions of {listed(absent)} are computed from the loops"
    unused = {"v": "velocities", "a": "accelerations", "q_ref": "commands"}
    unused = {name: noun for name, noun in unused.items() if getattr(log, name) is not None}
    if unused:
        note += f"; {listed(unused.values())} are not used, since these joints have none"
    return replace(
        log, joints=model.joints, q=q, tau=tau, v=None, a=None, q_ref=None, v_ref=None,
        tau_ref=None, notes=(*log.notes, note),
    )  # fmt: skip


def _closed(model: RobotModel, log: Log, q: np.ndarray, missing: np.ndarray) -> np.ndarray:
    """Return positions at which the loops close; refuse those at which they do not."""
    chains = Chains(model)
    if missing.any():
        q = chains.closed(q, missing)
    gaps = chains.gaps(q)
    allowed = (_COMPUTED if missing.any() else _OPEN) * model.length
    samples = np.flatnonzero(~(gaps.max(axis=1) <= allowed))
    if not len(samples):
        return q
    k = int(samples[0])
    loop = int(gaps[k].argmax())
    joints = [joint for joint, is_missing in zip(model.joints, missing, strict=True) if is_missing]
    what = f"no position of {listed(joints)} closes" if joints else "the positions do not close"
    raise DataError(
        f"{log.name}: {what} the loop {model.loops[loop].name} at t = {seconds(log.t[k])} s: "
        f"{gaps[k, loop]:.3g} m remain, wanted at most {allowed:.2g} m. Correct the zero positions "
        "or signs of the logged joints, or the frames of the loop",
        code="open_loop",
    )


def _root_poses(model: RobotModel, q: Array, poses: Array, link: str) -> Array:
    """Return the poses of the root link from those of another link, x y z qx qy qz qw, (N, 7).

    q (N, n) [rad or m], poses (N, 7) [m, -].
    """
    pin_model, root = model.pin_model, np.empty_like(poses)
    data, frame = pin_model.createData(), frame_id(pin_model, link)
    still = np.hstack([np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], (len(q), 1)), q])
    for k, q_k in enumerate(np.ascontiguousarray(model.configurations(still))):
        pin.forwardKinematics(pin_model, data, q_k)
        place = pin.updateFramePlacement(pin_model, data, frame)
        root[k] = pin.SE3ToXYZQUAT(pin.XYZQUATToSE3(poses[k]) * place.inverse())
    return root
