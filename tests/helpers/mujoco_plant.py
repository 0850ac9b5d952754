"""Robots in MuJoCo that follow position commands, with known drives: a plant that is not ours."""

import xml.etree.ElementTree as ET
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import mujoco
import numpy as np
from mujoco import rollout

from helpers.paths import URDF
from robotid.data.log import Log
from robotid.output.files.mjcf import write_mjcf
from robotid.output.files.result_file import CommandedDrive
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

LEG = ("FL_hip_joint", "FL_thigh_joint", "FL_calf_joint")
_STEP = 0.0005  # [s] of MuJoCo, at most
_SETTLES = 1.0  # [s] that the first command is held before the log begins
_TONES = 12  # of a multi-sine
#: URDF, joints that move (None: all), middle and reach of the commands [rad], and the scale of the
#: drives [N m/rad]: kp; the others are shares of it.
ROBOTS = {
    "planar": ("planar_2r.urdf", None, (0.3, 0.4), (0.6, 0.8), (600.0, 250.0)),
    "arm": (
        "ur5_robot.urdf", None, (0.0, -1.2, 1.4, -0.6, 0.4, 0.0), (0.5, 0.4, 0.5, 0.6, 0.6, 0.6),
        (2000.0, 2000.0, 1200.0, 200.0, 200.0, 150.0),
    ),
    "leg": ("go2.urdf", LEG, (0.0, 1.0, -1.9), (0.3, 0.5, 0.5), (20.0, 20.0, 20.0)),
    "quadruped": (
        "go2.urdf", None, 4 * (0.0, 1.0, -1.9), 4 * (0.3, 0.5, 0.5), 12 * (20.0,),
    ),
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Plant:
    """A robot whose drives are known."""

    model: RobotModel  # as its URDF says
    drives: tuple[CommandedDrive, ...]
    middle: np.ndarray  # (n,), of the commands [rad]
    reach: np.ndarray  # (n,) [rad]
    bodies: np.ndarray | None = None  # (10 n,), true inertial parameters; None: of the URDF

    @property
    def truth(self) -> dict[str, float]:
        """The parameters of the drives by name, as those of a result are named."""
        return {
            f"{drive.joint}.{key}": value
            for drive in self.drives
            for key, value in asdict(drive).items()
            if key not in ("joint", "effort_limit")
        }

    @property
    def gains(self) -> dict[str, dict[str, float]]:
        return {key: {d.joint: getattr(d, key) for d in self.drives} for key in ("kp", "kd")}

    @property
    def parameters(self) -> np.ndarray:
        """The standard parameters of the URDF's bodies and of the drives."""
        pi, names = self.model.standard_parameters(), self.model.layout.names
        for name in self.truth.keys() & set(names):
            pi[names.index(name)] = self.truth[name]
        return pi


def plant(name, rng, **changes):
    """Return one of these robots with drives drawn about their typical values, some changed."""
    file, joints, middle, reach, scale = ROBOTS[name]
    path = URDF / file
    urdf = path if path.is_file() else example_urdf(file)
    model = RobotModel.from_urdf(urdf, **({"joints": list(joints)} if joints else {}))
    drives = []
    for joint, kp in zip(model.joints, scale, strict=True):
        a, b, c, d, e = rng.uniform(0.7, 1.3, 5).tolist()
        drive = CommandedDrive(
            joint, kp=kp, kd=0.06 * kp * a, delay=0.006 * b, zero=0.0, armature=1e-3 * kp * c,
            viscous=5e-3 * kp * d, coulomb=0.01 * kp * e, offset=0.0,
            effort_limit=np.inf,
        )  # fmt: skip
        drives.append(replace(drive, **changes))
    return Plant(model, tuple(drives), np.array(middle), np.array(reach))


def assert_recovered(estimate, truth, within=3.3, certain=0.15):
    """Parameters are within so many errors of the truth by name, and errors a share of it."""
    for name, value, error in zip(estimate.names, estimate.theta, estimate.std_error, strict=True):
        assert abs(value - truth[name]) < within * error, name
        assert not truth[name] or error < certain * truth[name], name  # an offset is 0


def recorded(
    plant, rng, *, duration=10.0, rate=500.0, noise=1e-4, torque=None, speed=None, highest=4.0,
    step=_STEP,
):  # fmt: skip
    """Return the log of a multi-sine that a plant was commanded to follow, and its truth."""
    # Noise, torque and speed are standard deviations of what is logged; None: it is not. Each row
    # has a command that is held until the next; forces are half a step early.
    t = np.arange(round(duration * rate)) / rate
    q_ref = multisine(t, plant.middle, plant.reach, rng, highest=highest)
    q, force, v = rolled_out(loaded(plant, rate, step), q_ref, rate)
    v = None if speed is None else v + speed * rng.standard_normal(v.shape)
    q = q + noise * rng.standard_normal(q.shape)
    tau = np.zeros_like(q)
    if torque is not None:  # of the drive, whose offset does not reach the joint
        tau = force + [drive.offset for drive in plant.drives]
        tau += torque * rng.standard_normal(q.shape)
    log = Log(t, q, tau, plant.model.joints, v=v, q_ref=q_ref, has_torque=torque is not None)
    return log, plant.truth


def multisine(t, middle, reach, rng, lowest=0.1, highest=4.0):
    """Return sines of random phase and of falling size about the middle, shape (N, n)."""
    f = np.geomspace(lowest, highest, _TONES)[:, None] * rng.uniform(0.9, 1.1, len(middle))
    phase = rng.uniform(0.0, 2 * np.pi, f.shape)
    waves = (f**-0.5) * np.sin(2 * np.pi * f * t[:, None, None] + phase)  # (N, tones, n)
    shape = waves.sum(axis=1) / np.sqrt((1.0 / f).sum(axis=0))
    return middle + 0.5 * reach * shape * np.minimum(1.0, t)[:, None]  # from rest


def loaded(plant, rate, step=_STEP, *, as_exported=False):
    """Return MuJoCo's model of a plant, without shapes, its time step a part of the period."""
    # An implicit step brakes by the speed at its end, half a step early, as if the rotor were
    # heavier by step / 2 (kd + viscous): the plant's is lighter by that, unless it is to be as
    # exported. Its roll-outs are then those of the smallest steps to 0.02 mrad.
    pi = plant.parameters
    if plant.bodies is not None:
        pi[: plant.model.layout.n_inertial] = plant.bodies
    exact = 1.0 / rate / np.ceil(1.0 / rate / step - 1e-9)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "plant.xml"
        write_mjcf(plant.model, pi, path, commanded=plant.drives, step=exact)
        top = ET.parse(path).getroot()
    for parent in [*top.iter()]:
        for shape in [*parent.findall("geom"), *parent.findall("mesh")]:
            parent.remove(shape)
    sensors = ET.SubElement(top, "sensor")
    for drive in plant.drives:
        ET.SubElement(sensors, "actuatorfrc", actuator=drive.joint)
    robot = mujoco.MjModel.from_xml_string(ET.tostring(top, encoding="unicode"))
    if not as_exported:
        brakes = np.array([drive.kd + drive.viscous for drive in plant.drives])
        robot.dof_armature[robot.jnt_dofadr[robot.actuator_trnid[:, 0]]] -= 0.5 * exact * brakes
        assert (robot.dof_armature > 0).all(), "smaller steps are expected"
    return robot


def held(plant, q_ref, rate, clock, settles=_SETTLES):
    """Return positions under a controller that holds its torque between ticks, shape (N, n)."""
    # Motors, without delay, get what it makes of MuJoCo's own position and speed; Runge-Kutta's
    # steps between. Commands (N, n) come at a rate, ticks at that of a clock [Hz], the first
    # together.
    robot = loaded(plant, rate, as_exported=True)
    robot.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
    robot.actuator_gainprm[:, 0], robot.actuator_biasprm[:, :3] = 1.0, 0.0
    kp, kd, most = np.transpose([[d.kp, d.kd, d.effort_limit] for d in plant.drives])
    step, data, q = robot.opt.timestep, mujoco.MjData(robot), []
    row, tick, data.qpos[:] = round(1 / rate / step), round(1 / clock / step), q_ref[0]
    for k in range(-round(settles / step), (len(q_ref) - 1) * row + 1):
        if k >= 0 and k % row == 0:
            q.append(data.qpos.copy())
        if k % tick == 0:
            torque = kp * (q_ref[max(k, 0) // row] - data.qpos) - kd * data.qvel
            data.ctrl[:] = np.clip(torque, -most, most)
        mujoco.mj_step(robot, data)
    return np.array(q)


def rolled_out(robot, q_ref, rate, settles=_SETTLES):
    """Return positions, forces and speeds of MuJoCo's robot, (N, n), at times of held commands."""
    # Its actuators are in the order of the commands, the first of which is held until it settles
    # [s].
    held = round(1.0 / rate / robot.opt.timestep)
    at = robot.jnt_qposadr[robot.actuator_trnid[:, 0]]
    data = mujoco.MjData(robot)
    data.qpos[at] = q_ref[0]
    for k in range(robot.nu):
        if robot.actuator_delay[k]:
            mujoco.mj_initCtrlHistory(
                robot, data, k, None, [q_ref[0, k]] * robot.actuator_history[k, 0]
            )
    kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
    state = np.empty(mujoco.mj_stateSize(robot, kind))
    mujoco.mj_getState(robot, data, state, kind)
    before = round(settles / robot.opt.timestep)
    control = np.vstack([np.repeat(q_ref[:1], before, axis=0), np.repeat(q_ref, held, axis=0)])
    states, forces = rollout.rollout(robot, data, state[None], control[None])
    qpos = states[0, :, 1 : 1 + robot.nq]  # after the time; a row after each step
    q = qpos[before - 1 :][: held * len(q_ref) : held, at]
    qvel = states[0, before - 1 :, 1 + robot.nq : 1 + robot.nq + robot.nv]
    v = qvel[: held * len(q_ref) : held, robot.jnt_dofadr[robot.actuator_trnid[:, 0]]]
    return q, forces[0, before::held], v  # forces: of the state that a step begins with


def torque_log(
    plant, rng, *, duration, rate=250.0, fine=16000.0, noise=0.0, torque=0.0, relative=0.0
):
    """Return the log of a plant's positions and of the torques that move it, without commands."""
    # The loop runs so much faster (fine) than the log is written (rate) that its torque is smooth
    # between rows. Noise of encoders, of torques, and of torques relative to their typical size.
    t = np.arange(round(duration * fine)) / fine
    q_ref = multisine(t, plant.middle, plant.reach, rng)
    robot = loaded(plant, fine, 1.0 / fine)
    robot.dof_solref[:] = 2.0 / fine, 1.0  # friction as stiff as the steps allow
    robot.dof_solimp[:] = 0.9999, 0.9999, 0.001, 0.5, 2.0
    q, force, _ = rolled_out(robot, q_ref, fine)
    kept = slice(None, None, round(fine / rate))
    q = q[kept] + noise * rng.standard_normal(q[kept].shape)
    tau = force[kept] + [drive.offset for drive in plant.drives]
    level = torque + relative * np.sqrt(np.mean(tau**2, axis=0))
    tau = tau + level * rng.standard_normal(tau.shape)
    return Log(t[kept], q, tau, plant.model.joints)
