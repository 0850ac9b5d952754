"""Which findings a result has."""

import json
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.stats

from robotid.diagnosis.verdict.fit_findings import (
    consistency_findings,
    correlated_findings,
    correlated_parameters,
    correlated_sets,
    locked_findings,
)
from robotid.estimation.fitting.estimator_settings import EstimatorSettings
from robotid.identification.parameter_table import HEADERS, central_parameters
from robotid.output.files.entries import build_result
from robotid.output.files.result_file import Result
from robotid.robot.bodies import density_share
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel
from robotid.robot.parameters import inertial_from_pseudo_inertia


@pytest.mark.parametrize(
    ("file", "joints", "where"),
    [
        ("solo12.urdf", ["FL_HAA", "FL_HFE"], "FL_KFE"),  # not the other legs
        ("solo12.urdf", ["FL_KFE"], "FL_HAA, FL_HFE"),
        # neither the wheels nor the torso, which only lifts
        ("tiago_no_hand.urdf", [f"arm_{i}_joint" for i in range(2, 8)], "arm_1_joint"),
    ],
)
def test_locked_joints_are_named_where_they_carry_or_are_carried(file, joints, where):
    model = RobotModel.from_urdf(example_urdf(file), joints=joints)
    (finding,) = locked_findings(model, [])
    assert (finding.code, finding.where) == ("locked_at_zero", where)
    assert locked_findings(model, where.split(", ")) == []


def test_all_joints_of_a_floating_base_matter():
    model = RobotModel.from_urdf(
        example_urdf("solo12.urdf"), joints=["FL_HAA", "FL_HFE"], free_flyer=True
    )
    (finding,) = locked_findings(model, [])
    assert finding.where.split(", ") == list(model.locked)
    assert len(model.locked) == 10


def solved(**details):
    """What a fit of a possible robot says of its solvers."""
    check = SimpleNamespace(is_positive=True)
    estimate = SimpleNamespace(details=details)
    return SimpleNamespace(mass_matrix=check, estimate=estimate, estimator=EstimatorSettings())


def test_the_share_of_poses_with_a_mass_matrix_that_is_none_is_said():
    fit = solved()
    fit.mass_matrix = SimpleNamespace(
        is_positive=False, positive_share=0.935, poses=400, smallest_eigenvalue=-0.0125
    )
    (finding,) = consistency_findings(fit)
    assert finding.code == "mass_matrix"
    assert "not positive definite at 6.5 % of 400 random poses" in finding.message
    assert "(smallest eigenvalue -0.0125)" in finding.message


def test_bounds_that_bind_are_a_warning_where_data_or_masses_contradict_a_stated_one():
    def said(*active, ours=(1.04, 2.08), masses=(0.11, 3.9)):
        fit = solved(active=active)
        wls = (1.0, 2.0)
        fit.metrics = lambda name: SimpleNamespace(
            per_joint={
                joint: SimpleNamespace(rmse=x)
                for joint, x in zip("ab", wls if name == "wls" else ours, strict=True)
            }
        )
        prior, standard = np.full((2, 22), 7.0)
        prior[[0, 10]], standard[[0, 10]] = (2.0, 4.0), masses
        layout = SimpleNamespace(n_inertial=20, bodies=("one", "two"))
        fit.model = SimpleNamespace(layout=layout, standard_parameters=lambda: prior)
        fit.standard = standard
        bounds = SimpleNamespace(mass={"one": [0.1, 2.0]}, com={"two": []})
        fit.estimator = SimpleNamespace(bounds=bounds)
        found = list(consistency_findings(fit))
        assert all(f.code == "active_bound" for f in found)
        return [(f.severity, f.where, f.message) for f in found]

    fine = "the URDF's values are outside them; the bounds do not increase the torque error"
    assert said("mass one") == [("note", "mass one", f"the bounds mass one are active: {fine}")]
    ((severity, where, message),) = said("mass one", "cone two", "mass two", ours=(1.06, 2.11))
    assert (severity, where) == ("warning", "mass one, mass two")
    assert message.startswith(
        "the bounds mass one, mass two are active: they increase the torque error of a, b; check"
    )
    ((severity, _, message),) = said("total_mass all", ours=(1.0, 2.11))
    assert severity == "warning"
    assert "they increase the torque error of b; check" in message
    # next to nothing is left of a link
    ((severity, _, message),) = said("centre_of_mass two", masses=(0.09, 0.21))
    assert severity == "warning"
    assert "with them one has 0.09 of its 2 kg; check" in message
    # a bound of the geometry is no one's statement
    ((severity, _, message),) = said("mass two", masses=(0.09, 0.19))
    assert severity == "note"
    assert "with them one has 0.09 of its 2 kg, two has 0.19 of its 4 kg; check" in message
    assert said("cone one", "inertia two") == []


def ellipsoid(density, axes, centre):
    """Return the ten parameters of a homogeneous ellipsoid of three semi-axes."""
    axes, centre = np.array(axes), np.array(centre)
    mass = density * 4 / 3 * np.pi * max(np.prod(axes), 1e-6)
    moments = mass * (np.diag(axes**2) / 5 + np.outer(centre, centre))
    J = np.block([[moments, mass * centre[:, None]], [mass * centre[None], np.full((1, 1), mass)]])
    return inertial_from_pseudo_inertia(J[None])[0]


def test_errors_of_the_second_moments_allow_less_density_too():
    """The volume grows with the square root of each second moment about the centre."""
    body = ellipsoid(15e3, (0.03, 0.04, 0.05), (0, 0, 0))
    alone = np.zeros((10, 10))
    along = np.array([0, 0, 0, 0, 0.0, 0, 1, 0, 0, 1])  # mass apart along x
    moment = float(body[0]) * 0.03**2 / 5
    alone += np.outer(along, along) * (0.3 * moment) ** 2
    needed = (15e3 / 12e3) ** 2 * moment  # for a volume larger by 15 to 12
    below = scipy.stats.norm.cdf(0, moment, 0.3 * moment)
    share = scipy.stats.norm.sf(needed, moment, 0.3 * moment) / (1 - below)
    assert 0.02 < share < 0.2
    found = density_share(body, alone, 12e3, np.random.default_rng(2))
    assert found == pytest.approx(share, abs=4 * np.sqrt(share / 2000))
    assert density_share(body, np.zeros((10, 10)), 12e3, np.random.default_rng(2)) == 0.0
    assert density_share(body, np.zeros((10, 10)), 16e3, np.random.default_rng(2)) == 1.0


# --- parameters as tables -------------------------------------------------------------------------
@pytest.fixture
def written(identified, tmp_path):
    content = json.loads(json.dumps(build_result(identified, {"estimator": {"name": "x"}})))
    return Result(tmp_path / "result.json", content)


@pytest.mark.parametrize("of", ["found", "loaded"])
def test_a_data_frame_has_a_row_for_each_parameter(identified, written, of):
    frame = (identified if of == "found" else written).table()
    assert list(frame.columns) == list(HEADERS)
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


def test_without_pandas_a_table_is_a_list_of_rows(identified, monkeypatch):
    frame = identified.table()
    monkeypatch.setitem(sys.modules, "pandas", None)
    rows = identified.table()
    assert [row["value"] for row in rows] == list(frame["value"])
    assert list(rows[0]) == list(frame.columns)


def test_the_interval_of_a_parameter_that_is_a_base_parameter_is_that_of_it(identified):
    mapping, own = identified.mapping, identified.standard_interval
    checked = 0
    for b, row in enumerate(mapping.K):
        (columns,) = np.nonzero(row)
        if len(columns) == 1 and np.isfinite(own[columns[0], 0]):
            assert row[columns[0]] == 1.0
            half = np.diff(identified.base_interval[b])
            reach = own[columns[0], 1] - identified.standard[columns[0]]
            assert 2.0 * reach == pytest.approx(half, rel=1e-6)
            checked += 1
    assert checked > 12
    errors = identified.standard_error
    known = np.isfinite(errors) & (errors > 0)
    reach = (own[known, 1] - identified.standard[known]) / errors[known]
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
