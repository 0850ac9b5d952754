"""How much the data say, against the dense regressor."""

import numpy as np
import pytest
from helpers.fitting import fit
from helpers.synthetic import exact_log, truth

from robotid.data.signal_settings import SignalSettings
from robotid.dynamics.torque import joint_torque_regressor
from robotid.output.report.torque_report import information
from robotid.robot.model import RobotModel


@pytest.fixture(scope="module")
def found(ur5):
    rng = np.random.default_rng(0)
    logs = [exact_log(ur5, truth(ur5), rng, samples=300, noise=0.1) for _ in range(2)]
    return fit(ur5, logs, estimator="wls")


def dense(found):
    """Return the weighted regressor of the rows used, whole."""
    model, rows = found.model, []
    for e in found.fitted:
        t, sigma = e.recording.trajectory, found.wls.sigma
        W = joint_torque_regressor(model, t.q, t.v, t.a, t.direction)[:, found.mapping.independent]
        weighted = W.reshape(len(t.t), model.n_rows, -1) / sigma[:, None]
        rows.append(weighted[e.recording.mask.astype(bool)])
    return np.concatenate(rows)


def test_correlation_is_that_of_the_inverse_of_the_normal_matrix(found):
    W = dense(found)
    C = np.linalg.inv(W.T @ W)
    std = np.sqrt(np.diag(C))
    np.testing.assert_allclose(information(found)[0], C / np.outer(std, std), atol=1e-6)


def test_the_share_of_the_data_is_that_of_a_bayesian_update(found):
    said = information(found)[1]
    K = found.mapping.K
    for b in (0, 7, 30):
        prior = float(K[b] ** 2 @ found.prior_std**2)
        data = found.wls.covariance[b, b]
        posterior = 1.0 / (1.0 / prior + 1.0 / data)
        assert said[b] == pytest.approx(1.0 - posterior / prior, rel=1e-9)


def test_directions_shrink_by_the_rows_that_are_independent_behind_the_filter(ur5):
    rng = np.random.default_rng(1)
    logs = [
        exact_log(ur5, truth(ur5), rng, samples=300, rate=rate, noise=0.1) for rate in (40.0, 50.0)
    ]
    found = fit(ur5, logs, signals=SignalSettings(cutoff=5.0), estimator="wls")
    share = 2 * 5.0 / 50.0  # the filter's band over that of the rows, of the log with most of them
    spread = np.sqrt(found.mapping.K**2 @ found.prior_std**2)
    size = np.linalg.svd(np.sqrt(share) * dense(found) * spread, compute_uv=False)
    np.testing.assert_allclose(found.determination.shrinkage, 1 / np.hypot(1, size), rtol=1e-6)


def test_what_the_data_leave_open_has_no_share_and_no_correlation(ur5, rng):
    log = exact_log(ur5, truth(ur5), rng, samples=300, noise=0.1)
    model = RobotModel.from_urdf(ur5.tree.path)
    still = np.zeros_like(log.v)
    still[:, 0] = log.v[:, 0]
    a = np.zeros_like(log.a)
    a[:, 0] = log.a[:, 0]
    q = np.tile(log.q[0], (len(log.t), 1))
    q[:, 0] = log.q[:, 0]
    tau = (joint_torque_regressor(model, q, still, a) @ truth(ur5)).reshape(q.shape)
    one = type(log)(t=log.t, q=q, tau=tau + 0.1 * rng.standard_normal(q.shape), v=still, a=a,
                    joints=log.joints)  # fmt: skip
    found = fit(model, [one])
    correlation, share = information(found)
    open_ones = np.isin(found.mapping.base_names, found.wls.undetermined)
    assert open_ones.sum() > 20
    assert (share[open_ones] == 0).all()
    assert np.isnan(correlation[open_ones]).all()
    assert (share[~open_ones] > 0).all()
