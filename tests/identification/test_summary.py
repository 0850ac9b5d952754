"""What a notebook and print() show of a result."""

import pytest
from helpers.paths import ROOT
from helpers.synthetic import exact_log, truth

from robotid.cli.identify import identify
from robotid.identification.summary import (
    error_lines,
    friction_lines,
    one_more_gain,
    verdict_lines,
)
from robotid.robot.model import RobotModel


def test_its_text_has_verdict_reasons_and_every_joint(rng):
    arm = RobotModel.from_urdf(ROOT / "urdf" / "planar_2r.urdf")
    log, kept = (exact_log(arm, truth(arm), rng, samples=800, noise=0.1) for _ in range(2))
    found = identify(arm, [log], validation=[kept])
    text = str(found)
    assert text == found.summary()
    assert text.splitlines()[0].endswith(f"verdict {found.verdict.status}")
    for reason in found.verdict.reasons:
        assert reason in text
    for joint in found.model.joints:
        error = found.validation[0].metrics["estimate"].per_joint[joint].relative_error_pct
        (first, _) = [line.split() for line in text.splitlines() if line.split()[0] == joint]
        assert first[1] == f"{error:.1f}"
        assert text.count(f"  {joint} ") == 2  # kept and fitted rows


def test_joints_worse_than_a_constant_are_marked_wherever_they_stand():
    def lines(*better):
        joints = {
            joint: {
                "rmse": 0.25, "unit": "N m", "relative_error_pct": 120.0,
                "better_than_constant": is_so,
            }
            for joint, is_so in zip("abc", better, strict=True)
        }  # fmt: skip
        return error_lines({"per_joint": joints})

    note = "  * worse than a constant"
    for marked in ((0,), (1,), (0, 2)):
        found = lines(*(k not in marked for k in range(3)))
        assert found[-1] == note
        rows = found[-4:-1]
        assert [row.split()[1] == "*" for row in rows] == [k in marked for k in range(3)]
    assert not any("*" in line for line in lines(True, True, True))


def test_friction_is_said_from_the_first_step_to_the_last_that_was_taken():
    steps = [(20.0, True), (9.0, False), (8.04, True), (5.06, True), (3.0, False)]
    tried = [
        {"held_out_error_pct": error, "is_selected": is_selected} for error, is_selected in steps
    ]
    joints = {
        "a": {"families": ["tanh", "load"], "tried": tried},
        "b": {"families": [], "tried": tried[:2]},
        "c": {"families": ["lag"], "tried": tried[:3]},
    }
    assert friction_lines(joints) == [
        "friction besides viscous and Coulomb:",
        "  a: tanh + load (held-out error 20.0 -> 5.1 %)",
        "  c: lag (held-out error 20.0 -> 8.0 %)",
    ]
    assert friction_lines({"b": joints["b"]}) == []


def test_one_more_log_narrows_the_next_interval_by_a_share_of_its_width():
    more = {"std_error": 0.8, "interval_width": 3.0}
    found = one_more_gain({"std_error": 1.0, "next_interval": [-1.0, 3.0], "one_more": more})
    assert found == pytest.approx((0.2, 0.25))


def test_a_reason_of_a_joint_is_shown_once():
    verdict = {
        "status": "poor",
        "reasons": ["a: bad", "c: slow", "a: slow", "no log"],
        "per_joint": {
            "a": {"status": "poor", "reasons": ["a: bad", "a: slow"]},
            "b": {"status": "good", "reasons": ["error 3 %"]},
            "c": {"status": "usable", "reasons": ["c: slow"]},
            "d": {"status": "good", "reasons": ["error 4 %"]},
        },
    }
    assert verdict_lines(verdict) == [
        "verdict: poor", "  a: poor: bad", "  c: usable: slow", "  - a: slow", "  - no log",
        "  b, d: good",
    ]  # fmt: skip
    alone = {"status": "good", "reasons": ["fine"], "per_joint": {"b": verdict["per_joint"]["b"]}}
    assert verdict_lines(alone) == ["verdict: good", "  - fine", "  every joint: good"]
