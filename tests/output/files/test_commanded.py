"""Drives that follow commands, as simulators are given them: MuJoCo moves as the closed loop."""

import json
import os
import re
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pinocchio as pin
import pytest
import yaml
from helpers.commanded_results import by_position, written_result
from helpers.mujoco_plant import LEG, loaded, multisine, plant, recorded, rolled_out
from helpers.paths import DOCS, ROOT

from robotid.base.exceptions import DataError
from robotid.cli import main
from robotid.output.files.exports import formats
from robotid.output.files.isaac import isaac_actuators
from robotid.output.files.result_file import limit_of, load_result
from robotid.robot.examples import example_urdf
from robotid.robot.tree import Joint

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


def reference(drives, q_ref, *, step=5e-4, settles=0.3):
    """Return the positions of the closed loop, shape (N, n), by another way than MuJoCo's."""
    # M dv = dt (clip(kp (q_ref(t - delay) - q) - kd v) - offset - Fv v - c) - friction, implicit in
    # v; each joint's friction is the impulse within +-Fc dt that comes nearest to stopping it.
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
    found, *_ = rolled_out(loaded(leg, RATE, 1e-3, as_exported=True), commands, RATE, settles=0.3)
    assert np.abs(found - wanted).max() < 1e-3
    assert np.abs(wanted - commands).max() > 0.05  # the drives matter
    for key in ("delay", "coulomb", "armature", "viscous", "kd"):  # and each of their figures
        other = replace(leg, drives=tuple(replace(d, **{key: 0.0}) for d in leg.drives))
        missed, *_ = rolled_out(loaded(other, RATE, 1e-3, as_exported=True), commands, RATE, 0.3)
        assert np.abs(missed - wanted).max() > 2e-3, key


@pytest.mark.parametrize("late", [-0.0025, 0.0, 0.0002, 0.0004, 0.003, 0.0063, 0.0100001])
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
    wanted = max(late / step + 0.5, 1.0) if late > 0 else 0.0
    np.testing.assert_allclose(lag[20:], wanted, atol=1e-9)


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    leg = plant("leg", np.random.default_rng(0), coulomb=0.2, offset=0.1, zero=0.02, delay=0.0063)
    drives = (*leg.drives[:2], replace(leg.drives[2], kp=33.0, coulomb=0.4, delay=0.0036))
    same = replace(drives[0], joint=LEG[1])
    leg = replace(leg, drives=(drives[0], same, drives[2]))
    friction = {LEG[2]: by_position(0.05, 0.3, -2.5, -1.0)}
    folder = tmp_path_factory.mktemp("results") / "leg"
    return written_result(leg, folder, position=friction, limits={LEG[0]: 21.0}), leg


def test_a_joint_without_any_stated_effort_has_no_limit(result):
    (drive, *_), joint = result[1].drives, Joint("j", "revolute", "a", "b")
    for stated, effort, wanted in ((np.inf, 0.0, np.inf), (np.inf, 5.0, 5.0), (3.0, 5.0, 3.0)):
        limited = replace(drive, effort_limit=stated)
        assert limit_of(limited, replace(joint, effort=effort)) == wanted


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
    for name, wrong, wanted in ((one, 0.0, "more than 0"), (f"{LEG[1]}.kd", -1e-3, "0 or more")):
        changed = with_entries(
            lambda e, n=name, x=wrong: e | ({"value": x} if e["name"] == n else {})
        )
        with pytest.raises(DataError, match=f"{name} is {wrong:g}, expected {wanted}"):
            _ = changed.commanded
    none = with_entries(lambda e: None if e["name"].endswith((".kp", ".kd")) else e)
    assert none.commanded == ()
    rest = (".kd", ".delay", ".zero")  # which are 0 if not stated
    bare = with_entries(lambda e: None if e["name"].endswith(rest) else e).commanded
    assert {(drive.kd, drive.delay, drive.zero) for drive in bare} == {(0.0, 0.0, 0.0)}


def export(folder, kind, target, capsys, *flags):
    code = main(
        ["export", f"{folder}", "--format", kind, "--out", f"{target}", "--verbose", *flags]
    )
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
    assert "lacks" not in out
    np.testing.assert_allclose(robot.dof_frictionloss, [0.2, 0.2, 0.4 + mean], rtol=1e-4)


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
    assert "# Isaac Lab lacks the torque offset" in text
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
            "min_delay": 3 if joint != LEG[2] else 2,  # 3.15 and 1.8 steps
            "max_delay": 3 if joint != LEG[2] else 2,
        }
    names = ("hip.1", "hip_1", "knee")  # each group matches its own joints alone
    others = [replace(d, joint=name, delay=-4e-3) for d, name in zip(drives, names, strict=True)]
    for group in isaac_actuators(model, others, 0.002)["actuators"].values():
        (pattern,) = group["joint_names_expr"]
        assert group["min_delay"] == group["max_delay"] == 0
        assert sum(re.fullmatch(pattern, name) is not None for name in names) == 1


def test_the_pages_name_each_format():
    readme, page = (
        path.read_text() for path in (ROOT / "README.md", DOCS / "how_to" / "exports.md")
    )
    for kind in formats():
        assert re.search(rf"`{kind}`|--format {kind} ", readme)
        assert f"--format {kind} --out" in page
