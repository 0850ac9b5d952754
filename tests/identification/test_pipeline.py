from dataclasses import replace

import numpy as np
import pytest
from helpers.fitting import fit, identify
from helpers.synthetic import exact_log, truth

import robotid
from robotid.base.exceptions import DataError, RankDeficientError
from robotid.base.findings import Finding
from robotid.data.log import Log
from robotid.data.signal_settings import SignalSettings
from robotid.dynamics.base_parameters import structural_mapping
from robotid.estimation.fitting.estimator_settings import EstimatorSettings
from robotid.estimation.fitting.recorded import Recordings, hold_log
from robotid.identification.pipeline import conclude
from robotid.identification.summary import error_lines, friction_lines, one_more_gain, verdict_lines

EXACT = SignalSettings(cutoff=None, trim=0.0, min_velocity=0.0, velocity="measured")


def test_data_that_excite_too_little_are_refused_by_least_squares_only(ur5, rng):
    log = exact_log(ur5, truth(ur5), rng)
    q, v, a = (np.array(x) for x in (log.q, log.v, log.a))
    q[:, 5], v[:, 5], a[:, 5] = 0.3, 0.0, 0.0
    still = Log(t=log.t, q=q, v=v, a=a, tau=log.tau, joints=log.joints)
    with pytest.raises(RankDeficientError, match=r"undetermined: .*wrist_3_joint.viscous"):
        fit(ur5, [still], signals=EXACT, estimator="wls")
    found = identify(ur5, [still], signals=EXACT, estimator=EstimatorSettings())
    assert "wrist_3_joint.viscous" in found.estimate.undetermined
    assert found.verdict.status != "good"
    # what is named as undetermined is not named again as a drive that is known by its prior
    assert not [x for x in found.verdict.reasons if "as large as the prior's" in x]


def test_torques_that_are_all_0_are_refused(ur5, rng):
    log = exact_log(ur5, truth(ur5), rng, samples=300)
    off = replace(log, tau=0.0 * log.tau)
    with pytest.raises(DataError, match="the torque of every joint is 0 in all fitted logs"):
        identify(ur5, [off, off], signals=EXACT)
    identify(ur5, [off, log], signals=EXACT)
    tau = log.tau + rng.normal(0.0, 0.005, (300, 6)) * np.std(log.tau, axis=0)
    for dead in (0.0, 3.0):  # a channel that is dead changes no other joint
        part = replace(log, tau=np.column_stack([tau[:, :5], np.full(300, dead)]))
        found = robotid.identify(ur5, part, signals=EXACT, friction="viscous+coulomb")
        assert found.verdict.joints["wrist_3_joint"].status == "not evaluated"
        assert "wrist_3_joint: no recording has motion and a torque" in str(found.verdict.reasons)
        error = np.std(found.predict(log.q, log.v, log.a) - log.tau, axis=0)
        assert np.all(error[:5] < 0.01 * np.std(log.tau, axis=0)[:5])


def test_a_recording_that_was_fitted_does_not_show_what_repeats(planar, rng):
    """Of validation recordings, those that hold fitted rows do not count."""
    logs = [
        replace(
            exact_log(planar, truth(planar), rng, samples=300, noise=0.1), path=f"/logs/{name}.csv"
        )
        for name in "abc"
    ]
    own, kept = ([hold_log(planar, log, EXACT) for log in some] for some in (logs[:1], logs[1:]))
    mapping, choice = structural_mapping(planar), EstimatorSettings("wls")
    one_kept, code = [kept[0], own[0]], "repeated_motion"
    cases = (one_kept, [], True), (one_kept, [code], False), (kept, [], False)
    for beside, ignore, is_doubted in cases:
        guesses = [Finding(code, "warning", "b.csv", "")]
        recordings = Recordings(planar, mapping, own, beside)
        found = conclude(recordings, choice, guesses, ignore, friction="none")
        assert found.validation[1].is_refitted == (beside[1] is own[0])
        assert (code in {doubt.code for doubt in found.warnings}) == is_doubted


def test_a_fit_that_fails_says_what_the_doctor_warned_of(ur5, rng):
    log = exact_log(ur5, truth(ur5), rng, samples=300)
    still = hold_log(ur5, replace(log, v=0.0 * log.v), SignalSettings(cutoff=None))
    recordings = Recordings(ur5, structural_mapping(ur5), [still], [])
    with pytest.raises(DataError, match="0 torque rows") as caught:
        conclude(recordings, EstimatorSettings("wls"))
    assert not hasattr(caught.value, "__notes__")
    guesses = [
        Finding("jitter", "note", "run", "It shakes"),
        Finding("static_joint", "warning", "run", "It stands"),
        Finding("rows", "error", "run", str(caught.value)),
        Finding("clock", "error", "run", "It stops"),
    ]
    with pytest.raises(DataError, match="0 torque rows") as caught:
        conclude(recordings, EstimatorSettings("wls"), guesses)
    assert caught.value.__notes__ == [
        "doctor: warning: static_joint: It stands",
        "doctor: error: clock: It stops",
    ]


def test_a_drive_term_at_its_bound_has_no_error_and_what_stands_moved_little(ur5, rng):
    pi = truth(ur5)
    names = ur5.layout.names
    negative = names.index("elbow_joint.viscous")
    pi[negative] = -0.5  # as a Stribeck hook looks to a fit
    log = exact_log(ur5, pi, rng, samples=2000, noise=np.array([4, 4, 2, 0.5, 0.5, 0.2]))
    found = identify(ur5, [log], signals=EXACT)
    at_bound = [names[i] for i in np.flatnonzero(found.at_bound)]
    assert "elbow_joint.viscous" in at_bound
    assert {name.split(".")[1] for name in at_bound} <= {"viscous", "armature"}
    assert found.sources[negative] == "bound"
    assert found.standard_error[negative] == np.inf
    k = found.mapping.base_names.index("elbow_joint.viscous")
    np.testing.assert_array_equal(found.base_interval[k], [-np.inf, np.inf])
    open_ones = {found.mapping.base_names[k] for k in np.flatnonzero(np.isinf(found.base_error))}
    assert open_ones <= set(at_bound)
    (finding,) = [f for f in found.findings if f.code == "at_bound"]
    assert finding.message.startswith(f"{', '.join(at_bound)}: the estimate is 0, its bound")
    for i, source in enumerate(found.sources):
        if source == "prior":
            assert abs(found.standard[i] - found.prior[i]) <= 0.3 * found.prior_std[i]


def test_its_text_has_verdict_reasons_and_every_joint(planar, rng):
    log, kept = (exact_log(planar, truth(planar), rng, samples=800, noise=0.1) for _ in range(2))
    found = robotid.identify(planar, [log], validation=[kept])
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
        "further friction (held-out error): a tanh + load (20.0 -> 5.1 %), c lag (20.0 -> 8.0 %)"
    ]
    assert friction_lines({"b": joints["b"]}) == []


def test_one_more_log_narrows_the_next_interval_by_a_share_of_its_width():
    more = {"std_error": 0.8, "interval_width": 3.0}
    found = one_more_gain({"std_error": 1.0, "next_interval": [-1.0, 3.0], "one_more": more})
    assert found == pytest.approx((0.2, 0.25))


def test_a_reason_of_a_joint_is_shown_once():
    verdict = {
        "status": "poor",
        "reasons": ["a: bad", "c, a: slow", "e, f: cold", "no log"],
        "per_joint": {
            "a": {"status": "poor", "reasons": ["a: bad", "a: slow"]},
            "b": {"status": "good", "reasons": ["error 3 %"]},
            "c": {"status": "usable", "reasons": ["c: slow"]},
            "d": {"status": "good", "reasons": ["error 4 %"]},
            **{name: {"status": "poor", "reasons": ["e, f: cold"]} for name in "ef"},
        },
    }
    assert verdict_lines(verdict) == [
        "verdict: poor", "  a: poor, bad", "  - c, a: slow", "  e, f: poor, cold", "  - no log",
        "  b, d: good", "  c: usable, slow",
    ]  # fmt: skip
    alone = {"status": "good", "reasons": ["fine"], "per_joint": {"b": verdict["per_joint"]["b"]}}
    assert verdict_lines(alone) == ["verdict: good", "  - fine"]
