"""A payload on the trunk of a robot on its feet, from logs with and without it."""

import numpy as np
import pytest
from helpers.stands import recorded, stand

from robotid.data.signal_settings import SignalSettings
from robotid.dynamics.simulation.simulation_settings import Payload
from robotid.dynamics.simulation.simulator import carried
from robotid.estimation.estimators import two_runs
from robotid.identification.payload_fit import identify_payload
from robotid.robot.constraints import Contact
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

RAW = SignalSettings(cutoff=None, velocity="measured", acceleration="measured")
PACK = Payload("base_link", 0.4, (0.05, 0.02, 0.06), (1e-3, 0, 1e-3, 0, 0, 1e-3))
FEET = ("FL_FOOT", "FR_FOOT", "HL_FOOT", "HR_FOOT")


@pytest.fixture(scope="module")
def robot():
    return RobotModel.from_urdf(
        example_urdf("solo12.urdf"), free_flyer=True, terms=("viscous",),
        constraints=[Contact(foot) for foot in FEET],
    )  # fmt: skip


@pytest.fixture(scope="module")
def runs(robot):
    """Return the log with the payload, and that without it."""
    found = []
    for seed, payload in enumerate((PACK, Payload())):
        rng = np.random.default_rng(seed)
        motion = stand(robot, np.tile([0.0, 0.8, -1.6], 4), 0.25, rng, length=1.0)
        pi = carried(robot, robot.standard_parameters(), payload)
        found.append(recorded(robot, pi, motion, rng, rate=80.0, duration=3.0))
    return found


@pytest.fixture(scope="module")
def found(robot, runs):
    """Return the payload, and the noise level of each row in its fit."""
    noise, compare = [], two_runs.TwoRuns.compare

    def noted(self, **options):
        noise.append(self._noise)
        return compare(self, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(two_runs.TwoRuns, "compare", noted)
        fit = identify_payload(robot, *runs, signals=RAW, friction="none")
    return fit, noise[0]


def test_the_payload_of_the_trunk_is_found(found):
    fit, _ = found
    (payload,) = fit.payloads
    assert payload.link == "base_link"  # the base floats: it is the default
    assert payload.mass == pytest.approx(0.4, abs=3 * payload.mass_std_error)
    assert 1e-4 < payload.mass_std_error < 0.01
    assert (np.abs(payload.com - PACK.com) < 4 * payload.com_std_error).all()
    assert payload.com_std_error.max() < 0.02
    assert fit.unexplained.max() < 0.1


def test_the_noise_is_that_of_all_rows_together(found):
    """0.01 N m in 12 of the 18 rows, of which 9 to 6 equations remain."""
    _, levels = found
    assert np.ptp(levels) == 0.0
    assert 0.5 * 0.01 < levels[0] < 0.01
