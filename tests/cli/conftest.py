"""A planar arm of two joints, which every command runs on in a fraction of a second."""

import numpy as np
import pytest
from helpers.paths import URDF
from helpers.synthetic import exact_log, truth

from robotid.data.files.read import write_log
from robotid.robot.model import RobotModel


@pytest.fixture(scope="session")
def arm():
    return RobotModel.from_urdf(URDF / "planar_2r.urdf")


@pytest.fixture(scope="session")
def arm_logs(arm, tmp_path_factory):
    """A folder with two motions of an arm that its URDF does not describe."""
    folder, rng = tmp_path_factory.mktemp("arm"), np.random.default_rng(0)
    for name in ("fit", "keep"):
        log = exact_log(arm, truth(arm), rng, samples=800, rate=100.0, noise=0.1)
        write_log(log, folder / f"{name}.csv")
    return folder
