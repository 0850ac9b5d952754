"""Drives that follow commands, as simulators are given them: MuJoCo moves as the closed loop."""

import json
import os
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pinocchio as pin
import pytest
import yaml
from helpers.commanded_results import by_position, written_result
from helpers.mujoco_plant import LEG, ROBOTS, followed, loaded, multisine, plant, recorded

from robotid.base.exceptions import DataError, SettingsError
from robotid.cli import main
from robotid.data.log import Log
from robotid.dynamics.simulation.loops import ClosedLoopRobot, cut_windows
from robotid.identification.closed_loop.loop_result import logged_motion
from robotid.output.files.commanded import loops_of
from robotid.output.files.isaac import isaac_actuators
from robotid.output.files.mjcf import write_mjcf
from robotid.output.files.ranges import stated_ranges
from robotid.output.files.result_file import load_result
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

RATE = 200.0  # [Hz] of the commands
CHIRP = Path(os.environ.get("ROBOTID_DATA", "/none")) / "commands" / "go2" / "chirp.parquet"


@pytest.fixture(scope="module")
def commands():
    """Two seconds of the chirp of a real Go2 at its fastest; sines where it is not at hand."""
    if not CHIRP.is_file():
        t, rng = np.arange(400) / RATE, np.random.default_rng(0)
        return multisine(t, np.array([0.0, 1.0, -1.9]), np.array([0.3, 0.5, 0.5]), rng)
    import pyarrow.parquet as pq

    table = pq.read_table(CHIRP, columns=[f"qref_{joint}" for joint in LEG])
    return np.column_stack(table.columns)[2600:3000]


def reference(drives, q_ref, *, step=2e-4, settles=0.3):
    """Return the positions of the closed loop, shape (N, n), by another way than MuJoCo's.

    M dv = dt (clip(kp (q_ref(t - delay) - q) - kd v) - offset - Fv v - c) - friction, implicit in
    v; each joint's friction is the impulse within +-Fc dt that comes nearest to stopping it.
    """
    whole = pin.buildModelFromUrdf(str(example_urdf("go2.urdf")))
    held = [whole.getJointId(name) for name in whole.names[1:] if name not in LEG]
    robot = pin.buildReducedModel(whole, held, pin.neutral(whole))
    data, n, first = robot.createData(), len(drives), round(settles / step)
    kp, kd, late, zero, Ia, Fv, Fc, offset, most = np.array([
        [d.kp, d.kd, d.delay, d.zero, d.armature, d.viscous, d.coulomb, d.offset, d.effort_limit]
        for d in drives
    ]).T  # fmt: skip
    times = np.arange(first + round(len(q_ref) / RATE / step)) * step - settles
    rows = np.floor((times[:, None] - late) * RATE + 1e-6).astype(int)  # the command that is held
    q, v, found, friction = q_ref[0].copy(), np.zeros(n), np.empty((len(times), n)), np.zeros(n)
    for k, command in enumerate(q_ref[rows.clip(0), np.arange(n)]):
        found[k] = q
        M = pin.crba(robot, data, q + zero)
        M = np.triu(M) + np.triu(M, 1).T + np.diag(Ia)
        push = kp * (command - q) - kd * v
        D = step * (Fv + np.where(np.abs(push) < most, kd + step * kp, 0.0))
        force = np.clip(push, -most, most) - offset - pin.nle(robot, data, q + zero, v)
        A = np.linalg.inv(M + np.diag(D))
        drift = A @ (M @ v + step * force + np.where(np.abs(push) < most, step * kd * v, 0.0))
        for _ in range(4):  # Gauss-Seidel within the bounds, from the step before
            for j in range(n):
                stop = friction[j] + (drift[j] - A[j] @ friction) / A[j, j]
                friction[j] = min(max(stop, -Fc[j] * step), Fc[j] * step)
        v = drift - A @ friction
        q = q + step * v
    return found[first :: round(1 / RATE / step)]


@pytest.mark.parametrize(
    "changes",
    [{}, {"effort_limit": 2.5, "offset": 0.6, "zero": 0.05, "delay": 0.0113}],
    ids=["free", "limited, with offset and zero"],
)
def test_mujoco_follows_a_chirp_as_the_closed_loop_does(changes, commands):
    """Within 1 mrad of 0.6 to 1.3 rad at 5 rad/s; half of it are the steps of 1 ms."""
    leg = plant("leg", np.random.default_rng(1), **changes)
    wanted = reference(leg.drives, commands)
    found = followed(loaded(leg, RATE, 1e-3, as_exported=True), commands, RATE, settles=0.3)
    assert np.abs(found - wanted).max() < 1e-3
    assert np.abs(wanted - commands).max() > 0.05  # the drives matter
    for key in ("delay", "coulomb", "armature", "viscous", "kd"):  # and each of their figures
        other = replace(leg, drives=tuple(replace(d, **{key: 0.0}) for d in leg.drives))
        missed = followed(loaded(other, RATE, 1e-3, as_exported=True), commands, RATE, settles=0.3)
        assert np.abs(missed - wanted).max() > 2e-3, key


@pytest.mark.parametrize("late", [0.0, 0.0002, 0.0004, 0.003, 0.0063, 0.0100001])
def test_a_delay_is_exact_to_a_step(late):
    """A force at the beginning of a step acts half a step early, so it lags by half a step more."""
    step, leg = 0.001, plant("leg", np.random.default_rng(0), delay=late, coulomb=0.0)
    robot = loaded(leg, RATE, step)
    data = mujoco.MjData(robot)
    forces = []
    for k in range(40):
        data.ctrl[:] = 0.01 * k
        mujoco.mj_step(robot, data)
        data.qpos[:] = data.qvel[:] = 0.0
        forces.append(data.actuator_force[0])
    lag = np.arange(40) - 100 * np.array(forces) / leg.drives[0].kp
    np.testing.assert_allclose(lag[20:], max(late / step + 0.5, 1.0) if late else 0.0, atol=1e-9)


def test_a_filter_stands_for_the_delay_where_it_is_asked_for(tmp_path):
    leg = plant("leg", np.random.default_rng(0), delay=0.02)
    pi = leg.model.standard_parameters()
    notes = write_mjcf(leg.model, pi, tmp_path / "a.xml", commanded=leg.drives, delay="filter")
    assert any("first-order filters" in note for note in notes)
    robot = mujoco.MjModel.from_xml_path(str(tmp_path / "a.xml"))
    assert not robot.actuator_delay.any()
    data = mujoco.MjData(robot)
    data.ctrl[:] = 1.0
    while data.time < 0.02 - 1e-9:
        mujoco.mj_step(robot, data)
    np.testing.assert_allclose(data.act, 1 - np.exp(-1.0), rtol=1e-6)
    prompt = [replace(drive, delay=0.0) for drive in leg.drives]
    for delay in ("filter", "history"):
        notes = write_mjcf(leg.model, pi, tmp_path / "b.xml", commanded=prompt, delay=delay)
        assert not any("delays" in note for note in notes)
    with pytest.raises(SettingsError, match="delay is 'none', wanted one of history, filter"):
        write_mjcf(leg.model, pi, tmp_path / "a.xml", commanded=leg.drives, delay="none")


@pytest.mark.parametrize("name", ROBOTS)
def test_the_plant_is_quick_and_its_truth_says_what_it_does(name):
    rng = np.random.default_rng(2)
    robot = plant(name, rng)
    log, truth = recorded(robot, rng, duration=4.0)
    assert truth[f"{log.joints[0]}.kp"] == robot.drives[0].kp
    assert log.q.shape == log.q_ref.shape == (2000, len(robot.drives))
    assert np.ptp(log.q, axis=0).min() > 0.15
    assert np.sqrt(np.mean((log.q - log.q_ref) ** 2, axis=0)).max() < 0.2
    exact, noisy = (
        recorded(robot, np.random.default_rng(3), duration=1.0, noise=x)[0].q for x in (0.0, 1e-3)
    )
    assert np.std(noisy - exact) == pytest.approx(1e-3, rel=0.05)


def test_the_plant_logs_the_torques_of_its_drives():
    """kp (q_ref(t - delay) - q) - kd v, from the log itself, and the offset of the equation."""
    leg = plant("leg", np.random.default_rng(0), delay=0.006, offset=0.7)
    log, _ = recorded(leg, np.random.default_rng(1), duration=2.0, noise=0.0, torque=0.0)
    assert log.has_torque
    v = np.gradient(log.q, log.t, axis=0)
    kp, kd = (np.array([getattr(drive, key) for drive in leg.drives]) for key in ("kp", "kd"))
    late = 3  # rows
    by_hand = kp * (log.q_ref[:-late] - log.q[late:]) - kd * v[late:]
    np.testing.assert_allclose(log.tau[late:-1], by_hand[:-1], atol=0.05)
    assert np.ptp(by_hand, axis=0).min() > 0.8


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    leg = plant("leg", np.random.default_rng(0), coulomb=0.2, offset=0.1, zero=0.02, delay=0.0063)
    drives = (*leg.drives[:2], replace(leg.drives[2], kp=33.0, coulomb=0.4, delay=0.0048))
    same = replace(drives[0], joint=LEG[1])
    leg = replace(leg, drives=(drives[0], same, drives[2]))
    friction = {LEG[2]: by_position(0.05, 0.3, -2.5, -1.0)}
    folder = tmp_path_factory.mktemp("results") / "leg"
    return written_result(leg, folder, position=friction, limits={LEG[0]: 21.0}), leg


def test_the_drives_of_a_result_are_read(result):
    folder, leg = result
    found = load_result(folder).commanded
    for drive, wanted in zip(found, leg.drives, strict=True):
        assert drive == replace(wanted, effort_limit=21.0 if drive.joint == LEG[0] else np.inf)


def test_a_result_with_a_clock_follows_by_it_and_its_export_says_so(result, tmp_path, capsys):
    folder, leg = result
    text = json.loads((folder / "result.json").read_text())
    held = tmp_path / "held"
    held.mkdir()
    for name in ("robot.urdf", "robot.drive.json"):
        (held / name).write_bytes((folder / name).read_bytes())
    text["simulation"]["controller"]["rate"] = 100.0
    (held / "result.json").write_text(json.dumps(text))
    log, _ = recorded(leg, np.random.default_rng(5), duration=0.5, noise=0.0)
    at_once, by_clock = (load_result(at).follow_commands(log) for at in (folder, held))
    model, pi = load_result(held).identified
    loops = loops_of(model, pi, load_result(held).commanded, 100.0)
    (out,) = ClosedLoopRobot(model).roll_out(loops, cut_windows(log, np.inf, 0.0))
    np.testing.assert_array_equal(by_clock, out.q)
    assert np.abs(by_clock - at_once).max() > 3e-4
    for at, says in ((held, True), (folder, False)):
        code, out, _ = export(at, "mjcf", tmp_path / "a.xml", capsys)
        assert code == 0
        assert ("the controller runs at 100 Hz with a zero-order hold" in out) is says


def test_encoders_that_count_the_other_way_are_heard_and_answered_in_their_sense(result):
    folder, leg = result
    log, _ = recorded(leg, np.random.default_rng(5), duration=0.3, noise=0.0)
    plain = load_result(folder)
    loop = {**plain.content["simulation"], "signs": {LEG[1]: -1.0}}  # one that is not named: 1
    turned = replace(plain, content={**plain.content, "simulation": loop})
    sign = np.array([1.0, -1.0, 1.0])
    other = log.turned(sign)
    np.testing.assert_array_equal(turned.follow_commands(other), sign * plain.follow_commands(log))
    one, two = (found.open_loop(x) for found, x in ((plain, log), (turned, other)))
    np.testing.assert_array_equal(two.q, one.q)
    np.testing.assert_array_equal(two.rmse, one.rmse)
    assert one.rmse.max() < 0.1


def test_impossible_drives_are_refused(result, tmp_path):
    content = json.loads((result[0] / "result.json").read_text())
    for name in ("robot.urdf", "robot.drive.json"):
        (tmp_path / name).write_bytes((result[0] / name).read_bytes())

    def with_entries(change):
        entries = [change(dict(entry)) for entry in content["drive_parameters"]]
        text = json.dumps(content | {"drive_parameters": [e for e in entries if e]})
        (tmp_path / "result.json").write_text(text)
        return load_result(tmp_path)

    one = f"{LEG[1]}.kp"
    with pytest.raises(DataError, match=f"has gains of some joints, but no kp of {LEG[1]}"):
        _ = with_entries(lambda e: None if e["name"] == one else e).commanded
    for name, wrong, wanted in ((one, 0.0, "more than 0"), (f"{LEG[1]}.delay", -1e-3, "0 or more")):
        changed = with_entries(
            lambda e, n=name, x=wrong: e | ({"value": x} if e["name"] == n else {})
        )
        with pytest.raises(DataError, match=f"{name} is {wrong:g}, wanted {wanted}"):
            _ = changed.commanded
    none = with_entries(lambda e: None if e["name"].endswith((".kp", ".kd")) else e)
    assert none.commanded == ()
    rest = (".kd", ".delay", ".zero")  # which are 0 if not stated
    bare = with_entries(lambda e: None if e["name"].endswith(rest) else e).commanded
    assert {(drive.kd, drive.delay, drive.zero) for drive in bare} == {(0.0, 0.0, 0.0)}


def test_mujoco_rolls_out_what_our_own_roll_out_does():
    """The estimator's simulator and the exported file are one robot, on a log."""
    leg = plant("leg", np.random.default_rng(4), zero=0.04, offset=0.1, effort_limit=4.0)
    log, _ = recorded(leg, np.random.default_rng(5), duration=4.0, noise=0.0)
    pi, names = leg.model.standard_parameters(), leg.model.layout.names
    for drive in leg.drives:
        for term in ("armature", "viscous", "coulomb", "offset"):
            pi[names.index(f"{drive.joint}.{term}")] = getattr(drive, term)
    robot = ClosedLoopRobot(leg.model, step=1e-3)
    (found,) = robot.roll_out(loops_of(leg.model, pi, leg.drives), cut_windows(log, np.inf, 0.0))
    assert np.abs(found.q - log.q).max() < 3e-4
    assert np.abs(log.q - log.q_ref).max() > 0.05


def export(folder, kind, target, capsys, *flags):
    code = main(["export", str(folder), "--format", kind, "--out", str(target), *flags])
    out, err = capsys.readouterr()
    return code, " ".join(out.split()), err


def test_mjcf_of_a_result_has_the_nearest_friction_and_says_so(result, tmp_path, capsys):
    folder, leg = result
    code, out, _ = export(folder, "mjcf", tmp_path / "a.xml", capsys)
    assert code == 0
    robot = mujoco.MjModel.from_xml_path(str(tmp_path / "a.xml"))
    assert robot.opt.timestep == 0.001
    np.testing.assert_allclose(robot.dof_armature, [d.armature for d in leg.drives], rtol=1e-12)
    np.testing.assert_allclose(
        robot.dof_damping[:, 0] if robot.dof_damping.ndim > 1 else robot.dof_damping,
        [d.viscous for d in leg.drives],
        rtol=1e-12,
    )
    np.testing.assert_allclose(robot.actuator_gainprm[:, 0], [d.kp for d in leg.drives])
    bias = [[-0.1, -d.kp, -d.kd] for d in leg.drives]
    np.testing.assert_allclose(robot.actuator_biasprm[:, :3], bias)
    np.testing.assert_allclose(
        robot.actuator_forcerange, [[-21.1, 20.9], [-23.8, 23.6], [-45.53, 45.33]]
    )  # of the controller, else the URDF
    np.testing.assert_allclose(robot.qpos0, -0.02)
    urdf = [[j.lower, j.upper] for j in leg.model.limits]
    np.testing.assert_allclose(robot.jnt_range, np.array(urdf) - 0.02)

    mean = 0.3 * 1.5**2 / 12  # of x (q - q_0)^2 over a range of 1.5 rad; that of q - q_0 is 0
    assert f"{LEG[2]}: coulomb_q1, coulomb_q2 projected on viscous" in out
    assert "offset 0.1 N m; error" in out
    written = " ".join((tmp_path / "a.xml").read_text().split())
    assert f"{LEG[2]}: coulomb_q1, coulomb_q2 projected on viscous" in written
    assert "cannot state" not in out
    np.testing.assert_allclose(robot.dof_frictionloss, [0.2, 0.2, 0.4 + mean], rtol=1e-4)


def test_a_controller_that_carries_the_weight_is_named(tmp_path, capsys):
    settings = {"estimator": {"name": "wls"}, "controller": {"gravity_compensation": True}}
    folder = written_result(
        plant("planar", np.random.default_rng(0)), tmp_path / "out", settings=settings
    )
    for kind in ("mjcf", "isaac"):
        code, out, _ = export(folder, kind, tmp_path / "a", capsys)
        assert code == 0
        assert "the controller compensates gravity with the URDF's model" in out
        said = " ".join((tmp_path / "a").read_text().split())
        assert "compensates gravity with the URDF's model" in said


def test_the_motion_of_a_log_is_that_of_its_positions_between_gaps():
    t = np.concatenate([0.01 * np.arange(5), 1.0 + 0.01 * np.arange(4)])
    q = np.column_stack([3.0 * t, -0.5 * t**2])
    q[5:] += 10.0  # nothing is differentiated across the gap
    motion = logged_motion(Log(t, q, np.zeros_like(q), ("a", "b"), q_ref=q, has_torque=False))
    np.testing.assert_array_equal(motion.segment, [0] * 5 + [1] * 4)
    np.testing.assert_allclose(motion.v[:, 0], 3.0)
    np.testing.assert_allclose(motion.v[[1, 7], 1], -t[[1, 7]])
    np.testing.assert_array_equal(motion.q, q)


def test_isaac_actuators_are_grouped_and_read_back(result, tmp_path, capsys):
    folder, _ = result
    # the hip has another effort limit, so it is a group of its own
    code, out, _ = export(folder, "isaac", tmp_path / "a.yaml", capsys, "--step", "0.002")
    assert code == 0
    assert f"{LEG[2]}: coulomb_q1, coulomb_q2 projected on viscous" in out
    assert (
        f"the encoder's zero ({LEG[0]} 0.02, {LEG[1]} 0.02, {LEG[2]} 0.02); the simulator's "
        "position is the encoder's plus the zero" in out
    )
    text = (tmp_path / "a.yaml").read_text()
    assert "# Isaac Lab cannot state the torque offset" in text
    content = yaml.safe_load(text)
    loaded_result = load_result(folder)
    drives, model = loaded_result.commanded, loaded_result.robot
    efforts = dict(zip(LEG, (21.0, 23.7, 45.43), strict=True))
    speeds = {joint.name: joint.velocity for joint in model.limits}
    assert content["physics_dt"] == 0.002
    assert list(content["actuators"]) == list(LEG)
    by_position = dict.fromkeys(LEG, 0.0) | {LEG[2]: 0.3 * 1.5**2 / 12}  # its mean
    for drive, (joint, group) in zip(drives, content["actuators"].items(), strict=True):
        assert group == {
            "joint_names_expr": [joint],
            "effort_limit": efforts[joint],
            "velocity_limit": speeds[joint],
            "stiffness": pytest.approx(drive.kp, rel=1e-5),
            "damping": pytest.approx(drive.kd, rel=1e-5),
            "armature": pytest.approx(drive.armature, rel=1e-5),
            "friction": pytest.approx(drive.coulomb + by_position[joint], rel=1e-5),
            "dynamic_friction": pytest.approx(drive.coulomb + by_position[joint], rel=1e-5),
            "viscous_friction": pytest.approx(drive.viscous, rel=1e-5),
            "min_delay": 3 if joint != LEG[2] else 2,  # 3.15 and 2.4 steps
            "max_delay": 3 if joint != LEG[2] else 2,
        }


def test_isaac_groups_are_of_equal_drives_with_whole_delays():
    """Joints of four legs; their names are taken literally."""
    quadruped = RobotModel.from_urdf(example_urdf("go2.urdf"))
    (one, *_) = plant("leg", np.random.default_rng(0), delay=0.0063).drives
    drives = [replace(one, joint=name, kp=2.0 if "calf" in name else 1.0)
              for name in quadruped.joints]  # fmt: skip
    groups = isaac_actuators(quadruped, drives, 0.0063)["actuators"]
    assert list(groups) == ["joint", "calf_joint"]  # hips and thighs are alike
    assert groups["calf_joint"]["joint_names_expr"] == [
        f"{leg}_calf_joint" for leg in ("FL", "FR", "RL", "RR")
    ]
    for late, step, whole in ((0.0063, 0.0063, 1), (0.3, 0.1, 3), (0.00497, 0.005, 1)):
        own = [replace(drive, delay=late) for drive in drives]
        group = isaac_actuators(quadruped, own, step)["actuators"]["calf_joint"]
        assert (group["min_delay"], group["max_delay"]) == (whole, whole)
    dotted = plant("planar", np.random.default_rng(0))
    named = [replace(drive, joint=f"{drive.joint}.x") for drive in dotted.drives]
    for group in isaac_actuators(dotted.model, named, 0.005)["actuators"].values():
        assert group["joint_names_expr"][0].endswith(r"\.x")
        assert group["velocity_limit"] is None or group["velocity_limit"] > 0


def test_ranges_have_gains_delays_and_friction(result, tmp_path, capsys):
    folder, leg = result
    code, *_ = export(folder, "ranges", tmp_path / "a.yaml", capsys)
    assert code == 0
    drives = yaml.safe_load((tmp_path / "a.yaml").read_text())["drives"]
    assert list(drives) == list(LEG)
    for drive in leg.drives:
        terms = drives[drive.joint]
        kp = {"nominal": pytest.approx(drive.kp), "source": "stated", "unit": "N m/rad"}
        assert terms["kp"] == kp
        for term in ("delay", "armature", "coulomb"):
            x = getattr(drive, term)
            half = 1.96 * (0.1 * x + 1e-6)
            assert terms[term]["low"] == pytest.approx(x - half, rel=1e-3)
            assert terms[term]["high"] == pytest.approx(x + half, rel=1e-3)
            assert terms[term]["source"] == "data"
    assert {"coulomb_q1", "coulomb_q2"} <= drives[LEG[2]].keys()
    entries = [
        {"name": f"j.{term}", "value": 1.0, "std_error": 1.0, "unit": "-"}
        for term in ("kp", "kd", "zero", "offset")
    ]
    entries += [{**entry, "name": "j.bias", "quantile": 2.5} for entry in entries[-1:]]
    content = load_result(folder).content | {"drive_parameters": entries}
    lows = {term: ends["low"] for term, ends in stated_ranges(content)["drives"]["j"].items()}
    wanted = {"kp": np.exp(-1.96), "kd": 0.0, "zero": -0.96, "offset": -0.96, "bias": -1.5}
    assert lows == pytest.approx(wanted, rel=1e-4)


def test_options_of_other_formats_and_results_without_gains_are_refused(result, tmp_path, capsys):
    folder, _ = result
    for kind, *flags in (
        ("sdf", "--step", "0.001"), ("isaac", "--delay", "filter"),
    ):  # fmt: skip
        code, _, err = export(folder, kind, tmp_path / "a", capsys, *flags)
        assert code == 2
        assert f"{flags[0]} is an option of mjcf" in err or "--delay is an option of" in err
    code, _, err = export(folder, "isaac", tmp_path / "a", capsys, "--step", "0")
    assert code == 2
    assert "step is 0 s, wanted a positive time" in err
    with pytest.raises(DataError, match="the result has no gains of drives"):
        isaac_actuators(plant("leg", np.random.default_rng(0)).model, (), 0.005)
    assert not list(tmp_path.iterdir())


def test_a_file_without_commands_is_as_before(tmp_path):
    leg = plant("leg", np.random.default_rng(0))
    write_mjcf(leg.model, leg.model.standard_parameters(), tmp_path / "a.xml")
    top = ET.parse(tmp_path / "a.xml").getroot()
    assert {actuator.tag for actuator in top.find("actuator")} == {"motor"}
    assert "timestep" not in top.find("option").attrib
