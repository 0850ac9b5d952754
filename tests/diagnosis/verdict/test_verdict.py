from dataclasses import replace

import pytest

from robotid.base.findings import Finding
from robotid.diagnosis import catalogue
from robotid.diagnosis.verdict.scale_check import ScaleCheck, StatedMass
from robotid.diagnosis.verdict.verdict import (
    Determined,
    Predictions,
    VerdictWarning,
    blocking,
    is_beaten,
    is_downweighted,
    judge,
    judge_positions,
    rejected,
    uses_line,
    uses_of_motion,
    uses_of_torques,
    warnings_of,
)
from robotid.estimation.fitting.evaluation import JointMetrics, Metrics
from robotid.identification.summary import verdict_lines

JOINTS = ("a", "b", "c")


def finding(code, where, severity="warning", **evidence):
    log, _, part = where.rpartition(": ")
    channel, _, joint = part.rpartition("_")
    is_of_log = not log and part.endswith(".csv")
    joints = () if is_of_log or part == "all joints" else tuple(joint.split(", "))
    return Finding(
        code, severity, where, "what was found", evidence, log=part if is_of_log else log,
        joints=joints, words={"channel": channel}, fault="what was found",
    )  # fmt: skip


def joint(error, *, urdf=100.0, constant=True, **others):
    r2 = 0.9 if constant else -0.44  # the mean torque misses 1 / 1.2 of it
    return JointMetrics(1.0, "N m", error, r2, 100, {"urdf": urdf} | others, constant)


def judged(fit, validation, *, joints=(), refitted=(), **values):
    beside = {x: values.pop(x) for x in ("log_errors", "warnings", "scale_check") if x in values}
    return judge(Predictions(fit, validation, joints, refitted), Determined(**values), **beside)


def verdict(validation, fitted=None, **open):
    fit = Metrics(fitted or {"a": joint(3.0)}, 1.0)
    logs = {"val.csv": Metrics(validation, 1.0)} if validation is not None else {}
    return judged(fit, logs, **open)


@pytest.mark.parametrize(
    ("validation", "fitted", "status", "reason"),
    [
        ({"a": joint(4.0)}, None, "good", "on validation logs: at most 4.0 % at every joint"),
        (None, None, "usable", "not evaluated: no validation log given"),
        ({"a": joint(4.0)}, {"a": joint(3.0), "b": joint(3.0)}, "usable",
         "b: no validation log has motion and a torque that varies: not evaluated"),
        ({"a": joint(20.0), "b": joint(40.0, constant=False)}, None, "poor",
         "b: worse than a constant torque on val.csv: error 40.0 %; a constant would give 33.3 %"),
        ({"a": joint(None, constant=False)}, None, "poor",
         "a: the torque is 0 throughout val.csv: not evaluated. If the joint has no drive, set "
         'passive = ["a"] in the job file'),
        ({"a": joint(4.0, urdf=4.0)}, None, "good", "at most 4.0 % at every joint"),
        ({"a": joint(4.1, urdf=4.0)}, None, "poor", "4.1 % on val.csv, worse than the URDF's 4.0"),
    ],
)  # fmt: skip
def test_the_worst_reason_is_said_first(validation, fitted, status, reason):
    found = verdict(validation, fitted)
    assert found.status == status
    assert reason in found.reasons[0]


def test_alarms_come_before_everything_and_constants_before_the_rest():
    joints = {"a": joint(60.0), "b": joint(40.0, constant=False)}
    logs = {"val.csv": Metrics(joints, 1.0)}
    found = judged(Metrics({}, 1.0), logs, log_errors=["torque of c swapped"])
    assert found.status == "poor"
    assert found.reasons[0] == "torque of c swapped"
    assert found.reasons[1].startswith("b: worse than a constant")
    assert found.reasons[2].startswith("a: error 60.0 %")


def test_each_joint_has_a_verdict_of_its_own():
    joints = {"a": joint(4.0), "b": joint(20.0), "c": joint(40.0, constant=False)}
    found = verdict(joints, fitted={name: joint(3.0) for name in "abcd"})
    assert statuses(found) == {"a": "good", "b": "usable", "c": "poor", "d": "not evaluated"}
    (a, *_), _, (c, *_), d = (one.reasons for one in found.joints.values())
    assert a.startswith("error at most 4.0 %")
    assert c.startswith("c: worse than a constant torque on val.csv: error 40.0 %")
    assert d == ("no validation log has motion and a torque that varies",)


def test_the_good_joint_with_the_largest_error_has_the_cause_of_its_residual():
    logs = {"val.csv": Metrics({"a": joint(4.0), "b": joint(6.0), "c": joint(20.0)}, 1.0)}
    fit = Metrics({name: joint(5.0) for name in "abc"}, 1.0)
    causes = {"b": ("it is noise", "Do this")}  # of no other joint is the cause computed
    found = judge(Predictions(fit, logs), Determined(), cause_of=causes.__getitem__)
    _, reason = found.joints["b"].reasons
    assert reason == "largest error of the good joints: it is noise. Do this"
    assert [len(found.joints[name].reasons) for name in "ac"] == [1, 1]
    assert not any("noise" in reason for reason in found.reasons)  # another joint is worse
    logs = {"val.csv": Metrics({"a": joint(4.0), "b": joint(6.0)}, 1.0)}
    found = judge(Predictions(fit, logs, "ab"), Determined(), cause_of=causes.__getitem__)
    assert found.status == "usable"  # c does not move in the validation log
    assert not any("noise" in reason for reason in found.reasons)
    fit = Metrics({name: joint(5.0) for name in "ab"}, 1.0)
    found = judge(Predictions(fit, logs), Determined(), cause_of=causes.__getitem__)
    assert found.status == "good"
    assert not any("noise" in reason for reason in found.reasons), "the report has it"


def test_a_doubt_makes_its_joint_and_the_whole_usable_at_best():
    fit = {name: joint(3.0) for name in "abc"}
    logs = {"val.csv": Metrics({"a": joint(4.0), "b": joint(4.0), "c": joint(60.0)}, 1.0)}
    warnings = [VerdictWarning("clipped", name, "it is clipped") for name in "bc"]
    found = judged(Metrics(fit, 1.0), logs, warnings=warnings)
    assert statuses(found) == {"a": "good", "b": "usable", "c": "poor"}
    assert found.joints["b"].reasons == ("b: it is clipped (clipped)",)
    assert "b, c: it is clipped (clipped)" in found.reasons
    assert found.status == "poor"
    whole = [VerdictWarning("urdf_mismatch", "", "run.csv: masses do not fit")]
    logs = {"val.csv": Metrics({name: joint(4.0) for name in "abc"}, 1.0)}
    found = judged(Metrics(fit, 1.0), logs, warnings=whole)
    assert found.status == "usable"
    assert found.reasons == ("run.csv: masses do not fit (urdf_mismatch)",)
    assert {v.status for v in found.joints.values()} == {"usable"}
    (warning,) = found.to_dict()["warnings"]
    assert [*warning] == ["code", "joint", "message", "effect"]
    assert [*warning.values()] == ["urdf_mismatch", "", "run.csv: masses do not fit", "usable"]


@pytest.mark.parametrize("code", ["com_outside", "dense_body", "density", "ellipsoid", "gyration"])
def test_an_impossible_body_makes_the_result_usable_and_no_joint(code):
    found = Finding(code, "warning", "link a", "the mass of a is 40 kg: not possible")
    warnings = warnings_of([found, replace(found, severity="note")], JOINTS)
    assert warnings == (VerdictWarning(code, "", "the mass of a is 40 kg: not possible"),)
    concluded = verdict({name: joint(4.0) for name in JOINTS}, warnings=warnings)
    assert concluded.status == "usable"
    assert concluded.reasons == (f"the mass of a is 40 kg: not possible ({code})",)
    assert {own.status for own in concluded.joints.values()} == {"good"}


def test_impossible_bodies_are_one_reason():
    words = {"error": False, "needs": "none", "conclusion": False, "cure": "pin it", "mass": 4.0}
    bodies = [catalogue.finding("dense_body", subject=f"link {x}", link=x, **words) for x in "ab"]
    (warning,) = warnings_of(bodies, JOINTS)
    assert warning.message.startswith("as identified, the mass of a, b is 4 kg and its inertia")


@pytest.mark.parametrize(
    ("error", "fitted", "status"),
    [
        (14.9, 14.0, "good"),
        (15.1, 14.0, "usable"),
        (49.9, 40.0, "usable"),
        (50.1, 40.0, "poor"),
        (7.9, 4.0, "good"),  # twice the fitted error is allowed
        (8.1, 4.0, "usable"),
        (4.9, 0.1, "good"),  # small errors are, however much smaller the fitted one
        (5.1, 0.1, "usable"),
    ],
)
def test_each_threshold_lies_where_it_is_stated(error, fitted, status):
    found = verdict({"a": joint(error)}, fitted={"a": joint(fitted)})
    assert (found.status, found.joints["a"].status) == (status, status)


@pytest.mark.parametrize(
    ("where", "joints"),
    [("run.csv: b", ["b"]), ("b", ["b"]), ("run.csv: a, c", ["a", "c"]), ("run.csv", [""])],
)
def test_a_doubt_is_about_the_joints_that_the_finding_names(where, joints):
    found = warnings_of([finding("unexplained_torque", where)], JOINTS)
    assert [doubt.joint for doubt in found] == joints
    start = "run.csv: gravity," if joints == [""] else "gravity, inertia"
    assert found[0].message.startswith(start)


def test_notes_errors_and_harmless_warnings_raise_no_doubt():
    harmless = [
        finding("clipped", "run.csv: a", "note"),
        finding("torque_sign", "run.csv: a", "error"),  # leads the verdict as it is
        finding("velocity_delay", "run.csv"),
        finding("payload", "run.csv: link"),
        finding("constraint_costs", "a", error_pct=1.9, wls_error_pct=1.0),
        finding("constraint_costs", "b", error_pct=0.9, wls_error_pct=1e-3),
    ]
    assert warnings_of(harmless, JOINTS) == ()


def test_a_repeated_motion_matters_if_no_other_motion_was_kept_apart():
    repeated = [finding("repeated_motion", "one.csv")]
    assert warnings_of(repeated, JOINTS, ["one.csv", "two.csv"]) == ()
    assert warnings_of(repeated, JOINTS) == ()
    (doubt,) = warnings_of(repeated, JOINTS, ["one.csv"])
    assert "no prediction was tested" in doubt.message


def test_a_robust_loss_excuses_jumps_of_the_torque_and_what_they_cause():
    jump = finding("spikes", "run.csv: tau_a", "error")
    assert is_downweighted(jump)
    assert not is_downweighted(finding("spikes", "run.csv: q_a", "error"))
    found = [jump, finding("unexplained_torque", "run.csv: a")]
    assert warnings_of(found, JOINTS, is_robust=True) == ()
    assert [doubt.joint for doubt in warnings_of(found, JOINTS)] == ["a"]
    other = [jump, finding("unexplained_torque", "run.csv: b")]
    assert [doubt.joint for doubt in warnings_of(other, JOINTS, is_robust=True)] == ["b"]


def test_only_a_robust_loss_outvotes_jumps_and_ignored_errors_are_no_alarm():
    jump, other = finding("spikes", "run.csv: tau_a", "error"), finding("late", "x", "error")
    found = [jump, other, finding("clipped", "x")]
    assert blocking(found, ()) == (jump, other)
    assert blocking(found, (), is_robust=True) == (other,)
    assert blocking(found, ["late"]) == (jump,)


def kept_logs(**errors):
    """Return metrics of logs by name, of joints a and b."""
    return {name: Metrics({"a": joint(a), "b": joint(b)}, 1.0) for name, (a, b) in errors.items()}


def test_a_hypothesis_is_refuted_by_the_worst_of_all_logs_of_its_joints():
    logs = kept_logs(one=(6.0, 2.0), two=(1.0, 3.0))
    guesses = [finding("unexplained_torque", f"run.csv: {where}") for where in ("a", "b", "a, b")]
    found = rejected([*guesses, finding("urdf_mismatch", "run.csv")], logs, ScaleCheck())
    assert [f.severity for f in found] == ["warning", "note", "warning", "warning"]
    expected = "run.csv: what was found; rejected: torque error on validation logs at most 3.0 %"
    assert found[1].message == expected
    repeated = finding("repeated_motion", "one")
    assert rejected([repeated, guesses[1]], logs, ScaleCheck())[1].severity == "warning"
    alike = finding("unexplained_torque", "all joints")
    assert rejected([alike], kept_logs(one=(1.0, 1.0)), ScaleCheck())[0].severity == "warning"


@pytest.mark.parametrize(
    ("gravity", "severity"),
    [((1.9, 0.6), "note"), ((1.0, 2.1), "warning"), ((0.4, 1.0), "warning")],
)
def test_a_current_is_refuted_by_the_gravity_of_every_joint(gravity, severity):
    logs, scale_check = kept_logs(one=(1.0, 1.0)), ScaleCheck(dict(zip("ab", gravity, strict=True)))
    for kind in ("warning", "error"):
        guess = finding("current_for_torque", "run.csv: a, b", kind)
        (found,) = rejected([guess], logs, scale_check)
        assert found.severity == (severity if severity == "note" else kind)


@pytest.mark.parametrize(
    ("scale", "factor", "severity"),
    [(1.0, 1.9, "note"), (1.0, 2.1, "warning"), (1.0, 0.4, "warning"), (None, 1.0, "warning")],
)
def test_gravity_that_was_compensated_is_refuted_by_gravity(scale, factor, severity):
    guess = finding("gravity_compensated", "run.csv")
    (found,) = rejected([guess], kept_logs(one=(1.0, 1.0)), ScaleCheck(scale=scale, factor=factor))
    assert found.severity == severity


@pytest.mark.parametrize(
    ("error", "driven", "is_worse"),
    [(1.2, 1.0, False), (1.35, 1.0, True), (12.5, 12.0, False), (12.7, 12.0, True)],
)
def test_a_twentieth_and_a_third_of_a_percent_must_be_missed_more(error, driven, is_worse):
    assert is_beaten(joint(error, urdf_with_drives=driven)) is is_worse


def test_drive_parameters_that_the_prior_determines_are_named_and_change_no_verdict():
    for undetermined in ((), ("a.m",)):
        more = Determined(undetermined, is_poorly_excited=False, uncertain_drives=["a.coulomb"])
        assert more.warnings() == []
        assert "a.coulomb: the standard error is as large as the prior's" in more.notes()[-1]
        assert more.notes()[:-1] == Determined(undetermined, is_poorly_excited=False).notes()


def test_errors_of_the_wrench_on_the_base_are_noted_beside_those_of_joints():
    base = {"base.fz": joint(12.0), "base.mx": joint(30.0)}
    logs = {"both": {"a": joint(4.0)} | base, "joints": {"a": joint(4.0)}, "alone": base}
    metrics = {name: Metrics(own, 1.0) for name, own in logs.items()}
    (note,) = Predictions(Metrics({"a": joint(4.0)}, 1.0), metrics).of_base()
    assert note.startswith("wrench on the base that contact forces cannot cause, error on both: ")
    assert "fz 12 %, mx 30 %. The verdict is on the joint torques" in note


def test_joints_better_by_the_urdf_are_those_of_all_logs():
    better, worse = {"urdf_with_drives": 3.0}, {"urdf_with_drives": 9.0}
    logs = {
        "one": {"a": joint(4.0, **worse), "b": joint(4.0, **better), "c": joint(4.0, **worse)},
        "two": {"a": joint(4.0, **better), "b": joint(4.0, **better)},
    }
    fit = Metrics({name: joint(4.0) for name in "abcd"}, 1.0)
    found = Predictions(fit, {name: Metrics(own, 1.0) for name, own in logs.items()}, "abcde")
    (reason,) = found.better_by_urdf()
    assert reason.startswith("the URDF with fitted drives predicts b, a better than")
    (reason,) = found.better_by_urdf({"a"})  # bodies are not blamed for another gain
    assert reason.startswith("the URDF with fitted drives predicts b better than")
    assert found.better_by_urdf({"a", "b"}) == []
    one, other = replace(found, pinned=("b",)).better_by_urdf()
    assert "predicts a better than the identified bodies: keep the URDF's values for" in one
    assert "predicts b better than the identified bodies. The links of these joints keep" in other
    assert found.at_rest() == [
        "e: no recording has motion and a torque that varies: not evaluated",
        "d: no validation log has motion and a torque that varies: not evaluated",
    ]
    errors = {name: one.errors for name, one in found.on_each().items()}
    assert errors == {"a": [4.0, 4.0], "b": [4.0, 4.0], "c": [4.0], "d": [], "e": []}
    part = replace(found, hidden=("b", "e"))  # their metrics are ignored
    assert part.fitted.keys() == {"a", "c", "d"}
    assert {log: [*own] for log, own in part.tested.items()} == {"one": ["a", "c"], "two": ["a"]}
    assert part.on_each().keys() == {"a", "c", "d"}
    assert part.better_by_urdf()[0].startswith("the URDF with fitted drives predicts a better")


# --- uses -----------------------------------------------------------------------------------------
VERIFIED = ScaleCheck({"a": 1.0, "b": 1.0}, scale=1.0, factor=1.0, masses=(20.0, 20.0, 0.0))
OPEN = ScaleCheck({"a": 1.2, "b": 1.2}, scale=1.2, factor=1.2, masses=(20.0, 24.0, 0.0))
WRONG = ScaleCheck({"a": 2.0}, scale=2.0, factor=2.0, masses=(20.0, 40.0, 0.0))
SCALE = "yes, torque scale not verified"


def uses(*statuses, scale_check=VERIFIED, **changes):
    """Return the three uses of a result with joints a, b, c."""
    stated = {"is_consistent": True, "is_static": False, "log_errors": ()} | changes
    joints = dict(zip("abc", statuses, strict=False))
    return tuple(uses_of_torques(joints, scale_check=scale_check, **stated).values())


@pytest.mark.parametrize(
    ("statuses", "scale_check", "changes", "wanted"),
    [
        (("good",) * 3, VERIFIED, {}, ("yes", "yes", "yes")),
        (("good",) * 3, OPEN, {}, ("yes", SCALE, SCALE)),
        (("good",) * 3, None, {}, ("yes", SCALE, "no, no joint determines its gravity")),
        (("good",) * 3, WRONG, {}, ("yes", *["no, the torque scale is contradicted"] * 2)),
        (("good", "usable", "good"), VERIFIED, {}, ("yes, with the warnings",) * 3),
        # gravity loads a and b only
        (("good", "good", "poor"), VERIFIED, {},
         ("yes, without c", "no, torques of c are poor", "yes")),
        (("poor", "good", "good"), VERIFIED, {},
         ("yes, without a", "no, torques of a are poor", "yes, without a")),
        (("poor",) * 3, VERIFIED, {},
         ("no, the errors on validation logs are large", "no, torques of a, b, c are poor",
          "no, the errors on validation logs are large")),
        (("poor", "good", "poor"), VERIFIED, {},
         ("yes, for b only", "no, torques of a, c are poor", "yes, without a")),
        (("not evaluated",) * 3, VERIFIED, {}, ("not verified, no validation log",) * 3),
        (("good",) * 3, VERIFIED, {"is_consistent": False},
         ("yes", "no, not physically consistent", "yes")),
        (("good",) * 3, VERIFIED, {"is_static": True},
         ("yes, at rest and in slow motion", "no, inertias are the URDF's", "yes")),
        (("good",) * 3, VERIFIED, {"log_errors": ("x",)}, ("no, errors of the recordings",) * 3),
        (("good", "usable", "good"), VERIFIED, {"inaccurate": ["b"]}, ("yes, without b",) * 3),
    ],
)  # fmt: skip
def test_uses_follow_from_joints_consistency_and_scale(statuses, scale_check, changes, wanted):
    assert uses(*statuses, scale_check=scale_check, **changes) == wanted


def test_no_use_contradicts_the_error_of_a_joint():
    logs = {"val.csv": Metrics({"a": joint(15.1), "b": joint(14.9)}, 1.0)}
    found = judged(Metrics({"a": joint(14.0), "b": joint(14.0)}, 1.0), logs, scale_check=VERIFIED)
    assert statuses(found) == {"a": "usable", "b": "good"}
    assert set(found.use_for.values()) == {"yes, without a"}


@pytest.mark.parametrize(
    ("factor", "mass", "status"),
    [(1.24, 24.8, "good"), (1.26, 20.0, "usable"), (0.74, 15, "usable")],
)
def test_a_scale_far_from_that_of_a_complete_urdf_is_not_good(factor, mass, status):
    # even if errors of the URDF's links may explain the common factor
    far = ScaleCheck(
        scale=factor, factor=factor, masses=(20.0, mass, 0.0), common=(factor, 0.5), mass_error=9.0
    )
    assert not far.contradicts
    found = verdict({"a": joint(4.0)}, scale_check=far)
    assert found.status == status
    assert ("absolute scale not verified" in found.reasons[0]) is (status == "usable")
    for known in ({"assumed": 2}, {"stated": StatedMass(("total_mass",), 1.0, 0.01)}):
        sure = replace(far, **known)
        assert verdict({"a": joint(4.0)}, scale_check=sure).status == "good"


@pytest.mark.parametrize(("factor", "effect"), [(0.001, "poor"), (0.4, "usable"), (3.1, "poor")])
def test_a_torque_in_another_unit_is_poor(factor, effect):
    found = warnings_of([finding("current_for_torque", "run.csv: a, b", factor=factor)], JOINTS)
    assert [(one.joint, one.effect) for one in found] == [("a", effect), ("b", effect)]
    every = warnings_of([finding("current_for_torque", "run.csv", factor=factor)], JOINTS)
    named = JOINTS if effect == "poor" else ("",)
    assert [(one.joint, one.effect) for one in every] == [(joint, effect) for joint in named]


def test_the_scale_of_positions_comes_from_a_torque_only():
    joints = {"a": "good", "b": "not evaluated"}
    found = uses_of_motion(joints, log_errors=(), is_scaled=False)
    assert [*found.values()] == [
        "yes, without b (not evaluated)",
        "yes, without b (not evaluated), scale not verified by a torque",
        "no, it needs a result from logged torques",
    ]
    scaled = uses_of_motion({"a": "good"}, log_errors=(), is_scaled=True)
    assert uses_line(scaled) == (
        "use for: simulation of drives and controllers: yes; torque feed-forward: yes; "
        "payload estimation: no, it needs a result from logged torques"
    )
    wrong = uses_of_motion({"a": "good"}, log_errors=("x",), is_scaled=True)
    assert {*wrong.values()} == {
        "no, errors of the recordings", "no, it needs a result from logged torques",
    }  # fmt: skip
    assert uses_line({}) == ""


# --- simulated positions --------------------------------------------------------------------------
def judged_positions(errors, is_validation=True, joints=("a", "b"), **known):
    """Return the verdict on joints by their errors [%], or by errors with baselines."""
    per_joint = {}
    for name, own in errors.items():
        error, baselines = own if isinstance(own, tuple) else (own, {})
        per_joint[name] = JointMetrics(1e-3, "rad", error, 0.9, 100, baselines, True)
    return judge_positions(Metrics(per_joint, 1e-3), joints, is_validation=is_validation, **known)


def statuses(found):
    return {joint: verdict.status for joint, verdict in found.joints.items()}


def test_the_worst_joint_decides_by_the_thresholds():
    good = judged_positions({"a": 2.0, "b": 5.0})
    assert good.status == "good"
    assert good.reasons == (
        "simulated position error on validation logs: at most 5 % of each joint's RMS motion, "
        "smaller than with simpler models",
    )
    usable = judged_positions({"a": 5.1, "b": 2.0})
    assert (usable.status, statuses(usable)) == ("usable", {"a": "usable", "b": "good"})
    assert usable.reasons == ("a: simulated position error 5.1 % of its RMS motion",)
    assert judged_positions({"a": 30.0, "b": 2.0}).status == "usable"
    poor = judged_positions({"a": 5.1, "b": 30.1})
    assert (poor.status, statuses(poor)) == ("poor", {"a": "usable", "b": "poor"})
    assert [reason[0] for reason in poor.reasons] == ["b", "a"], "the worst first"


def test_a_plainer_model_that_is_better_keeps_it_from_being_good_and_the_command_makes_it_poor():
    others = {"command": 50.0, "urdf": None, "second_order": 1.9}
    near = judged_positions({"a": (1.99, others), "b": 1.0})
    assert near.status == "good", "within a twentieth"
    beaten = judged_positions({"a": (2.0, others), "b": 1.0})
    assert statuses(beaten) == {"a": "usable", "b": "good"}
    assert beaten.reasons[0].endswith("2 % of its RMS motion; smaller with a second-order model")
    worse = judged_positions({"a": (2.0, others | {"command": 1.0}), "b": 1.0})
    assert worse.status == "poor"
    driven = judged_positions({"a": (2.0, {"urdf": 1.0, "rows": 3.0, "steady": 40.0}), "b": 1.0})
    assert "smaller with the URDF with fitted drives" in driven.reasons[0]
    stated = judged_positions({"a": (2.0, {"urdf": 1.0, "command": 40.0}), "b": 1.0})
    assert "smaller with the URDF with the given gains" in stated.reasons[0]


def test_what_no_log_tests_is_not_evaluated():
    fitted = judged_positions({"a": 2.0, "b": 60.0}, is_validation=False)
    assert fitted.status == "not evaluated"
    assert statuses(fitted) == {"a": "not evaluated", "b": "not evaluated"}
    assert fitted.reasons[0].endswith("no validation log given")
    still = judged_positions({"a": 2.0})
    assert (still.status, statuses(still)) == ("usable", {"a": "good", "b": "not evaluated"})
    assert still.reasons == ("b: commanded to rest in all logs: not evaluated",)
    none = judged_positions({})
    assert none.status == "not evaluated"
    assert none.reasons == ("a, b: commanded to rest in all logs: not evaluated",)
    assert "  a, b: commanded to rest in all logs: not evaluated" in verdict_lines(none.to_dict())


def test_faults_and_cautions_come_first_and_the_scale_last():
    errors = {"a": 2.0, "b": 2.0}
    unsettled = judged_positions(errors, is_settled=False, scale="the scale depends on kp")
    assert unsettled.status == "usable"
    assert unsettled.reasons == ("the fit has not converged", "the scale depends on kp")
    assert judged_positions(errors, scale="the scale depends on kp").status == "good"
    doubtful = judged_positions(errors, is_settled=False, cautions=["at its bound"])
    assert doubtful.reasons == ("at its bound", "the fit has not converged")
    wrong = judged_positions(
        {"a": 2.0, "b": 9.0}, log_errors=["the clock jumps"], cautions=["at its bound"]
    )
    assert wrong.status == "poor"
    assert wrong.log_errors == ("the clock jumps",)
    assert [reason[:5] for reason in wrong.reasons] == ["the c", "at it", "b: si"]


def test_the_largest_error_is_the_first_reason():
    errors = {"a": 8.0, "b": 45.0, "c": 70.0, "d": 12.0}
    found = judged_positions(errors, joints=tuple(errors))
    assert [reason[0] for reason in found.reasons] == ["c", "b", "d", "a"]
    lines = verdict_lines(found.to_dict())
    assert [line.split()[0] for line in lines] == ["verdict:", "c:", "b:", "d:", "a:", "use"]
