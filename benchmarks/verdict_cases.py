"""Robots, motions and faults of the confusion table of verdicts, with a simulator of their own.

A case is simulated by inverse dynamics: Pinocchio's recursion on a robot whose bodies were deformed
(an affine map of each body's points, so that it stays possible), armature, viscous and Coulomb
friction and an offset drawn at random, white and coloured noise. Motions are sums of sinusoids of
random frequencies within the limits of the URDF. Each case states beforehand which verdicts are
right and which findings name its cause.
"""

import xml.etree.ElementTree as ET
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import scipy.linalg
import scipy.signal

from robotid.robot.bodies import body_points, held_parameters, least_density
from robotid.robot.examples import example_urdf
from robotid.robot.model import GRAVITY, RobotModel
from robotid.robot.parameters import inertial_from_pseudo_inertia, pseudo_inertia

FOLDER = Path(__file__).parents[1] / "urdf"
FIT, KEPT = 30.0, 20.0  # [s] length of the log to fit and of the one kept apart
RATES = (100.0, 125.0, 200.0)  # [Hz]
TONES = 8  # sinusoids of a motion
LOWEST, HIGHEST = 0.05, 0.8  # [Hz]
QUANTILE = {"turns": 1.5, "slides": 0.3}  # [rad or m] largest amplitude
SPEED = {"turns": 1.5, "slides": 0.3}  # [rad/s or m/s] largest speed
DENSEST = 12_000.0  # [kg/m^3] of a body of a true robot: lead has 11,340
SIGN_SPEED = 1e-3  # [rad/s or m/s] over which Coulomb friction changes its sign
#: Sensor noise: position [rad or m], velocity [same/s], torque, white and coloured, as a share of
#: the joint's standard deviation.
NOISES = {
    "quiet": (1e-6, 1e-4, 0.001, 0.0),
    "usual": (2e-5, 5e-4, 0.01, 0.005),
    "noisy": (1e-4, 5e-3, 0.04, 0.02),
}


@dataclass(frozen=True)
class Robot:
    """A robot of the table: its URDF, the joints that move, and gravity in its root's frame."""

    urdf: str
    joints: tuple[str, ...] | None = None
    gravity: tuple[float, float, float] = GRAVITY

    @property
    def path(self):
        own = FOLDER / self.urdf
        return own if own.exists() else example_urdf(self.urdf)


def numbered(pattern, numbers):
    return tuple(pattern.format(i) for i in numbers)


ROBOTS = {
    "ur5": Robot("ur5_robot.urdf"),
    "ur10": Robot("ur10_robot.urdf"),
    "ur3 + gripper": Robot("ur3_gripper.urdf"),
    "panda": Robot("panda.urdf", numbered("panda_joint{}", range(1, 8))),
    "xarm7": Robot("xarm7.urdf"),
    "z1": Robot("z1.urdf", numbered("joint{}", range(1, 7))),
    "kinova j2s6": Robot("kinova.urdf"),
    "tiago": Robot("tiago.urdf", ("torso_lift_joint", *numbered("arm_{}_joint", range(1, 8)))),
    "tiago pro": Robot("tiago_pro.urdf", numbered("arm_left_{}_joint", range(1, 8))),
    "talos arm": Robot("talos_left_arm.urdf", numbered("arm_left_{}_joint", range(2, 8))),
    "baxter": Robot("baxter.urdf", numbered("left_{}", ("s0", "s1", "e0", "e1", "w0", "w1", "w2"))),
    "alex arm": Robot(
        "alex_nub_hands.urdf",
        numbered("Left{}", ("ShoulderPitch", "ShoulderRoll", "ShoulderYaw", "ElbowPitch",
                            "WristYaw", "WristRoll")),
    ),
    "so101": Robot("so101.urdf", ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex",
                                  "wrist_roll")),
    "planar 2R": Robot("planar_2r.urdf", gravity=(0.0, -9.81, 0.0)),
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Run:
    """A recording: torques as the drives make them, then as the log has them."""

    t: np.ndarray  # (N,)
    q: np.ndarray  # (N, n)
    v: np.ndarray | None
    a: np.ndarray
    tau: np.ndarray
    is_kept: bool = False


@dataclass(frozen=True, eq=False)
class Arm:
    """The true robot behind the runs of a case."""

    model: RobotModel  # kinematics and gravity as they are
    pi: np.ndarray  # true standard parameters, drives included
    key: tuple[int, ...]  # of the random numbers of the case
    stiffness: np.ndarray  # of springs as strong as the bodies' torque (n,) [N m/rad or N/m]
    motion: Run  # a motion of its own with the torque, of which faults of the plant are a share

    @property
    def n(self):
        return len(self.model.joints)

    @property
    def elbow(self):
        return max(1, (self.n - 1) // 2)

    @property
    def wrists(self):
        return list(range(self.n - max(1, self.n // 3), self.n))

    @property
    def slides(self):
        return np.array([joint in self.model.layout.prismatic for joint in self.model.joints])

    @property
    def unit_load(self):
        """A load that a hand may hold [kg]: 1 kg, or 15 % of what moves of a light robot."""
        return min(1.0, 0.15 * self.pi[: self.model.layout.n_inertial : 10].sum())

    def rng(self, what):
        """Return the same random numbers for each recording of the case."""
        return np.random.default_rng([*self.key, *what.encode()])

    def rigid(self, run, *, still=False, loaded=0.0):
        """Return the torque of the bodies; of gravity alone if it is at rest; (N, n)."""
        pi = self.pi[: self.model.layout.n_inertial].copy()
        if loaded:
            pi[-10:] += loaded * self.load_shape()
        model = self.model.with_parameters(pi)
        G, data = model.velocity_map, model.pin_model.createData()
        tau = np.empty(run.q.shape)
        rest = 0.0 if still else 1.0
        x = model.configurations(run.q)
        for k in range(len(run.t)):
            rows = pin.rnea(model.pin_model, data, x[k], rest * (G @ run.v[k]), G @ run.a[k] * rest)
            tau[k] = G.T @ rows
        return tau

    def load_shape(self):
        """Return the parameters of 1 kg some centimetres from the last joint, off its axis."""
        c = np.array([0.03, 0.02, 0.06])  # [m]
        inertia = (c @ c) * np.eye(3) - np.outer(c, c) + 4e-4 * np.eye(3)
        (xx, xy, xz), (_, yy, yz), (_, _, zz) = inertia
        return np.array([1.0, *c, xx, xy, yy, xz, yz, zz])

    def drives(self, run):
        """Return the torque of armature, friction and offset, (N, n)."""
        Ia, Fv, Fc, offset = self.drive_terms()
        return Ia * run.a + Fv * run.v + Fc * np.tanh(run.v / SIGN_SPEED) + offset

    def drive_terms(self):
        layout = self.model.layout
        terms = dict(zip(layout.names, self.pi, strict=True))
        names = ("armature", "viscous", "coulomb", "offset")
        return [np.array([terms[f"{joint}.{x}"] for joint in layout.joints]) for x in names]


def build(robot, key, *, is_far=False, turn=None, resize=False, folder=None):
    """Return the true robot of a case."""
    path = robot.path
    if resize:
        path = resized(path, folder / "another.urdf")
    gravity = np.array(robot.gravity) if turn is None else turn @ np.array(robot.gravity)
    model = RobotModel.from_urdf(path, joints=robot.joints, gravity=gravity)
    rng = np.random.default_rng([*key, 1])
    pi = model.standard_parameters()
    size = model.layout.n_inertial
    held = held_parameters(model)  # links beyond locked joints stay as they are
    pi[:size] = held + deformed(model, pi[:size] - held, rng, 0.35 if is_far else 0.1)
    motion = move(model, np.random.default_rng([*key, 2]), 100.0, 20.0)
    arm = Arm(model, pi, key, np.zeros(len(model.joints)), motion)
    bodies = arm.rigid(motion)
    rigid = np.sqrt(np.mean(bodies**2, axis=0))
    level = np.maximum(rigid, 0.03 * rigid.max())
    speed, change = (np.sqrt(np.mean(x**2, axis=0)) for x in (motion.v, motion.a))
    drawn = {
        "armature": rng.uniform(0.05, 0.3, len(level)) * level / change,
        "viscous": rng.uniform(0.05, 0.3, len(level)) * level / speed,
        "coulomb": rng.uniform(0.1, 0.4, len(level)) * level,
        "offset": rng.uniform(-0.05, 0.05, len(level)) * level,
    }
    for term, values in drawn.items():
        for joint, value in zip(model.joints, values, strict=True):
            pi[model.layout.names.index(f"{joint}.{term}")] = value
    motion = replace(motion, tau=bodies + arm.drives(motion))
    return replace(arm, stiffness=level, motion=motion)


def deformed(model, inertial, rng, share):
    """Return bodies whose points were moved by an affine map, with another density.

    They can exist: the centre of mass of each body lies inside the box around its geometry, its
    mass no farther from it than the box reaches, and no body is denser than any material. A body of
    the URDF that cannot moves a little.
    """
    bodies, points = [], body_points(model)
    for name, J in zip(model.layout.bodies, pseudo_inertia(inertial), strict=True):
        is_bound = name in points and fits(J, points[name])
        is_solid = is_material(J)
        own = share if is_bound or name not in points else min(share, 0.1)
        moved = deform(J, rng, own)
        while (is_bound and not fits(moved, points[name])) or (is_solid and not is_material(moved)):
            moved = deform(J, rng, own)
        bodies.append(inertial_from_pseudo_inertia(moved))
    return np.concatenate(bodies)


def deform(J, rng, share):
    D = scipy.linalg.expm(share * rng.standard_normal((4, 4)))
    gyration = np.sqrt(np.trace(J[:3, :3]) / J[3, 3])
    D[3, :3] = 0.0
    D[:3, 3] = share * gyration * rng.standard_normal(3)
    return D @ J @ D.T


def fits(J, points):
    """Return whether a body of that pseudo-inertia can lie in the box around points."""
    low, high = points.min(axis=0), points.max(axis=0)
    centre = J[:3, 3] / J[3, 3]
    spread = np.sqrt(np.diag(J)[:3] / J[3, 3] - centre**2)  # root mean square about the centre
    inside = (low <= centre) & (centre <= high)
    return bool((inside & (spread < np.maximum(high - centre, centre - low))).all())


def is_material(J):
    """Return whether a material has the density that a body of that pseudo-inertia needs."""
    return least_density(inertial_from_pseudo_inertia(J)) <= DENSEST


def move(model, rng, rate, duration, is_kept=False):
    """Return a random motion within the limits, with no torque yet."""
    t = np.arange(round(duration * rate)) / rate
    q, v, a = (np.empty((len(t), len(model.joints))) for _ in range(3))
    for j, joint in enumerate(model.limits):
        kind = "slides" if joint.type == "prismatic" else "turns"
        low, high = (joint.lower, joint.upper) if joint.has_limits else (-3.0, 3.0)
        reach = min(QUANTILE[kind], 0.45 * (high - low))
        centre = (low + high) / 2 + rng.uniform(-1, 1) * max(0.0, 0.45 * (high - low) - reach) * 0.5
        w = 2 * np.pi * rng.uniform(LOWEST, HIGHEST, TONES)  # [rad/s]
        size = rng.uniform(0.3, 1.0, TONES) / w
        phase = np.outer(t, w) + rng.uniform(0, 2 * np.pi, TONES)
        x, dx = np.sin(phase) @ size, np.cos(phase) @ (size * w)
        ddx = -np.sin(phase) @ (size * w**2)
        most = min(SPEED[kind], 0.8 * joint.velocity) if joint.velocity > 0 else SPEED[kind]
        scale = min(reach / np.abs(x).max(), most / np.abs(dx).max())
        q[:, j], v[:, j], a[:, j] = centre + scale * x, scale * dx, scale * ddx
    return Run(t, q, v, a, np.zeros_like(q), is_kept)


def measured(run, level, rng):
    """Return a run with sensor noise."""
    q_noise, v_noise, white, coloured = NOISES[level]
    rate = 1 / np.median(np.diff(run.t))
    pole = np.exp(-2 * np.pi * 2.0 / rate)  # coloured below 2 Hz
    colour = scipy.signal.lfilter(
        [np.sqrt(1 - pole**2)], [1.0, -pole], rng.standard_normal(run.tau.shape), axis=0
    )
    tau = run.tau + np.std(run.tau, axis=0) * (
        white * rng.standard_normal(run.tau.shape) + coloured * colour
    )
    q = run.q + q_noise * rng.standard_normal(run.q.shape)
    return replace(run, q=q, v=run.v + v_noise * rng.standard_normal(run.q.shape), tau=tau)


def resized(path, target):
    """Write a URDF whose links are longer and shorter by turns, and return its path."""
    tree = ET.parse(path)
    moving = [j for j in tree.getroot().iter("joint") if j.get("type") not in (None, "fixed")]
    for i, joint in enumerate(moving):
        origin = joint.find("origin")
        if origin is not None and origin.get("xyz"):
            factor = (0.6, 1.5)[i % 2]
            origin.set("xyz", " ".join(str(factor * float(x)) for x in origin.get("xyz").split()))
    tree.write(target)
    return target


def with_hand(path, link, load, mass, target):
    """Write a URDF with a hand fixed to a link, and return its path."""
    m, *c = mass * load[:4]
    centre = " ".join(f"{x / mass:.6f}" for x in c)
    moment = mass * 1e-3  # [kg m^2] of a hand of some 8 cm
    hand = (
        f'<link name="bench_hand"><inertial><origin xyz="{centre}"/><mass value="{m:.6f}"/>'
        f'<inertia ixx="{moment}" iyy="{moment}" izz="{moment}" ixy="0" ixz="0" iyz="0"/>'
        f'</inertial><visual><origin xyz="{centre}"/><geometry><box size="0.15 0.15 0.15"/>'
        '</geometry></visual></link><joint name="bench_mount" type="fixed">'
        f'<parent link="{link}"/><child link="bench_hand"/></joint></robot>'
    )
    target.write_text(path.read_text().replace("</robot>", hand))
    return target


# What goes wrong. A change of the plant adds to the noise-free torque; a change of the record is
# made to what the sensors gave.


def std(x):
    return np.std(x, axis=0)


def added(run, arm, part_of, share, joints=slice(None)):
    """Return the run with a torque added that the robot has in every recording.

    Its standard deviation is a share of each joint's torque on the motion of ``arm``.
    """
    size = std(part_of(arm.motion))
    factor = np.where(size > 0, share * std(arm.motion.tau) / np.where(size > 0, size, 1.0), 0.0)
    return fixed(run, factor * part_of(run), joints)


def fixed(run, part, joints=slice(None)):
    tau = run.tau.copy()
    tau[:, joints] += part[:, joints]
    return replace(run, tau=tau)


def stribeck(run, arm):
    """More friction when slow, gone at a third of the top speed."""
    slow = 0.15 * np.where(arm.slides, SPEED["slides"], SPEED["turns"])

    def part_of(run):
        return np.exp(-((run.v / slow) ** 2)) * np.tanh(run.v / SIGN_SPEED)

    return added(run, arm, part_of, 0.25)


def load_friction(run, arm):
    return fixed(run, 0.15 * np.abs(arm.rigid(run)) * np.tanh(run.v / SIGN_SPEED))


def periodic(run, arm):
    """A torque that repeats with the position, a few times per turn, of the last two joints."""
    rng = arm.rng("periodic")
    count = rng.integers(6, 20, arm.n) * np.where(arm.slides, 20.0, 1.0)
    phase = rng.uniform(0, 2 * np.pi, arm.n)
    return added(run, arm, lambda run: np.sin(count * run.q + phase), 0.25, [arm.n - 2, arm.n - 1])


def spring(run, arm):
    """A spring beside the second joint: per radian as much as the bodies' torque."""
    part = np.zeros_like(run.tau)
    part[:, 1] = arm.stiffness[1] * run.q[:, 1]
    return fixed(run, part)


def coupling(run, arm):
    """The drive of the last joint also turns with the one before it, and rubs."""

    def part_of(run):
        part = np.zeros_like(run.q)
        part[:, -1] = run.v[:, -2] / std(arm.motion.v)[-2] + np.tanh(run.v[:, -2] / SIGN_SPEED)
        return part

    return added(run, arm, part_of, 0.4, [arm.n - 1])


def backlash(run, arm):
    """The encoders sit on the motors: the links lag by a play that the torque takes up."""
    play = np.where(arm.slides, 5e-4, 0.003)  # [m or rad], to either side
    side = np.tanh(run.tau / (0.05 * std(run.tau)))
    q = run.q + play * side
    v = np.gradient(q, run.t, axis=0)
    return replace(run, q=q, v=v)


def late(delay):
    def change(run, arm):
        tau = [np.interp(run.t - delay, run.t, x) for x in run.tau.T]
        return replace(run, tau=np.column_stack(tau))

    return change


def filtered(run, arm):
    """A drive that reports its torque through a first-order low-pass of 5 Hz."""
    rate = 1 / np.median(np.diff(run.t))
    pole = np.exp(-2 * np.pi * 5.0 / rate)
    start = pole * run.tau[:1]
    return replace(
        run, tau=scipy.signal.lfilter([1 - pole], [1.0, -pole], run.tau, axis=0, zi=start)[0]
    )


def held(run, arm):
    """Torques that are read anew every 40 ms only."""
    step = round(0.04 / np.median(np.diff(run.t)))
    return replace(run, tau=run.tau[np.arange(len(run.t)) // step * step])


def of_torque(factor):
    """Return a change that multiplies torques by what ``factor(arm)`` returns."""
    return lambda run, arm: replace(run, tau=run.tau * factor(arm))


def ones_but(arm, joints, value):
    factor = np.ones(arm.n)
    factor[joints] = value
    return factor


def main_joint(run):
    """Return the joint with the largest torque but the first."""
    return 1 + int(np.argmax(np.abs(run.tau[:, 1:]).mean(axis=0)))


def negated(*kinds):
    def change(run, arm):
        sign = ones_but(arm, [arm.elbow], -1.0)
        return replace(run, **{kind: getattr(run, kind) * sign for kind in kinds})

    return change


def swapped(*kinds):
    def change(run, arm):
        order = np.arange(arm.n)
        i, k = (0, 1) if arm.n == 2 else (arm.elbow - 1, arm.elbow)
        order[[i, k]] = order[[k, i]]
        return replace(run, **{kind: getattr(run, kind)[:, order] for kind in kinds})

    return change


def currents(run, arm):
    gains = arm.rng("currents").uniform(6.0, 20.0, arm.n)
    return replace(run, tau=run.tau / gains)


def without_velocity(run, arm):
    return replace(run, v=None)


def slow_clock(run, arm):
    return replace(run, t=1.1 * run.t)


def wide_angles(run, arm):
    return replace(run, q=np.where(arm.slides, 1.0, 1.1) * run.q, v=None)


def shifted_zero(run, arm):
    offset = np.zeros(arm.n)
    offset[arm.elbow] = 0.03 if arm.slides[arm.elbow] else 0.1
    return replace(run, q=run.q + offset)


def degrees(run, arm):
    unit = np.where(arm.slides, 1.0, 180 / np.pi)
    return replace(run, q=unit * run.q, v=unit * run.v)


def milliseconds(run, arm):
    return replace(run, t=1e3 * run.t)


def coarse_encoder(run, arm):
    """12 bits a turn, and a dq that was differenced from them."""
    step = np.where(arm.slides, 1e-4, 2 * np.pi / 4096)
    q = step * np.round(run.q / step)
    return replace(run, q=q, v=np.gradient(q, run.t, axis=0))


def noise_for_velocity(run, arm):
    v = run.v.copy()
    v[:, arm.elbow] = std(run.v)[arm.elbow] * arm.rng("dq").standard_normal(len(run.t))
    return replace(run, v=v)


def still_joint(run, arm):
    q, v, a = run.q.copy(), run.v.copy(), run.a.copy()
    q[:, arm.elbow], v[:, arm.elbow], a[:, arm.elbow] = q[0, arm.elbow], 0.0, 0.0
    return replace(run, q=q, v=v, a=a)


def spikes(run, arm):
    rng, tau = arm.rng("spikes"), run.tau.copy()
    rows = rng.choice(len(run.t), 8, replace=False)
    joints = rng.integers(0, arm.n, 8)
    tau[rows, joints] += rng.choice([-1, 1], 8) * 12 * std(run.tau)[joints]
    return replace(run, tau=tau)


def clipped(run, arm):
    j = main_joint(run)
    tau = run.tau.copy()
    low, high = np.quantile(tau[:, j], [0.08, 0.92])
    tau[:, j] = np.clip(tau[:, j], low, high)
    return replace(run, tau=tau)


def unsigned(run, arm):
    return replace(run, tau=np.abs(run.tau))


def compensated(run, arm):
    return fixed(run, -arm.rigid(run, still=True))


def gaps(run, arm):
    t, kept = run.t, np.ones(len(run.t), dtype=bool)
    for share, length in ((0.3, 0.5), (0.6, 1.0)):
        start = share * t[-1]
        kept &= (t < start) | (t > start + length)
    rows = {name: getattr(run, name)[kept] for name in ("t", "q", "v", "a", "tau")}
    return replace(run, **rows)


def has_gravity(run, arm):
    """Return whether gravity is a tenth of the torque of two joints at least."""
    gravity = arm.rigid(run, still=True)
    return (std(gravity) > 0.1 * std(run.tau)).sum() > 1


def anything(run, arm):
    return True


def is_long(run, arm):
    return arm.n >= 4


GOOD = frozenset({"good"})
NOT_GOOD = frozenset({"usable", "poor", "refused"})
REFUSED = frozenset({"poor", "refused"})
FINE = frozenset({"good", "usable"})


@dataclass(frozen=True)
class Case:
    """A fault, or none, with what must be said of it.

    Attributes:
        right: The right verdicts.
        names: Codes of findings of which one must be given.
        plant: Changes the run before noise.
        record: Changes the run after noise.
        noise: Level of noise.
        loads: Whether the fitted and the kept run carry a load that the URDF does not know.
        world: How the true robot differs: "far", "resized", "turned", "tilted", "hand".
        seconds: Length of the fitted run.
        fits: Whether the case exists for a robot.
        is_hidden: Whether another robot could have made the same recordings, or nearly so: then a
            statement of what could not be checked is right, too.
        allowed: Warnings that are true of a clean case.
        terms: True values of drive terms that the plant adds, by the end of their names; NaN where
            the simulator has other ones.
    """

    right: frozenset[str]
    names: tuple[str, ...] = ()
    plant: Callable | None = None
    record: Callable | None = None
    noise: str = "usual"
    loads: tuple[bool, bool] = (False, False)
    world: str = ""
    seconds: float = FIT
    fits: Callable = field(default=anything)
    is_hidden: bool = False
    allowed: tuple[str, ...] = ()
    terms: Mapping[str, float] = field(default_factory=dict)


VELOCITY = ("velocity_mismatch", "velocity_order", "velocity_scale", "quantised")

CASES = {
    # nothing is wrong
    "clean, quiet": Case(GOOD, noise="quiet"),
    "clean": Case(GOOD),
    "clean, noisy torque": Case(GOOD, noise="noisy"),
    "clean, no dq": Case(GOOD, record=without_velocity),
    "clean, far from the URDF": Case(
        GOOD, world="far", allowed=("urdf_mismatch", "payload")
    ),
    # friction that the default drive models select: no finding has to name it. With its amplitude
    # the same in both recordings, the torque on the validation log is predicted within 5 % where
    # friction is of Stribeck's shape, and within the noise where it grows with the load.
    "Stribeck friction": Case(FINE, plant=stribeck, terms={"stribeck": np.nan, "tanh": np.nan}),
    "friction grows with load": Case(GOOD, plant=load_friction, terms={"load": 0.15}),
    # the plant has what the model lacks
    "position-periodic torque": Case(NOT_GOOD, ("position_periodic",), plant=periodic),
    "spring": Case(NOT_GOOD, ("spring",), plant=spring),
    "coupled drives": Case(NOT_GOOD, ("coupling",), plant=coupling),
    "backlash": Case(FINE | NOT_GOOD, ("backlash",), plant=backlash),
    # torque
    "torque 5 ms late": Case(NOT_GOOD, ("torque_delay",), plant=late(0.005)),
    "torque 20 ms late": Case(NOT_GOOD, ("torque_delay",), plant=late(0.020)),
    "torque filtered at 5 Hz": Case(NOT_GOOD, ("torque_delay",), plant=filtered),
    "torque held for 40 ms": Case(
        NOT_GOOD, ("repeated_torque", "torque_delay"), record=held
    ),
    "all torques reversed": Case(REFUSED, ("torque_sign",), record=of_torque(lambda arm: -1.0)),
    "one torque reversed": Case(REFUSED, ("torque_sign",), record=negated("tau")),
    "two torque columns swapped": Case(
        REFUSED, ("torque_order",), record=swapped("tau")
    ),
    "torque without its sign": Case(
        REFUSED, ("unsigned_torque",), record=unsigned
    ),
    "gravity taken off the torque": Case(
        NOT_GOOD, ("gravity_compensated", "gravity"), plant=compensated, fits=has_gravity
    ),
    "currents for torques": Case(
        NOT_GOOD, ("current_for_torque", "torque_scale"), record=currents
    ),
    "one current for torque": Case(
        NOT_GOOD, ("current_for_torque", "torque_scale"),
        record=of_torque(lambda arm: ones_but(arm, [arm.elbow], 0.1)),
    ),
    "torque clipped": Case(NOT_GOOD, ("clipped",), record=clipped),
    "eight spikes": Case(NOT_GOOD, ("spikes", "outliers"), record=spikes),
    # joints, positions, velocities, time
    "one joint reversed": Case(REFUSED, ("joint_axis",), record=negated("q", "v", "tau")),
    "one position reversed": Case(
        REFUSED, ("position_sign", "joint_axis"), record=negated("q", "v")
    ),
    "two positions swapped": Case(
        REFUSED, ("position_order", "joint_order"), record=swapped("q", "v")
    ),
    "elbow zero off by 0.1 rad": Case(
        NOT_GOOD, ("position_offset",), record=shifted_zero, fits=is_long
    ),
    "degrees": Case(REFUSED, ("angle_unit",), record=degrees),
    "milliseconds": Case(REFUSED, ("time_unit",), record=milliseconds),
    "12-bit encoder, dq of it": Case(FINE, VELOCITY, record=coarse_encoder),
    "dq of one joint is noise": Case(FINE | NOT_GOOD, VELOCITY, record=noise_for_velocity),
    "gaps of 0.5 and 1 s": Case(FINE, ("gap",), record=gaps),
    # the wrong robot
    "hand of the URDF not mounted": Case(
        FINE, ("payload", "urdf_mismatch"), world="hand"
    ),
    "1 kg in the fitted log": Case(
        NOT_GOOD, ("payload", "log_differs", "urdf_mismatch"), loads=(True, False)
    ),
    "1 kg in the validation log": Case(
        NOT_GOOD, ("payload", "log_differs", "urdf_mismatch"), loads=(False, True)
    ),
    "1 kg in both": Case(FINE, loads=(True, True)),
    "URDF of another size": Case(
        NOT_GOOD, ("joint_origin", "urdf_mismatch", "unexplained_torque"), world="resized"
    ),
    "mounted on a wall": Case(NOT_GOOD, ("gravity",), world="turned", fits=has_gravity),
    "base tilted by 15 deg": Case(NOT_GOOD, ("gravity",), world="tilted", fits=has_gravity),
    # little to learn from
    "one joint is at rest": Case(
        NOT_GOOD, ("static_joint", "excitation", "undetermined"), plant=still_joint
    ),
    "2 s only": Case(NOT_GOOD, ("excitation", "undetermined", "too_short"), seconds=2.0),
    "wrist torques x 1.5": Case(
        NOT_GOOD, ("torque_scale", "current_for_torque"),
        record=of_torque(lambda arm: ones_but(arm, arm.wrists, 1.5)),
    ),
    "time x 1.1, no dq": Case(
        NOT_GOOD, ("time_scale",),
        record=lambda run, arm: replace(slow_clock(run, arm), v=None),
    ),
    "time x 1.1": Case(NOT_GOOD, ("time_scale", "velocity_scale"), record=slow_clock),
    "angles x 1.1, no dq": Case(NOT_GOOD, ("angle_scale",), record=wide_angles),
    # what another robot may look like
    "all torques x 0.8": Case(NOT_GOOD, record=of_torque(lambda arm: 0.8), is_hidden=True),
    "all torques x 1.1": Case(NOT_GOOD, record=of_torque(lambda arm: 1.1), is_hidden=True),
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Recording:
    """What a case gives the user: a URDF, two log tables, and the truth behind them."""

    arm: Arm
    truth: np.ndarray  # parameters of the robot as it was in the fitted log, (p,)
    urdf: Path
    fitted: dict[str, np.ndarray]
    kept: dict[str, np.ndarray]


def make(robot, case, key, folder):
    """Return the recordings of a case on a robot, or None if it does not exist for it."""
    turns = {"turned": np.pi / 2, "tilted": np.pi / 12}
    turn = None
    if case.world in turns:
        axis = np.random.default_rng([*key, 3]).uniform(0, 2 * np.pi)
        vector = turns[case.world] * perpendicular(robot.gravity, axis)
        turn = pin.exp3(vector)
    arm = build(
        robot, key, is_far=case.world == "far", turn=turn, resize=case.world == "resized",
        folder=folder,
    )  # fmt: skip
    rate = np.random.default_rng([*key, 4]).choice(RATES)
    tables = []
    for is_kept, seconds in ((False, case.seconds), (True, KEPT)):
        rng = np.random.default_rng([*key, 5 + is_kept])
        run = move(arm.model, rng, rate, seconds, is_kept)
        if case.plant is still_joint:
            run = still_joint(run, arm)
        load = arm.unit_load if case.loads[is_kept] else 0.0
        run = replace(run, tau=arm.rigid(run, loaded=load) + arm.drives(run))
        if not case.fits(run, arm):
            return None
        if case.plant is not None and case.plant is not still_joint:
            run = case.plant(run, arm)
        run = measured(run, case.noise, rng)
        if case.record is not None:
            run = case.record(run, arm)
        tables.append(table_of(run, arm.model.joints))
    urdf = robot.path
    if case.world == "hand":
        link = arm.model.limits[-1].child
        urdf = with_hand(urdf, link, arm.load_shape(), arm.unit_load, folder / "hand.urdf")
    truth = arm.pi.copy()
    size = arm.model.layout.n_inertial
    truth[size - 10 : size] += case.loads[0] * arm.unit_load * arm.load_shape()
    return Recording(arm, truth, urdf, *tables)


def perpendicular(gravity, angle):
    """Return a unit vector across gravity."""
    down = np.array(gravity) / np.linalg.norm(gravity)
    first = np.cross(down, [1.0, 0.0, 0.0] if abs(down[0]) < 0.9 else [0.0, 1.0, 0.0])
    first /= np.linalg.norm(first)
    return np.cos(angle) * first + np.sin(angle) * np.cross(down, first)


def table_of(run, joints):
    columns = {"time": run.t}
    for kind, values in (("q", run.q), ("dq", run.v), ("tau", run.tau)):
        if values is not None:
            columns |= {f"{kind}_{joint}": values[:, j] for j, joint in enumerate(joints)}
    return columns
