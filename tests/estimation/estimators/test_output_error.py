from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from scipy.signal import lfilter

from robotid.base.exceptions import DataError, NotConvergedError
from robotid.estimation.estimators.output_error import OutputError, Residual

DT, RHO, SIGMA = 0.02, 0.9, 0.02
TRUTH = np.array([1.5, 0.3, 0.1])  # gain, time constant [s], offset


@dataclass(frozen=True, eq=False)
class Lagging:
    """First-order lags with a gain and an offset that follow held commands, window by window."""

    told: np.ndarray  # (W, N), N samples of W windows
    measured: np.ndarray  # likewise
    prior: np.ndarray
    prior_std: np.ndarray
    bounds: np.ndarray
    further: np.ndarray = field(default_factory=lambda: np.zeros((0, 4)))  # rows A theta = b
    names: tuple[str, ...] = ("gain", "time", "offset")

    def simulated(self, theta):
        gain, time, offset = theta
        if not time > 0:
            raise NotConvergedError("a lag needs a time constant above 0", "no lag")
        a = np.exp(-DT / time)
        return gain * lfilter([0.0, 1.0 - a], [1.0, -a], self.told, axis=1) + offset

    def rows(self, theta):
        A, b = self.further[:, :-1], self.further[:, -1]
        return A, b - A @ theta

    def residuals(self, theta, *, with_slopes, with_starts=False):
        e = self.measured - self.simulated(theta)
        slopes = None
        if with_slopes:
            gain, time, _ = theta
            a = np.exp(-DT / time)
            y = lfilter([0.0, 1.0 - a], [1.0, -a], self.told, axis=1)
            # y_k = a y_(k-1) + (1 - a) u_(k-1), so dy = a dy + da (y - u)
            late = lfilter([0.0, 1.0], [1.0, -a], y - self.told, axis=1) * a * DT / time**2
            slopes = np.stack([y, gain * late, np.ones_like(y)], axis=-1)
        joints, columns = np.array([0]), np.arange(3)
        return [
            Residual(e[w, :, None], None if slopes is None else slopes[w, :, None], joints, columns)
            for w in range(len(e))
        ]


def lagging(rng, *, rho=RHO, sigma=SIGMA, windows=24, samples=120, **changes):
    told = np.repeat(rng.standard_normal((windows, samples // 10)), 10, axis=1)
    exact = Lagging(told, told, np.zeros(3), np.full(3, np.inf), UNBOUNDED)
    white = sigma * rng.standard_normal(told.shape)
    white[:, 0] /= np.sqrt(1.0 - rho**2)
    noise = lfilter([1.0], [1.0, -rho], white, axis=1)
    return replace(exact, measured=exact.simulated(TRUTH) + noise, **changes)


START = np.array([1.0, 0.2, 0.0])
UNBOUNDED = np.outer([-1.0, 1.0], np.full(3, np.inf))


@pytest.mark.parametrize("bounds", [(2.0, np.inf), (-np.inf, 1.2)])
def test_a_bound_holds_and_is_named(rng, bounds):
    lag = lagging(rng, bounds=np.array([bounds, (0.0, np.inf), (-np.inf, np.inf)]).T)
    found = OutputError().fit(lag, START)
    assert found.theta[0] in bounds
    assert found.details["at_bound"] == ("gain",)
    fixed = lag.measured - lag.simulated(found.theta)
    nearby = [lag.simulated(found.theta + np.array([0.0, d, 0.0])) for d in (-0.02, 0.02)]
    whitened = [np.sum(np.diff(lag.measured - s, axis=1) ** 2) for s in nearby]
    assert np.sum(np.diff(fixed, axis=1) ** 2) < min(whitened), "the others are at their best"


def test_a_prior_weighs_as_an_observation(rng):
    lag = lagging(rng)
    free = OutputError().fit(lag, START)
    prior, spread = free.theta + 3 * free.std_error, free.std_error
    both = OutputError().fit(replace(lag, prior=prior, prior_std=spread), START)
    middle = (free.theta + prior) / 2  # of two that are equally sure
    assert (np.abs(both.theta - middle) < 0.2 * np.abs(prior - free.theta)).all()
    assert (both.std_error < 0.9 * free.std_error).all()
    held = OutputError().fit(replace(lag, prior=prior, prior_std=np.full(3, 1e-9)), START)
    np.testing.assert_allclose(held.theta, prior, atol=1e-6)
    assert held.undetermined == lag.names


def test_a_step_that_cannot_be_simulated_is_shortened(rng):
    """From far away, the first full step leads to a time constant below 0."""
    lag = lagging(rng, sigma=1e-6)
    start = np.array([0.1, 5.0, 0.0])
    found = OutputError(whitens=False, steps=80).fit(lag, start)
    np.testing.assert_allclose(found.theta, TRUTH, rtol=1e-3)
    exact = OutputError().fit(lagging(rng, sigma=1e-9), START)
    np.testing.assert_allclose(exact.theta, TRUTH, rtol=1e-6)
    assert (exact.converged, exact.undetermined, exact.names) == (True, (), lag.names)


def test_a_start_that_cannot_be_simulated_is_refused(rng):
    with pytest.raises(NotConvergedError, match=r"time constant above 0"):
        OutputError().fit(lagging(rng), np.array([1.0, -1.0, 0.0]))


def test_fewer_samples_than_parameters_are_refused(rng):
    lag = lagging(rng, windows=1)
    short = replace(lag, told=lag.told[:, :2], measured=lag.measured[:, :2])
    with pytest.raises(DataError, match=r"2 samples of position for 3 parameters"):
        OutputError(whitens=False).fit(short, START)


@dataclass(frozen=True, eq=False)
class Started(Lagging):
    """The same, where a window's start adds what fades away."""

    def residuals(self, theta, *, with_slopes, with_starts=False):
        found = super().residuals(theta, with_slopes=with_slopes)
        fades = 0.97 ** np.arange(self.told.shape[1])[:, None, None]
        return [replace(r, by_start=fades) if with_slopes or with_starts else r for r in found]


def test_a_step_of_parameters_and_starts_together_settles_what_held_starts_bind(rng):
    lag = lagging(rng)
    fades = 0.97 ** np.arange(lag.told.shape[1])
    off = lag.measured + rng.standard_normal((len(lag.told), 1)) * fades
    simulator = Started(**{**vars(lag), "measured": off})
    exact = OutputError(frees=True).fit(simulator, START)
    held = OutputError().fit(simulator, START)
    assert (np.abs(held.theta - exact.theta) > 0.5 * exact.std_error).any()
    settled = OutputError().settle(simulator, held)
    assert np.abs((settled.theta - exact.theta) / exact.std_error).max() < 0.02
    np.testing.assert_allclose(settled.sigma, exact.sigma, rtol=5e-3)
    near = OutputError().settle(simulator, exact)
    np.testing.assert_allclose(settled.std_error, near.std_error, rtol=0.02)
    assert (settled.n_iter, settled.message) == (held.n_iter, held.message)
    low = replace(simulator, bounds=np.array([[-np.inf, -np.inf, 0.2], np.full(3, np.inf)]))
    settled = OutputError().settle(low, replace(held, theta=np.array([1.5, 0.3, 0.2001])))
    assert settled.theta[2] == 0.2
    assert settled.details["at_bound"] == ("offset",)


def test_a_step_to_parameters_that_cannot_be_simulated_is_not_taken(rng):
    simulator = Started(**vars(lagging(rng)))
    near, far = np.array([1.4, 0.31, 0.1]), np.array([1.5, 1.5, 0.1])  # and then below 0 s
    moved = OutputError().joint_step(simulator, near)
    assert np.abs(moved - near).max() > 1e-3
    np.testing.assert_array_equal(OutputError().joint_step(simulator, far), far)
    held = OutputError().fit(simulator, START)
    with pytest.raises(NotConvergedError, match="a lag needs"):
        OutputError().settle(simulator, replace(held, theta=far))


@pytest.mark.parametrize("spread", [np.inf, 0.01])
def test_a_covariance_is_of_scores_rows_and_prior_together(rng, spread):
    """Bell and McCaffrey's scatter of segments; rows and prior are as sure as they say."""
    lag = lagging(rng, windows=16, prior=TRUTH + 0.003, prior_std=np.full(3, spread))
    further = np.array([[400.0, -100.0, 30.0, 575.0], [0.0, 500.0, 0.0, 150.0]])
    estimator = OutputError(whitens=False)
    lag = replace(lag, further=further)
    found = estimator.fit(lag, START)
    sigma = found.sigma[0]
    meat, H = further[:, :3].T @ further[:, :3] + np.eye(3) / spread**2, 0.0
    segments = []
    for r in lag.residuals(found.theta, with_slopes=True):
        rows = np.hstack([r.slopes[1:, 0], r.e[1:]]) / sigma  # whitened by a correlation of 0
        segments += np.array_split(rows, 3)
        H = H + rows[:, :3].T @ rows[:, :3]
    bread = np.linalg.inv(H + meat)
    for rows in segments:  # 48 of them
        A, e = rows[:, :3], rows[:, 3]
        values, vectors = np.linalg.eigh(np.eye(len(A)) - A @ bread @ A.T)
        assert values.min() > 0.05
        score = A.T @ (vectors @ ((vectors.T @ e) / np.sqrt(values)))
        meat = meat + np.outer(score, score)
    wanted = bread @ meat @ bread
    own, least = np.sqrt(np.diag(wanted)), np.sqrt(np.diag(bread))
    assert (own > 1.1 * least).any()
    wider = np.maximum(own, least) / own
    np.testing.assert_allclose(found.covariance, wanted * np.outer(wider, wider), rtol=1e-5)


@pytest.mark.parametrize("spread", [0.1, 1e-12])  # a known parameter beside a free one
def test_other_residuals_move_an_estimate_by_its_normal_equations(rng, spread):
    """Whitened by the other residuals, free starts taken out, without parameters at a bound."""
    one = lagging(rng, windows=5)
    other = replace(one, measured=one.measured + SIGMA * rng.standard_normal(one.told.shape))
    theta, std = np.array([1.4, 0.32, 0.1]), np.array([2.0, spread, 0.3])
    known = {"prior": np.array([1.3, 0.4, 0.0]), "prior_std": std}
    known["further"] = np.array([[3.0, -5.0, 1.0, 0.5]])
    known["bounds"] = np.array([[-np.inf, 0.0, 0.1], np.full(3, np.inf)])  # the offset is at one
    simulators = [Started(**{**vars(lag), **known}) for lag in (one, other)]
    change, error = OutputError(inflation=3.0).moved(*simulators, theta)
    e = [lag.measured - one.simulated(theta) for lag in (one, other)]
    rho = np.sum(e[1][:, 1:] * e[1][:, :-1]) / np.sum(e[1][:, :-1] ** 2)
    assert 0.1 < rho < 0.95
    sigma = np.sqrt(3.0 * np.mean((e[1][:, 1:] - rho * e[1][:, :-1]) ** 2))
    slopes = np.stack([r.slopes[:, 0] for r in one.residuals(theta, with_slopes=True)])
    fades = 0.97 ** np.arange(one.told.shape[1])
    u = fades[1:] - rho * fades[:-1]
    without = np.eye(len(u)) - np.outer(u, u) / (u @ u)
    A = without @ (slopes[:, 1:] - rho * slopes[:, :-1]) / sigma
    H = np.einsum("wki,wkl->il", A, A) + np.diag(std**-2.0)
    H += known["further"][:, :3].T @ known["further"][:, :3]
    pulls = [np.einsum("wki,wk->i", A, (x[:, 1:] - rho * x[:, :-1]) @ without / sigma) for x in e]
    inverse = np.linalg.inv(H[:2, :2])
    wanted = inverse @ (pulls[1] - pulls[0])[:2]
    np.testing.assert_allclose(change, [*wanted, 0.0], rtol=1e-9, atol=1e-8 * spread)
    np.testing.assert_allclose(error, [*np.sqrt(np.diag(inverse)), 0.0], rtol=1e-9)


def test_residuals_of_larger_variance_count_less_beside_further_rows(rng):
    lag = lagging(rng)
    row = np.array([[30.0, 0.0, 0.0, 30.0 * 1.6]])  # says 1.6 of the gain, which is 1.5
    less = OutputError(inflation=4.0).fit(replace(lag, further=row), START)
    same = OutputError().fit(replace(lag, further=2.0 * row), START)
    plain = OutputError().fit(replace(lag, further=row), START)
    np.testing.assert_allclose(less.theta, same.theta, rtol=1e-6)
    np.testing.assert_allclose(less.sigma, same.sigma, rtol=1e-6)
    assert plain.theta[0] + 0.002 < less.theta[0] < 1.6
    assert less.details["inflation"] == pytest.approx(same.details["inflation"], rel=1e-4)


def test_standard_errors_of_what_drifts_are_the_scatter_of_many_drifts():
    """What an input's noise adds up to: whitening leaves much of it, as long as a window goes."""
    rng = np.random.default_rng(9)
    draws = []
    for _ in range(60):
        lag = lagging(rng, windows=20, samples=160)
        drift = 0.002 * np.cumsum(rng.standard_normal(lag.told.shape), axis=1)
        own = {**vars(lag), "measured": lag.simulated(TRUTH) + drift}
        draws.append(OutputError(frees=True, rounds=2).fit(Started(**own), TRUTH))
    theta = np.array([d.theta for d in draws])
    ratio = np.mean([d.std_error for d in draws], axis=0) / theta.std(axis=0)
    assert ((ratio > 0.8) & (ratio < 1.25)).all(), ratio
