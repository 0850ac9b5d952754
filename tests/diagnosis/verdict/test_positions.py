"""Verdicts on simulated positions: by thresholds, plainer models, and what else is known."""

from robotid.diagnosis.verdict.verdict import judge_positions
from robotid.estimation.fitting.evaluation import JointMetrics, Metrics
from robotid.identification.summary import verdict_lines


def judged(errors, is_validation=True, joints=("a", "b"), **known):
    """Return the verdict on joints by their errors [%], or by errors with baselines."""
    per_joint = {}
    for name, own in errors.items():
        error, baselines = own if isinstance(own, tuple) else (own, {})
        per_joint[name] = JointMetrics(1e-3, "rad", error, 0.9, 100, baselines, True)
    return judge_positions(Metrics(per_joint, 1e-3), joints, is_validation=is_validation, **known)


def statuses(found):
    return {joint: verdict.status for joint, verdict in found.joints.items()}


def test_the_worst_joint_decides_by_the_thresholds():
    good = judged({"a": 2.0, "b": 5.0})
    assert good.status == "good"
    assert good.reasons == (
        "simulated position error on validation logs: at most 5 % of each joint's RMS motion, "
        "smaller than those of simpler models",
    )
    usable = judged({"a": 5.1, "b": 2.0})
    assert (usable.status, statuses(usable)) == ("usable", {"a": "usable", "b": "good"})
    assert usable.reasons == ("a: simulated position error 5.1 % of its RMS motion",)
    assert judged({"a": 30.0, "b": 2.0}).status == "usable"
    poor = judged({"a": 5.1, "b": 30.1})
    assert (poor.status, statuses(poor)) == ("poor", {"a": "usable", "b": "poor"})
    assert [reason[0] for reason in poor.reasons] == ["b", "a"], "the worst first"


def test_a_plainer_model_that_is_better_keeps_it_from_being_good_and_the_command_makes_it_poor():
    others = {"command": 50.0, "urdf": None, "second_order": 1.9}
    near = judged({"a": (1.99, others), "b": 1.0})
    assert near.status == "good", "within a twentieth"
    beaten = judged({"a": (2.0, others), "b": 1.0})
    assert statuses(beaten) == {"a": "usable", "b": "good"}
    assert beaten.reasons[0].endswith("2 % of its RMS motion; smaller with a second-order model")
    worse = judged({"a": (2.0, others | {"command": 1.0}), "b": 1.0})
    assert worse.status == "poor"
    driven = judged({"a": (2.0, {"urdf": 1.0, "rows": 3.0, "steady": 40.0}), "b": 1.0})
    assert "smaller with the URDF with fitted drives" in driven.reasons[0]
    stated = judged({"a": (2.0, {"urdf": 1.0, "command": 40.0}), "b": 1.0})
    assert "smaller with the URDF with the stated gains" in stated.reasons[0]


def test_what_no_log_tests_is_not_evaluated():
    fitted = judged({"a": 2.0, "b": 60.0}, is_validation=False)
    assert fitted.status == "not evaluated"
    assert statuses(fitted) == {"a": "not evaluated", "b": "not evaluated"}
    assert fitted.reasons[0].endswith("no validation log given")
    still = judged({"a": 2.0})
    assert (still.status, statuses(still)) == ("usable", {"a": "good", "b": "not evaluated"})
    assert still.reasons == ("b: commanded to rest in all logs: not evaluated",)
    assert judged({}).status == "not evaluated"


def test_faults_and_cautions_come_first_and_the_scale_last():
    errors = {"a": 2.0, "b": 2.0}
    unsettled = judged(errors, is_settled=False, scale="the scale depends on kp")
    assert unsettled.status == "usable"
    assert unsettled.reasons == ("the fit has not converged", "the scale depends on kp")
    assert judged(errors, scale="the scale depends on kp").status == "good"
    doubtful = judged(errors, is_settled=False, cautions=["at its bound"])
    assert doubtful.reasons == ("at its bound", "the fit has not converged")
    wrong = judged({"a": 2.0, "b": 9.0}, log_errors=["the clock jumps"], cautions=["at its bound"])
    assert wrong.status == "poor"
    assert wrong.log_errors == ("the clock jumps",)
    assert [reason[:5] for reason in wrong.reasons] == ["the c", "at it", "b: si"]


def test_the_largest_error_is_the_first_reason():
    errors = {"a": 8.0, "b": 45.0, "c": 70.0, "d": 12.0}
    found = judged(errors, joints=tuple(errors))
    assert [reason[0] for reason in found.reasons] == ["c", "b", "d", "a"]
    lines = verdict_lines(found.to_dict())
    assert [line.split()[0] for line in lines] == ["verdict:", "c:", "b:", "d:", "a:", "use"]
