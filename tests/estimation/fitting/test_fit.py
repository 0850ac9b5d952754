"""Steps of a fit that other tests see only in part."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.fitting import fit
from helpers.synthetic import exact_log, truth

from robotid.data.signal_settings import SignalSettings
from robotid.dynamics.base_parameters import BaseMapping
from robotid.estimation.fitting.estimator_settings import (
    EstimatorSettings,
    Known,
)
from robotid.estimation.fitting.fit import rough_choice
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel
from robotid.robot.prior import prior_spread


@pytest.mark.parametrize(("weight", "rough"), [("auto", 1.0), ("evidence", 1.0), (2.5, 2.5)])
def test_rough_settings_keep_a_stated_weight_and_draw_nothing(weight, rough):
    choice = EstimatorSettings("consistent", prior_weight=weight)
    assert rough_choice(choice) == replace(choice, prior_weight=rough)
    least_squares = EstimatorSettings("wls", robust="huber")
    assert rough_choice(least_squares) is least_squares


def test_a_base_parameter_of_terms_at_their_bound_alone_has_no_error(rng):
    model = RobotModel.from_urdf(example_urdf("double_pendulum_simple.urdf"))
    joint = model.joints[1]
    log = exact_log(model, truth(model), rng, samples=250, noise=np.array([0.5, 0.1]))
    log = replace(log, tau=log.tau - [0.0, 9.0] * log.v)  # negative friction of the second joint
    choice = EstimatorSettings("consistent", prior_weight=1.0)
    found = fit(model, [log], signals=SignalSettings(cutoff=None, trim=0.0), estimator=choice)
    K = found.mapping.K
    at_bound = set(np.flatnonzero(found.at_bound))
    wanted = np.array([at_bound >= set(np.flatnonzero(row)) for row in K])
    assert found.mapping.base_names[int(np.flatnonzero(wanted)[0])] == f"{joint}.viscous"
    is_open = np.isinf(found.base_error)
    np.testing.assert_array_equal(is_open, wanted)
    C = found.standard_covariance
    np.testing.assert_allclose(found.base_error[~is_open] ** 2, np.diag(K @ C @ K.T)[~is_open])


def test_what_is_known_of_base_parameters_follows_from_the_standard_ones(rng):
    K = np.hstack([np.eye(3), rng.standard_normal((3, 2))])
    mapping = BaseMapping(K, np.arange(3), tuple("abcde"), np.ones(5))
    pi, spread = rng.standard_normal(5), np.array([0.1, 2.0, 0.5, 7.0, 1.5])
    known = Known(None, mapping, pi, spread, 0.3, np.ones(2))
    np.testing.assert_allclose(known.beta, K @ pi)
    np.testing.assert_allclose(known.covariance, K @ np.diag(spread**2) @ K.T)


def test_the_prior_of_a_fit_has_the_scale_of_the_samples_of_all_logs(rng):
    model = RobotModel.from_urdf(example_urdf("double_pendulum_simple.urdf"))
    logs = [exact_log(model, truth(model), rng, samples=n, noise=0.3) for n in (130, 70)]
    logs[1] = replace(logs[1], tau=9.0 * logs[1].tau)
    found = fit(model, logs, signals=SignalSettings(cutoff=None, trim=0.0), estimator="wls")
    motions = [e.recording.trajectory for e in found.fitted]
    squares = sum(np.array([np.sum(x**2, axis=0) for x in (m.tau, m.v, m.a)]) for m in motions)
    samples = sum(len(m.t) for m in motions)
    np.testing.assert_allclose(found.prior_std, prior_spread(model, squares, samples))
    np.testing.assert_array_equal(found.prior, model.standard_parameters())
    K = found.mapping.K
    C = np.diag(found.prior_std**2)  # the nearest to the prior in units of its spread
    gain = C @ K.T @ np.linalg.inv(K @ C @ K.T)
    wanted = found.prior + gain @ (found.estimate.theta - K @ found.prior)
    np.testing.assert_allclose(found.standard, wanted, atol=1e-9)
    np.testing.assert_allclose(found.base, found.estimate.theta, atol=1e-9)
    np.testing.assert_allclose(found.base_error, found.estimate.std_error)
    np.testing.assert_allclose(found.wls.theta, found.estimate.theta, rtol=1e-6)
