"""Recordings of other laboratories, identified as a user would: job file in, figures out."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from robotid.cli.identify import run_job
from robotid.cli.job import read_job
from robotid.estimation.fitting.evaluation import predict
from robotid.output.files.result_file import read_result
from robotid.output.files.urdf import load_identified
from robotid.robot.parameters import pseudo_inertia

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
            # no interval is asked for here: no sample of fits is drawn
            estimator = replace(job.estimator, draws=0)
            job = replace(job, report=name == "kinova_gen3", estimator=estimator)
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


@pytest.mark.parametrize("name", REACHED)
def test_the_written_urdf_and_sidecar_reproduce_the_fit(run, name):
    identification, result, folder = run(name)
    outputs = result["outputs"]
    model, pi = load_identified(folder / outputs["urdf"], folder / outputs["sidecar"])
    evaluation = identification.validation[0]
    (torque,) = predict(model, [pi], evaluation.recording.trajectory)
    fit = evaluation.torques["estimate"]
    assert np.linalg.norm(torque - fit) <= 1e-6 * np.linalg.norm(fit)


@pytest.mark.parametrize("name", ALL)
def test_the_parameters_are_possible(run, name):
    identification, result, folder = run(name)
    assert identification.is_consistent
    layout = identification.model.layout
    J = pseudo_inertia(identification.standard[: layout.n_inertial])
    assert np.linalg.eigvalsh(J).min() > 0
    assert read_result(folder / "result.json") == result


def test_tx40_has_sane_masses_and_armatures(run):
    identification, _, _ = run("tx40")
    n = identification.model.layout.n_inertial
    ratio = identification.standard[:n:10].sum() / identification.prior[:n:10].sum()
    assert 0.5 <= ratio <= 2.0
    names = identification.model.layout.names
    armature = [v for k, v in zip(names, identification.standard, strict=True) if "armature" in k]
    assert min(armature) >= 0
    own = sum(map(len, identification.model.layout.own.values()))
    assert own >= 3
    assert len(identification.base) == 61 + own
    (kept,) = identification.validation
    assert kept.metrics["estimate"].pooled_rmse < kept.metrics["wls"].pooled_rmse


@pytest.mark.parametrize("name", ALL)
def test_no_stretch_kept_apart_is_taken_for_a_fitted_one(run, name):
    identification, result, _ = run(name)
    assert identification.refitted == ()
    codes = {warning["code"] for warning in result["warnings"]}
    assert "validation_was_fitted" not in codes
    # TIAGo's currents make its links 3.4 times too light: said, and no URDF is written
    assert ("total_mass" in codes) == bool(identification.log_errors) == (name == "tiago")
    assert ("urdf" in result["outputs"]) == (name != "tiago")


def test_late_velocities_are_not_used(run):
    # TIAGo reports velocity 140 to 190 ms late, the Panda 6 ms, like its torque
    tiago, panda = run("tiago")[0], run("panda_inria")[0]
    assert tiago.fitted[0].recording.signals.velocity == "differentiated"
    assert panda.fitted[0].recording.signals.velocity == "measured"


def test_gaps_stay_gaps(run):
    identification, _, _ = run("kinova_gen3")
    trajectory = identification.fitted[0].recording.trajectory
    assert trajectory.segment[-1] >= 2  # its longest gaps: 0.94, 0.56 and 0.03 s
    for number in np.unique(trajectory.segment):
        steps = np.diff(trajectory.t[trajectory.segment == number])
        assert steps.size == 0 or steps.max() < 0.05


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
