from dataclasses import replace

import numpy as np
import pytest
from helpers.mujoco_plant import plant, recorded

from robotid.commanded.fit import stated_loops
from robotid.commanded.settings import LoopSettings
from robotid.commanded.unknowns import LoopSimulator, Unknown, body_unknowns
from robotid.robot.drives import Coulomb, Viscous
from robotid.robot.parameters import pseudo_inertia
from robotid.simulation.loops import LoopedRobot, cut_windows


@pytest.fixture(scope="module")
def simulator():
    """A leg whose upper joints share armature and viscous friction, its bodies free."""
    rng = np.random.default_rng(0)
    robot = plant("leg", rng)
    log, _ = recorded(robot, rng, duration=0.5)
    looped = LoopedRobot(robot.model)
    base = replace(
        stated_loops(robot.model, LoopSettings(kp=20.0, kd=1.5)),
        armature=np.full(3, 0.02), terms=((Viscous(), Coulomb()),) * 3,
        values=np.tile([0.1, 0.2], 3), delay=np.full(3, 0.0047),
    )  # fmt: skip
    unknowns = (
        Unknown("calf.coulomb", "term", (2,), 0.2, 1.0, 0.0, term=Coulomb()),
        Unknown("upper.armature", "armature", (0, 1), 0.02, 1.0, 0.0),
        Unknown("upper.viscous", "term", (0, 1), 0.1, 1.0, 0.0, term=Viscous()),
        Unknown("delay", "delay", (0, 1, 2), 0.0047, 0.1, 0.0),
        *body_unknowns(looped, 0.1),
        Unknown("hip.kp", "kp", (0,), 20.0, 100.0, 1.0),
    )
    return LoopSimulator(looped, cut_windows(log, 0.25, 0.0), base, unknowns)


def test_slopes_of_residuals_are_those_of_differences(simulator, rng):
    theta = simulator.prior + np.array(
        [0.05 * rng.standard_normal() if u.what == "body" else 0.0 for u in simulator.unknowns]
    )
    found = simulator.residuals(theta, with_slopes=True)
    slopes = np.concatenate([r.slopes for r in found])  # of the outputs
    np.testing.assert_array_equal(found[0].columns, np.arange(len(theta)))
    for k, name in enumerate(simulator.names):
        h = 1e-8 / max(np.abs(slopes[..., k]).max(), 1e-4)
        ends = []
        for s in (1, -1):
            moved = theta.copy()
            moved[k] += s * h
            ends.append(
                np.concatenate([r.e for r in simulator.residuals(moved, with_slopes=False)])
            )
        exact = -(ends[0] - ends[1]) / (2 * h)
        size = max(np.abs(exact).max(), 1e-6)
        np.testing.assert_allclose(slopes[..., k], exact, atol=1e-5 * size, err_msg=name)


def test_unknowns_stand_over_what_is_known(simulator):
    theta = simulator.prior.copy()
    theta[:4] = 0.3, 0.05, 0.4, 0.01
    loops = simulator.loops(theta)
    np.testing.assert_array_equal(loops.armature, [0.05, 0.05, 0.02])
    np.testing.assert_array_equal(loops.values, [0.4, 0.2, 0.4, 0.2, 0.1, 0.3])
    np.testing.assert_array_equal(loops.delay, np.full(3, 0.01))
    np.testing.assert_allclose(loops.bodies, simulator.base.bodies, atol=1e-12)
    np.testing.assert_array_equal(simulator.base.armature, np.full(3, 0.02))


def test_every_value_is_a_body_that_can_be(simulator, rng):
    is_body = np.array([u.what == "body" for u in simulator.unknowns])
    for _ in range(20):
        theta = np.where(is_body, rng.standard_normal(len(is_body)), simulator.prior)
        bodies = simulator.loops(theta).bodies
        assert (np.linalg.eigvalsh(pseudo_inertia(bodies.reshape(-1)))[:, 0] > -1e-12).all()
    theta = simulator.prior.copy()
    k = simulator.names.index(next(n for n in simulator.names if n.endswith(".mass")))
    theta[k] = 0.1  # mass changes by exp(2 m)
    body = simulator.robot.joint_of_body.index(simulator.unknowns[k].joints[0])
    ratio = simulator.loops(theta).bodies[body, 0] / simulator.base.bodies[body, 0]
    assert ratio == pytest.approx(np.exp(0.2), rel=1e-9)
