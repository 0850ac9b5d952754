"""Gravity, Coulomb friction and offsets of poses and slow sweeps."""

from itertools import pairwise

import numpy as np
import pinocchio as pin
import pytest
from helpers.synthetic import truth

from robotid.cli.identify import identify
from robotid.data.log import Log
from robotid.dynamics.torque import joint_torque_regressor
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

ROBOTS = {"panda": [f"panda_joint{i}" for i in range(1, 8)], "ur10_robot": None}


def robot(name, **options):
    return RobotModel.from_urdf(example_urdf(f"{name}.urdf"), joints=ROBOTS[name], **options)


def reach(model):
    return np.array([[max(j.lower, -2.5), min(j.upper, 2.5)] for j in model.limits]).T


def poses(full, pi, rng, count=60, rows=20):
    """A log of poses, 20 s apart, each held against friction of unknown direction."""
    q = rng.uniform(*reach(full), (count, len(full.joints)))
    still, held = np.zeros_like(q), rng.uniform(-1, 1, q.shape)
    tau = (joint_torque_regressor(full, q, still, still, held) @ pi).reshape(q.shape)
    t = (20.0 * np.arange(count)[:, None] + np.arange(rows) / 100).ravel()
    q, tau = (np.repeat(x, rows, axis=0) for x in (q, tau))
    q, tau = (x + s * rng.standard_normal(x.shape) for x, s in ((q, 2e-5), (tau, 0.3)))
    return Log(t=t, q=q, tau=tau, joints=full.joints)


def sweep(full, pi, rng, legs=12, speed=0.03, rate=10.0):
    """A log of straight lines between random points, all dynamics but viscous friction in it."""
    via = rng.uniform(*reach(full), (legs, len(full.joints)))
    parts = []
    for a, b in pairwise(via):
        rows = int(np.abs(b - a).max() / speed * rate)
        parts.append(a + np.arange(rows)[:, None] / rows * (b - a))
    q = np.concatenate(parts)
    t = np.arange(len(q)) / rate
    v = np.gradient(q, t, axis=0)
    pi = np.where([n.endswith("viscous") for n in full.layout.names], 0.0, pi)
    tau = (joint_torque_regressor(full, q, v, 0 * v) @ pi).reshape(q.shape)
    q, tau = (x + s * rng.standard_normal(x.shape) for x, s in ((q, 2e-5), (tau, 0.3)))
    return Log(t=t, q=q, tau=tau, joints=full.joints)


def own(full, static, pi):
    """The truth in the parameters of the static model."""
    values = dict(zip(full.layout.names, pi, strict=True))
    return np.array([values[name] for name in static.layout.names])


def gravity(model, pi, q):
    bodies = model.with_parameters(pi)
    data = bodies.pin_model.createData()
    rows = [pin.computeGeneralizedGravity(bodies.pin_model, data, x) for x in q]
    return np.array(rows)


CASES = {"poses": (poses, ("offset",), 0.02), "sweeps": (sweep, None, 0.002)}


@pytest.mark.parametrize("kind", CASES)
@pytest.mark.parametrize("name", ROBOTS)
def test_gravity_is_found_with_true_intervals(name, kind, rng):
    record, terms, near = CASES[kind]
    full = robot(name)
    static = robot(name, dynamics="static", **({} if terms is None else {"terms": terms}))
    pi = truth(full)
    found = identify(static, [record(full, pi, rng)], validation=[record(full, pi, rng)])
    beta = found.mapping.to_base(own(full, static, pi))
    low, high = found.base_interval.T
    assert np.mean((low <= beta) & (beta <= high)) >= 0.85  # 95 % of 16 to 26, by chance
    assert (np.abs(found.base - beta) <= 2 * (high - low)).all()
    q = static.configurations(rng.uniform(-2, 2, (50, len(static.joints))))
    wanted, given = gravity(full, pi, q), gravity(static, found.standard, q)
    size = np.sqrt(np.mean(wanted**2, axis=0))
    assert np.sqrt(np.mean((given - wanted) ** 2, axis=0)).max() < near * size.max()
    assert found.is_consistent
    assert found.verdict.status in ("good", "usable")
    expected = "static model: gravity, offsets and Coulomb friction"
    assert found.verdict.reasons[-1].startswith(expected)
    (note,) = [f for f in found.findings if f.code == "static"]
    count = note.evidence["samples"]
    assert count == 60 if kind == "poses" else count > 500


def test_inertias_about_the_centres_of_mass_are_the_urdfs(rng):
    full, static = robot("panda"), robot("panda", dynamics="static", terms=("offset",))
    found = identify(static, [poses(full, truth(full), rng)])
    models = static.pin_model, static.with_parameters(found.standard).pin_model
    before, after = ([model.inertias[i] for i in (2, 3, 4)] for model in models)
    assert max(abs(b.mass / a.mass - 1) for a, b in zip(after, before, strict=True)) > 0.03
    for a, b in zip(after, before, strict=True):
        np.testing.assert_allclose(a.inertia, b.inertia, atol=0.05 * np.trace(b.inertia))
