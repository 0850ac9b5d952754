"""Recordings of other laboratories, identified as a user would: job file in, figures out."""

from functools import cache

import numpy as np
import pytest
from helpers.paths import JOBS

import robotid

# validation error per joint [%] reached with plain numpy and weighted least squares on the same
# splits; the figure of WLS may be at most 1.15 times that; the consistent fit, whose prior may cost
# a joint something, 1.2 times that, and no more than that in the geometric mean
REACHED = {
    "ur10e": (6.7, 3.2, 3.2, 3.7, 5.5, 4.2),
    "tx40": (6.4, 6.0, 9.7, 8.8, 30.0, 21.0),
    "panda_inria": (5.8, 1.1, 1.9, 0.9, 6.4, 3.2, 15.0),
    "kinova_gen3": (27.0, 11.0, 16.0, 15.0, 19.0, 13.0, 10.0),
}


@pytest.fixture(scope="module")
def run(recordings):
    """Run a job once."""

    @cache
    def runner(name):
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("ROBOTID_DATA", str(recordings))
            return robotid.identify(JOBS / f"{name}.toml")

    return runner


def errors(metrics):
    return np.array([m.relative_error_pct for m in metrics.per_joint.values()])


@pytest.mark.parametrize("estimate", ["wls", "estimate"])
@pytest.mark.parametrize("name", REACHED)
def test_a_new_motion_is_predicted_as_well_as_plain_numpy_does(run, name, estimate):
    (kept,) = run(name).validation
    ratio = errors(kept.metrics[estimate]) / np.array(REACHED[name])
    assert ratio.max() <= (1.15 if estimate == "wls" else 1.2), ratio
    assert np.exp(np.log(ratio).mean()) <= 1.03, ratio


def test_what_the_data_cannot_say_is_said(run):
    # the wrist currents of TIAGo are a few quanta: no torque information
    verdict = run("tiago").verdict
    assert verdict.status == "poor"
    assert any("worse than a constant" in reason for reason in verdict.reasons)
    found = run("ur10e")
    # the friction of its first joint is no line, and that of the next two grows with the load
    assert found.verdict.status == "good"
    assert found.verdict.warnings == ()
    families = {drive.joint.removesuffix("_joint"): drive.families for drive in found.drives}
    assert families["shoulder_pan"] in (("stribeck",), ("tanh",))
    assert families["shoulder_lift"] == families["elbow"] == ("load",)
    assert families["wrist_1"] == families["wrist_3"] == ()
    values = zip(found.model.layout.names, found.standard, strict=True)
    load = [value for name, value in values if name.endswith(".load")]
    assert all(0.06 < mu < 0.085 for mu in load)  # six fits of two robots: 0.064 to 0.081
