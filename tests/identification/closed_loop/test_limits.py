from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.mujoco_plant import loaded, multisine, plant, rolled_out

from robotid.data.log import Log
from robotid.diagnosis.logs.command_channels import largest_speeds
from robotid.estimation.fitting.estimator_settings import SimulationSettings
from robotid.identification.closed_loop import stages
from robotid.identification.closed_loop.from_commands import identify_loops
from robotid.identification.closed_loop.loop_settings import LoopSettings

RATE, HELD, RAMP, STEPS = 250.0, 110, 20, 4  # [Hz], rows, of a leg that goes from pose to pose
LIMIT, VISCOUS, KP = 9.0, 4.5, 200.0  # [N m], [N m s/rad], [N m/rad] of the calf
DELAY = 0.008  # [s] of all drives
SETTINGS = SimulationSettings(window=2.0, lead=0.2, bodies=0.0, step=4e-3)


@pytest.fixture(scope="module")
def limited():
    """A leg whose calf has a limit, and its log of steps."""
    rng = np.random.default_rng(2)
    robot = plant("leg", rng, delay=DELAY)
    calf = replace(robot.drives[2], effort_limit=LIMIT, viscous=VISCOUS, kp=KP)
    robot = replace(robot, drives=(*robot.drives[:2], calf))
    away = (-1.0) ** np.arange(STEPS)[:, None] * rng.uniform(0.4, 0.8, (STEPS, 3))
    poses = robot.middle + robot.reach * away
    t = np.arange(STEPS * HELD) / RATE
    since = np.minimum(t * RATE % HELD / RAMP, 1.0)[:, None]
    last, next_ = (np.repeat(x, HELD, axis=0) for x in (poses, np.roll(poses, -1, axis=0)))
    q_ref = last + (next_ - last) * since
    q = rolled_out(loaded(robot, RATE), q_ref, RATE)[0]
    q = q + 1e-4 * rng.standard_normal(q.shape)
    none = np.zeros_like(q)
    return robot, Log(t, q, none, robot.model.joints, q_ref=q_ref, has_torque=False)


def test_a_drive_at_its_limit_has_it_found(limited):
    robot, log = limited
    calf = robot.model.joints[2]
    assert largest_speeds(log).keys() == {calf}
    coulomb = robot.drives[2].coulomb
    assert largest_speeds(log)[calf] == pytest.approx((LIMIT - coulomb) / VISCOUS, rel=0.15)
    loop = LoopSettings(**robot.gains)
    found = identify_loops(robot.model, [log], [], loop, SETTINGS, chooses=False)
    estimate = found.fit.estimate
    values = dict(zip(estimate.names, estimate.theta, strict=True))
    assert [name for name in values if name.endswith("limit")] == [f"{calf}.limit"]
    assert values[f"{calf}.limit"] == pytest.approx(LIMIT, rel=0.03)
    assert values[f"{calf}.viscous"] == pytest.approx(VISCOUS, rel=0.03)
    assert values[f"{calf}.coulomb"] == pytest.approx(coulomb, rel=0.3)
    np.testing.assert_array_equal(found.fit.loops.limit[:2], np.inf)
    assert [name for name in values if name.endswith("delay")] == ["robot.delay"]
    assert values["robot.delay"] == pytest.approx(DELAY, abs=2e-4)
    np.testing.assert_array_equal(found.fit.loops.delay, values["robot.delay"])
    [said] = [f for f in found.findings if f.code == "limit"]
    assert said.where == calf
    error = dict(zip(estimate.names, estimate.std_error, strict=True))[f"{calf}.limit"]
    assert said.evidence == {"limit": values[f"{calf}.limit"], "std_error": error}
    assert f"as {values[f'{calf}.limit']:.3g} +- {error:.2g} N m; at the limit" in said.message


def test_a_drive_that_saturates_while_it_follows_has_its_limit_and_gain_found():
    """The limit bounds kp and kd together: there, and only there, kd is not viscous friction."""
    rng = np.random.default_rng(3)
    robot = plant("leg", rng, kp=14.0, kd=0.3, viscous=0.5, coulomb=0.1, armature=0.03, delay=0.012)
    robot = replace(robot, drives=tuple(replace(d, effort_limit=1.2) for d in robot.drives))
    t = np.arange(1200) / RATE
    q_ref = robot.middle + 0.8 * (multisine(t, robot.middle, robot.reach, rng) - robot.middle)
    q = rolled_out(loaded(robot, RATE), q_ref, RATE)[0]
    q = q + 1e-4 * rng.standard_normal(q.shape)
    log = Log(1000.0 + t, q, 0 * q, robot.model.joints, q_ref=q_ref, has_torque=False)
    assert not largest_speeds(log)
    found = identify_loops(robot.model, [log], [log], LoopSettings(), SETTINGS, chooses=False)
    values = dict(zip(found.fit.estimate.names, found.fit.estimate.theta, strict=True))
    hip = robot.model.joints[0]
    true = {"kp": 14.0, "kd": 0.3, "limit": 1.2, "viscous": 0.5, "armature": 0.03}
    for key, truth in true.items():
        assert values[f"{hip}.{key}"] == pytest.approx(truth, rel=0.03), key
    said = next(f for f in found.findings if f.code == "limit")
    assert (said.where, said.severity) == (hip, "warning")
    assert "saturates" in said.message
    assert not any(name.endswith("calf_joint.limit") for name in values), "its drive stays below"


@pytest.mark.parametrize(
    ("limited", "taken"), [((5.0, 2.9), (False, False)), ((3.0, 2.9), (True, False))]
)
def test_a_limit_that_was_not_asked_for_is_taken_where_the_error_is_clearly_smaller(
    limited, taken, monkeypatch
):
    errors = {(False, False): (6.0, 3.0), (True, True): limited, (True, False): limited}

    def first_fit(initial):
        return initial, None, np.array(errors[*map(bool, initial.limited)])

    def vary(factor, limited):
        return SimpleNamespace(factor=factor, limited=limited)

    monkeypatch.setattr(stages, "_first_fit", first_fit)
    monkeypatch.setattr(stages, "_errors_of", lambda *_: np.array([50.0, 50.0]))
    initial = SimpleNamespace(
        torque=np.ones(2), groups=("hip", "knee"), starts=((1.0, False), (1.0, True)), vary=vary,
        plain=SimpleNamespace(loops=None), simulator=None,
    )  # fmt: skip
    chosen, _ = stages._best_start(initial)
    np.testing.assert_array_equal(chosen.limited, taken)
