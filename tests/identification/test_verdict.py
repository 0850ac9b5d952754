import pytest

from robotid.identification.metrics import JointMetrics, Metrics
from robotid.identification.verdict import Doubt, judge


def joint(error, *, urdf=100.0, constant=True):
    return JointMetrics(1.0, "N m", error, 0.9, 100, {"urdf": urdf}, constant)


def verdict(validation, fitted=None, undetermined=(), is_consistent=True):
    fit = Metrics(fitted or {"a": joint(3.0)}, 1.0)
    logs = {"val.csv": Metrics(validation, 1.0)} if validation is not None else {}
    return judge(fit, logs, undetermined=undetermined, is_consistent=is_consistent)


def test_good_needs_every_joint_good_on_kept_recordings():
    found = verdict({"a": joint(4.0)})
    assert found.status == "good"
    assert "within 4.0 % on recordings that were not fitted" in found.reasons[0]


def test_not_evaluated_is_never_a_pass():
    found = verdict(None)
    assert found.status == "usable"
    assert "was not evaluated: no validation log given" in found.reasons[0]
    found = verdict({"a": joint(4.0)}, fitted={"a": joint(3.0), "b": joint(3.0)})
    assert found.status == "usable"
    assert found.reasons == ("the joints ['b'] do not move in any validation log: not evaluated",)


def test_worse_than_a_constant_is_said_first():
    found = verdict({"a": joint(20.0), "b": joint(40.0, constant=False)})
    assert found.status == "poor"
    assert found.reasons[0] == "b: worse than a constant torque on val.csv (40.0 %)"


def test_alarms_come_before_everything_and_constants_before_the_rest():
    joints = {"a": joint(60.0), "b": joint(40.0, constant=False)}
    logs = {"val.csv": Metrics(joints, 1.0)}
    found = judge(
        Metrics({}, 1.0), logs, undetermined=(), is_consistent=True, alarms=["torque of c swapped"]
    )
    assert found.status == "poor"
    assert found.reasons[0] == "torque of c swapped"
    assert found.reasons[1].startswith("b: worse than a constant")
    assert found.reasons[2].startswith("a: predicted to 60.0 % only")


def test_worse_than_the_urdf_is_poor():
    found = verdict({"a": joint(8.0, urdf=6.0)})
    assert found.status == "poor"
    assert found.reasons == ("a: 8.0 % on val.csv, worse than the URDF's 6.0 %",)


def test_large_errors_and_open_parameters_make_it_usable_at_best():
    assert verdict({"a": joint(20.0)}).status == "usable"
    assert verdict({"a": joint(60.0)}).status == "poor"
    assert verdict({"a": joint(9.0)}).status == "usable"  # three times the error of the fit
    assert verdict({"a": joint(4.0)}, undetermined=["x.m"]).status == "usable"
    assert verdict({"a": joint(4.0)}, is_consistent=False).status == "usable"


def test_each_joint_has_a_verdict_of_its_own():
    joints = {"a": joint(4.0), "b": joint(20.0), "c": joint(40.0, constant=False)}
    found = verdict(joints, fitted={name: joint(3.0) for name in "abcd"}).joints
    assert {name: v.status for name, v in found.items()} == {
        "a": "good", "b": "usable", "c": "poor", "d": "not evaluated",
    }  # fmt: skip
    assert found["a"].reasons[0].startswith("predicted within 4.0 %")
    assert found["c"].reasons == ("c: worse than a constant torque on val.csv (40.0 %)",)
    assert found["d"].reasons == ("it does not move in any kept recording",)


def test_the_worst_of_several_recordings_decides_on_a_joint():
    logs = {
        "one.csv": Metrics({"a": joint(4.0)}, 1.0),
        "two.csv": Metrics({"a": joint(60.0)}, 1.0),
    }
    found = judge(Metrics({"a": joint(3.0)}, 1.0), logs, undetermined=(), is_consistent=True)
    assert found.joints["a"].status == "poor"
    assert found.to_dict()["per_joint"]["a"]["reasons"] == [
        "a: predicted to 60.0 % only on two.csv"
    ]


def test_without_a_kept_recording_no_joint_is_evaluated():
    assert verdict(None).joints["a"].status == "not evaluated"


def test_a_joint_that_moves_nowhere_is_not_evaluated():
    found = judge(
        Metrics({"a": joint(3.0)}, 1.0),
        {"val.csv": Metrics({"a": joint(4.0)}, 1.0)},
        undetermined=(),
        is_consistent=True,
        joints=("a", "b"),
    )
    assert found.status == "usable"
    assert found.reasons == ("the joints ['b'] move in no recording: not evaluated",)
    assert found.joints["b"].status == "not evaluated"
    assert found.joints["b"].reasons == ("it does not move in any recording",)


def test_a_result_that_is_validated_later_knows_only_what_was_kept():
    kept = {"val.csv": Metrics({"a": joint(4.0)}, 1.0)}
    found = judge(Metrics({}, 0.0), kept, undetermined=(), is_consistent=True, joints=("a", "b"))
    assert found.reasons == ("the joints ['b'] do not move in any validation log: not evaluated",)


def test_a_doubt_makes_its_joint_and_the_whole_usable_at_best():
    fit = {name: joint(3.0) for name in "abc"}
    logs = {"val.csv": Metrics({"a": joint(4.0), "b": joint(4.0), "c": joint(60.0)}, 1.0)}
    doubts = [Doubt("clipped", name, "it is clipped") for name in "bc"]
    found = judge(Metrics(fit, 1.0), logs, undetermined=(), is_consistent=True, doubts=doubts)
    assert {name: v.status for name, v in found.joints.items()} == {
        "a": "good", "b": "usable", "c": "poor",
    }  # fmt: skip
    assert found.joints["b"].reasons == ("b: it is clipped (clipped)",)
    assert "b, c: it is clipped (clipped)" in found.reasons
    assert found.status == "poor"
    whole = [Doubt("urdf_mismatch", "", "run.csv: masses do not fit")]
    logs = {"val.csv": Metrics({name: joint(4.0) for name in "abc"}, 1.0)}
    found = judge(Metrics(fit, 1.0), logs, undetermined=(), is_consistent=True, doubts=whole)
    assert found.status == "usable"
    assert found.reasons == ("run.csv: masses do not fit (urdf_mismatch)",)
    assert {v.status for v in found.joints.values()} == {"usable"}
    assert found.to_dict()["doubts"] == [
        {"code": "urdf_mismatch", "joint": "", "message": "run.csv: masses do not fit"}
    ]


def test_kept_recordings_that_were_fitted_are_named():
    found = judge(
        Metrics({"a": joint(3.0)}, 1.0), {}, undetermined=(), is_consistent=True, refitted=["x.csv"]
    )
    assert found.status == "usable"
    (reason,) = found.reasons
    assert reason.endswith("was not evaluated: ['x.csv'] hold rows that were fitted")


def test_a_torque_of_zero_is_no_prediction():
    found = verdict({"a": joint(None, constant=False)})
    assert found.status == "poor"
    assert found.reasons == ("a: the torque on val.csv is 0 throughout: nothing was predicted",)


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
    assert found.status == status
    assert found.joints["a"].status == status


def test_an_alarm_alone_makes_a_good_prediction_poor():
    kept = {"val.csv": Metrics({"a": joint(4.0)}, 1.0)}
    found = judge(
        Metrics({"a": joint(3.0)}, 1.0), kept, undetermined=(), is_consistent=True, alarms=["late"]
    )
    assert found.status == "poor"
    assert found.reasons == ("late",)
    assert found.to_dict()["alarms"] == ["late"]


def test_an_error_equal_to_the_urdfs_is_not_worse_than_it():
    assert verdict({"a": joint(4.0, urdf=4.0)}).status == "good"
    assert verdict({"a": joint(4.1, urdf=4.0)}).status == "poor"
