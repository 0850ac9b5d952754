import re

import numpy as np
import pytest
import yaml

from robotid.data.files.read import open_table
from robotid.data.signal_settings import LogSource
from robotid.design.design import DesignedMotion, FourierBasis
from robotid.design.excitation import write_motion

JOINTS = tuple(f"joint_{k}" for k in range(6))


@pytest.fixture
def motion(rng):
    return DesignedMotion(FourierBasis(2.0, 3), rng.standard_normal((5, 6)))


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_a_table_has_positions_velocities_and_accelerations(motion, tmp_path, suffix):
    path = write_motion(motion, JOINTS, 2.0, 50.0, tmp_path / f"m{suffix}")
    table = open_table(path, LogSource()).read(["time", "q_joint_2", "dq_joint_2", "ddq_joint_5"])
    np.testing.assert_array_equal(table["time"], np.arange(101) / 50)
    q, v, a = motion.evaluate(table["time"])
    np.testing.assert_array_equal(table["q_joint_2"], q[:, 2])
    np.testing.assert_array_equal(table["dq_joint_2"], v[:, 2])
    np.testing.assert_array_equal(table["ddq_joint_5"], a[:, 5])


@pytest.mark.parametrize("suffix", [".csv", ".yaml", ".script"])
def test_the_last_row_is_the_end_of_the_motion_where_it_rests(rng, tmp_path, suffix):
    """Of 2.06 s, whose last row is at 2.1 s at 10 Hz, and at 2.064 s every 8 ms."""
    motion = DesignedMotion(FourierBasis(2.06, 3), rng.standard_normal((5, 6)))
    text = write_motion(motion, JOINTS, 2.06, 10.0, tmp_path / f"m{suffix}").read_text()
    q = motion.evaluate(np.array([2.06]))[0][0]
    if suffix == ".csv":
        found = np.array(text.splitlines()[-1].split(","), dtype=float)
        np.testing.assert_allclose(found, [2.1, *q, *[0.0] * 12], atol=1e-9)
        return
    numbers = re.findall(r"(?:positions: |servoj\()\[(.*?)\]", text)[-1]
    np.testing.assert_allclose(np.array(numbers.split(","), dtype=float), q, atol=1e-6)


def test_ros_reads_it_as_a_joint_trajectory(motion, tmp_path):
    path = write_motion(motion, JOINTS, 2.0, 10.0, tmp_path / "m.yaml")
    content = yaml.safe_load(path.read_text())
    assert content["joint_names"] == list(JOINTS)
    assert len(content["points"]) == 21
    for k, seconds in ((7, 0), (17, 1)):
        point = content["points"][k]
        assert point["time_from_start"] == {"sec": seconds, "nanosec": 700_000_000}
        q, v, a = motion.evaluate(np.array([k / 10]))
        for name, values in (("positions", q), ("velocities", v), ("accelerations", a)):
            np.testing.assert_allclose(point[name], values[0], atol=1e-6)
