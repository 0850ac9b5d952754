"""Drives from commands and positions: errors of open loops, intervals, and time.

    ROBOTID_DATA=folder python benchmarks/bench_commands.py [--quick] [--out FOLDER]
        [--go2] [--so101] [--arms] [--rollouts] [--coverage RUNS [--with-torque] [--driven]]
        [--held RUNS [--bits BITS ...]]

Without a part named, roll-outs and 20 runs of coverage. --go2: fitted to the first 14.09 s of a
chirp of twelve joints, beside mujoco.sysid on the same bodies, which starts its roll-out of the
rest from the same position and speed. --so101: fitted to three motions of six servos, beside the
plain baseline of the recording's description. --arms: recordings without commands, whose torque
drives the robot: torque rows alone, simulations alone, both, each with viscous and Coulomb friction
and offset; and the last with what friction other windows confirm. The simulated arm is MuJoCo's,
16 kHz, written at 100 Hz, its torque with noise of 1 % of its size, encoders of 0.05 mrad.
--coverage: MuJoCo simulates a robot with known drives on a multi-sine of 10 s at 500 Hz, at a step
of 0.05 ms and with stiff friction, encoders with noise of 0.3 mrad; gains are stated, bodies are
those of the URDF. --with-torque instead: nothing is stated, bodies differ from the URDF, without
and with logged torques. --driven: again without commands, the torque drives: logs as of the
simulated arm at 250 Hz, the noise 5 %.
--held: the planar arm and the leg, a plant of 0.1 ms with commands held for 4 ms, logged at 250 Hz,
positions rounded to the steps of an encoder, one delay of the robot. Times are of the processor,
all threads together, where they do not say otherwise: other loads of the machine add little.
"""

import setting  # noqa: I001 -- pins the threads of BLAS before numpy is imported

import argparse
import itertools
import json
import os
import sys
import time
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

sys.path.append(str(Path(__file__).parents[1] / "tests"))

import mujoco
from helpers import mujoco_plant
from mujoco import rollout

from robotid.base.exceptions import SettingsError
from robotid.cli.identify import identify
from robotid.cli.job import read_job
from robotid.data.log import Log
from robotid.data.signal_settings import SignalSettings
from robotid.dynamics.simulation.loops import ClosedLoopRobot, Window, open_loops
from robotid.estimation.fitting.estimator_settings import SimulationSettings
from robotid.estimation.fitting.evaluation import evaluate_logs
from robotid.estimation.fitting.recorded import hold_log
from robotid.identification.closed_loop.from_commands import driven_log, identify_loops
from robotid.identification.closed_loop.loop_settings import LoopSettings
from robotid.identification.closed_loop.loop_simulator import LoopSimulator, free_body_parameters
from robotid.identification.closed_loop.position_errors import run_open_loop
from robotid.identification.closed_loop.stages import stated_loops
from robotid.output.files.result_file import CommandedDrive, loops_of
from robotid.robot.drives import AUTO
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

FINE = 5e-5  # [s] step of the plant
STEP = 5e-4  # [s] of our roll-outs beside it
STIFF = (0.9999, 0.9999, 0.001, 0.5, 2.0)  # impedance of its friction
HELD_RATE, HELD_STEP = 250.0, 1e-4  # [Hz], [s]: of commands that are held, and of their plant
RATE, DURATION, NOISE = 500.0, 10.0, 3e-4  # [Hz], [s], [rad]
TORQUE_NOISE = 2e-3  # [rad]: times kp
QUANTILE = 1.96
KHZ = 1e-3  # [s] step and period of the roll-outs that are timed

GO2_GAINS = (20.0, 1.5)  # [N m/rad], [N m s/rad]
GO2_SYSID = (3.5, 3.3, 9.0, 5.6, 2.8, 10.6, 3.8, 2.6, 17.2, 6.9, 3.9, 10.9)  # [mrad], published
GO2_PUBLISHED = "mujoco.sysid, published: 49 parameters, 104 s of two cores"
GO2_SPLIT = 14.09  # [s]
SYSID_STEP, LONGEST = 2.5e-3, 0.03  # [s] of MuJoCo, of a delay
#: Of each joint: key, begin, lowest, highest.
SYSID_PARAMETERS = (
    ("armature", 0.01, 1e-4, 0.3), ("damping", 0.1, 0.0, 5.0), ("frictionloss", 0.1, 0.0, 5.0),
    ("bias", 0.0, -0.3, 0.3),
)  # fmt: skip

ARMS = ("ur10e", "kinova_gen3")  # of tests/jobs
SO101_FITTED = ("chirp_sweep", "multisine", "large_amplitude")
SO101_PLAIN = {  # [mrad], of the recording's description
    "friction_gravity": (4.4, 8.6, 13.0, 3.9, 3.4, 1.6),
    "step_response": (6.6, 25.5, 38.4, 12.4, 12.7, 2.7),
    "prbs_excitation": (24.0, 49.0, 52.0, 18.0, 14.0, 31.0),
    "workspace_sweep": (11.0, 28.0, 53.0, 15.0, 6.5, 2.8),
}
SO101_JOINTS = {
    "shoulder_pan": "Rotation", "shoulder_lift": "Pitch", "elbow_flex": "Elbow",
    "wrist_flex": "Wrist_Pitch", "wrist_roll": "Wrist_Roll", "gripper": "Jaw",
}  # fmt: skip


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="few runs of one robot, as a trial")
    parser.add_argument(
        "--go2", action="store_true", help="a quadruped, compared with mujoco.sysid"
    )
    parser.add_argument("--so101", action="store_true", help="an arm of six servos")
    parser.add_argument("--arms", action="store_true", help="arms whose input is the logged torque")
    parser.add_argument("--rollouts", action="store_true", help="speed, compared with MuJoCo")
    parser.add_argument(
        "--coverage", type=int, metavar="RUNS", help="coverage of intervals for a known truth"
    )
    parser.add_argument(
        "--robots", nargs="+", default=["planar", "leg", "arm"], help="for --coverage"
    )
    parser.add_argument(
        "--with-torque",
        action="store_true",
        help="for --coverage, all unknown, without and with torques",
    )
    parser.add_argument(
        "--driven", action="store_true", help="for --coverage, also with the logged torque as input"
    )
    parser.add_argument(
        "--held", type=int, metavar="RUNS", help="coverage for commands with a zero-order hold"
    )
    parser.add_argument(
        "--bits", type=int, nargs="+", default=[14], help="bits of the encoders, for --held"
    )
    parser.add_argument(
        "--sysid-steps", type=int, default=30, help="maximum number of steps; 0: as published"
    )
    parser.add_argument("--out", type=Path, help="folder for bench_commands.json")
    options = parser.parse_args()
    parts = {
        "go2": options.go2 and (lambda: go2(options.sysid_steps)),
        "so101": options.so101 and so101,
        "arms": options.arms and arms,
        "rollouts": options.rollouts and (lambda: rollouts(0.3 if options.quick else 10.0)),
        "coverage": options.coverage
        and (
            lambda: coverage(
                options.robots, options.coverage, with_torque=options.with_torque,
                driven=options.driven,
            )
        ),
        "held": options.held
        and (
            lambda: coverage(
                [r for r in options.robots if r != "arm"], options.held, bits=options.bits
            )
        ),
    }  # fmt: skip
    if not any(parts.values()):
        runs = (["planar"], 2, 4.0) if options.quick else (options.robots, 20)
        parts["rollouts"] = lambda: rollouts(0.3 if options.quick else 10.0)
        parts["coverage"] = lambda: coverage(*runs)
    results = {name: part() for name, part in parts.items() if part}
    print(f"{setting.machine()}, mujoco {mujoco.__version__}")
    if options.out:
        options.out.mkdir(parents=True, exist_ok=True)
        text = json.dumps({**results, "machine": setting.machine()}, indent=1)
        (options.out / "bench_commands.json").write_text(text + "\n")


def clocks():
    """Return the time of the wall and of the processor [s]."""
    return np.array([time.perf_counter(), time.process_time()])


def by_job(text):
    """Return what a job finds, and the times that it took."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "job.toml"
        path.write_text(text)
        job = read_job(path)
        initialised = clocks()
        model = job.model()
        logs, kept = (
            [job.read(entry, model, needs="commands") for entry in entries]
            for entries in (job.identification, job.validation)
        )
        found = identify_loops(
            model, logs, kept, job.controller, job.estimator, chooses=AUTO in job.terms
        )
        return found, clocks() - initialised


def geometric_mean(ratios):
    return float(np.exp(np.mean(np.log(ratios))))


def recordings(name):
    if "ROBOTID_DATA" not in os.environ:
        raise SystemExit("set ROBOTID_DATA to the folder of the recordings")
    return Path(os.environ["ROBOTID_DATA"]) / "commands" / name


def go2(sysid_steps):
    """Print the open-loop error of twelve joints, beside mujoco.sysid; return the figures."""
    log = recordings("go2") / "chirp.parquet"
    begin, kp, kd = np.nextafter(GO2_SPLIT, np.inf), *GO2_GAINS
    found, took = by_job(
        f'urdf = "{example_urdf("go2.urdf")}"\n[estimator]\nname = "simulation"\n'
        f"[controller]\nkp = {kp}\nkd = {kd}\n"
        f'[[identification]]\nlog = "{log}"\nend = {GO2_SPLIT}\n'
        f'[[validation]]\nlog = "{log}"\nstart = {begin}\n'
    )
    ours = 1e3 * found.validation[0].rmse
    beside = [(GO2_PUBLISHED, np.array(GO2_SYSID))]
    if sysid_steps:
        theirs, count, steps, their_time = sysid_fit(found, sysid_steps)
        beside.insert(0, (f"mujoco.sysid, {count} parameters, {steps} steps here", theirs))
    joints = found.model.joints
    print(f"| simulated position error, rest of the chirp, mrad | {' | '.join(joints)} | ratio |")
    print("|---" * (len(joints) + 2) + "|")
    count_of_ours = len(found.fit.estimate.theta)
    table = [(f"robotid, {count_of_ours} parameters", ours), *beside]
    for who, errors in table:
        ratio = "" if errors is ours else f"{geometric_mean(ours / errors):.3f}"
        print(f"| {who} | {' | '.join(f'{e:.1f}' for e in errors)} | {ratio} |")
    times = {"robotid": took} | ({"mujoco.sysid": their_time} if sysid_steps else {})
    said = [f"{who} {t[0]:.0f} s wall clock, {t[1]:.0f} s of processor" for who, t in times.items()]
    print(f"\nRatio: geometric mean of robotid's error divided by theirs. {'; '.join(said)}.")
    print(f"{found.fit.estimate.message}.\n", flush=True)
    return {
        "errors_mrad": {who: list(errors) for who, errors in table},
        "ratios": {who: geometric_mean(ours / errors) for who, errors in beside},
        "seconds": {who: list(t) for who, t in times.items()},
    }


def sysid_fit(found, most):
    """Return the errors of mujoco.sysid on the validation log, parameters, steps and times."""
    from mujoco import sysid

    log, kept = found.fitted[0].log, found.validation[0].log
    model, initialised = found.model, clocks()
    spec = sysid_spec(model)
    params = sysid.ParameterDict()
    for joint in model.joints:
        for key, value, low, high in SYSID_PARAMETERS:
            modifier = sysid_modifier(key, joint)
            params.add(sysid.Parameter(f"{joint}.{key}", value, low, high, modifier=modifier))
    params.add(sysid.Parameter("delay", 0.005, 0.0, 0.9 * LONGEST, modifier=sysid_delay))
    robot, names = spec.compile(), [f"q_{joint}" for joint in model.joints]
    t, q_ref = held(log)
    sequences = sysid.ModelSequences(
        "go2", spec, "chirp", beginning(robot, log),
        sysid.TimeSeries.from_control_names(t, q_ref, robot),
        sysid.TimeSeries.from_names(log.t - log.t[0], log.q, robot, names),
        allow_missing_sensors=True,
    )  # fmt: skip
    residual = sysid.build_residual_fn(models_sequences=[sequences])
    best, result = sysid.optimize(params, residual, verbose=False, max_iters=most)
    took = clocks() - initialised
    fitted = sysid.apply_param_modifiers(best, spec)
    t, q_ref = held(kept)
    data = mujoco.MjData(fitted)
    states, _ = rollout.rollout(fitted, data, beginning(fitted, kept)[None], q_ref[None])
    at = [fitted.joint(joint).qposadr[0] for joint in model.joints]
    q = states[0][:, 1:][:, at]  # at t + one step
    q = np.column_stack(
        [np.interp(kept.t - kept.t[0], t + SYSID_STEP, own, left=np.nan) for own in q.T]
    )
    rmse = 1e3 * np.sqrt(np.nanmean((q - kept.q) ** 2, axis=0))
    return rmse, params.size, len(result.extras.get("objective", ())), took


def sysid_spec(model):
    """Return MuJoCo's description of the robot of the URDF, each joint with a drive."""
    drives = [
        CommandedDrive(joint, *GO2_GAINS, LONGEST, 0.0, 0.01, 0.05, 0.1, 0.0, np.inf)
        for joint in model.joints
    ]
    bare = RobotModel.from_urdf(model.tree)
    none = np.zeros(len(drives))
    plant = mujoco_plant.Plant(bare, tuple(drives), none, none)
    robot = mujoco_plant.loaded(plant, 1 / SYSID_STEP, SYSID_STEP)
    with TemporaryDirectory() as folder:
        path = str(Path(folder) / "robot.xml")
        mujoco.mj_saveLastXML(path, robot)
        spec = mujoco.MjSpec.from_file(path)
    for sensor in list(spec.sensors):
        spec.delete(sensor)
    for joint in model.joints:
        spec.add_sensor(
            name=f"q_{joint}", type=mujoco.mjtSensor.mjSENS_JOINTPOS,
            objtype=mujoco.mjtObj.mjOBJ_JOINT, objname=joint,
        )  # fmt: skip
    return spec


def sysid_modifier(key, joint):
    """Return what writes a parameter of a joint into MuJoCo's description."""

    def write(spec, parameter):
        value = float(parameter.value[0])
        if key == "bias":
            spec.actuator(joint).biasprm[0] = GO2_GAINS[0] * value
        elif key == "damping":
            spec.joint(joint).damping[0] = value
        else:
            setattr(spec.joint(joint), key, value)

    return write


def sysid_delay(spec, parameter):
    for actuator in spec.actuators:
        actuator.delay = float(parameter.value[0])


def held(log):
    """Return times from 0 at MuJoCo's step, and the command that is held at each."""
    t = np.arange(int((log.t[-1] - log.t[0]) / SYSID_STEP) + 1) * SYSID_STEP
    at = np.searchsorted(log.t - log.t[0], t + 1e-6, side="right") - 1
    return t, np.array(log.q_ref[at])


def beginning(robot, log):
    """Return MuJoCo's state where a log begins."""
    q, v = Window(log, 0, 0, len(log.t)).start
    data = mujoco.MjData(robot)
    for j, joint in enumerate(log.joints):
        data.qpos[robot.joint(joint).qposadr[0]] = q[j]
        data.qvel[robot.joint(joint).dofadr[0]] = v[j]
    for k in range(robot.nu):
        if robot.actuator_history[k, 0]:
            size = robot.actuator_history[k, 0]
            mujoco.mj_initCtrlHistory(robot, data, k, None, [log.q_ref[0, k]] * size)
    kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
    state = np.empty(mujoco.mj_stateSize(robot, kind))
    mujoco.mj_getState(robot, data, state, kind)
    return state


def so101():
    """Print the open-loop error of six servos on four motions; return the figures."""
    folder = recordings("so101")
    columns = "".join(
        f'{kind}_{joint} = "{kind}_{name}"\n'
        for joint, name in SO101_JOINTS.items()
        for kind in ("q", "qref")
    )
    groups = ", ".join(f'"{joint}"' for joint in SO101_JOINTS)
    entries = [("identification", name) for name in SO101_FITTED]
    entries += [("validation", name) for name in SO101_PLAIN]
    found, took = by_job(
        f'urdf = "{example_urdf("so101.urdf")}"\n[estimator]\nname = "simulation"\n'
        f"[controller.groups]\nservo = [{groups}]\n[columns]\n{columns}"
        + "".join(f'[[{what}]]\nlog = "{folder / name}.parquet"\n' for what, name in entries)
    )
    print(
        f"| validation motion, position error in mrad | {' | '.join(found.model.joints)} | ratio |"
    )
    print("|---" * (len(found.model.joints) + 2) + "|")
    ratios, rows = [], {}
    for (name, plain), run in zip(SO101_PLAIN.items(), found.validation, strict=True):
        errors = 1e3 * run.rmse
        ratios.append(errors / np.array(plain))
        rows[name] = list(errors)
        print(f"| {name} | {' | '.join(f'{e:.1f}' for e in errors)} | "
              f"{geometric_mean(ratios[-1]):.2f} |")  # fmt: skip
        print(f"| - plain baseline | {' | '.join(f'{e:.1f}' for e in plain)} | |")
    by_joint = [geometric_mean(own) for own in np.array(ratios).T]
    whole = geometric_mean(ratios)
    print(f"| ratio | {' | '.join(f'{x:.2f}' for x in by_joint)} | {whole:.3f} |")
    print(f"\n{took[0]:.0f} s wall clock, {took[1]:.0f} s of processor; "
          f"{found.fit.estimate.message}.\n", flush=True)  # fmt: skip
    return {"errors_mrad": rows, "ratio": whole, "by_joint": by_joint, "seconds": list(took)}


def arms():
    """Print validation errors of fits to torque rows, simulations and both; return the figures."""
    print("| robot | fitted to | torque error, N m | position error over 0.5 s, mrad "
          "| torque, ratio | position, ratio | processor, s |")  # fmt: skip
    print("|---" * 7 + "|")
    found = {}
    for name in ARMS:
        job = read_job(Path(__file__).parents[1] / "tests" / "jobs" / f"{name}.toml")
        model = job.model()
        logs, kept = (
            [job.read(entry, model) for entry in entries]
            for entries in (job.identification, job.validation)
        )
        found[name] = arm_rows(name, model, logs, kept, job.signals)
    rng = np.random.default_rng(17)
    plant = mujoco_plant.plant("arm", rng, delay=0.0)
    logs = [
        mujoco_plant.torque_log(plant, rng, duration=d, rate=100.0, noise=5e-5, relative=0.01)
        for d in (30.0, 10.0)
    ]
    signals = SignalSettings(cutoff=10.0)
    found["simulated"] = arm_rows(
        "simulated UR5", plant.model, logs[:1], logs[1:], signals, drive_pi(plant)
    )
    print("\nRatio: geometric mean over joints of the error divided by that of torque rows.\n")
    return found


def arm_rows(name, model, logs, kept, signals, truth=None):
    """Print the rows of one arm; return the figures."""
    loop, rows, initialised = LoopSettings(kind="torque"), {}, time.process_time()
    linear = identify(model, logs, signals=signals, friction="none", doctor=False)
    took = time.process_time() - initialised
    ways = {"simulations alone": (False, False), "both": (True, False),
            "both, friction selected": (True, True)}  # fmt: skip
    for way, (torques, chooses) in ways.items():
        initialised = time.process_time()
        settings = SimulationSettings(torques=torques)
        found = identify_loops(model, logs, kept, loop, settings, signals=signals, chooses=chooses)
        spent = time.process_time() - initialised
        if not rows:
            missed = torque_mismatch(model, linear.standard, kept, signals)
            rows["torque rows alone"] = (missed, found.validation[0].baselines["rows"], took)
        missed = torque_mismatch(found.model, found.standard, kept, signals)
        rows[way] = (missed, found.validation[0].rmse, spent)
    if truth is not None:
        position = driven_error(model, truth, kept[0], signals)
        rows["the truth"] = (torque_mismatch(model, truth, kept, signals), position, 0.0)
    initialised = time.process_time()
    linear = identify(model, logs, signals=signals, doctor=False)
    rows["torque rows alone, friction selected"] = (
        torque_mismatch(linear.model, linear.standard, kept, signals),
        driven_error(linear.model, linear.standard, kept[0], signals),
        time.process_time() - initialised,
    )
    plain = rows["torque rows alone"]
    for way, (torque, position, spent) in rows.items():
        moved, ratio = "-", "-"
        if np.isfinite(position).all():
            moved = " ".join(f"{1e3 * x:.1f}" for x in position)
            ratio = f"{geometric_mean(position / plain[1]):.2f}"
        print(f"| {name} | {way} | {' '.join(f'{x:.2f}' for x in torque)} | {moved} | "
              f"{geometric_mean(torque / plain[0]):.2f} | {ratio} | {spent:.0f} |",
              flush=True)  # fmt: skip
    return {
        way: {"torque": list(own[0]), "position": list(own[1]), "seconds": own[2]}
        for way, own in rows.items()
    }


def driven_error(model, pi, log, signals):
    """Return the error of position of a robot that the torque of a log drives, joint by joint."""
    heard = driven_log(model, log, signals)
    try:
        return run_open_loop(ClosedLoopRobot(model), open_loops(model, pi), heard).rmse
    except SettingsError:  # a term that rows of torque have, and roll-outs have not: shown as "-"
        return np.full(len(model.joints), np.nan)


def torque_mismatch(model, pi, logs, signals):
    """Return the root mean square of the torque that parameters miss in logs, joint by joint."""
    kept = [hold_log(model, log, signals) for log in logs]
    _, [found] = evaluate_logs((), kept, {"own": pi}, model.standard_parameters())
    return np.array([found.metrics["own"].per_joint[joint].rmse for joint in model.joints])


def rollouts(seconds):
    """Print the simulations of 1 s per second; return the figures."""
    print("| robot, 1 kHz | simulations per second: robotid, 1 thread | 2 threads "
          "| MuJoCo, 1 thread | 2 threads "
          "| robotid over MuJoCo | gradient, simulations | by parameters |")  # fmt: skip
    print("|---" * 8 + "|")
    rows = []
    for name in ("arm", "quadruped"):
        plant = mujoco_plant.plant(name, np.random.default_rng(0))
        row = rollout_row(name, plant, seconds)
        rows.append(row)
        print(f"| {name}, {row['joints']} joints | {row['ours'][0]:.0f} | {row['ours'][1]:.0f} | "
              f"{row['mujoco'][0]:.0f} | {row['mujoco'][1]:.0f} | "
              f"{row['ours'][0] / row['mujoco'][0]:.1f} | {row['gradient']:.1f} | "
              f"{row['parameters']} |", flush=True)  # fmt: skip
    print(
        "\nEach simulation is of 1 s with steps of 1 ms; one thread: processor time, two threads: "
        "wall-clock time. The gradient is by all parameters together.\n"
    )
    return rows


def rollout_row(name, plant, seconds):
    """Return roll-outs per second of a plant, ours and MuJoCo's, and the gradient's cost."""
    n, many = len(plant.drives), 64
    t = np.arange(1001) * KHZ
    q_ref = mujoco_plant.multisine(t, plant.middle, plant.reach, np.random.default_rng(1))
    log = Log(t, q_ref, 0 * q_ref, plant.model.joints, q_ref=q_ref, has_torque=False)
    robot, loops = (
        ClosedLoopRobot(plant.model, step=KHZ),
        loops_of(plant.model, drive_pi(plant), plant.drives),
    )
    windows = [Window(log, 0, 0, len(t))] * many
    kinds = robot.kinds
    columns = [(kinds[what], j, 0) for what in ("armature", "kp", "kd", "delay") for j in range(n)]
    columns += [(kinds["term"], j, k + sum(map(len, loops.terms[:j])))
                for j in range(n) for k in range(len(loops.terms[j]))]  # fmt: skip
    mj = mujoco_plant.loaded(plant, 1 / KHZ, KHZ)
    state = np.repeat(beginning(mj, log)[None], many, axis=0)
    control = np.repeat(q_ref[None, :-1], many, axis=0)
    datas = [mujoco.MjData(mj) for _ in range(2)]
    ways = {
        "ours": lambda: robot.roll_out(loops, windows),
        "gradient": lambda: robot.roll_out(loops, windows, columns),
        "mujoco 1": lambda: rollout.rollout(mj, datas[:1], state, control),
        "mujoco 2": lambda: rollout.rollout(mj, datas, state, control),
    }
    best = {way: np.full(2, np.inf) for way in ways}
    for way in ways.values():
        way()  # what is compiled is ready then
    initialised = time.process_time()
    while time.process_time() - initialised < seconds or not np.isfinite(best["mujoco 2"]).all():
        for key, way in ways.items():  # in turn, so that all meet the same load
            start = clocks()
            way()
            best[key] = np.minimum(best[key], clocks() - start)
    per_second = {key: many / own for key, own in best.items()}
    return {
        "robot": name,
        "joints": n,
        "parameters": len(columns),
        "ours": [per_second["ours"][1], per_second["ours"][0]],
        "mujoco": [per_second["mujoco 1"][1], per_second["mujoco 2"][0]],
        "gradient": best["gradient"][1] / best["ours"][1],
    }


def drive_pi(plant):
    """Return the standard parameters of a plant."""
    pi, names = plant.model.standard_parameters(), plant.model.layout.names
    for drive in plant.drives:
        for term in ("armature", "viscous", "coulomb", "offset"):
            pi[names.index(f"{drive.joint}.{term}")] = getattr(drive, term)
    return pi


def coverage(
    robots, runs, seconds=DURATION, *, with_torque=False, driven=False, bits=(None,)
):  # fmt: skip
    """Print the coverage of intervals, by robot and kind of parameter; return the rows."""
    print(f"| robot, {runs} runs | parameter | values | mean error / scatter | stated error / "
          "scatter | 95 % interval coverage | stated error / without torque "
          "| error / without torque |")  # fmt: skip
    print("|---" * 8 + "|")
    rows = []
    for name, bit in itertools.product(robots, bits):
        how = {} if bit is None else {"run": held_run, "bits": bit}
        label = name if bit is None else f"{name}, {bit} bits"
        if not with_torque:
            rows += coverage_rows(label, covered(name, runs, seconds, **how))
        else:
            alone = covered(name, runs, seconds, finds_all=True)
            rows += coverage_rows(f"{name}, all unknown", alone)
            both = covered(name, runs, seconds, finds_all=True, torque=True)
            rows += coverage_rows(f"{name}, all unknown, torque", both, alone)
        if driven:
            for way, found in driven_errors(name, runs, seconds).items():
                rows += coverage_rows(f"{name}, driven, {way}", found)
    print()
    return rows


def covered(name, runs, seconds, run=None, **how):
    """Return errors, standard errors and reaches by kind of parameter, of shape (3, values)."""
    found, initialised = {}, time.process_time()
    for seed in range(runs):
        rng = np.random.default_rng([17, seed])
        for kind, *own in (run or one_run)(name, rng, seconds, **how):
            found.setdefault(kind, []).append(own)
    print(f"{name}: {(time.process_time() - initialised) / runs:.1f} s of processor a run",
          file=sys.stderr)  # fmt: skip
    return {kind: np.array(own).T for kind, own in found.items()}


def driven_errors(name, runs, seconds):
    """Return the same of a robot that its torque drives, by what it was fitted to."""
    ways = {"simulations alone": {"torques": False}, "both": {"torques": True}}
    errors = {way: {} for way in ("torque rows alone", *ways)}
    for seed in range(runs):
        rng = np.random.default_rng([18, seed])
        plant = mujoco_plant.plant(name, rng, delay=0.0)
        log = mujoco_plant.torque_log(plant, rng, duration=seconds, noise=5e-5, relative=0.05)
        for way, changes in ways.items():
            found = identify_loops(
                plant.model, [log], [], LoopSettings(kind="torque"),
                SimulationSettings(bodies=0.0, **changes), signals=SignalSettings(cutoff=10.0),
                chooses=False,
            )  # fmt: skip
            estimate, linear = found.fit.estimate, found.fit.linear
            kinds = [(key, key.rpartition(".")[2]) for key in estimate.names]
            for (key, kind), theta, *said in zip(
                kinds, estimate.theta, estimate.std_error, estimate.quantile, strict=True
            ):
                errors[way].setdefault(kind, []).append((theta - plant.truth[key], *said))
        place = linear.model.layout.names.index
        for key, kind in kinds:
            error = linear.standard[place(key)] - plant.truth[key]
            said = np.sqrt(linear.standard_covariance[place(key), place(key)])
            if kind != "armature":  # which rows tell with the bodies alone
                errors["torque rows alone"].setdefault(kind, []).append((error, said, QUANTILE))
    return {
        way: {kind: np.array(pairs).T for kind, pairs in own.items()} for way, own in errors.items()
    }


def coverage_rows(name, found, alone=None):
    """Print and return a row for each kind of parameter; alone: of the same runs without torque."""
    rows = []
    for kind, (error, said, reach) in found.items():
        row = {
            "robot": name,
            "parameter": kind,
            "values": len(error),
            "bias": float(np.mean(error / said)),
            "said": float(1.0 / np.std(error / said)),
            "held": float(np.mean(np.abs(error) <= reach * said)),
        }
        less = "| | |"
        if alone and kind in alone and kind != "viscous":  # which stood for kd, too
            before, said_before, _ = alone[kind]
            row["said_less"] = float(np.exp(np.mean(np.log(said / said_before))))
            row["less"] = float(np.sqrt(np.mean((error / said_before) ** 2)
                                        / np.mean((before / said_before) ** 2)))  # fmt: skip
            less = f"| {row['said_less']:.2f} | {row['less']:.2f} |"
        rows.append(row)
        print(f"| {name} | {kind} | {len(error)} | {row['bias']:+.2f} | {row['said']:.2f} | "
              f"{100 * row['held']:.1f} % {less}", flush=True)  # fmt: skip
    return rows


def one_run(name, rng, seconds, *, finds_all=False, torque=False):
    """Yield kind, error, standard error and its reach of each parameter of a run.

    Where all is found, bodies are drawn about the URDF's, by as much as they are taken to be
    unknown, and no gain is stated. Without torque, that of the speed is counted as friction.
    """
    delay = 2e-4 * rng.integers(20, 41)
    plant = mujoco_plant.plant(name, rng, delay=delay)
    settings = SimulationSettings(step=STEP, **({} if finds_all else {"bodies": 0.0}))
    truth = plant.truth
    if finds_all:
        plant, drawn = with_drawn_bodies(plant, rng, settings.bodies)
        truth |= drawn
    log = plant_log(plant, rng, seconds, torque=torque)
    gains = plant.gains
    first = plant.model.joints[0]
    gains = {} if finds_all else gains
    # every joint has a drive of its own
    loop = LoopSettings(**gains, groups={first: [first]}, delays="group")
    found = identify_loops(plant.model, [log], [], loop, settings, chooses=False)
    estimate = found.fit.estimate
    found = zip(estimate.names, estimate.theta, estimate.std_error, estimate.quantile, strict=True)
    for key, theta, *said in found:
        joint, _, kind = key.rpartition(".")
        true = truth[key]
        if kind == "viscous" and finds_all and f"{joint}.kd" not in estimate.names:
            true += truth[f"{joint}.kd"]
        yield kind, theta - true, *said


def held_run(name, rng, seconds, *, bits):
    """Yield the same of a plant whose commands are held and whose encoders have steps."""
    plant = mujoco_plant.plant(name, rng, delay=HELD_STEP * rng.integers(40, 121))
    t = np.arange(round(seconds * HELD_RATE)) / HELD_RATE
    q_ref = mujoco_plant.multisine(t, plant.middle, plant.reach, rng)
    robot = stiff(mujoco_plant.loaded(plant, HELD_RATE, HELD_STEP), HELD_STEP)
    q, _, _ = mujoco_plant.rolled_out(robot, q_ref, HELD_RATE)
    turn = 2 * np.pi / 2**bits
    q = turn * np.round(q / turn)
    log = Log(t, q, 0 * q, plant.model.joints, q_ref=q_ref, has_torque=False)
    gains = plant.gains
    first = plant.model.joints[0]
    loop = LoopSettings(**gains, groups={first: [first]})
    settings = SimulationSettings(bodies=0.0)
    found = identify_loops(plant.model, [log], [], loop, settings, chooses=False)
    estimate, truth = found.fit.estimate, plant.truth
    truth["robot.delay"] = plant.drives[0].delay
    found = zip(estimate.names, estimate.theta, estimate.std_error, estimate.quantile, strict=True)
    for key, theta, *said in found:
        yield key.rpartition(".")[2], theta - truth[key], *said


def stiff(robot, step):
    """Return MuJoCo's robot with friction as stiff as a step allows."""
    robot.dof_solref[:] = 2 * step, 1.0
    robot.dof_solimp[:] = STIFF
    return robot


def with_drawn_bodies(plant, rng, spread):
    """Return a plant whose bodies differ from the URDF's, and how, by name of the coordinate."""
    robot = ClosedLoopRobot(plant.model)
    free_parameters = tuple(free_body_parameters(robot, spread))
    simulator = LoopSimulator(robot, (), stated_loops(plant.model, LoopSettings()), free_parameters)
    coordinates = spread * rng.standard_normal(len(free_parameters))
    bodies = simulator.loops(coordinates).bodies
    drawn = dict(zip(simulator.names, coordinates.tolist(), strict=True))
    return replace(plant, bodies=bodies.reshape(-1)), drawn


def plant_log(plant, rng, seconds, noise=NOISE, *, torque=False):
    """Return the log of a plant on a multi-sine, at a fine step and with stiff friction.

    Torques, if there are any, are the drives' with noise of a share of the position's gain.
    """
    t = np.arange(round(seconds * RATE)) / RATE
    q_ref = mujoco_plant.multisine(t, plant.middle, plant.reach, rng)
    robot = stiff(mujoco_plant.loaded(plant, RATE, FINE), FINE)
    q, force, _ = mujoco_plant.rolled_out(robot, q_ref, RATE)
    q = q + noise * rng.standard_normal(q.shape)
    level = TORQUE_NOISE * np.array([drive.kp for drive in plant.drives])
    tau = force + level * rng.standard_normal(q.shape) if torque else 0 * q
    return Log(t, q, tau, plant.model.joints, q_ref=q_ref, has_torque=torque)


if __name__ == "__main__":
    main()
