import numpy as np
import pytest

from robotid.base.exceptions import DataError
from robotid.estimation.fitting.evaluation import Metrics, TorqueSums

TAU = np.array([[1.0, 10.0], [-1.0, 10.0], [3.0, 12.0], [0.0, 12.0]])


def measure(tau, prediction, mask, names, units, baselines=None):
    return TorqueSums.of(tau, prediction, mask, baselines or {}).metrics(names, units)


def test_metrics_are_what_their_names_say():
    prediction = TAU + np.array([[0.1, 1.0]])
    mask = np.array([[True, True], [True, True], [True, False], [False, False]])
    metrics = measure(TAU, prediction, mask, ["a", "b"], ["N m", "N"], {"urdf": np.zeros((4, 2))})
    a, b = metrics.per_joint["a"], metrics.per_joint["b"]
    assert a.rmse == pytest.approx(0.1)
    assert a.relative_error_pct == pytest.approx(100 * np.sqrt(3 * 0.01) / np.sqrt(11))
    assert a.rows == 3
    assert a.baselines == {"urdf": 100.0}
    assert a.r2 == pytest.approx(1 - 0.03 / 8)
    assert a.better_than_constant
    assert b.unit == "N"
    assert b.r2 == 0.0  # its torque does not vary over the rows used
    assert not b.better_than_constant
    assert metrics.pooled_rmse == pytest.approx(np.sqrt((3 * 0.01 + 2 * 1.0) / 5))
    assert Metrics.from_dict(metrics.to_dict()) == metrics


def test_a_joint_without_rows_is_not_scored():
    mask = np.array([[True, False]] * 4)
    assert list(measure(TAU, TAU, mask, ["a", "b"], ["N m", "N m"]).per_joint) == ["a"]


def test_a_silent_torque_channel_has_no_relative_error():
    zeros = np.zeros((4, 1))
    metrics = measure(zeros, zeros + 1, np.ones((4, 1), dtype=bool), ["a"], ["N m"])
    assert metrics.per_joint["a"].relative_error_pct is None


def test_nothing_to_measure_is_an_error():
    with pytest.raises(DataError, match="0 torque rows are used"):
        measure(TAU, TAU, np.zeros((4, 2), dtype=bool), ["a", "b"], ["N m", "N m"])


def test_sums_of_parts_merge_into_those_of_the_whole(rng):
    tau, prediction, other = (5.0 + rng.standard_normal((50, 2)) for _ in range(3))
    mask = rng.uniform(size=(50, 2)) < 0.7
    mask[:20, 1] = False  # a part without rows of a joint
    parts = [
        TorqueSums.of(tau[k], prediction[k], mask[k], {"urdf": other[k]})
        for k in (slice(0, 20), slice(20, 20), slice(20, 50))
    ]
    merged = parts[0].merge(parts[1]).merge(parts[2]).metrics(["a", "b"], ["N m", "N"])
    whole = measure(tau, prediction, mask, ["a", "b"], ["N m", "N"], {"urdf": other})
    assert merged.pooled_rmse == pytest.approx(whole.pooled_rmse, rel=1e-13)
    for j, name in enumerate("ab"):
        found, rows = merged.per_joint[name], mask[:, j]
        residual = np.sum((tau - prediction)[rows, j] ** 2)
        wanted = 1 - residual / np.sum((tau[rows, j] - tau[rows, j].mean()) ** 2)
        assert found.r2 == pytest.approx(wanted)
        assert found.rows == rows.sum()
        assert found.relative_error_pct == pytest.approx(whole.per_joint[name].relative_error_pct)
        assert found.baselines == pytest.approx(whole.per_joint[name].baselines)
