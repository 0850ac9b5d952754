import os
from pathlib import Path

import numpy as np
import pytest
from helpers.browsing import launch
from helpers.paths import IN_CI, ROOT

from robotid.doctor.urdf import inspect_urdf
from robotid.robot.examples import example_urdf, example_urdfs
from robotid.robot.model import RobotModel


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@pytest.fixture(scope="session")
def ur5():
    return RobotModel.from_urdf(example_urdf("ur5_robot.urdf"))


@pytest.fixture(scope="session")
def panda():
    arm = [f"panda_joint{i}" for i in range(1, 8)]
    return RobotModel.from_urdf(example_urdf("panda.urdf"), joints=arm)


@pytest.fixture(scope="session")
def inspections():
    """The inspection of every example robot by its path; tests share it by one xdist group."""
    return {path: inspect_urdf(path) for path in example_urdfs()}


@pytest.fixture(scope="session")
def recordings():
    """The folder of real recordings, which are never part of the project."""
    for folder in (os.environ.get("ROBOTID_DATA"), ROOT.parent / "shared" / "data"):
        if folder and Path(folder).is_dir():
            return Path(folder)
    assert not IN_CI, "CI must not skip the real recordings: set ROBOTID_DATA"
    pytest.skip("no real recordings: set ROBOTID_DATA to their folder")


@pytest.fixture(scope="session")
def browser():
    """The system's Chromium; see browsing.py."""
    yield from launch()
