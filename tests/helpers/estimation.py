"""One list of estimators, and the problems that they are tried on. A new estimator is one line."""

from dataclasses import replace

import numpy as np

from helpers.synthetic import exact_log, truth
from robotid.data.log import Trajectory
from robotid.data.signal_settings import SignalSettings
from robotid.data.signals import process
from robotid.dynamics.base_parameters import structural_mapping
from robotid.dynamics.factors import Problem
from robotid.dynamics.torque import build_problem, joint_torque_regressor
from robotid.estimation.estimators import (
    OLS,
    PRX,
    RLS,
    TLS,
    WLS,
    Consistent,
    Kalman,
    NormalisedGradient,
)
from robotid.robot.prior import prior_spread

EXACT = SignalSettings(cutoff=None, trim=0.0, min_velocity=0.0)
NOISE = np.array([4.0, 2.0, 1.0, 0.3, 0.2, 0.1])  # [N m]


class Case:
    """A robot, its true parameters and a problem made of them."""

    def __init__(self, model, rng, noise=None, **options):
        log = exact_log(model, truth(model), rng, noise=noise, **options)
        self._describe(model, process(log, EXACT), noise)
        self.problem = self.mapping.reduce(build_problem(model, self.trajectory))

    def _describe(self, model, trajectory, noise):
        self.model, self.trajectory = model, trajectory
        self.sigma = np.full(len(model.joints), 1e-2) if noise is None else noise
        self.pi = truth(model)
        self.mapping = structural_mapping(model)
        self.beta = self.mapping.to_base(self.pi)

    def base(self, estimate):
        theta = estimate.theta
        return theta if len(theta) == len(self.beta) else self.mapping.to_base(theta)


class RandomStates(Case):
    """The same without noise, from samples that have nothing to do with each other."""

    def __init__(self, model, rng, samples=1000):
        n = len(model.joints)
        q = rng.uniform(-np.pi, np.pi, (samples, n))
        v, a = rng.uniform(-2, 2, (samples, n)), rng.uniform(-5, 5, (samples, n))
        W = joint_torque_regressor(model, q, v, a)
        tau = (W @ truth(model)).reshape(samples, n)
        t, segment = np.arange(samples) / 50.0, np.zeros(samples, dtype=int)
        self._describe(model, Trajectory(t, q, v, a, tau, model.joints, 50.0, segment), None)
        columns = self.mapping.independent
        block = (W[:, columns], W[:, columns] @ self.beta, np.ones(len(W)))
        names, support = self.mapping.base_names, model.support[:, columns]
        self.problem = Problem(lambda: iter([block]), names, n, support)


def consistent(case, **options):
    prior = case.model.standard_parameters()
    spread = prior_spread(case.model, case.trajectory.squares, len(case.trajectory.t))
    return Consistent(case.model.layout, case.mapping.K, prior, spread, **options)


def still_wrist(model, rng):
    """Return a case whose last joint never moves."""
    case = Case(model, rng, NOISE)
    q, v, a = (np.array(getattr(case.trajectory, key)) for key in ("q", "v", "a"))
    q[:, 5], v[:, 5], a[:, 5] = 0.3, 0.0, 0.0
    case.trajectory = replace(case.trajectory, q=q, v=v, a=a)
    case.problem = case.mapping.reduce(build_problem(model, case.trajectory))
    return case


def _descent(kind, passes=10):
    return lambda case: kind(case.sigma, average=False, passes=passes, rng=np.random.default_rng(0))


def _kalman(case):
    return Kalman(case.sigma, 0 * case.beta, 1e2 + 0 * case.beta, gate=None)


#: How each is made for a case, and how near it comes to the truth without noise, relative.
ESTIMATORS = {
    "ols": (lambda case: OLS(), 1e-8),
    "wls": (lambda case: WLS(), 1e-8),
    "tls": (lambda case: TLS(regressor_noise=1e-9), 1e-8),
    "consistent": (consistent, 1e-8),
    "rls": (lambda case: RLS(case.sigma), 1e-9),
    # the covariance form keeps half the digits of P / sigma^2, which starts at 1e8 here
    "kalman": (_kalman, 1e-6),
    "prx": (_descent(PRX), 1e-9),
    # one number for all rows: the rate is that of the worst column
    "gradient": (_descent(NormalisedGradient, passes=20), 1e-4),
}
