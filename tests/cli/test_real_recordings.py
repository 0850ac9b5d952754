"""Recordings of other laboratories, identified as a user would: job file in, figures out."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from robotid.cli.identify import run_job
from robotid.cli.job import read_job

JOBS = Path(__file__).parents[1] / "jobs"
# validation error per joint [%] reached with plain numpy and weighted least squares on the same
# splits; the figure of WLS may be at most 1.15 times that; the consistent fit, whose prior may cost
# a joint something, 1.2 times that, and no more than that in the geometric mean
REACHED = {
    "ur10e": (6.7, 3.2, 3.2, 3.7, 5.5, 4.2),
    "tx40": (6.4, 6.0, 9.7, 8.8, 30.0, 21.0),
    "panda_inria": (5.8, 1.1, 1.9, 0.9, 6.4, 3.2, 15.0),
    "kinova_gen3": (27.0, 11.0, 16.0, 15.0, 19.0, 13.0, 10.0),
}
ALL = [*REACHED, "tiago"]


@pytest.fixture(scope="module")
def run(recordings, tmp_path_factory):
    """Run a job once, with a report where there are gaps; keep what it found and where it wrote."""
    done = {}

    def runner(name):
        if name not in done:
            with pytest.MonkeyPatch.context() as patch:
                patch.setenv("ROBOTID_DATA", str(recordings))
                job = read_job(JOBS / f"{name}.toml")
            folder = tmp_path_factory.mktemp(name)
            job = replace(job, report=name == "kinova_gen3")
            done[name] = (*run_job(job, folder), folder)
        return done[name]

    return runner


def errors(metrics):
    return np.array([m.relative_error_pct for m in metrics.per_joint.values()])


@pytest.mark.parametrize("estimate", ["wls", "estimate"])
@pytest.mark.parametrize("name", REACHED)
def test_a_new_motion_is_predicted_as_well_as_plain_numpy_does(run, name, estimate):
    identification, _, _ = run(name)
    (kept,) = identification.validation
    ratio = errors(kept.metrics[estimate]) / np.array(REACHED[name])
    assert ratio.max() <= (1.15 if estimate == "wls" else 1.2), ratio
    assert np.exp(np.log(ratio).mean()) <= 1.03, ratio


def test_what_the_data_cannot_say_is_said(run):
    # the wrist currents of TIAGo are a few quanta: no torque information
    _, result, _ = run("tiago")
    assert result["verdict"]["status"] == "poor"
    assert any("worse than a constant" in reason for reason in result["verdict"]["reasons"])
    _, result, _ = run("ur10e")
    # the friction of its first joint is no line, and that of the next two grows with the load
    assert result["verdict"]["status"] == "good"
    assert result["verdict"]["warnings"] == []
    friction = {joint: found["families"] for joint, found in result["friction"].items()}
    assert friction["shoulder_pan_joint"] in (["stribeck"], ["tanh"])
    assert friction["shoulder_lift_joint"] == friction["elbow_joint"] == ["load"]
    assert friction["wrist_1_joint"] == friction["wrist_3_joint"] == []
    load = [p["value"] for p in result["drive_parameters"] if p["name"].endswith(".load")]
    assert all(0.06 < mu < 0.085 for mu in load)  # six fits of two robots: 0.064 to 0.081
