"""A hoist of four joints by Pinocchio's RNEA and drives of its own: nothing of the package."""

import csv
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
import pinocchio as pin

JOINTS = ("swing", "lift", "reach", "roll")
LOCKED = {"finger": 0.012}
URDF = (Path(__file__).parents[1] / "figures" / "hoist.urdf").read_text()
#: mass, centre, principal inertias about it: of the robot that moves; the URDF says otherwise
TRUE = {
    "post": (6.5, (0.03, 0.0, 0.14), (0.06, 0.07, 0.034)),
    "boom": (4.6, (0.25, 0.02, 0.01), (0.025, 0.14, 0.15)),
    "slide": (2.1, (0.17, -0.01, 0.015), (0.012, 0.038, 0.034)),
    "hand": (1.5, (0.04, 0.03, 0.11), (0.008, 0.010, 0.004)),
}
GRAVITY = (1.2, -0.9, -9.6)  # [m/s^2] the hoist stands on a slope


@dataclass(frozen=True)
class Drive:
    """tau = armature a + (coulomb + load |tau_rigid|) sign(v) + viscous v + hook ... + offset."""

    armature: float = 0.0
    viscous: float = 0.0
    coulomb: float = 0.0
    offset: float = 0.0
    load: float = 0.0  # [-] of the rigid torque
    stribeck: float = 0.0  # beside Coulomb's, gone at a speed of some WIDTH
    spring: float = 0.0
    ripple: float = 0.0  # times cos(2 q + 0.4)


WIDTH = 0.25  # [rad/s or m/s] of every Stribeck hook
DRIVES = {
    "swing": Drive(1.1, 3.0, 4.0, 0.6),
    "lift": Drive(0.9, 2.2, 3.1, -0.8),
    "reach": Drive(2.4, 14.0, 6.0, 1.5),
    "roll": Drive(0.05, 0.35, 0.5, 0.11),
}


@dataclass(frozen=True)
class Hoist:
    """The robot that moves: joints, bodies, drives, and what hangs on it."""

    joints: tuple = JOINTS
    bodies: dict = field(default_factory=lambda: TRUE)
    drives: dict = field(default_factory=lambda: DRIVES)
    locked: dict = field(default_factory=lambda: LOCKED)
    gravity: tuple = GRAVITY
    coupling: tuple = ()  # ratios by joint of one more drive
    coupled: Drive = Drive()
    load: tuple = ()  # mass and centre in the tool's frame
    text: str = URDF  # of a URDF, with other bodies

    def model(self):
        """Return Pinocchio's model of the joints that move, in their order."""
        full = pin.buildModelFromXML(self.text)
        for link, (mass, com, moments) in self.bodies.items():
            inertia = pin.Inertia(mass, np.array(com), np.diag(moments))
            full.inertias[full.getJointId(_LINK[link])] = inertia
        q = pin.neutral(full)
        still = []
        for name, where in self.locked.items():
            joint = full.joints[full.getJointId(name)]
            still.append(full.getJointId(name))
            q[joint.idx_q : joint.idx_q + joint.nq] = (
                where if joint.nq == 1 else (np.cos(where), np.sin(where))
            )
        if self.load:
            mass, com = self.load
            frame = full.frames[full.getFrameId("tool")]
            ball = pin.Inertia(mass, np.array(com), 0.001 * mass * np.eye(3))
            full.appendBodyToJoint(frame.parentJoint, ball, frame.placement)
        model = pin.buildReducedModel(full, still, q)
        model.gravity.linear = np.array(self.gravity)
        assert tuple(model.names)[1:] == self.joints
        return model

    def torque(self, q, v, a):
        """Return the torques of the drives, shape (N, n)."""
        model = self.model()
        data = model.createData()
        rigid = np.stack([
            pin.rnea(model, data, _configuration(model, q[i]), v[i], a[i]) for i in range(len(q))
        ])  # fmt: skip
        tau = rigid.copy()
        for j, name in enumerate(self.joints):
            tau[:, j] += own(self.drives[name], q[:, j], v[:, j], a[:, j], rigid[:, j])
        if self.coupling:
            r = np.array(self.coupling)
            load = rigid @ r / (r @ r)
            tau += r * own(self.coupled, q @ r, v @ r, a @ r, load)[:, None]
        return tau


def own(drive, q, v, a, rigid):
    """Return the torque of a drive at some speeds."""
    hook = drive.stribeck * np.exp(-np.abs(v) / WIDTH)
    friction = (drive.coulomb + drive.load * np.abs(rigid) + hook) * np.sign(v)
    rest = drive.offset + drive.spring * q + drive.ripple * np.cos(2 * q + 0.4)
    return drive.armature * a + drive.viscous * v + friction + rest


def _configuration(model, q):
    out = np.empty(model.nq)
    for joint, x in zip(list(model.joints)[1:], q, strict=True):
        out[joint.idx_q : joint.idx_q + joint.nq] = x if joint.nq == 1 else (np.cos(x), np.sin(x))
    return out


QUANTILE = {"swing": (0.2, 1.1), "lift": (-0.2, 0.8), "reach": (0.05, 0.18), "roll": (0.4, 1.9)}
NOISE = {"swing": 0.9, "lift": 0.7, "reach": 1.3, "roll": 0.09}  # [N m or N]


def motion(joints, seed, t, speed=1.0):
    """Return position, velocity and acceleration of four tones per joint, shape (N, n) each."""
    rng = np.random.default_rng(seed)
    q, v, a = (np.zeros((len(t), len(joints))) for _ in range(3))
    for j, name in enumerate(joints):
        centre, most = QUANTILE[name]
        w = 2 * np.pi * speed * (np.array([0.11, 0.23, 0.41, 0.67]) + rng.uniform(-0.03, 0.03, 4))
        size = most * np.array([0.45, 0.3, 0.15, 0.1]) * rng.uniform(0.8, 1.1, 4)
        phase = rng.uniform(0, 2 * np.pi, 4)
        angle = np.outer(t, w) + phase
        q[:, j] = centre + np.sin(angle) @ size
        v[:, j] = np.cos(angle) @ (size * w)
        a[:, j] = -np.sin(angle) @ (size * w**2)
    return q, v, a


def record(
    path, hoist, seed, *, seconds, rate, start=0.0, noise=1.0, scale=None, velocity=False,
    speed=1.0, kind="tau", cut=(),
):  # fmt: skip
    """Write a log as CSV, and return (t, q, v, a, tau without noise)."""
    # Noise and speed are factors; scale has factors of columns by their first letters, as {"time":
    # 1e3}; kind is the first letters of torques; cut, the first and last row that are lost.
    t = np.arange(round(seconds * rate)) / rate
    q, v, a = motion(hoist.joints, seed, t, speed)
    exact = hoist.torque(q, v, a)
    rng = np.random.default_rng(seed + 1000)
    tau = exact + noise * np.array([NOISE[j] for j in hoist.joints]) * rng.standard_normal(q.shape)
    tau = np.round(tau / 0.01) * 0.01
    seen = np.round((q + 2e-5 * rng.standard_normal(q.shape)) / 1e-5) * 1e-5
    table = {"time": start + t}
    for j, name in enumerate(hoist.joints):
        table[f"q_{name}"] = seen[:, j]
        if velocity:
            table[f"dq_{name}"] = v[:, j] + 1e-3 * rng.standard_normal(len(t))
        table[f"{kind}_{name}"] = tau[:, j]
    rows = np.ones(len(t), dtype=bool)
    if cut:
        rows[cut[0] : cut[1]] = False
    write_table(path, {k: x[rows] for k, x in table.items()}, scale)
    return t + start, q, v, a, exact


def write_table(path, table, scale=None):
    """Write columns as CSV, some of them in other units."""
    for key, factor in (scale or {}).items():
        for name in table:
            if name.startswith(key):
                table[name] = table[name] * (factor if np.isscalar(factor) else factor(name))
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(table)
        writer.writerows([[f"{x:.9g}" for x in row] for row in zip(*table.values(), strict=True)])


INERTIAL = ("m", "mcx", "mcy", "mcz", "Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz")
_LINK = {"post": "swing", "boom": "lift", "slide": "reach", "hand": "roll"}


def parameters(hoist):
    """Return the true standard parameters by name, as "boom.mcx" and "lift.viscous"."""
    model, found = hoist.model(), {}
    for link, joint in _LINK.items():
        if joint in hoist.joints:
            values = model.inertias[model.getJointId(joint)].toDynamicParameters()
            found |= {f"{link}.{k}": float(x) for k, x in zip(INERTIAL, values, strict=True)}
    for name in hoist.joints:
        found |= {f"{name}.{k}": x for k, x in asdict(hoist.drives[name]).items()}
    return found


def base_value(expression, values):
    """Return a base parameter, a sum as "slide.m + 0.98 hand.m", of standard ones by name."""
    words = expression.replace(" - ", " + -1 ").split(" + ")
    total = 0.0
    for word in words:
        *factors, name = word.split()
        total += np.prod([float(x) for x in factors]) * values[name]
    return total


def standardised(result, values):
    """Return the errors of base parameters over their standard errors, where these are known."""
    return np.array([
        (entry["value"] - base_value(entry["expression"], values)) / entry["std_error"]
        for entry in result["base_parameters"]
        if entry["std_error"] is not None
    ])  # fmt: skip


def regressor_torque(hoist, values, q, v, a):
    """Return the torque of standard parameters by name, by Pinocchio's regressor, shape (N, n)."""
    model = hoist.model()
    data = model.createData()
    pi = np.concatenate([
        [values[f"{link}.{k}"] for k in INERTIAL]
        for name in hoist.joints
        for link, joint in _LINK.items()
        if joint == name
    ])  # fmt: skip
    tau = np.stack([
        pin.computeJointTorqueRegressor(model, data, _configuration(model, q[i]), v[i], a[i]) @ pi
        for i in range(len(q))
    ])  # fmt: skip
    rigid = tau.copy()
    for j, name in enumerate(hoist.joints):
        keys = [k for k in asdict(Drive()) if f"{name}.{k}" in values]
        drive = Drive(**{k: values[f"{name}.{k}"] for k in keys})
        tau[:, j] += own(drive, q[:, j], v[:, j], a[:, j], rigid[:, j])
    return tau


# ---- a closed loop ---------------------------------------------------------------------------


@dataclass(frozen=True)
class Loop:
    """torque = clip(kp (q_ref(t - delay) - q) - kd v, +-limit), of each joint by name."""

    kp: dict
    kd: dict
    delay: float = 0.0
    limit: dict = field(default_factory=dict)


def _rubbed(admittance, free, most):
    """Return the speeds that friction, of impulses up to some size, leaves of free ones."""
    # What would turn a joint round stops it; through the mass matrix it acts on other joints, too.
    # of a few numbers: NumPy takes ten times as long as Python
    A, v, most, impulse = admittance.tolist(), free.tolist(), most.tolist(), [0.0] * len(free)
    joints = range(len(v))
    for _ in range(100):
        before = [*v]
        for j in joints:
            new = min(max(impulse[j] - v[j] / A[j][j], -most[j]), most[j])
            change, impulse[j] = new - impulse[j], new
            for i in joints:
                v[i] += A[i][j] * change
        if max(abs(v[j] - before[j]) for j in joints) < 1e-14:
            break
    return np.array(v)


def follow(hoist, loop, wanted, *, step=5e-4):
    """Return positions, velocities and torques of a robot that follows commands, shape (N, n)."""
    # Commands are wanted at each step, (N, n); of drives armature, viscous, coulomb and offset
    # count.
    model = hoist.model()
    data = model.createData()
    own_drives = [hoist.drives[j] for j in hoist.joints]
    armature, viscous, coulomb, offset = (
        np.array([getattr(d, key) for d in own_drives])
        for key in ("armature", "viscous", "coulomb", "offset")
    )
    kp, kd = (np.array([table[j] for j in hoist.joints]) for table in (loop.kp, loop.kd))
    most = np.array([loop.limit.get(j, np.inf) for j in hoist.joints])
    late = round(loop.delay / step)
    q, v = wanted[0].copy(), np.zeros(len(hoist.joints))
    path = []
    for i in range(len(wanted)):
        tau = np.clip(kp * (wanted[max(i - late, 0)] - q) - kd * v, -most, most)
        path.append((q.copy(), v.copy(), tau))
        place = _configuration(model, q)
        M = np.array(pin.crba(model, data, place))
        M = np.triu(M) + np.triu(M, 1).T + np.diag(armature)
        push = tau - offset - pin.rnea(model, data, place, v, np.zeros_like(v))
        admittance = np.linalg.inv(M + step * np.diag(viscous))
        v = _rubbed(admittance, admittance @ (M @ v + step * push), step * coulomb)
        q = q + step * v
    return tuple(np.array(x) for x in zip(*path, strict=True))
