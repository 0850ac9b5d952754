"""Motions of a robot on its feet: the trunk sways, single legs swing."""

import numpy as np
import pinocchio as pin

from robotid.data.base_motion import quaternions_of_angles
from robotid.dynamics.simulation.motions import FloatingMotion
from robotid.robot.constraints import frame_id


def stand(model, middle, height, rng, *, parts=4, length=3.0, rate=100.0, size=1.0):
    """Return a motion whose base sways; a leg is in the air in each part but the first.

    Joints of the model are in order of its contacts, as many at each leg; it stands in the middle
    posture. Size is a factor on the motion of the base: 1 is a few centimetres.
    """
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
    """Return the joint positions nearest to q with which feet on the ground do not move, (N, n).

    A foot remains where it is at the first sample of its contact.
    """
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
