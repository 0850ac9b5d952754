"""The doctor finds what is wrong, by its own code, and nothing where nothing is."""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from helpers.corruptions import CASES, NOISE, ROBOTS, clean_log, controlled_log, robot, table_of
from helpers.legged import with_other_bodies
from helpers.paths import ROOT
from helpers.synthetic import exact_log, perfect, truth

from robotid.base.findings import Finding, grouped
from robotid.cli import main
from robotid.cli.doctor import doctor
from robotid.cli.job import Job, LogEntry, read_job
from robotid.cli.logs import examine
from robotid.data.files.read import write_columns, write_log
from robotid.data.log import REPEATED, Log, Trajectory, repeated_share
from robotid.data.signal_settings import SignalSettings
from robotid.data.signals import process
from robotid.diagnosis.explanations import explained
from robotid.diagnosis.logs.channels import check_clock
from robotid.diagnosis.logs.check_logs import check_excitation, diagnose, findings_to_dict
from robotid.diagnosis.urdf.inspection import inspect_urdf
from robotid.dynamics.base_parameters import structural_mapping
from robotid.dynamics.simulation.motions import random_fourier
from robotid.dynamics.simulation.simulation_settings import Sensors
from robotid.dynamics.simulation.simulator import another_robot, simulate
from robotid.dynamics.torque import joint_torque_regressor
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel
from robotid.robot.prior import prior_spread

JOBS = Path(__file__).parents[2] / "jobs"
SIGNALS = SignalSettings()


@pytest.fixture(scope="module")
def table():
    """The table of a log at 100 Hz."""
    return table_of(controlled_log("ur5", 0))


#: Whose fault is not one at 50 Hz; for all others every other row does.
AT_100_HERTZ = {"velocity of a 12-bit encoder", "too few rows"}


@pytest.fixture(scope="module")
def short(ur5):
    return clean_log(ur5, 0, duration=5.0)


def loud(findings):
    return {f.code for f in findings if f.severity != "note"}


def spoil(name, table, folder):
    """Return the job of a table as a case changes it."""
    case, path = CASES[name], folder / "run.csv"
    if name not in AT_100_HERTZ:
        table = {column: values[::2] for column, values in table.items()}
    write_columns(case.change(table), path)
    return Job(example_urdf(case.urdf), gravity=case.gravity, identification=(LogEntry(path),))


@pytest.fixture(scope="module")
def spoilt(table, tmp_path_factory):
    """The job of each spoilt table and what is found of it, examined once."""

    @cache
    def examined_once(name):
        job = spoil(name, table, tmp_path_factory.mktemp("spoilt"))
        return job, examine(job)

    return examined_once


@pytest.mark.parametrize("name", ROBOTS)
def test_a_clean_log_gives_no_more_than_notes(name):
    # that of the UR5 is there, for others to be spoilt
    how = {} if name == "ur5" else {"rate": 50.0, "duration": 7.0}
    findings = diagnose(robot(name), [controlled_log(name, 0, **how)], [], SIGNALS)
    assert loud(findings) == set()
    assert {"rate", "noise", "excitation"} <= {f.code for f in findings}


@pytest.mark.parametrize("seed", range(4))
def test_an_exact_log_gives_no_more_than_notes(ur5, seed):
    log = exact_log(ur5, truth(ur5, seed), np.random.default_rng(seed), samples=1500, rate=100.0)
    assert loud(diagnose(ur5, [log], [], SIGNALS)) == set()


# what a corruption cannot but show besides its own code
BESIDES = {
    "two position columns swapped": {"position_order"},
    "static joint": {"excitation"},
    "stale rows": {"unexplained_torque"},
    "torques held for 5 rows": {"torque_delay"},  # by two rows on average
    "five spikes of 1000 N m": {"unexplained_torque"},
}


@pytest.mark.parametrize("name", CASES)
def test_each_corruption_is_found_by_its_own_code(name, spoilt):
    case, (_, findings) = CASES[name], spoilt(name)
    assert set(case.codes) & loud(findings)  # a note is not read
    assert loud(findings) - set(case.codes) <= BESIDES.get(name, set())
    json.dumps(findings_to_dict(findings), allow_nan=False)


@pytest.mark.parametrize(
    ("name", "seed"), [("torques without their sign", 0), ("torque delayed by 30 ms", 3)]
)
def test_a_fault_of_all_torques_that_hardly_shows_in_one_is_found(name, seed, tmp_path):
    table, path = table_of(clean_log(robot("ur5"), seed)), tmp_path / "run.csv"
    write_columns(CASES[name].change(table), path)
    job = Job(urdf=example_urdf("ur5_robot.urdf"), identification=(LogEntry(path),))
    assert loud(examine(job)) == set(CASES[name].codes)


def test_where_names_the_joint_and_the_evidence_says_how_much(spoilt):
    (found,) = (f for f in spoilt("one torque negated")[1] if f.code == "torque_sign")
    assert found.where == "run.csv: elbow_joint"
    assert found.evidence["unexplained"] == pytest.approx(0.30, abs=0.01)
    assert found.evidence["unexplained_if_negated"] < 0.005
    assert "negate tau_elbow_joint" in found.message
    (found,) = (f for f in spoilt("two torque columns swapped")[1] if f.code == "torque_order")
    assert found.where == "run.csv: shoulder_lift_joint, wrist_1_joint"
    assert "tau_wrist_1_joint is the torque of shoulder_lift_joint" in found.message


def recorded(model, change=lambda robot: None, gravity=1.0, inertia=1.0, gain=(1.0,) * 6):
    """Return a log of Pinocchio's own UR5 with bodies 10 % off, friction and 1 % of noise."""
    rng, robot = np.random.default_rng(0), pin.Model(model.pin_model)
    for body in robot.inertias.tolist()[1:]:
        body.mass *= rng.uniform(0.9, 1.1)
    change(robot)
    t = np.arange(0.0, 12.0, 0.01)
    w = 2 * np.pi * 0.15 * np.arange(1, 5)[:, None, None]
    size, phase = rng.uniform(0.1, 0.3, (4, 1, 6)), rng.uniform(0, 2 * np.pi, (4, 1, 6))
    angle = w * t[:, None] + phase
    q, v, a = (size * x for x in (np.sin(angle), w * np.cos(angle), -(w**2) * np.sin(angle)))
    q, v, a = (x.sum(axis=0) for x in (q, v, a))
    q += [0.0, -1.0, 1.2, 0.5, 0.8, 0.0]
    data, still = robot.createData(), np.zeros(6)
    weight = np.array([pin.rnea(robot, data, x, still, still) for x in q])
    whole = np.array([pin.rnea(robot, data, *x) for x in zip(q, v, a, strict=True)])
    tau = inertia * (whole - weight) + gravity * weight
    friction = 0.1 * np.tanh(v / 0.01) + 0.05 * v
    tau += whole.std(axis=0) * (friction + 0.01 * rng.standard_normal(v.shape))
    return Log(t=t, q=q, tau=np.asarray(gain) * tau, joints=model.joints, path="run.csv")


def pulled(model, log):
    """Return a log with a force beside the last link, constant in the world."""
    engine, point, force = model.pin_model, np.array([-0.2, -0.1, -0.1]), [-13.0, -6.0, 2.0]
    data, tau = engine.createData(), log.tau.copy()
    for k, q in enumerate(log.q):
        J = pin.computeJointJacobian(engine, data, q, 6)
        pin.forwardKinematics(engine, data, q)
        tau[k] -= (J[:3].T + np.cross(J[3:].T, point)) @ data.oMi[6].rotation.T @ force
    return replace(log, tau=tau)


def hung(robot):
    robot.gravity.linear = 9.81 * np.array([0.0, np.sin(0.35), -np.cos(0.35)])


SHIFT = np.pi / 2 * np.array([0.0, 1.0, 0.0, 0.0, 1.0, 0.0])
QUARTER = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
READ = {
    "as it is": (lambda m: (m, recorded(m)), {}),
    "other bodies": (lambda m: (m, recorded(with_other_bodies(m, np.random.default_rng(0)))), {}),
    "pulled": (lambda m: (m, pulled(m, recorded(m))), {"unexplained_torque": ("wrist_3_joint",)}),
    "clock": (lambda m: (m, (x := recorded(m), replace(x, t=2 * x.t))[1]), {"time_scale": ()}),
    "slow": (lambda m: (m, (x := recorded(m), replace(x, t=1.25 * x.t))[1]), {"time_scale": ()}),
    "two zeros": (lambda m: (m, (x := recorded(m), replace(x, q=x.q + SHIFT))[1]), {
        "position_offset": ("shoulder_lift_joint", "wrist_2_joint")}),
    "wide": (lambda m: (m, (x := recorded(m), replace(x, q=1.1 * x.q))[1]), {"angle_scale": ()}),
    "axis": (lambda m: (m.with_turned_axis("elbow_joint", QUARTER, False), recorded(m)), {
        "axis_direction": ("elbow_joint",)}),
    "hung": (lambda m: (m, recorded(m, hung)), {"gravity": ()}),
    "currents": (lambda m: (m, recorded(m, gain=[1, 1, 1, 50, 50, 50])), {
        "current_for_torque": ("wrist_1_joint", "wrist_2_joint", "wrist_3_joint")}),
    "static": (lambda m: (m, recorded(m, inertia=0.0)), {"static_torque": ()}),
    "one compensated": (lambda m: (m, recorded(m, gravity=np.array([1, 1, 0, 1, 1, 1]))), {
        "gravity_compensated": ("elbow_joint",)}),
}  # fmt: skip


@pytest.mark.parametrize("name", READ)
def test_one_reading_explains_the_torques_of_a_plant_by_pinocchio(ur5, name):
    made, wanted = READ[name]
    model, log = made(ur5)
    found = [f for f in diagnose(model, [log], [], SIGNALS) if f.severity != "note"]
    codes = {code: tuple(j for f in found if f.code == code for j in f.joints) for code in wanted}
    assert codes == wanted
    assert {f.code for f in found} - {"excitation"} == set(wanted)
    sizes = {"speed": 0.5, "offset": np.pi / 2, "factor": 0.02, "angle_deg": np.degrees(0.35)}
    sizes |= {"slow": {"speed": 0.8}, "wide": {"factor": 1 / 1.1}}.get(name, {})
    for key, size in sizes.items():
        seen = [f.evidence[key] for f in found if key in f.evidence]
        assert seen == pytest.approx([size] * len(seen), rel=0.1)


def test_delays_are_measured_and_corrected_only_on_request(spoilt):
    job, findings = spoilt("torque delayed by 30 ms")
    (found,) = [f for f in findings if f.code == "torque_delay"]
    delay, error = found.evidence["delay"], found.evidence["std_error"]
    # 5 ms: unmodelled friction near a change of direction imitates a few
    assert abs(delay - 0.03) < max(3 * error, 0.005)
    stated = replace(job, signals=SignalSettings(torque_delay=0.03))
    assert "torque_delay" not in loud(examine(stated))
    job, findings = spoilt("velocity delayed by 30 ms")
    (found,) = [f for f in findings if f.code == "velocity_delay"]
    assert found.evidence["delay"] == pytest.approx(0.03, abs=0.001)
    stated = replace(job, signals=SignalSettings(velocity_delay=0.03))
    assert "velocity_delay" not in {f.code for f in examine(stated)}


def test_a_payload_is_weighed(ur5):
    pi = truth(ur5)
    last = pi[: ur5.layout.n_inertial].reshape(-1, 10)[-1]
    log = clean_log(ur5, 0, pi=pi, rate=50.0)
    # truth() has 10 to 30 % wrong masses and a tool of 1.2 kg, which is no cause for alarm
    (tool,) = [f for f in diagnose(ur5, [log], [], SIGNALS) if f.code == "payload"]
    assert tool.severity == "note"
    assert abs(tool.evidence["mass"] - 1.2) < 3 * tool.evidence["std_error"]
    last += 3.0 * np.array([1, 0, 0.05, 0.1, 0.02, 0, 0.02, 0, 0, 0.02])
    log = clean_log(ur5, 0, pi=pi, rate=50.0)
    findings = diagnose(ur5, [log], [], SIGNALS)
    (found,) = [f for f in findings if f.code == "payload"]
    assert loud(findings) == {"payload"}
    assert abs(found.evidence["mass"] - 4.2) < 3 * found.evidence["std_error"]
    # the load explains more of the torques than the sign of one of them does
    reversed_wrist = replace(log, tau=log.tau * [1, 1, 1, -1, 1, 1])
    assert "torque_sign" in loud(diagnose(ur5, [reversed_wrist], [], SIGNALS))


@pytest.mark.parametrize(("last", "severity"), [(1000, "error"), (300, "warning")])
def test_a_drive_that_is_off_is_no_sign_of_its_torque(ur5, last, severity):
    log, rng = clean_log(ur5, 0, duration=10.0), np.random.default_rng(0)
    tau = log.tau.copy()
    tau[:last, 1] = 0.05 * rng.standard_normal(len(tau[:last])) - 0.02 * log.v[:last, 1]
    findings = diagnose(ur5, [replace(log, tau=tau)], [], SIGNALS)
    (found,) = [f for f in findings if f.code == "drive_off"]
    assert (found.where, found.severity) == ("run.csv: shoulder_lift_joint", severity)
    assert found.evidence["share"] == pytest.approx(last / 1000, abs=0.1)
    assert found.evidence["ratio"] < 0.02
    if severity == "error":
        assert {f.code for f in findings if f.joints == found.joints} == {"drive_off"}
        wrong = replace(log, tau=tau, q=log.q[:, [0, 1, 3, 2, 4, 5]])  # as the URDF's torque is
        assert "drive_off" not in loud(diagnose(ur5, [wrong], [], SIGNALS))


def test_a_recording_that_is_fitted_twice_is_named(ur5, short):
    again = replace(short, path="again.csv", t=short.t + 3.0)
    findings = diagnose(ur5, [short, clean_log(ur5, 1, duration=5.0), again], [], SIGNALS)
    (found,) = [f for f in findings if f.code == "repeated_log"]
    assert (found.where, found.severity) == ("again.csv", "warning")
    assert f"the same recording as {short.name}" in found.message


def test_rows_that_are_stamped_on_arrival_have_no_other_fault(ur5, short):
    k = np.arange(len(short.t))
    t = short.t[np.minimum(k // 8 * 8 + 7, len(k) - 1)] + 1e-5 * (k % 8)
    found = diagnose(ur5, [replace(short, t=t, assumed=("q in rad",))], [], SIGNALS)
    severities = {f.code: f.severity for f in found if f.severity != "note"}
    assert severities == {"bunched_stamps": "error", "log_assumption": "warning"}


@pytest.mark.parametrize(("joint", "seed"), [(2, 2), (3, 0)])
def test_a_zero_competes_by_its_best_start(ur5, joint, seed):
    pi, n = ur5.standard_parameters(), ur5.layout.n_inertial
    pi[:n] *= np.repeat(np.random.default_rng(seed).choice([0.6, 1.5], n // 10), 10)
    log = clean_log(ur5, seed, rate=50.0, duration=10.0, pi=pi)
    (found,) = diagnose(ur5, [replace(log, q=log.q + 0.3 * np.eye(6)[joint])], [], SIGNALS)[:1]
    assert (found.code, found.joints) == ("position_offset", (ur5.joints[joint],))


def test_stamps_that_are_not_those_of_the_rows_and_a_log_that_stops_are_named(ur5):
    log, shift = controlled_log("ur5", 0), np.random.default_rng(0).uniform(-0.004, 0.004, 2001)
    (found,) = (f for f in check_clock(replace(log, t=log.t + shift)) if f.code == "jitter")
    assert (found.severity, found.evidence["ratio"] < 0.1) == ("warning", True)
    gap = log.t + shift + 0.5 * (log.t > 10.0)  # equal steps are no explanation of a log with gaps
    (found,) = (f for f in check_clock(replace(log, t=gap)) if f.code == "jitter")
    assert found.severity == "note"
    last = np.minimum(np.arange(2001), 1400)
    values = {"q": log.q[last], "v": None, "tau": log.tau[last]}
    (found,) = (f for f in check_clock(replace(log, **values)) if f.code == "stale_rows")
    assert (found.severity, found.evidence["rows"]) == ("warning", 600)
    assert "cut the log with end = 14" in found.message


def test_an_origin_in_millimetres_is_the_only_cause(short, tmp_path):
    text = Path(URDF).read_text().replace("0.0 -0.1197 0.425", "0.0 -119.7 425")
    (tmp_path / "mm.urdf").write_text(text)
    model = RobotModel.from_urdf(tmp_path / "mm.urdf")
    (found,) = (f for f in diagnose(model, [short], [], SIGNALS) if f.severity != "note")
    assert (found.code, found.severity) == ("origin_units", "error")
    assert found.joints == ("elbow_joint",)
    spring = Finding("spring", "warning", "elbow_joint", "", joints=found.joints)  # of a fit
    assert [x.severity for x in explained([found, spring], model)] == ["error", "note"]


# ---- the recordings of other laboratories
def whole(recordings, monkeypatch, name, *files):
    monkeypatch.setenv("ROBOTID_DATA", str(recordings))
    job = read_job(JOBS / f"{name}.toml")
    folder = job.identification[0].path.parent
    entries = tuple(LogEntry(folder / f"{file}.parquet") for file in files)
    return replace(job, identification=entries[:1], validation=entries[1:])


def test_ur10e_carries_a_load_and_moves_one_joint_at_a_time(recordings, monkeypatch):
    files = "ident_20200219_14harm_load", "ident_20200219_14harm"
    findings = examine(whole(recordings, monkeypatch, "ur10e", *files))
    payload = {f.where.split(":")[0]: f for f in findings if f.code == "payload"}
    loaded = payload["ident_20200219_14harm_load.parquet"]
    assert loaded.severity == "warning"
    assert loaded.evidence["mass"] == pytest.approx(2.805, abs=3 * loaded.evidence["std_error"])
    assert "ident_20200219_14harm.parquet" not in payload
    assert "repeated_motion" in loud(findings)  # the same motion with and without the load
    single = examine(whole(recordings, monkeypatch, "ur10e", "jointwise_2"))
    still = {f.where.split(": ")[1] for f in single if f.code in ("static_joint", "hardly_moves")}
    assert "shoulder_lift_joint" not in still
    assert len(still) >= 4


@pytest.mark.parametrize("file", ["log_143747", "log_144115"])
def test_the_drive_of_a_recorded_pendulum_is_off(recordings, file):
    folder = recordings / "pendulums" / "dfki_double_pendulum_C1"
    job = Job(folder / "robot.urdf", identification=(LogEntry(folder / f"{file}.parquet"),))
    assert [f.code for f in examine(job) if f.severity == "error"] == ["drive_off"]


def test_motor_side_columns_are_refused_by_name(recordings, monkeypatch):
    findings = examine(whole(recordings, monkeypatch, "tx40", "motor_side"))
    assert [f.code for f in findings] == ["missing_column"]


# ---- command line and identify
@pytest.fixture(scope="module")
def wrong_sign(planar, tmp_path_factory):
    path = tmp_path_factory.mktemp("doctor") / "run.csv"
    table = table_of(clean_log(planar, 0, duration=10.0, rate=50.0))
    table |= {"tau_joint_2": -table["tau_joint_2"]}
    write_columns(table, path)
    return str(path)


URDF, PLANAR = str(example_urdf("ur5_robot.urdf")), str(ROOT / "urdf" / "planar_2r.urdf")


def test_doctor_prints_findings_as_json_and_as_text(wrong_sign, tmp_path, capsys):
    assert main(["doctor", PLANAR, wrong_sign, "--json"]) == 1
    (first, *_) = json.loads(capsys.readouterr().out)["findings"]
    assert set(first) == {"code", "severity", "where", "message", "evidence"}
    assert (first["code"], first["severity"]) == ("torque_sign", "error")
    assert main(["doctor", PLANAR, wrong_sign]) == 1
    assert capsys.readouterr().out.startswith("error: torque_sign: run.csv: the torque of joint_2")
    job = tmp_path / "job.toml"
    job.write_text(f'urdf = "{PLANAR}"\n[[identification]]\nlog = "{wrong_sign}"\n')
    assert main(["doctor", str(job)]) == 1
    assert "torque_sign" in capsys.readouterr().out
    assert main(["doctor", PLANAR, wrong_sign, "--ignore", "torque_sign"]) == 0
    assert main(["doctor", PLANAR, wrong_sign, "--ignore", "torque_sgn"]) == 2
    assert main(["doctor", PLANAR, str(tmp_path / "none.csv")]) == 1


def test_what_makes_a_result_wrong_leads_its_verdict_unless_it_is_ignored(
    wrong_sign, tmp_path, capsys
):
    job = tmp_path / "job.toml"
    job.write_text(
        f'urdf = "{PLANAR}"\n[output]\nreport = false\n[[identification]]\nlog = "{wrong_sign}"\n'
    )
    words = ["identify", str(job), "--out", str(tmp_path / "out"), "--json"]
    assert main(words) == 1
    result = json.loads(capsys.readouterr().out)
    assert result["verdict"]["status"] == "poor"
    assert "the torque of joint_2 has the opposite sign" in result["verdict"]["reasons"][0]
    assert "torque_sign" in [warning["code"] for warning in result["warnings"]]
    words = ["identify", PLANAR, wrong_sign, *words[2:], "--estimator", "wls", "--no-report"]
    assert main([*words, "--ignore", "torque_sign"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert not any("opposite sign" in reason for reason in result["verdict"]["reasons"])
    assert result["settings"]["doctor"] == {"ignore": ["torque_sign"]}


def test_a_log_of_standing_still_is_said_to_be_one(short, tmp_path):
    still = replace(short, q=0.0 * short.q + short.q[0], v=0.0 * short.q)
    write_log(still, tmp_path / "still.csv")
    job, stages = Job(Path(URDF), identification=(LogEntry(tmp_path / "still.csv"),)), []
    found = examine(job, progress=lambda *stage: stages.append(stage))
    assert {"no_motion", "static_joint"} <= loud(found)
    assert stages == [("reading logs", 0, 2, "stages"), ("checking logs", 1, 2, "stages")]


@pytest.mark.parametrize("name", ["finger_edu.urdf", "so101.urdf", "double_pendulum.urdf"])
def test_a_clean_log_of_a_small_arm_at_30_hertz_raises_no_alarm(name):
    model = RobotModel.from_urdf(example_urdf(name))
    rng = np.random.default_rng(0)
    size, pi = model.layout.n_inertial, another_robot(model, rng)
    # no tool of 1.2 kg: these arms would rightly be said to carry a load
    share = rng.uniform(0.8, 1.2, size // 10)
    pi[:size] = (model.standard_parameters()[:size].reshape(-1, 10) * share[:, None]).ravel()
    motion, sensors = random_fourier(model, rng, period=10.0), Sensors(noise=NOISE)
    log = perfect(model, pi, motion, rng, rate=30.0, duration=20.0, sensors=sensors)
    found = diagnose(model, [log], [], SignalSettings())
    assert [f.code for f in found if f.severity != "note"] == []
    # that of so101 writes 1.5708 for pi / 2
    assert ("rounded_rpy" in {f.code for f in found}) == (name == "so101.urdf")


def test_check_logs_asks_the_doctor_with_the_default_signals(model, rng):
    log, other = (exact_log(model, truth(model), rng, samples=400) for _ in range(2))
    log = replace(log, tau=log.tau[:, [1, 0, 2]], path="fit.csv")
    kept = [replace(other, path="kept.csv"), replace(log, path="again.csv")]
    found = doctor(model, [log], validation=kept)
    assert found == diagnose(model, [log], kept, SignalSettings())
    said = {(finding.code, finding.where.partition(":")[0]) for finding in found}
    assert ("torque_order", "fit.csv") in said
    assert ("repeated_motion", "again.csv") in said
    assert ("repeated_motion", "kept.csv") not in said
    assert ("rate", "kept.csv") in said


def test_a_clean_log_of_a_light_arm_at_30_hertz_raises_no_alarm():
    # 33 ms in two Runge-Kutta steps: the simulated log itself would be wrong
    model = RobotModel.from_urdf(example_urdf("talos_left_arm.urdf"))
    rng = np.random.default_rng(0)
    pi = another_robot(model, rng)  # with a tool of 1.2 kg
    motion = random_fourier(model, rng, period=5.0)
    log = simulate(model, pi, motion, rate=30.0, duration=10.0, rng=rng, noise=NOISE)
    assert loud(diagnose(model, [log], [], SIGNALS)) == set()


def test_a_load_is_not_taken_for_another_gravity():
    # 1.2 kg in the hand of an arm of 0.6 kg
    model = RobotModel.from_urdf(example_urdf("so101.urdf"))
    assert "gravity" not in loud(diagnose(model, [clean_log(model, 0)], [], SIGNALS))


# --- traps that the publishers of recordings warn of ----------------------------------------------
# what the notes of each set say, and the finding with its figure
TRAPS = {
    "kinova_gen3/gen3_1.parquet": [
        ("gap", "longest", 0.9, 1.0),  # slow samples were removed
        ("jitter", "relative_spread", 0.16, 0.17),
    ],
    "kinova_gen3/gen3_2.parquet": [("gap", "gaps", 2, 4)],
    "tx40/joint_side.parquet": [
        ("rate", "rate", 4999, 5001),
        ("standstill", "after", 1.2, 1.6),  # motion 0-7.45 s of 9, cut and trimmed by the settings
    ],
    "ur10e/ident_20200212_50s12h.parquet": [
        ("standstill", "before", 2.0, 4.0),  # every file starts and ends at rest
        ("standstill", "after", 3.0, 6.0),
    ],
    "tiago/tiago_dyn.parquet": [
        ("velocity_delay", "delay", 0.13, 0.2),  # 140-190 ms, smoothed by the driver
        ("quantised", "steps_arm_5_joint", 20, 60),  # wrist currents of a few quanta
        ("quantised", "steps_arm_7_joint", 20, 60),
        ("standstill", "before", 6.0, 10.0),  # about 9 s at rest, then slow
        ("standstill", "after", 11.0, 13.0),
        ("unexplained_torque", "share", 0.7, 0.8),  # of the last joint
    ],
    "panda/panda_inria.parquet": [
        ("jitter", "longest", 0.0019, 0.009),  # 0.7-8.8 ms around 1 ms
        ("stale_rows", "rows", 1000, 1300),  # 1255 repeated rows, those at rest among them
        ("velocity_delay", "delay", 0.004, 0.008),  # about 6 ms
        ("gap", "longest", 0.0085, 0.009),
    ],
}
FOLDERS = {"panda": "panda_inria"}


@pytest.mark.parametrize("file", TRAPS)
def test_the_doctor_finds_the_traps_of_a_real_recording(recordings, monkeypatch, file):
    monkeypatch.setenv("ROBOTID_DATA", str(recordings))
    folder = file.split("/", maxsplit=1)[0]
    job = read_job(JOBS / f"{FOLDERS.get(folder, folder)}.toml")
    model = job.model()
    findings = diagnose(model, [job.read(LogEntry(recordings / file), model)], [], job.signals)
    assert not [f.code for f in findings if f.severity == "error"]
    for code, figure, low, high in TRAPS[file]:
        values = [f.evidence[figure] for f in findings if f.code == code and figure in f.evidence]
        assert any(low <= value <= high for value in values), (code, figure, values)


def test_joints_that_turn_freely_but_are_stated_without_limits_are_named(recordings):
    found = inspect_urdf(recordings / "kinova_gen3" / "robot.urdf").findings
    (cause,) = (c for c in grouped(found) if c.code == "no_limits")
    assert {f.where for f in cause.findings} == {f"joint joint_{k}" for k in (1, 3, 5, 7)}
    assert len(cause.messages) == 1


# --- repeated motions and excitation --------------------------------------------------------------
EXACT = SignalSettings(cutoff=None, trim=0.0, min_velocity=0.0)


@pytest.fixture(scope="module")
def motions(planar):
    """Motions of 10 s at 100 Hz, one quicker than the other."""
    rng = np.random.default_rng(1)
    logs = [
        exact_log(planar, truth(planar), rng, samples=n, rate=100.0, noise=[0.2, 0.05])
        for n in (1000, 1000, 600)
    ]
    return [process(log, EXACT) for log in logs]


def joined(first, second):
    """Return the rows of two motions as segments of one."""
    later = second.t - second.t[0] + first.t[-1] + 5.0
    arrays = {k: np.vstack([getattr(first, k), getattr(second, k)]) for k in ("q", "v", "a", "tau")}
    segment = np.repeat([0, 1], [len(first.t), len(second.t)])
    t = np.append(first.t, later)
    return Trajectory(t=t, joints=first.joints, rate=None, segment=segment, **arrays)


def test_the_share_that_repeats_is_that_of_the_log_that_has_most_of_it(motions):
    first, second, other = motions
    kept = joined(first.at(slice(100, 600)), other)
    # rows that go on for a second, 400 of the first segment and 500 of the second, and move in it
    moved = [np.abs(part[100:] - part[:-100]) / np.ptp(kept.q, axis=0) > 0.04
             for part in np.split(kept.q, [500])]  # fmt: skip
    old, new = (part.any(axis=1).sum() for part in moved)
    assert old == 400
    for fitted in ([first, second], [second, first]):
        assert repeated_share(fitted, kept) == pytest.approx(old / (old + new), abs=0.005)
    assert repeated_share([second], kept) == 0.0
    # 150 of 650 are less than three tenths
    assert repeated_share([first], joined(first.at(slice(0, 250)), other)) < REPEATED


def test_excitation_is_that_of_the_weighted_rows_of_all_motions(planar, motions):
    mapping, two = structural_mapping(planar), motions[1:]
    (found,) = check_excitation(planar, mapping, two, EXACT, "one, other")
    Y = np.concatenate([joint_torque_regressor(planar, m.q, m.v, m.a) for m in two])
    W = Y[:, mapping.independent].reshape(-1, 2, len(mapping.K))
    tau, sigma = np.concatenate([m.tau for m in two]), np.ones(2)
    for _ in range(30):
        rows = (W / sigma[:, None]).reshape(-1, W.shape[2])
        beta = np.linalg.lstsq(rows, (tau / sigma).ravel(), rcond=None)[0]
        sigma = np.sqrt(np.mean((tau - W @ beta) ** 2, axis=0))
    rows = (W / sigma[:, None]).reshape(-1, W.shape[2])
    condition = np.linalg.cond(rows / np.linalg.norm(rows, axis=0))
    assert found.evidence["condition"] == pytest.approx(condition, rel=2e-3)
    # of the plausible spread of base parameters, what the rows leave of its largest sum
    spread = prior_spread(planar, sum(m.squares for m in two), sum(len(m.t) for m in two))
    L = np.linalg.cholesky(mapping.K @ np.diag(spread**2) @ mapping.K.T)
    weakest = 1.0 / np.sqrt(1.0 + np.linalg.eigvalsh((rows @ L).T @ rows @ L)[0])
    assert found.evidence["weakest"] == pytest.approx(weakest, rel=2e-3)
    b = len(mapping.K)
    assert (found.evidence["rank"], found.evidence["base"]) == (b, b)
    assert found.severity == "note"
    assert found.message.startswith(f"one, other: the motion determines {b} of {b} base parameters")
    assert (
        f"(condition number {found.evidence['condition']:.3g} of the regressor, unit columns); no "
        "action needed" in found.message
    )


def test_the_excitation_by_a_joint_at_rest_is_checked_too(planar, motions):
    """The rows determine fewer sums than there are base parameters."""
    still = {name: getattr(motions[2], name) * [1.0, 0.0] for name in ("q", "v", "a")}
    mapping, motion = structural_mapping(planar), replace(motions[2], **still)
    (found,) = check_excitation(planar, mapping, [motion], EXACT, "one")
    Y = joint_torque_regressor(planar, motion.q, motion.v, motion.a)[:, mapping.independent]
    b = len(mapping.K)
    assert (found.evidence["rank"], found.evidence["base"]) == (np.linalg.matrix_rank(Y), b)
    assert found.evidence["rank"] < b
    assert found.severity == "warning"
    assert found.message.startswith("one: the motion determines 7 of 11 base parameters")
