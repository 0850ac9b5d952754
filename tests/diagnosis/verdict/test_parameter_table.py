"""The table of parameters: every parameter once, with what result.json says of it."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from robotid.diagnosis.verdict import parameter_table
from robotid.diagnosis.verdict.fit_findings import correlated_findings
from robotid.diagnosis.verdict.parameter_table import (
    central_parameters,
    correlated_parameters,
    correlated_sets,
)
from robotid.output.files.entries import build_result
from robotid.output.files.result_file import Result


@pytest.fixture
def written(identified, tmp_path):
    content = json.loads(json.dumps(build_result(identified, {"estimator": {"name": "x"}})))
    return Result(tmp_path / "result.json", content)


@pytest.mark.parametrize("of", ["found", "loaded"])
def test_a_data_frame_has_a_row_for_each_parameter(identified, written, of):
    frame = (identified if of == "found" else written).table()
    assert list(frame.columns) == list(parameter_table.HEADERS)
    assert tuple(frame["part"] + "." + frame["parameter"]) == identified.model.layout.names
    np.testing.assert_array_equal(frame["value"], identified.standard)
    size = identified.model.layout.n_inertial
    np.testing.assert_array_equal(frame["urdf"][:size], identified.prior[:size])
    assert frame["urdf"][size:].isna().all()
    errors = identified.standard_error
    np.testing.assert_array_equal(frame["std_error"], np.where(np.isfinite(errors), errors, np.nan))
    assert tuple(frame["source"]) == identified.sources
    assert tuple(frame["unit"]) == identified.model.layout.units
    assert frame["value"].dtype == frame["std_error"].dtype == frame["high"].dtype == float
    low, high = identified.standard_interval.T
    known = np.isfinite(errors)
    np.testing.assert_array_equal(frame["low"], np.where(known, low, np.nan))
    np.testing.assert_array_equal(frame["high"], np.where(known, high, np.nan))


def test_the_interval_of_a_parameter_that_is_a_base_parameter_is_that_of_it(identified):
    mapping, own = identified.mapping, identified.standard_interval
    checked = 0
    for b, row in enumerate(mapping.K):
        (columns,) = np.nonzero(row)
        if len(columns) == 1 and np.isfinite(own[columns[0], 0]):
            assert row[columns[0]] == 1.0
            half = np.diff(identified.base_interval[b])
            assert np.diff(own[columns[0]]) == pytest.approx(half, rel=1e-6)
            checked += 1
    assert checked > 12
    errors = identified.standard_error
    known = np.isfinite(errors) & (errors > 0)
    reach = np.diff(own[known], axis=1)[:, 0] / (2.0 * errors[known])
    assert (reach >= 1.95).all()


def test_a_body_with_a_parameter_without_an_error_has_no_interval(identified):
    keys = ("model", "standard", "prior", "standard_quantile", "standard_covariance")
    found = SimpleNamespace(**{key: getattr(identified, key) for key in keys})
    found.standard_error = identified.standard_error.copy()
    found.standard_error[13] = np.inf
    half = central_parameters(found).half
    assert np.isinf(half[1]).all()
    assert np.isfinite(half[[0, 2]]).all()


def test_a_parameter_is_correlated_with_another_one_of_its_own_drive_that_has_an_error():
    """Two drives of four parameters each, behind two of a body."""
    drives = [(k // 4, None) for k in range(8)]
    layout = SimpleNamespace(drives=("a", "b"), drive_parameters=drives, n_inertial=2)
    R = np.eye(10)
    for i, k, r in (
        (2, 3, -0.97), (2, 4, 0.96), (3, 4, -0.94),  # the strongest is taken
        (5, 6, 0.99),  # of different drives
        (6, 7, 0.98), (8, 9, 0.951),  # the seventh is at its bound
        (0, 1, 0.99),  # of a body
    ):  # fmt: skip
        R[i, k] = R[k, i] = r
    error = np.array([1.0, 2.0, 0.3, 5.0, 0.7, 0.0, 2.0, 3.0, 0.1, 40.0])
    found = SimpleNamespace(
        model=SimpleNamespace(layout=layout),
        standard_covariance=R * np.outer(error, error),
        at_bound=np.arange(10) == 7,
    )
    wanted = {2: (3, -0.97), 3: (2, -0.97), 4: (2, 0.96), 8: (9, 0.951), 9: (8, 0.951)}
    pairs = correlated_parameters(found)
    assert {i: k for i, (k, _) in pairs.items()} == {i: k for i, (k, _) in wanted.items()}
    assert [r for _, r in pairs.values()] == pytest.approx([r for _, r in wanted.values()])
    names = [f"{'xab'[(i + 2) // 4]}.{i}" for i in range(10)]
    layout.names, layout.prismatic, found.drives = names, (), ()
    found.standard = found.standard_error = np.ones(10)
    line = np.linspace(0.0, 1.0, 3)
    found.friction = lambda joint: SimpleNamespace(v=line, torque=line, std=line)
    assert [f.evidence["r"] for f in correlated_findings(found)] == pytest.approx([-0.97, 0.951])


def test_sets_are_joined_by_correlations_of_either_sign_and_hold_numbers_of_all_parameters():
    """Of nine parameters 7, 1 and 4 hang together, in two steps, and 2 and 8; 0 is left out."""
    R = np.eye(9)
    for i, k, r in ((7, 1, 0.97), (1, 4, -0.96), (7, 4, -0.94), (2, 8, -0.951), (0, 3, 0.99),
                    (5, 6, 0.949)):  # fmt: skip
        R[i, k] = R[k, i] = r
    size = np.array([1.0, 3.0, 0.2, 10.0, 0.5, 2.0, 7.0, 0.01, 5.0])
    C = R * np.outer(size, size)
    assert correlated_sets(C, [1, 2, 4, 5, 6, 7, 8]) == [[1, 4, 7], [2, 8]]
    assert correlated_sets(C, [8, 7, 4, 2]) == [[8, 2]]
    assert correlated_sets(C, [3, 0, 5]) == [[3, 0]]
    assert correlated_sets(C, [5, 6]) == []
