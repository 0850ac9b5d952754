"""A robot on its feet, whose trunk sways and whose legs swing: its motion and its log."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pinocchio as pin

from robotid.data.base_motion import BaseMotion, in_base, quaternions_of_angles, vector_part
from robotid.data.log import Log, Trajectory
from robotid.dynamics.constraint_rows import constraint_jacobian, logged_base
from robotid.dynamics.simulation.motions import SampledMotion
from robotid.dynamics.torque import predict, remember
from robotid.robot.constraints import frame_id


@dataclass(frozen=True, eq=False)
class FloatingMotion:
    """A motion of a robot whose base floats: splines through poses and joint positions."""

    t: np.ndarray  # times, shape (N,) [s]
    pose: np.ndarray  # pose of the base, as of ``BaseMotion``, shape (N, 7) [m, -]
    q: np.ndarray  # joint positions, shape (N, n) [rad or m]
    contacts: np.ndarray  # whether each touches, until the next sample, shape (N, k), bool

    @cached_property
    def _samples(self):
        return SampledMotion(self.t, np.hstack([self.pose, self.q]))

    def touching(self, t):
        """Return which contacts touch the ground, shape (N, k), bool: t (N,) [s]."""
        rows = np.searchsorted(self.t - self.t[0], t + 1e-9, side="right") - 1
        return self.contacts[np.clip(rows, 0, len(self.t) - 1)]

    def evaluate(self, t):
        """Return q (N, 7 + n), v (N, 6 + n) and a (N, 6 + n), the twist with the axes of the base.

        With the unit quaternion p / |p| of the spline p, w = 2 p* dp/dt / |p|^2 (vector part).
        """
        x, rate, change = self._samples.evaluate(t)
        p, dp, ddp = x[:, 3:7], rate[:, 3:7], change[:, 3:7]
        square = np.sum(p**2, axis=1, keepdims=True)
        unit = p / np.sqrt(square)
        w = 2.0 * vector_part(p, dp) / square
        alpha = 2.0 * vector_part(p, ddp) / square
        alpha -= 2.0 * np.sum(p * dp, axis=1, keepdims=True) / square * w
        v = in_base(unit, rate[:, :3])
        a = in_base(unit, change[:, :3]) - np.cross(w, v)
        return (
            np.hstack([x[:, :3], unit, x[:, 7:]]),
            np.hstack([v, w, rate[:, 7:]]),
            np.hstack([a, alpha, change[:, 7:]]),
        )


def recorded(model, pi, motion, rng, *, rate, duration, acceleration=True, noise=0.01):
    """Return the log of a robot that follows a motion by the smallest forces of the ground."""
    # Rate [Hz], duration [s], noise of the torques [N m]; accelerations are logged or not.
    t, robot = np.arange(round(duration * rate) + 1) / rate, model.with_reference(pi)
    (q, v, a), flags = motion.evaluate(t), motion.touching(t)
    still, segment = np.zeros_like(v), np.zeros(len(t), dtype=int)
    rows = Trajectory(t, q, v, a, still, model.joints, None, segment)
    (torque,) = predict(robot, [pi], remember(robot, rows))
    J = constraint_jacobian(model, q, flags)
    f = np.einsum("kmi,ki->km", np.linalg.pinv(J[..., :6].swapaxes(1, 2), rcond=1e-8),
                  torque[:, :6])  # fmt: skip
    tau = torque[:, 6:] - np.einsum("kmj,km->kj", J[..., 6:], f)
    names, wanted = [x.frame for x in model.contacts], logged_base(model)
    parts = [
        f"{part} {x.frame}" for x in model.contacts for part in x.components[: x.sizes[x.kind]]
    ]
    return Log(
        t, q[:, 7:], tau + noise * rng.standard_normal(tau.shape), model.joints, v[:, 6:],
        a[:, 6:] if acceleration else None,
        base=BaseMotion(q[:, :7], v[:, :6], a[:, :6] if acceleration else None),
        contacts={link: flags[:, names.index(link)] for link in wanted.contacts},
        wrenches={name: f[:, parts.index(name)] for name in wanted.wrenches},
    )  # fmt: skip


def stand(model, middle, height, rng, *, parts=4, length=3.0, rate=100.0, size=1.0):
    """Return a motion whose base sways; a leg is in the air in each part but the first."""
    # Joints of the model are in order of its contacts, as many at each leg; it stands in the middle
    # posture. Size is a factor on the motion of the base: 1 is a few centimetres.
    t = np.arange(round(parts * length * rate) + 1) / rate
    part = np.minimum((t / length).astype(int), parts - 1)
    s = t / length - part
    feet, n = len(model.contacts), len(model.joints)
    pose, q = np.zeros((len(t), 6)), np.tile(middle, (len(t), 1))
    touching = np.ones((len(t), feet), dtype=bool)
    for p in range(parts):
        k, tones = part == p, np.arange(1, 4)[:, None, None]
        phase = rng.uniform(0, 2 * np.pi, (3, 6 + n, 1))
        size_of = rng.standard_normal((3, 6 + n, 1))
        wave = np.sum(size_of * np.sin(2 * np.pi * tones * s[k] + phase), axis=0).T
        wave *= np.sin(np.pi * s[k, None]) ** 3  # at rest at both ends
        pose[k] = size * wave[:, :6] * ([0.01] * 3 + [0.07] * 3)
        if p:
            touching[k & (s > 0.02) & (s < 0.98), (p - 1) % feet] = False
            own = slice((p - 1) % feet * n // feet, ((p - 1) % feet + 1) * n // feet)
            q[k, own] += 0.2 * wave[:, 6:][:, own]
    pose = np.hstack([pose[:, :3] + [0, 0, height], quaternions_of_angles(pose[:, 3:])])
    return FloatingMotion(t, pose, on_feet(model, pose, q, touching), touching)


def on_feet(model, pose, q, contacts):
    """Return the joint positions nearest to q, (N, n), at which feet stay where they touched."""
    pin_model, data = model.pin_model, model.pin_model.createData()
    ids = [frame_id(pin_model, x.frame) for x in model.contacts]
    found, change, places = np.empty_like(q), np.zeros(q.shape[1]), {}

    def placed(base, x):
        (configuration,) = model.configurations(np.append(base, x)[None])
        pin.computeJointJacobians(pin_model, data, configuration)
        pin.updateFramePlacements(pin_model, data)
        return {i: data.oMf[at].translation.copy() for i, at in enumerate(ids)}

    for k, (base, wanted, touching) in enumerate(zip(pose, q, contacts, strict=True)):
        x = wanted + change
        places = {i: at for i, at in (placed(base, x) | places).items() if touching[i]}
        for _ in range(30):
            now = placed(base, x)
            error = np.concatenate([np.empty(0), *(now[i] - at for i, at in places.items())])
            if np.abs(error).max(initial=0.0) < 1e-10:
                break
            axes = pin.LOCAL_WORLD_ALIGNED
            rows = [pin.getFrameJacobian(pin_model, data, ids[i], axes)[:3] for i in places]
            J = (np.vstack(rows) @ model.velocity_map)[:, 6:]
            x = x - np.linalg.lstsq(J, error, rcond=1e-8)[0]
        else:
            raise ValueError(f"sample {k}: the feet on the ground cannot remain where they are")
        found[k], change = x, x - wanted
    return found
