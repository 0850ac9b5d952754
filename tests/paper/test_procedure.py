"""The equations and the procedure (11)-(25), on the paper's arm and on a UR5 under gravity."""

import re
from dataclasses import replace
from functools import partial

import numpy as np
import pinocchio as pin
import pytest
from helpers.synthetic import truth

from robotid.base.exceptions import RankDeficientError, SettingsError
from robotid.dynamics.base_parameters import structural_mapping
from robotid.dynamics.simulation.motions import ProgramMotion
from robotid.dynamics.simulation.simulator import RobotPlant
from robotid.dynamics.torque import joint_torque_regressor
from robotid.paper import planar_2r, study
from robotid.paper.planar_2r import (
    PAPER_LINKS,
    PAPER_PARAMETERS,
    PARAMETER_NAMES,
    PlanarLinks,
    parameters,
    regressor,
    urdf_text,
)
from robotid.paper.study import (
    Influences,
    LinearDynamics,
    LoopSettings,
    PaperSettings,
    energy_drift,
    one_shot,
    paper_arm,
    planar_dynamics,
    proximity,
    random_runs,
    recursive_update,
    rk4,
    run_procedure,
    study_model,
)

P4 = planar_2r.parameters(planar_2r.PAPER_LINKS)
ARM = planar_dynamics()
PLANT = partial(ARM.acceleration, P=P4)
MOTION = ProgramMotion(np.array([1.0, 1.5]), 2.0)
DEGREE = np.array([np.pi / 180, 0.0])


def short(iterations=3, **settings):
    return LoopSettings(iterations=iterations, **settings)


def run(P0=P4 / 2, **options):
    return run_procedure(ARM, PLANT, MOTION, np.atleast_2d(P0), **options)


def base_dynamics(model):
    """Return a robot as the procedure takes it, linear in its base parameters."""
    mapping = structural_mapping(model)

    def regressor(q, v, a):
        W = joint_torque_regressor(model, q, v, a)  # (R n, p)
        return W[:, mapping.independent].reshape(*q.shape, -1)

    return LinearDynamics(mapping.base_names, regressor)


def test_the_true_parameters_track_the_program():
    # the torque is held for T / 200, and the error falls with this; eta itself is exactly 0
    history, finer = (run(P4, settings=short(1, updates=n)).tracking.max() for n in (200, 600))
    assert history < 1e-3
    assert history / finer == pytest.approx(3.0, rel=0.03)


def test_at_the_true_parameters_prx_is_zero_and_the_procedure_stops_at_once():
    history = run(P4, settings=short(5))
    np.testing.assert_array_equal(history.NA, [1])
    assert len(history.prx) == 1
    np.testing.assert_array_equal(history.estimates[-1], [P4])


@pytest.mark.parametrize(("form", "P", "left"), [
    ("printed", planar_2r.PAPER_PARAMETERS, 0.1011), ("corrected", P4, 0.09864),
    ("corrected_five", planar_2r.PAPER_PARAMETERS, 0.09915),
])  # fmt: skip
def test_the_recursion_finds_the_papers_parameters(form, P, left):
    dynamics = planar_dynamics(form)
    history = run_procedure(
        dynamics, partial(dynamics.acceleration, P=P), MOTION, P[None] / 2, settings=short(12),
        offset=DEGREE,
    )  # fmt: skip
    error = history.relative_error(P)[:, 0]
    assert error[0] == 0.5
    assert 0.34 < error[1] < 0.40  # the reading has 0.39, 0.15 and, after 100, 1e-5
    assert 0.10 < error[10] < 0.16
    assert error[-1] == pytest.approx(left, rel=1e-3)
    assert (np.diff(error) < 0).all()


def test_an_impossible_guess_is_not_updated_and_a_runaway_is_told():
    # D of -P is negative definite: the control drives the robot away
    history = run(np.stack([-P4, P4 / 2]), settings=short(2), offset=DEGREE)
    np.testing.assert_array_equal(history.diverged, [1, 0])
    assert 0 < history.skipped[0] < 100  # of 200: none after it has diverged
    assert history.skipped[1] == 0
    np.testing.assert_array_equal(history.estimates[-1, 0], -P4)
    alone = run(settings=short(2), offset=DEGREE)
    np.testing.assert_array_equal(history.estimates[:, 1], alone.estimates[:, 0])


@pytest.fixture(scope="module")
def arm(ur5):
    return base_dynamics(ur5)


def states(rng, count, n):
    return rng.uniform(-np.pi, np.pi, (count, n)), *rng.uniform(-3, 3, (2, count, n))


def test_a_linear_plant_moves_as_the_robot_does(arm, ur5, rng):
    pi = truth(ur5)
    q, v, u = states(rng, 10, 6)
    v += 0.5 * np.sign(v)  # away from 0, where the plant's friction is smooth
    ours = arm.acceleration(q, v, 20 * u, structural_mapping(ur5).to_base(pi))
    # wrist inertias of 0.1 kg m^2 multiply rounding of 50 N m
    theirs = [RobotPlant(ur5, pi).acceleration(*one) for one in zip(q, v, 20 * u, strict=True)]
    np.testing.assert_allclose(ours, theirs, rtol=1e-9)


def test_proximity_is_the_gradient_of_the_criterion(rng):
    Psi, P, u, h = rng.normal(size=(2, 5)), rng.normal(size=5), rng.normal(size=2), 1e-6

    def J(P):  # (3)
        return 0.5 * np.sum((u - Psi @ P) ** 2)

    slopes = [(J(P + h * e) - J(P - h * e)) / (2 * h) for e in np.eye(5)]
    # J is quadratic: central differences are exact but for rounding, 1e-16 / h
    np.testing.assert_allclose(proximity(Psi, P, u), slopes, atol=1e-8)


@pytest.mark.parametrize(("change", "why"), [
    ({"is_open": np.array(False)}, "PRX is zero"), ({"eps2": 1e9}, "the sample is small"),
    ({"sigma": np.array(-0.1)}, "D is not positive definite"),
])  # fmt: skip
def test_an_update_is_left_out_where(change, why, rng):
    P, Psi, eta = rng.normal(size=5), rng.normal(size=(2, 5)), rng.normal(size=2)
    arguments = {"sigma": np.array(1.0), "is_open": np.array(True), **change}
    found = recursive_update(P, Psi, eta, **arguments)
    np.testing.assert_array_equal(found, P, err_msg=why)


def test_one_shot_names_what_the_motion_leaves_open(rng):
    G = rng.normal(size=(40, 4))
    G[:, 3] = 2 * G[:, 1]
    with pytest.raises(RankDeficientError, match=r"excite 3 of 4 .* undetermined: b, d\."):
        one_shot(G, G, np.ones(4), "abcd")


def swing(q, v):
    return -4.0 * q - 0.2 * v


def test_its_error_falls_with_the_fourth_power_of_the_step():
    def end(steps):
        q, v = np.array([1.0]), np.array([0.0])
        for _ in range(steps):
            q, v = rk4(swing, q, v, 2.0 / steps)
        return float(q[0])

    w = np.sqrt(4.0 - 0.01)
    exact = np.exp(-0.2) * (np.cos(2 * w) + 0.1 / w * np.sin(2 * w))
    assert (end(20) - exact) / (end(40) - exact) == pytest.approx(16.0, rel=0.1)


class Given:
    """A random generator that returns stated arrays, one after the other."""

    def __init__(self, *arrays):
        self.arrays = iter(arrays)

    def standard_normal(self, shape):
        found = next(self.arrays)
        assert found.shape == shape
        return found


def test_an_iteration_is_its_equations_update_by_update(rng):
    """Two runs of their own duration; each sensor has noise of its own."""
    motion = ProgramMotion(np.array([[1.0, 1.5], [0.7, -1.1]]), np.array([2.0, 1.5]))
    alpha, beta = np.array([20.0, 11.0]), np.array([100.0, 40.0])
    levels = 0.01 * np.array([1.0, 2.0]), np.full(2, 0.05), np.array([0.7, 0.2])
    drawn = rng.standard_normal((40, 3, 2, 2))
    influences = Influences(
        lambda t, u: 0.1 * u + t[:, None], *levels, rng=Given(*drawn.reshape(120, 2, 2))
    )
    guesses, offset = np.array([P4 / 2, P4 * 0.8]), np.array([[0.05, -0.4], [0.0, 0.1]])
    settings = short(1, updates=40, alpha=alpha, beta=beta)
    history = run_procedure(
        ARM, PLANT, motion, guesses, settings=settings, offset=offset, influences=influences
    )
    P, dt = guesses.copy(), np.array([0.05, 0.0375])
    start = P.copy()
    q, v = motion.evaluate(np.zeros(2))[0] + offset, np.zeros((2, 2))
    largest, distance, torques = np.zeros(2), np.zeros(2), []
    for k, noisy in enumerate(drawn):
        q_pr, v_pr, a_pr = motion.evaluate(k * dt)
        distance = np.maximum(distance, np.abs(q - q_pr).max(axis=1))
        q_seen, v_seen = q + levels[0] * noisy[0], v + levels[1] * noisy[1]
        q_star = a_pr - alpha[:, None] * (v_seen - v_pr) - beta[:, None] * (q_seen - q_pr)
        Psi = ARM.regressor(q_seen, v_seen, q_star)
        u = np.array([X @ p for X, p in zip(Psi, P, strict=True)])
        applied = 1.1 * u + (k * dt)[:, None]
        a = PLANT(q, v, applied)
        a_seen = a + levels[2] * noisy[2]
        G = ARM.regressor(q_seen, v_seen, a_seen)
        prx = [np.abs(X.T @ (X @ p - w)).max() for X, p, w in zip(G, P, u, strict=True)]
        largest = np.maximum(largest, prx)
        for r, (X, D) in enumerate(zip(Psi, ARM.mass_matrix(q_seen, P), strict=True)):
            sigma = max(np.linalg.eigvalsh(D)[0], 0.0)
            P[r] -= sigma / np.sum(X**2) * X.T @ (a_seen - q_star)[r]
        torques.append(u[0])
        q, v = rk4(partial(PLANT, u=applied), q, v, dt[:, None])
    np.testing.assert_allclose(history.estimates, [start, P], rtol=1e-9)
    np.testing.assert_allclose(history.prx, [largest], rtol=1e-9)
    np.testing.assert_allclose(history.tracking, [distance], rtol=1e-9)
    assert history.tracking[0, 0] > 0.39  # of the second joint
    np.testing.assert_allclose(history.torques, [torques], rtol=1e-9)
    assert (largest > prx).any()  # of an update before the last
    np.testing.assert_array_equal([history.NA, history.diverged], np.zeros((2, 2)))


def test_the_physical_arm_has_four_parameters_and_the_others_the_papers_five():
    for name in ("printed", "corrected"):
        np.testing.assert_array_equal(paper_arm(name)[1], PAPER_PARAMETERS)
    np.testing.assert_allclose(paper_arm("physical")[1], [22, 5, 3, 0.1], rtol=1e-14)
    with pytest.raises(SettingsError, match=r"is 'other', expected one of printed, corrected"):
        paper_arm("other")


def test_one_shot_needs_one_run_and_disturbance_shows():
    study = study_model("physical", PaperSettings(iterations=2, longest=1))
    assert study.one_shot_error < 1e-12
    assert study.errors("disturbed")[1] != study.errors()[1]
    assert study.errors("noisy")[1] != study.errors()[1]
    assert study.errors("on_program")[1] > study.errors()[1]


def test_only_the_physical_arm_keeps_its_energy():
    t, gained = energy_drift(duration=4.0, dt=4e-3)
    np.testing.assert_allclose(t, np.linspace(0.0, 4.0, 1001), atol=1e-12)
    assert {len(share) for share in gained.values()} == {1001}
    assert np.abs(gained["physical"]).max() < 1e-9  # error of the integration
    assert np.abs(gained["printed"]).max() > 0.2
    assert np.abs(gained["corrected"]).max() > 0.1  # p3 != p4


def test_random_runs_tell_every_failure(rng):
    dynamics, P = paper_arm("physical")
    runs = random_runs(dynamics, P, 8, 12, rng)
    content = runs.to_dict()
    assert 0 < content["converged"] < 8
    assert (content["runs"], content["most_iterations"], content["tolerance"]) == (8, 12, 1e-3)
    for failure in content["failures"]:
        assert runs.errors[:, failure["run"]].min() >= 1e-3
        assert re.match(r"slow: the error is .* after 12 iterations", failure["reason"])
    converged = np.setdiff1d(np.arange(8), [failure["run"] for failure in content["failures"]])
    for number, r in zip(content["iterations"], converged, strict=True):
        assert runs.errors[number, r] < 1e-3 <= runs.errors[number - 1, r]


def test_a_random_run_is_critically_damped_at_its_bandwidth(rng):
    dynamics, P = paper_arm("physical")
    runs = random_runs(dynamics, P, 2, 1, rng)
    drawn = runs.drawn
    for r, w in enumerate(drawn["gain"]):
        history = run_procedure(
            dynamics,
            partial(dynamics.acceleration, P=P),
            ProgramMotion(drawn["amplitude"][r], drawn["duration"][r]),
            drawn["guess"][[r]],
            settings=LoopSettings(alpha=2 * w, beta=w**2, iterations=1),
            offset=drawn["offset"][r],
        )
        np.testing.assert_allclose(history.relative_error(P)[:, 0], runs.errors[:, r], rtol=1e-9)
        np.testing.assert_allclose(history.tracking[:, 0], runs.history.tracking[:, r], rtol=1e-9)


@pytest.mark.parametrize(("change", "reason"), [
    ({"diverged": 3}, "the robot diverged from its program in iteration 3"),
    ({"skipped": 7}, "slow: the error is 0.4 after 1 iterations, with a decrease of 20 % in the "
     "last 1; 7 updates were omitted, since D(q, P^) was not positive definite"),
    ({"errors": [0.5, 0.6]}, "the error increased: from 0.5 to 0.6"),
    ({"errors": [0.5, 0.5]}, "stalled: the motion excites too little; the error is 0.5"),
    ({"errors": [0.9, 0.8, 0.5, *[0.48] * 9, 0.45]},
     "slow: the error is 0.45 after 12 iterations, with a decrease of 10 % in the last 10"),
    ({"errors": [0.8, *[0.7] * 8, 0.6]},
     "slow: the error is 0.6 after 9 iterations, with a decrease of 25 % in the last 9"),
    ({"errors": [0.9, *[0.4] * 11]},
     "stalled: the motion excites too little; the error is 0.4"),
])  # fmt: skip
def test_each_kind_of_failure_has_its_reason(change, reason, rng):
    dynamics, P = paper_arm("physical")
    runs = random_runs(dynamics, P, 1, 1, rng)
    errors = np.array(change.pop("errors", [0.5, 0.4]))[:, None]
    history = replace(runs.history, **{key: np.array([x]) for key, x in change.items()})
    found = replace(runs, errors=errors, history=history).to_dict()["failures"]
    assert [failure["reason"] for failure in found] == [reason]


def test_each_case_has_its_own_disturbance_and_noise(rng):
    cases = list(study.CASES.values())
    found = study._influences(cases, np.random.default_rng(4))
    is_noisy = np.array([[0.0], [0.0], [0.0], [1.0], [1.0]])
    for level, size in ((found.q, 1e-5), (found.v, 1e-4), (found.a, 1e-2)):
        np.testing.assert_array_equal(level, size * is_noisy)
    u = rng.standard_normal((5, 2))
    wanted = np.array([[0.0], [0.0], [0.1], [0.0], [0.0]]) * u
    wanted *= np.random.default_rng(4).uniform(-1.0, 1.0, (5, 2))
    np.testing.assert_allclose(found.torque(np.zeros(5), u), wanted)


FORMS = tuple(PARAMETER_NAMES)
#: Another possible arm, every field unlike the others, so that no term can hide behind a 0 or 1.
OTHER_LINKS = PlanarLinks(0.7, 0.4, 3.0, -0.3, 0.05, 0.9, 2.0, -0.15, -0.08, 0.3)
ARMS = pytest.mark.parametrize("links", [PAPER_LINKS, OTHER_LINKS], ids=["paper", "other"])


def random_states(n):
    """Yield n random states: q in +-pi rad, v in +-10 rad/s, a in +-20 rad/s^2."""
    rng = np.random.default_rng(0)
    for _ in range(n):
        yield tuple(rng.uniform(-bound, bound, 2) for bound in (np.pi, 10.0, 20.0))


def mass_matrix(q, P, form="corrected"):
    """Return D(q, P), with the columns G(q, 0, e_j) P."""
    return np.stack([regressor(q, 0 * e, e, form=form) @ P for e in np.eye(2)], axis=1)


@ARMS
@pytest.mark.parametrize("form", ["corrected", "corrected_five"])
def test_corrected_torque_equals_pinocchio(links, form):
    model = pin.buildModelFromXML(urdf_text(links))
    data = model.createData()
    P = parameters(links, form=form)
    for q, v, a in random_states(200):
        tau = pin.rnea(model, data, q, v, a)
        error = np.linalg.norm(regressor(q, v, a, form=form) @ P - tau)
        # rounding of terms of up to 1e4 N m in links of about 1 m
        assert error <= 1e-12 * np.linalg.norm(tau)


@ARMS
@pytest.mark.parametrize("form", FORMS)
def test_mass_matrix_is_that_of_equation_26(links, form):
    L1, L2, m1, m2 = links.L1, links.L2, links.m1, links.m2
    m1x, m2x, m2y = m1 * links.xbar1, m2 * links.xbar2, m2 * links.ybar2
    for q, _, _ in random_states(20):
        c2, s2 = np.cos(q[1]), np.sin(q[1])
        D22 = links.Izz2 + L2**2 * m2 + 2 * L2 * m2x
        D12 = links.Izz2 + (c2 * L1 * L2 + L2**2) * m2
        D12 += (c2 * L1 + 2 * L2) * m2x - L1 * s2 * m2y
        D11 = links.Izz1 + L1**2 * m1 + 2 * L1 * m1x + links.Izz2
        D11 += (2 * c2 * L1 * L2 + L1**2 + L2**2) * m2
        D11 += (2 * c2 * L1 + 2 * L2) * m2x - 2 * L1 * s2 * m2y
        D = mass_matrix(q, parameters(links, form=form), form=form)
        np.testing.assert_allclose(D, [[D11, D12], [D12, D22]], rtol=1e-13, atol=1e-13)


@ARMS
def test_printed_p4_takes_ybar_where_column_4_needs_xbar(links):
    printed = parameters(links, form="printed")
    mended = parameters(links, form="corrected_five")
    difference = links.L1 * links.m2 * (links.ybar2 - links.xbar2)
    np.testing.assert_allclose(printed - mended, [0, 0, 0, difference, 0], atol=1e-15)
    np.testing.assert_array_equal(mended[[0, 1, 2, 4]], parameters(links))


def test_printed_regressor_is_wrong_in_both_rows_of_column_4_only():
    for q, v, a in random_states(50):
        wrong = regressor(q, v, a, form="printed") - regressor(q, v, a, form="corrected_five")
        expected = np.zeros((2, 5))
        expected[:, 3] = np.sin(q[1]) * (v @ v) * np.array([1.0, -1.0])
        np.testing.assert_allclose(wrong, expected, atol=1e-12)
