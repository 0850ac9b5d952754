from dataclasses import replace

import numpy as np
from helpers.fitting import fit
from helpers.synthetic import exact_log, truth
from scipy.optimize import lsq_linear

from robotid.data.signal_settings import SignalSettings
from robotid.dynamics.torque import joint_torque_regressor

EXACT = SignalSettings(cutoff=None, trim=0.0, min_velocity=0.0, velocity="measured")


def test_the_drives_of_a_true_urdf_are_found_exactly(ur5, rng):
    pi = ur5.standard_parameters()
    size = ur5.layout.n_inertial
    pi[size:] = truth(ur5)[size:]
    log = exact_log(ur5, pi, rng)
    found = fit(ur5, [log], validation=[log], signals=EXACT, estimator="wls")
    np.testing.assert_allclose(found.urdf_with_drives, pi, rtol=1e-6, atol=1e-8)
    measured = found.metrics().per_joint["elbow_joint"]
    assert measured.baselines["urdf_with_drives"] < 1e-5 < measured.baselines["urdf"]


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
