"""Which findings a result has."""

import pytest

from robotid.judgement.findings import locked_findings
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
