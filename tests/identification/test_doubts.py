import numpy as np
import pytest
from helpers.synthetic import exact_log, truth

from robotid.commands.identify import run_job
from robotid.commands.job import job_from_settings
from robotid.commands.validate import validate_result
from robotid.findings import Finding
from robotid.identification.doubts import doubts_of, is_outvoted
from robotid.identification.verdict import Doubt
from robotid.logs.read import write_log
from robotid.robot.examples import example_urdf

NOISE = np.array([2.0, 2.0, 1.0, 0.3, 0.3, 0.1])
JOINTS = ("a", "b", "c")


def finding(code, where, severity="warning", **evidence):
    return Finding(code, severity, where, "what was found", evidence)


@pytest.mark.parametrize(
    ("where", "joints"),
    [("run.csv: b", ["b"]), ("b", ["b"]), ("run.csv: a, c", ["a", "c"]), ("run.csv", [""])],
)
def test_a_doubt_is_about_the_joints_that_the_finding_names(where, joints):
    found = doubts_of([finding("unexplained_torque", where)], JOINTS)
    assert [doubt.joint for doubt in found] == joints
    assert found[0].message.startswith("run.csv: much" if joints == [""] else "much of the torque")


def test_notes_errors_and_harmless_warnings_raise_no_doubt():
    harmless = [
        finding("clipped", "run.csv: a", "note"),
        finding("torque_sign", "run.csv: a", "error"),  # leads the verdict as it is
        finding("velocity_delay", "run.csv"),
        finding("payload", "run.csv: link"),
        finding("constraint_costs", "a", error_pct=1.9, wls_error_pct=1.0),
        finding("constraint_costs", "b", error_pct=0.9, wls_error_pct=1e-3),
    ]
    assert doubts_of(harmless, JOINTS) == ()


def test_what_several_logs_show_is_said_once():
    found = doubts_of([finding("clipped", f"{log}: a") for log in ("one", "two")], JOINTS)
    assert found == (Doubt("clipped", "a", "the torque is clipped at a limit"),)


def test_figures_are_stated():
    (late,) = doubts_of([finding("torque_delay", "run.csv", delay=0.0562)], JOINTS)
    assert late.message == "run.csv: the torque is late against the position by 0.056 s"
    (costs,) = doubts_of([finding("constraint_costs", "a", error_pct=4.0, wls_error_pct=1)], JOINTS)
    assert costs.message.startswith("4.0 % of the torque is missed where it was fitted, 1.0 %")


def test_a_repeated_motion_matters_if_no_other_motion_was_kept_apart():
    repeated = [finding("repeated_motion", "one.csv")]
    assert doubts_of(repeated, JOINTS, ["one.csv", "two.csv"]) == ()
    assert doubts_of(repeated, JOINTS) == ()
    (doubt,) = doubts_of(repeated, JOINTS, ["one.csv"])
    assert "no prediction was tested" in doubt.message


def test_a_robust_loss_excuses_jumps_of_the_torque_and_what_they_cause():
    jump = finding("spikes", "run.csv: tau_a", "error")
    assert is_outvoted(jump)
    assert not is_outvoted(finding("spikes", "run.csv: q_a", "error"))
    found = [jump, finding("unexplained_torque", "run.csv: a")]
    assert doubts_of(found, JOINTS, is_robust=True) == ()
    assert [doubt.joint for doubt in doubts_of(found, JOINTS)] == ["a"]
    other = [jump, finding("unexplained_torque", "run.csv: b")]
    assert [doubt.joint for doubt in doubts_of(other, JOINTS, is_robust=True)] == ["b"]


@pytest.fixture
def run(ur5, tmp_path):
    """Run a job on two logs of the same arm, the fitted one as a test spoils it."""

    def runner(spoil=None, ignore=(), **settings):
        names = ("run.csv", "kept.csv")
        for name, rng in zip(names, np.random.default_rng(0).spawn(2), strict=True):
            log = exact_log(ur5, truth(ur5), rng, samples=800, rate=100.0, noise=0.1 * NOISE)
            if spoil is not None:
                log = spoil(log, name)
            write_log(log, tmp_path / name)
        table = {
            "urdf": str(example_urdf("ur5_robot.urdf")),
            "identification": [{"log": "run.csv"}],
            "validation": [{"log": "kept.csv"}],
            "estimator": {"prior_weight": 1.0, "draws": 0, **settings},
            "doctor": {"ignore": list(ignore)},
        }
        out = tmp_path / "out"
        found, result = run_job(job_from_settings(table, "job.toml", tmp_path), out)
        again = validate_result(out / "result.json", [tmp_path / "kept.csv"])
        return found, result, again["verdict"]

    return runner


def test_a_stated_bound_that_binds_makes_it_usable(run):
    far = {"com": {"forearm_link": [[1, 1, 1], [1.2, 1.2, 1.2]]}}
    _, result, again = run(constraints=far)
    assert result["verdict"]["status"] == again["status"] == "usable"
    bound = "centre_of_mass forearm_link: the data, or the masses that it leaves, speak against"
    assert bound in str(result["verdict"])
    (finding,) = [f for f in result["warnings"] if f["code"] == "bound_binds"]
    assert "the data push against them at ['shoulder_pan_joint'," in finding["message"]


def test_a_stated_bound_that_only_the_urdf_minds_is_a_note(run):
    found, result, _ = run(constraints={"total_mass": [10.0, 17.0]})
    (finding,) = [f for f in result["warnings"] if f["code"] == "bound_binds"]
    assert found.doubts == ()
    assert "the torque is explained as well as without" in finding["message"]
    assert found.verdict.status == "good"


def test_a_mass_that_is_stated_does_not_come_from_the_data(run):
    _, result, _ = run(constraints={"mass": {"forearm_link": 2.0}})
    (mass,) = [p for p in result["standard_parameters"] if p["name"] == "forearm_link.m"]
    assert (mass["value"], mass["source"]) == (pytest.approx(2.0), "prior")


def test_a_wrong_total_mass_makes_the_joints_usable_that_it_costs(run):
    _, result, again = run(constraints={"total_mass": 5.0})
    assert result["verdict"]["status"] == again["status"] == "usable"
    lift = result["verdict"]["per_joint"]["shoulder_lift_joint"]
    assert lift["status"] == "usable"
    costs = [f["message"] for f in result["warnings"] if f["code"] == "constraint_costs"]
    assert costs
    assert all("what [estimator] asks for ({'total_mass': 5.0})" in text for text in costs)
    assert "physics and data disagree" in lift["reasons"][-1]
    assert again["per_joint"]["shoulder_lift_joint"]["status"] == "usable"
    found, *_ = run(constraints={"total_mass": 5.0}, ignore=["constraint_costs"])
    assert "constraint_costs" not in {doubt.code for doubt in found.doubts}


def test_spikes_in_torques_do_not_condemn_a_robust_fit(run):
    def spoil(log, name):
        tau = log.tau.copy()
        if name == "run.csv":
            tau[[200, 400, 600], 2] += 1000.0
        return type(log)(**{**vars(log), "tau": tau})

    plain, result, _ = run(spoil)
    assert "jumps by up to" in result["verdict"]["reasons"][0]
    assert plain.alarms
    robust, result, again = run(spoil, robust="tukey")
    verdict = result["verdict"]
    assert verdict["status"] == again["status"] == "good", verdict["reasons"]
    assert verdict["doubts"] == []
    assert not robust.alarms
