"""Priors, bounds and baselines of a fit."""

from dataclasses import replace

import numpy as np
from helpers.fitting import fit
from helpers.synthetic import exact_log, truth
from scipy.optimize import lsq_linear

from robotid.data.signal_settings import SignalSettings
from robotid.dynamics.torque import joint_torque_regressor
from robotid.estimation.fitting.estimator_settings import EstimatorSettings
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel
from robotid.robot.prior import prior_spread

EXACT = SignalSettings(cutoff=None, trim=0.0, min_velocity=0.0, velocity="measured")


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


def test_drives_beside_the_urdf_are_those_of_bounded_least_squares_on_all_rows(ur5, rng):
    size = ur5.layout.n_inertial
    log = exact_log(ur5, truth(ur5), rng, noise=np.full(6, 0.3))
    log = replace(log, tau=log.tau - [9, 0, 0, 0, 0, 9] * log.v)  # no friction is negative
    found = fit(ur5, [log], signals=EXACT, estimator="wls")
    W = joint_torque_regressor(ur5, log.q, log.v, log.a)
    weight = np.tile(1 / found.wls.sigma, len(log.t))
    left = weight * (log.tau.ravel() - W[:, :size] @ ur5.standard_parameters()[:size])
    lowest = np.where(ur5.layout.is_nonnegative()[size:], 0.0, -np.inf)
    drives = lsq_linear(weight[:, None] * W[:, size:], left, (lowest, np.inf), method="bvls").x
    np.testing.assert_allclose(found.urdf_with_drives[size:], drives, rtol=1e-6, atol=1e-7)
    assert (drives[ur5.layout.is_nonnegative()[size:]] >= 0).all()
    np.testing.assert_array_equal(found.urdf_with_drives[:size], found.prior[:size])
