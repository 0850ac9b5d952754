"""Motions of a robot on its feet: the trunk sways, single legs swing."""

import numpy as np

from robotid.data.base_motion import quaternions_of_angles
from robotid.dynamics.simulation.motions import FloatingMotion
from robotid.dynamics.simulation.stand import on_feet


def stand(model, middle, height, rng, *, parts=4, length=3.0, rate=100.0, size=1.0):
    """Return a motion whose base sways; a leg is in the air in each part but the first.

    Args:
        model: The robot; its joints are in order of its contacts, as many at each leg.
        middle: Posture in which it stands, shape (n,) [rad].
        height: Of the base [m].
        rng: Source of the motion.
        parts: Number of parts.
        length: Of each part [s].
        rate: Samples per second [Hz].
        size: Factor on the motion of the base: 1 is a few centimetres.
    """
    t = np.arange(round(parts * length * rate) + 1) / rate
    part = np.minimum((t / length).astype(int), parts - 1)
    s = t / length - part
    feet, n = len(model.contacts), len(model.joints)
    pose, q = np.zeros((len(t), 6)), np.tile(middle, (len(t), 1))
    touching = np.ones((len(t), feet), dtype=bool)
    for p in range(parts):
        k, tones = part == p, np.arange(1, 4)[:, None, None]
        phase, size_of = (
            rng.uniform(0, 2 * np.pi, (3, 6 + n, 1)),
            rng.standard_normal((3, 6 + n, 1)),
        )
        wave = np.sum(size_of * np.sin(2 * np.pi * tones * s[k] + phase), axis=0).T
        wave *= np.sin(np.pi * s[k, None]) ** 3  # at rest at both ends
        pose[k] = size * wave[:, :6] * ([0.01] * 3 + [0.07] * 3)
        if p:
            touching[k & (s > 0.02) & (s < 0.98), (p - 1) % feet] = False
            own = slice((p - 1) % feet * n // feet, ((p - 1) % feet + 1) * n // feet)
            q[k, own] += 0.2 * wave[:, 6:][:, own]
    pose = np.hstack([pose[:, :3] + [0, 0, height], quaternions_of_angles(pose[:, 3:])])
    return FloatingMotion(t, pose, on_feet(model, pose, q, touching), touching)
