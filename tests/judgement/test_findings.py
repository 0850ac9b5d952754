"""Which findings a result has."""

from types import SimpleNamespace

import pytest

from robotid.fitting.settings import EstimatorSettings
from robotid.judgement.findings import consistency_findings, locked_findings
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel


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


def test_of_several_starts_the_best_is_above_the_optimum_by_its_own_gap():
    for gaps in ([0.3, 0.9e-3, 0.5], [0.0]):
        assert consistency_findings(solved(gaps=gaps)) == []
    (finding,) = consistency_findings(solved(gaps=[0.3, 0.0123, 0.5]))
    assert (finding.code, finding.severity) == ("optimum_gap", "warning")
    assert finding.message.startswith("log-Cholesky ended 1.2 % above the optimum")


def test_two_solvers_differ_by_the_shares_that_are_said():
    check = {"solver": "two", "torque_difference": 0.9e-3, "objective_difference": 0.5}
    assert consistency_findings(solved(solver="one", check=check)) == []
    check |= {"torque_difference": 0.0234, "objective_difference": 4.5e-4}
    (finding,) = consistency_findings(solved(solver="one", check=check))
    assert finding.code == "solvers_differ"
    assert "one and two differ by 2.3 % of the torque (objective: 0.045 %)" in finding.message


def test_the_share_of_poses_with_a_mass_matrix_that_is_none_is_said():
    fit = solved()
    fit.mass_matrix = SimpleNamespace(
        is_positive=False, positive_share=0.935, poses=400, smallest_eigenvalue=-0.0125
    )
    (finding,) = consistency_findings(fit)
    assert finding.code == "mass_matrix"
    assert "not positive definite at 6.5 % of 400 random poses" in finding.message
    assert "(smallest eigenvalue -0.0125)" in finding.message
