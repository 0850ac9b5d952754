"""Terms that are offered, and what they gain in windows that they were not fitted to."""

from types import SimpleNamespace

import numpy as np
import pytest
from helpers.crane import identified_crane

from robotid.estimation.estimators.output_error import OutputError, linearised
from robotid.identification.closed_loop import further_parameters as term_choice
from robotid.identification.closed_loop.further_parameters import _Fold, _folds, _gains, candidates
from robotid.robot.drives import LoadFriction


def test_gains_are_those_of_fits_to_the_other_folds(rng):
    parts = [(rng.standard_normal((rows, 5)), rng.standard_normal(rows)) for rows in (12, 9, 15)]
    folds = [_Fold(A.T @ A, A.T @ b, len(b)) for A, b in parts]
    sets = {7: [1], 9: [4, 3]}
    found = _gains(folds, [0, 2], sets)
    for k, (A, b) in enumerate(parts):
        others = [part for i, part in enumerate(parts) if i != k]
        A_f, b_f = (np.concatenate(x) for x in zip(*others, strict=True))

        def left(columns, A=A, b=b, A_f=A_f, b_f=b_f):
            fitted = np.linalg.lstsq(A_f[:, columns], b_f, rcond=None)[0]
            return np.sum((A[:, columns] @ fitted - b) ** 2)

        for s, own in sets.items():
            assert found[s][k] == pytest.approx(left([0, 2]) - left([0, 2, *own]), rel=1e-9)


def test_folds_share_windows_in_turn_and_count_the_prior_once(tmp_path, monkeypatch):
    monkeypatch.setattr(term_choice, "_FOLDS", 3)
    found = identified_crane(tmp_path)
    simulator, theta = found.fit.simulator, found.estimate.theta + 0.01
    estimator = OutputError()
    folds = _folds(simulator, theta, estimator)
    parts = list(linearised(simulator, estimator.weights(simulator, theta), theta))
    assert len(parts) == len(simulator.windows) > 3
    for k, fold in enumerate(folds):
        H = np.diag(simulator.prior_std**-2.0) / 3
        g = (simulator.prior - theta) / simulator.prior_std**2 / 3
        rows = 0
        for A, b, columns in parts[k::3]:
            wide = np.zeros((len(b), len(theta)))
            wide[:, columns] = A
            H, g, rows = H + wide.T @ wide, g + wide.T @ b, rows + len(b)
        np.testing.assert_allclose(fold.H, H, rtol=1e-9, atol=1e-9 * np.abs(H).max())
        np.testing.assert_allclose(fold.g, g, rtol=1e-9, atol=1e-9 * np.abs(g).max())
        assert fold.rows == rows // 2  # of one joint of two

    def halved(*_):
        """Yield two parts of each window, as of a robot of two arms."""
        for A, b, columns in parts:
            cut = len(b) // 3
            yield A[:cut], b[:cut], columns
            yield A[cut:], b[cut:], columns

    monkeypatch.setattr(term_choice, "linearised", halved)
    for fold, other in zip(folds, _folds(simulator, theta, estimator), strict=True):
        np.testing.assert_allclose(other.H, fold.H, rtol=1e-9, atol=1e-9 * np.abs(fold.H).max())
        np.testing.assert_allclose(other.g, fold.g, rtol=1e-9, atol=1e-9 * np.abs(fold.g).max())
        assert other.rows == fold.rows


def test_terms_are_offered_in_the_size_of_motion_and_torque():
    t = 7.0 + np.arange(400) / 200.0  # two windows of a second, one of them in the log's middle
    q = np.column_stack(
        [0.2 + 0.5 * np.sin(2 * np.pi * t), 0.02 * np.sin(4 * np.pi * t), 0.0 * t + 1.0]
    )
    windows = [
        SimpleNamespace(log=SimpleNamespace(t=t, q=q), counted=part)
        for part in (slice(0, 200), slice(200, 400))
    ]
    model = SimpleNamespace(joints=("wide", "narrow", "still"))
    simulator = SimpleNamespace(robot=SimpleNamespace(model=model), windows=windows)
    offered = candidates(simulator, np.array([8.0, 3.0, 1.0]))
    assert [[u.name for u in free_parameters] for free_parameters in offered] == [
        ["wide.stribeck"], ["wide.load"], ["wide.coulomb_q1", "wide.coulomb_q2"],
        ["narrow.stribeck"], ["narrow.load"],
    ]  # fmt: skip
    found = {u.name: u for free_parameters in offered for u in free_parameters}
    for name, amplitude, rate in (("wide", 0.5, 1.0), ("narrow", 0.02, 2.0)):
        rms = amplitude * 2 * np.pi * rate / np.sqrt(2)
        assert found[f"{name}.stribeck"].term.speed == pytest.approx(0.3 * rms, rel=0.01)
    spread = {name: u.spread for name, u in found.items()}
    assert spread == pytest.approx({
        "wide.stribeck": 8.0, "wide.load": 1.0, "wide.coulomb_q1": 8.0 / 0.5,
        "wide.coulomb_q2": 8.0 / 0.5**2, "narrow.stribeck": 3.0, "narrow.load": 1.0,
    }, rel=1e-3)  # fmt: skip
    for order in (1, 2):
        term = found[f"wide.coulomb_q{order}"].term
        assert (term.order, term.centre) == (order, pytest.approx(0.2, abs=1e-3))
        assert term.data_range == pytest.approx((-0.3, 0.7), abs=1e-3)
    bounds = {name: (u.lowest, u.highest) for name, u in found.items()}
    free, load = (-np.inf, np.inf), (0.0, LoadFriction.highest)
    assert bounds == {n: load if n.endswith("load") else free for n in found}
    assert load[1] < 1.0, "a gear that loses its whole load has no unique motion"
