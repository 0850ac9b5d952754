"""Figures derived of a fit of loops with given errors, and the information of each log."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.stats
from helpers.mujoco_plant import plant, recorded

from robotid.data.log import Log
from robotid.dynamics.simulation.loops import ClosedLoopRobot, cut_windows
from robotid.estimation.estimators.estimator import Estimate
from robotid.estimation.estimators.output_error import segment_scores
from robotid.estimation.fitting.standard_errors import QUANTILE
from robotid.identification.closed_loop.from_commands import logged_motion, loop_findings, loop_runs
from robotid.identification.closed_loop.initial_values import Encoders
from robotid.identification.closed_loop.loop_simulator import (
    FreeParameter,
    GainScale,
    LoopSimulator,
    Tried,
)
from robotid.output.files.result_file import loops_of
from robotid.robot.drives import Coulomb

#: Names of the unknowns, in the order of the fit.
NAMES = ("rail.armature", "turn.armature", "robot.delay", "rail.viscous", "turn.viscous")


@pytest.fixture
def found(crane):
    return crane


def of(found, **changes):
    """Return the same with another estimate."""
    return replace(found, fit=replace(found.fit, estimate=replace(found.estimate, **changes)))


def test_intervals_reach_as_far_as_those_of_what_they_follow_from(found):
    assert found.estimate.names == NAMES
    freedom = np.array([5.0, 4.0, 3.0, 8.0, 12.0])
    own = of(found, details={**found.estimate.details, "freedom": freedom})
    reach = dict(zip(found.model.layout.names, own.standard_quantile, strict=True))
    stated = dict(zip(NAMES, scipy.stats.t.ppf(0.975, freedom), strict=True))
    assert reach == pytest.approx({name: stated.get(name, QUANTILE) for name in reach}, rel=1e-6)
    sums = found.mapping.K != 0.0
    assert sums.sum(axis=1).max() > 1, "a base parameter sums several"
    for row, base in zip(sums, own.base_quantile, strict=True):
        assert base == own.standard_quantile[row].max()
    opposite = replace(own)  # parameters that decrease, as moments do if a body moves to one side
    vars(opposite)["_slopes"] = -own._slopes
    np.testing.assert_array_equal(opposite.standard_quantile, own.standard_quantile)


def test_errors_of_sums_are_those_of_their_parameters(found):
    variance = dict(zip(NAMES, np.diag(found.estimate.covariance), strict=True))
    C = np.diag([variance.get(name, 0.0) for name in found.model.layout.names])
    standard = dict(zip(found.model.layout.names, found.standard_error, strict=True))
    for name, error in standard.items():
        assert error == pytest.approx(np.sqrt(variance[name]) if name in variance else np.inf)
    k = [found.model.layout.names.index(name) for name in NAMES if name in standard]
    places = [NAMES.index(found.model.layout.names[i]) for i in k]
    C[np.ix_(k, k)] = found.estimate.covariance[np.ix_(places, places)]
    for row, error in zip(found.mapping.K, found.base_error, strict=True):
        size = np.sqrt(row @ C @ row)
        assert error == (pytest.approx(size) if size > 0 else np.inf)


def test_a_limit_and_a_gain_at_their_lower_bound_are_findings(found):
    simulator, theta = found.fit.simulator, found.estimate.theta.copy()
    first, second, *others = simulator.free_parameters
    limit = replace(first, name="rail.limit", what="limit", lowest=0.25)
    gain = replace(second, name="turn.kp", what="kp", lowest=1.5)
    theta[:2] = 0.25, 1.5
    names = ("rail.limit", "turn.kp", *NAMES[2:])

    def said(*at_bound):
        details = {**found.estimate.details, "at_bound": at_bound}
        estimate = replace(found.estimate, theta=theta, details=details, names=names)
        both = replace(simulator, free_parameters=(limit, gain, *others))
        at = replace(found, fit=replace(found.fit, simulator=both, estimate=estimate))
        return [f for f in loop_findings(at, ()) if f.code in ("at_bound", "limit")]

    [bound] = said("rail.limit", "turn.kp")
    assert (bound.code, bound.severity) == ("at_bound", "warning")
    assert bound.where == "rail.limit = 0.25, turn.kp = 1.5"
    bound, free = sorted(said("turn.kp"), key=lambda finding: finding.code)
    assert bound.where == "turn.kp = 1.5"
    assert free.where == "rail"
    assert free.evidence["limit"] == 0.25
    assert f"as 0.25 +- {found.estimate.std_error[0]:.2g} N; at the" in free.message


def test_encoders_are_told_with_the_figures_of_their_own_joint(found):
    def told(**changes):
        both = dict.fromkeys(Encoders.__dataclass_fields__, np.zeros(2))
        both |= {"sign": np.ones(2), "next_sign": np.ones(2)}
        encoders = Encoders(**{key: np.array(x) for key, x in (both | changes).items()})
        fit = replace(found.fit, encoders=encoders)
        loop = replace(found.loop, zeros="find")
        said = loop_findings(replace(found, fit=fit, loop=loop), ())
        return {f.code: f for f in said if f.code.startswith("encoder")}

    [open_] = told(margin=[0.05, 0.13]).values()
    assert (open_.where, open_.evidence) == ("rail, turn", {"margin": 0.13})
    assert "leaves at most 13 % more squared position error" in open_.message
    turned = {"gain": [0.0, 0.31], "sign": [1.0, -1.0], "next_zero": [0.4, -0.25]}
    every = told(**turned, margin=[0.5, 2.1], explained=[0.62, 0.9])
    assert {code: f.where for code, f in every.items()} == {
        "encoder": "turn", "encoder_uncorrected": "rail",
    }  # fmt: skip
    assert "-0.25 rad and the other sign, leaves 210 % more" in every["encoder"].message
    assert "explains 62 % of the slow part" in every["encoder_uncorrected"].message


def test_speeds_of_a_log_are_those_between_its_gaps():
    t = 3.0 + np.concatenate([np.arange(50), 80 + np.arange(30)]) / 100.0
    q = np.column_stack([2.0 * t, -0.5 * t**2])
    q[50:] += 7.0  # while nothing was recorded
    log = Log(t, q, 0 * q, ("a", "b"), q_ref=q, has_torque=False)
    motion = logged_motion(log)
    np.testing.assert_array_equal(motion.segment, np.repeat([0, 1], [50, 30]))
    np.testing.assert_allclose(motion.v[:, 0], 2.0)
    inner = np.delete(np.arange(80), [0, 49, 50, 79])  # ends have half a step
    np.testing.assert_allclose(motion.v[inner, 1], -t[inner])
    np.testing.assert_allclose(motion.v[:, 1], -t, atol=0.0051)
    assert not motion.a.any()


def test_findings_of_the_fit_have_its_figures(found):
    details = {**found.estimate.details, "halving": 2.46, "step": 4e-3}
    scale = GainScale(np.array([0.2, 0.26]), np.array([0.05, 0.04]), 0.234, 0.0152)
    tried = [Tried("turn", ("stribeck", "load"), 0.316, True), Tried("rail", ("load",), 0.5, False)]
    own = of(found, details=details, converged=False, n_iter=17)
    first, *others = found.fit.simulator.free_parameters
    shared = replace(own.fit.simulator, free_parameters=(replace(first, joints=(0, 1)), *others))
    own = replace(own, fit=replace(own.fit, scale=scale, tried=tried, simulator=shared))
    said = {f.code: f for f in loop_findings(own, ())}
    assert "after 17 steps" in said["not_settled"].message
    assert "steps of 4 ms changes a parameter by 2.5" in said["coarse_steps"].message
    gains = said["gains_contradicted"]
    rail, turn = 1.234 * found.fit.loops.kp
    assert "weight and inertia indicate gains of 1.23 +- 0.015 times the given" in gains.message
    assert f"of kp: rail = {rail:.3g}, turn = {turn:.3g}; kd" in gains.message
    assert gains.evidence == {"scale": pytest.approx(1.234), "std_error": 0.0152}
    assert "turn: with stribeck and load" in said["friction_found"].message
    assert said["friction_found"].evidence == {"gain_pct": pytest.approx(31.6)}
    assert (said["scale"].severity, said["shared_drives"].where) == ("note", "rail, turn")
    quiet = of(found, details={**details, "halving": 0.99})
    codes = {f.code for f in loop_findings(quiet, ())}
    assert not codes & {"not_settled", "coarse_steps", "gains_contradicted", "shared_drives"}
    stated = replace(own, loop=replace(own.loop, groups={"drive": ["rail", "turn"]}))
    assert "shared_drives" not in {f.code for f in loop_findings(stated, ())}


NOISE = 1e-4  # [rad]


@pytest.fixture(scope="module")
def leg():
    """Four logs of a leg; the third has a larger kp at the hip and friction at the calf."""
    rng = np.random.default_rng(0)
    robot = plant("leg", rng, delay=0.006)
    hip, thigh, calf = robot.drives
    changed = (replace(hip, kp=1.03 * hip.kp), thigh, replace(calf, coulomb=1.2 * calf.coulomb))
    logs = [
        recorded(replace(robot, drives=changed) if k == 2 else robot, rng, duration=1.5,
                 noise=NOISE)[0]
        for k in range(4)
    ]  # fmt: skip
    free = (
        FreeParameter("calf.coulomb", "term", (2,), calf.coulomb, 1.0, 0.0, term=Coulomb()),
        FreeParameter("hip.kp", "kp", (0,), hip.kp, np.inf, 1.0),
        FreeParameter("hip.delay", "delay", (0,), 0.006, 0.1, 0.0),
    )
    windows = [window for log in logs for window in cut_windows(log, 0.5, 0.1)]
    base = loops_of(robot.model, robot.parameters, robot.drives)
    simulator = LoopSimulator(ClosedLoopRobot(robot.model), tuple(windows), base, free)
    estimate = Estimate(
        theta=simulator.prior, covariance=1e-6 * np.eye(3), names=simulator.names,
        sigma=np.full(3, NOISE), rank=3, condition=1.0, undetermined=(), converged=True, n_iter=1,
        message="", prior_std=simulator.prior_std,
        details={"correlation": np.zeros(3), "at_bound": ()},
    )  # fmt: skip
    return robot, simulator, estimate


def test_each_log_tells_its_own_gains_and_friction(leg):
    robot, simulator, estimate = leg
    calf, hip = loop_runs(robot.model, simulator, estimate)
    assert calf.group.parameters == ("calf.coulomb",)
    assert hip.group.parameters == ("hip.kp", "hip.delay")
    assert hip.group.units == ("N m/rad", "s")
    assert hip.runs.unit.tolist() == [0, 0, 0, 0]

    def values(found):
        return np.array([np.linalg.solve(*pair) for pair in zip(found.runs.H, found.runs.h,
                                                               strict=True)])  # fmt: skip

    coulomb = values(calf)[:, 0] / calf.centre[0]
    assert coulomb == pytest.approx([0.0, 0.0, 0.2, 0.0], abs=0.04)
    kp = values(hip)[:, 0] / hip.centre[0]
    assert kp == pytest.approx([0.0, 0.0, 0.03, 0.0], abs=0.006)
    assert np.abs(values(hip)[:, 1]).max() < 3e-4  # [s]
    assert hip.runs.scale == pytest.approx([0.1 * hip.centre[0], 1e-3])
    own = tuple(w for w in simulator.windows if w.log is simulator.windows[-1].log)
    each = [segment_scores(replace(simulator, windows=(w,)), estimate) for w in own]
    H, g = (sum(x[k].sum(axis=0) for x in each) for k in (0, 1))  # of all windows of the last log
    assert hip.runs.H[3] * hip.inflation == pytest.approx(H[1:, 1:], rel=1e-6)
    assert hip.runs.h[3] * hip.inflation == pytest.approx(g[1:], rel=1e-6)
    # another noise level: another information, the same inflated one
    louder = loop_runs(robot.model, simulator, replace(estimate, sigma=2.0 * estimate.sigma))
    assert louder[1].inflation == pytest.approx(hip.inflation / 4)
    assert pytest.approx(hip.runs.H) == louder[1].runs.H


def test_robots_bounds_and_two_logs(leg):
    robot, simulator, estimate = leg
    bound = replace(estimate, details={**estimate.details, "at_bound": ("hip.delay",)})
    _, hip = loop_runs(robot.model, simulator, bound, ["b", "b", "a", "a"])
    assert hip.group.parameters == ("hip.kp",)
    assert hip.runs.unit.tolist() == [1, 1, 0, 0]
    logs = list(dict.fromkeys(window.log for window in simulator.windows))
    for count, groups in ((2, 0), (3, 2)):
        own = tuple(w for w in simulator.windows if w.log in logs[:count])
        assert len(loop_runs(robot.model, replace(simulator, windows=own), estimate)) == groups
