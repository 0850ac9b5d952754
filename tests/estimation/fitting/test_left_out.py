"""Each log predicted by a fit to the others: as fits to the others with it as validation log."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.driven import EXACT, arm, driven_log
from helpers.synthetic import truth

from robotid.data.log import alike_motions
from robotid.diagnosis.verdict.verdict import Determined, Predictions, judge
from robotid.dynamics.base_parameters import structural_mapping
from robotid.estimation.fitting.estimator_settings import EstimatorSettings
from robotid.estimation.fitting.evaluation import LEFT_OUT, logs_that_test
from robotid.estimation.fitting.fit import solve_recordings
from robotid.estimation.fitting.recorded import Recordings, hold_log
from robotid.identification.pipeline import conclude
from robotid.identification.summary import left_out_lines

WLS = EstimatorSettings("wls")


@pytest.fixture(scope="module")
def logs():
    """Four logs of other friction; the third repeats the motion of the first."""
    model, rng, held = arm(), np.random.default_rng(0), []
    friction = [k for k, n in enumerate(model.layout.names) if n.endswith("coulomb")]
    for run, motion in enumerate((0, 1, 0, 3)):
        pi = truth(model)
        pi[friction] *= 1 + 0.05 * rng.normal(size=len(friction))
        log = driven_log(model, pi, motion, duration=5.0, noise=0.02)
        tau = log.tau + 0.05 * rng.normal(size=log.tau.shape)
        held.append(hold_log(model, replace(log, tau=tau, path=f"run_{run}.csv"), EXACT))
    return model, held


def fit_of(model, fitted, validation=(), choice=WLS):
    some = Recordings(model, structural_mapping(model), fitted, validation)
    return solve_recordings(some, choice).with_errors()


@pytest.mark.parametrize("choice", [WLS, EstimatorSettings(prior_weight=1.0)])
def test_errors_are_those_of_validation_logs_of_a_fit_to_the_others(logs, choice):
    model, held = logs
    whole = fit_of(model, held, choice=choice)
    folds = [{0, 2}, {1}, {3}]
    assert len(whole.left_out) == 4
    assert whole.predictions == whole.left_out
    for out in folds:
        others = [log for k, log in enumerate(held) if k not in out]
        alone = fit_of(model, others, [held[k] for k in sorted(out)], choice)
        assert alone.left_out == {}
        for e in alone.validation:
            wanted, own = e.metrics["estimate"], whole.left_out[e.recording.name + LEFT_OUT]
            near = 1e-6 if choice is WLS else 0.05  # the spread of the prior is that of all logs
            for joint, measured in wanted.per_joint.items():
                found = own.per_joint[joint]
                assert found.rmse == pytest.approx(measured.rmse, rel=near)
                assert found.rows == measured.rows
                for name, error in measured.baselines.items():
                    same = 0.05 if name == "urdf_with_drives" else 1e-9
                    assert found.baselines[name] == pytest.approx(error, rel=same), name
            k = [each.recording.name for each in whole.fitted].index(e.recording.name)
            assert own.pooled_rmse > whole.fitted[k].metrics["estimate"].pooled_rmse


def test_motions_that_repeat_one_another_are_one_group(logs):
    model, held = logs
    motions = [log.whole.trajectory for log in held]
    assert alike_motions(motions) == [[0, 2], [1], [3]]
    joined = [motions[0], motions[1], replace(motions[3], q=motions[3].q + 1.0), motions[2]]
    assert alike_motions(joined) == [[0, 3], [1], [2]]
    still = replace(motions[1], q=np.zeros_like(motions[1].q))
    assert alike_motions([still, motions[0], still]) == [[0], [1], [2]]
    assert fit_of(model, held[:3]).left_out == {}  # of two motions
    assert fit_of(model, held, held[1:2]).left_out == {}  # a validation log tests


def test_the_verdict_is_on_the_logs_left_out(logs):
    model, held = logs
    some = Recordings(model, structural_mapping(model), held)
    found = conclude(some, EstimatorSettings(prior_weight=1.0), friction="viscous+coulomb")
    worst = max(m.relative_error_pct for each in found.left_out.values()
                for m in each.per_joint.values())  # fmt: skip
    reasons = " ".join(found.verdict.reasons)
    assert "no validation log" not in reasons
    assert worst < 15.0
    assert {each.status for each in found.verdict.joints.values()} == {"good"}
    good = judge(Predictions(found.metrics(), found.left_out, model.joints), Determined())
    assert good.status == "good"
    said = f"error on logs left out of the fit in turn: at most {worst:.1f} % at every joint"
    assert said in good.reasons[0]
    errors = [[each.per_joint[joint].relative_error_pct for each in found.left_out.values()]
              for joint in model.joints]  # fmt: skip
    (line,) = left_out_lines([each.to_dict() for each in found.left_out.values()])
    assert line == "error of each of 4 logs, by a fit to the others: " + ", ".join(
        f"{joint} {min(x):.1f} to {max(x):.1f} %"
        for joint, x in zip(model.joints, errors, strict=True)
    )
    assert left_out_lines([]) == []
    assert logs_that_test([f"a{LEFT_OUT}", "b"]) == logs_that_test([]) == "validation logs"
