"""The quadruped of these tests."""

import pytest

from robotid.robot.constraints import Contact
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel


@pytest.fixture(scope="module")
def robot():
    """Return Solo12 on its four feet, as points."""
    feet = ("FL_FOOT", "FR_FOOT", "HL_FOOT", "HR_FOOT")
    return RobotModel.from_urdf(
        example_urdf("solo12.urdf"), free_flyer=True, terms=(),
        constraints=[Contact(foot) for foot in feet],
    )  # fmt: skip
