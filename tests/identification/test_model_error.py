"""Errors of drive parameters count what the model of the drives lacks, and what its shapes may be.

The truth of a parameter is that of the robot that made the log: Coulomb friction is what it is
without load, whether the model that is fitted knows of load friction or not.
"""

from dataclasses import replace

import numpy as np
import pytest
from helpers.driven import ELBOW, LIFT, driven, driven_log, found_in

from robotid.diagnosis.residual.misfit import find_misfits
from robotid.diagnosis.residual.term_trials import take_sample
from robotid.dynamics.torque import trajectory_regressor
from robotid.estimation.fitting.drive_terms import open_torques
from robotid.estimation.fitting.fitted import expected_band, friction_curve
from robotid.identification.drive_choice import choose_drives
from robotid.robot.drives import LoadFriction, Stribeck

QUANTILE = 1.5
PLAIN = "viscous+coulomb"


@pytest.fixture(scope="module")
def loaded(model):
    """A robot whose elbow has load friction, its parameters by name, and its log."""
    true, pi = driven(model, {ELBOW: [LoadFriction()]}, {f"{ELBOW}.load": 0.1})
    names = dict(zip(true.layout.names, pi, strict=True))
    return names, driven_log(true, pi, 3, reach=QUANTILE)


@pytest.fixture(scope="module")
def hooked(model):
    true, pi = driven(model, {ELBOW: [Stribeck(speed=0.1)]}, {f"{ELBOW}.stribeck": 3.0})
    names = dict(zip(true.layout.names, pi, strict=True))
    return names, driven_log(true, pi, 3, reach=QUANTILE)


@pytest.fixture(scope="module")
def fits(model, request):
    """Fits of these robots by name and friction, each made when it is first asked for."""
    made = {}

    def fit(robot, friction):
        key = robot, str(friction)
        if key not in made:
            _, log = request.getfixturevalue(robot)
            slower = replace(log, t=1.4 * log.t, v=None, a=None)  # at other speeds, other loads
            made[key] = found_in(
                model, [log], validation=[slower], friction=friction, estimator="wls"
            )
        return made[key]

    return fit


def at(found, name):
    return list(found.model.layout.names).index(name)


def test_coulomb_friction_that_stands_on_a_misfit_covers_the_truth(loaded, fits):
    true, found = loaded[0], fits("loaded", PLAIN)
    (misfit,) = found.misfits
    assert (misfit.joint, misfit.term.code) == (ELBOW, "load_friction")
    assert misfit.size == pytest.approx(0.1, abs=0.015)
    coulomb = f"{ELBOW}.coulomb"
    assert coulomb in found.on_misfit
    k, b = at(found, coulomb), found.mapping.base_names.index(coulomb)
    noise_alone = found.wls.std_error[b]
    miss = abs(found.standard[k] - true[coulomb])
    assert miss > 5.0 * noise_alone  # it took a part of the load's
    assert found.standard_error[k] > 5.0 * noise_alone
    assert miss < 1.96 * found.standard_error[k]
    assert found.base_interval[b, 0] < true[coulomb] < found.base_interval[b, 1]
    (said,) = [f for f in found.findings if f.code == "load_friction"]
    assert f"{coulomb} stand" in said.message or f"{coulomb}, " in said.message


def test_what_a_misfit_moves_is_what_a_fit_with_the_term_finds(fits):
    """The oracle: the same log fitted with the term."""
    found, better = fits("loaded", PLAIN), fits("loaded", {ELBOW: "load", "*": "none"})
    (misfit,) = found.misfits
    sample = take_sample(found)
    shift = sample.U.T @ misfit.shift  # base parameters
    for name in (f"{ELBOW}.coulomb", f"{ELBOW}.viscous", f"{LIFT}.coulomb"):
        b = found.mapping.base_names.index(name)
        moved = better.standard[at(better, name)] - found.standard[at(found, name)]
        assert shift[b] == pytest.approx(moved, abs=3.0 * better.standard_error[at(better, name)])
        before = found.wls.std_error[b]
        assert found.base_error[b] == pytest.approx(np.hypot(before, shift[b]), rel=1e-6)
        is_wide = found.base_error[b] > 1.3 * before
        assert (name in found.on_misfit) == is_wide


@pytest.mark.parametrize(("robot", "family"), [("loaded", "load"), ("hooked", "stribeck")])
def test_a_prediction_errs_by_what_a_missing_term_moves_and_by_its_torque(
    model, robot, family, fits
):
    """The oracle: how much the prediction changes once the term is in the model."""
    joint = model.joints.index(ELBOW)
    found, better = (fits(robot, x) for x in (PLAIN, {ELBOW: family, "*": "none"}))
    (term,) = (term for term in found.open_terms if term.joint == ELBOW)
    pure = found.standard_covariance - sum(np.outer(x.moves, x.moves) for x in found.open_terms)
    assert np.linalg.eigvalsh(pure).min() > -1e-9 * np.linalg.eigvalsh(pure).max()
    for one, other in zip(
        (*found.fitted, *found.validation), (*better.fitted, *better.validation), strict=True
    ):
        band = expected_band(found, one)
        changed = (other.torques["estimate"] - one.torques["estimate"])[band.samples, joint]
        W = trajectory_regressor(found.model, one.recording.trajectory.at(band.samples))
        W = W.reshape(len(band.samples), -1, W.shape[1])[:, joint]
        model = found.model.with_reference(found.standard)
        (torque,) = open_torques(model, [term], one.recording, band.samples)
        errs = W @ term.moves + torque[:, joint]
        assert np.sqrt(np.mean((errs - changed) ** 2)) < 0.2 * np.sqrt(np.mean(changed**2))
        assert not torque[:, :joint].any()
        others = [x for x in found.open_terms if x is not term]
        wanted = np.einsum("ij,jk,ik->i", W, pure, W) + errs**2
        wanted += sum((W @ x.moves) ** 2 for x in others)
        np.testing.assert_allclose(band.parameters[:, joint] ** 2, wanted, rtol=1e-6)
    v = np.array([-1.0, -0.3, 0.3, 1.0])
    curves = [friction_curve(x, ELBOW, v, load=20.0) for x in (found, better)]
    changed = curves[1].torque - curves[0].torque
    np.testing.assert_allclose(curves[0].std, np.abs(changed), atol=0.3 * np.abs(changed).max())


def test_an_error_of_a_shape_moves_parameters_as_refits_do(model, hooked, fits):
    """The oracle: fits with the shape stated, larger and smaller by its standard error."""
    true, log = hooked
    found = fits("hooked", {ELBOW: "stribeck", "*": "none"})
    (choice,) = found.drives
    (shape,) = choice.shapes
    sure = {}
    for size in (shape.value - shape.std_error, shape.value, shape.value + shape.std_error):
        (term,) = choice.terms
        own = Stribeck(speed=size, data_range=term.data_range)
        known = model.with_terms({ELBOW: [own]})
        sure[size] = found_in(known, [log], friction="none", estimator="wls")
    low, middle, high = sure.values()
    for term in ("stribeck", "coulomb", "viscous"):
        k = at(found, f"{ELBOW}.{term}")
        moved = 0.5 * (high.standard[k] - low.standard[k])
        wanted = np.hypot(middle.standard_error[k], moved)
        assert found.standard_error[k] == pytest.approx(wanted, rel=0.05), term
        by_one_error = found.open_terms[0].moves[k]  # of either sign
        assert abs(by_one_error) == pytest.approx(abs(moved), rel=0.1), term
        assert abs(found.standard[k] - true[f"{ELBOW}.{term}"]) < 2.6 * found.standard_error[k]
    k = at(found, f"{ELBOW}.stribeck")
    assert found.standard_error[k] > 1.1 * middle.standard_error[k]
    # the curve itself bends with the shape: at a speed it moves less or more than its parameters
    v = np.array([0.05, 0.1, 0.3, 1.0])
    curves = [friction_curve(x, ELBOW, v).torque for x in (low, high)]
    bent = 0.5 * (curves[1] - curves[0])
    wanted = np.hypot(friction_curve(middle, ELBOW, v).std, bent)
    np.testing.assert_allclose(friction_curve(found, ELBOW, v).std, wanted, rtol=0.05)


def test_a_clean_robot_has_the_errors_of_its_noise(model):
    true, pi = driven(model, {}, {})
    found = found_in(
        model, [driven_log(true, pi, 3, reach=QUANTILE)], friction=PLAIN, estimator="wls"
    )
    assert find_misfits(take_sample(found)) == found.misfits == ()
    np.testing.assert_allclose(found.base_error, found.wls.std_error)
    assert choose_drives(found, dict.fromkeys(found.model.joints, ())) == ()
