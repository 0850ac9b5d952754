"""Variation between runs and robots: intervals of the next run, and runs that are unlike others.

Recordings: each log is left out of the fit; its drive parameters are compared with the 95 %
prediction interval of the other logs, and with the interval of their mean alone, as if runs were
alike; all of them together with draws of their joint distribution; its torque error with the
expected one. Servos: the fit is to all logs, the prediction from the others to first order.
Estimates of simulated drives: coverage of the joint regions of samples.
Warm-up within a log: the finding drift, and false ones. Simulated arms (Pinocchio's inverse
dynamics, not the regressor): coverage for the next robot, one by one and jointly, and of the
spreads; causes named in runs that differ, false alarms in runs that do not. Arms in MuJoCo (0.1 ms,
torque held for 1 ms, encoders of 18 bits): false alarms for logs and robots, causes named in robots
that differ.

    ROBOTID_DATA=folder python benchmarks/bench_runs.py [--quick]
"""

import argparse
import os
import sys
from dataclasses import replace
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory

for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

import mujoco
import numpy as np
import pinocchio as pin
from scipy.linalg import block_diag
from scipy.special import ndtr

from robotid.cli.identify import identify, run_job
from robotid.cli.job import LogEntry, job_from_settings, read_job
from robotid.cli.logs import survey_logs
from robotid.data.log import Log
from robotid.data.signal_settings import SignalSettings
from robotid.dynamics.base_parameters import structural_mapping
from robotid.dynamics.simulation.motions import random_fourier
from robotid.estimation.fitting.estimator_settings import EstimatorSettings
from robotid.estimation.fitting.fit import solve_recordings
from robotid.estimation.fitting.fitted import expected_band
from robotid.estimation.fitting.recorded import Recordings, hold_log
from robotid.estimation.variation.groups import Group, RunsOf, runs_of, sums_of
from robotid.estimation.variation.spread import Runs, SpreadModel, covariance_of, scores_to_values
from robotid.estimation.variation.variation import SCORES, Variation, _parameters, vary
from robotid.identification.closed_loop.from_commands import loop_runs
from robotid.identification.pipeline import with_drives
from robotid.robot.drives import wanted_families
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

JOBS = Path(__file__).parents[1] / "tests" / "jobs"
UNLOADED = (
    "ident_20200210_30s12h", "ident_20200212_50s12h", "ident_20200219_14harm", "val_ptp10",
    *(f"jointwise_{k}" for k in range(1, 7)),
)  # fmt: skip
SERVOS = {
    "shoulder_pan": "Rotation", "shoulder_lift": "Pitch", "elbow_flex": "Elbow",
    "wrist_flex": "Wrist_Pitch", "wrist_roll": "Wrist_Roll", "gripper": "Jaw",
}  # fmt: skip
JOINTS = ("shoulder_lift_joint", "elbow_joint", "wrist_1_joint")
WITHIN, BETWEEN = 0.05, 0.15  # spread of friction between runs, between robots
SLIP = 0.1, 0.2  # [rad] of the encoder of a joint in one log, of one robot
COMMON = 0.7  # correlation of frictions between robots
KINDS = ("friction", "gain", "payload", "zero")


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="few left out, few simulated sets")
    options = parser.parse_args()
    if "ROBOTID_DATA" not in os.environ:
        sys.exit("set ROBOTID_DATA to the folder of the recordings")
    print("| recordings | logs | 95 % of the next log | of the mean | parameters | 95 % jointly |")
    print("|---|---|---|---|---|---|")
    for name, entries in islice(recordings(), 1 if options.quick else None):
        left_out(name, entries, 1 if options.quick else len(entries))
    if not options.quick:
        servos()
    print()
    fleets(1, 8) if options.quick else fleets(5)
    samples(1 if options.quick else 100)
    warm_up(3, 3) if options.quick else warm_up(110, 25)
    unlike(1 if options.quick else 20)
    print("| arms in MuJoCo | sets | named | another | none |\n|---|---|---|---|---|")
    alike_logs(6 if options.quick else 150)
    alike_fleets(5 if options.quick else 150)
    if not options.quick:
        odd_fleets(20)


def recordings():
    """Yield name and logs of the robots of which there are three logs or more."""
    yield "kinova_gen3", [*read_job(JOBS / "kinova_gen3.toml").identification,
                          *read_job(JOBS / "kinova_gen3.toml").validation]  # fmt: skip
    job = read_job(JOBS / "ur10e.toml")
    known = {entry.path.stem: entry for entry in (*job.identification, *job.validation)}
    folder = job.identification[0].path.parent
    yield "ur10e", [known.get(name, LogEntry(folder / f"{name}.parquet")) for name in UNLOADED]


def left_out(name, entries, count):
    """Print how well the other logs predict the drives and the torque of a log."""
    job = read_job(JOBS / f"{name}.toml")
    job = replace(job, identification=tuple(entries), validation=())
    model = job.model()
    (logs,) = survey_logs(job, model, entries)
    inside = alike = total = joint = 0
    errors, rows, rng = [], [], np.random.default_rng(0)
    wanted = wanted_families(job.friction, model.joints)
    for k in range(count):
        others = [log for j, log in enumerate(logs) if j != k]
        some = Recordings(model, structural_mapping(model), others, [logs[k]])
        fit = with_drives(some, job.estimator, wanted)
        fit = replace(fit, variation=vary([str(j) for j in range(len(others))], fit.runs))
        error, share = torque_errors(fit)
        errors.append(error)
        rows.append(share)
        every = some.with_model(fit.model)
        every = replace(every, fitted=[log.with_model(fit.model) for log in logs])
        segments = [every.segments(j, log.whole.trajectory) for j, log in enumerate(every.fitted)]
        unit = np.zeros(len(logs), int)
        sums = sums_of(fit.model, every.mapping, segments, fit.standard, fit.wls.sigma)
        found = runs_of(fit.model, every.mapping, fit.standard, sums, unit)
        drives = [group for group in found if group.group.kind == "drive"]
        for group in drives:
            inside, alike, total = np.add((inside, alike, total), compared(group.runs, k))
        joint += fit.variation is not None and is_likely(drives, k, rng)
    print(f"| {name} | {len(logs)} | {100 * inside / total:.1f} % | {100 * alike / total:.1f} % "
          f"| {total} | {joint} of {count} |", flush=True)  # fmt: skip
    if fit.between is None:
        return
    errors, rows = np.array(errors), np.nanmean(rows, axis=(0, 2))
    ratio = np.exp(np.nanmean(np.log(errors), axis=(0, 2)))
    print(f"  torque of the log left out, measured RMSE over expected, geometric mean: with spread "
          f"{ratio[0]:.2f}, without {ratio[1]:.2f}; rows within 95 %: {100 * rows[0]:.1f} %, "
          f"{100 * rows[1]:.1f} %", flush=True)  # fmt: skip


def torque_errors(fit):
    """Return measured over expected RMSE, and the share of rows in the band, shapes (2, n).

    Of the validation log, with the spread between logs and without it.
    """
    (log,) = fit.validation
    motion, mask = log.recording.trajectory, log.recording.mask
    ratios, shares = [], []
    for between in (fit.between, None):
        band = expected_band(fit, log, between)
        used = mask[band.samples]
        residual = (motion.tau - log.torques["estimate"])[band.samples]
        count = np.where(used.sum(axis=0) > 20, used.sum(axis=0), np.nan)
        measured = np.sqrt((residual**2 * used).sum(axis=0) / count)
        expected = np.sqrt((band.total**2 * used).sum(axis=0) / count)
        ratios.append(measured / expected)
        shares.append(np.where(count > 0, band.coverage(motion.tau, log.torques["estimate"], mask),
                               np.nan))  # fmt: skip
    return ratios, shares


def is_likely(drives, k, rng):
    """Return whether a run is among the 95 % of draws nearest to the mean, all drives together.

    Distances are Mahalanobis distances by the covariance of the draws. Values that the run hardly
    determines are left out.
    """
    others = [replace(group, runs=group.runs.without(k)) for group in drives]
    names = [str(j) for j in range(len(others[0].runs.h))]
    variation = vary(names, others)
    at = {each.name: j for j, each in enumerate(variation.parameters)}
    truth, errors, order = [], [], []
    for group in drives:
        runs = group.runs
        C = covariance_of(runs.H[k], runs.scale)
        x, known = C @ runs.h[k] + group.centre, np.sqrt(np.diag(C)) < runs.scale
        own = [p for p in np.flatnonzero(known) if group.group.parameters[p] in at]
        truth += x[own].tolist()
        errors.append(C[np.ix_(own, own)])
        order += [at[group.group.parameters[p]] for p in own]
    draws = drawn(variation, 4000, rng)[:, order]
    noise = rng.standard_normal(draws.shape) @ np.linalg.cholesky(block_diag(*errors)).T
    return mahalanobis_rank(draws + noise, np.array(truth)) < 0.95


def drawn(variation, count, rng):
    """Return draws of the drive parameters of the next run or robot, shape (count, m)."""
    found = [each.prediction for each in variation.parameters]
    z = rng.standard_normal((count, len(found))) @ np.linalg.cholesky(variation.correlation).T
    return np.column_stack([
        scores_to_values(z[:, p], SCORES, each.mixture.quantiles(ndtr(SCORES)), -np.inf)
        for p, each in enumerate(found)
    ])  # fmt: skip


def mahalanobis_rank(draws, x):
    """Return the share of draws that are nearer to the mean than x (m,), or each of x (k, m)."""
    mean, P = draws.mean(axis=0), np.linalg.inv(np.cov(draws.T))
    own, of_draws = (np.einsum("...i,ij,...j->...", y - mean, P, y - mean) for y in (x, draws))
    return np.searchsorted(np.sort(of_draws), own) / len(draws)


def servos():
    """Print the same for the eight logs of an arm of six servos, about the fit to all of them."""
    folder = Path(os.environ["ROBOTID_DATA"]) / "commands" / "so101"
    columns = {f"{kind}_{joint}": f"{kind}_{name}" for joint, name in SERVOS.items()
               for kind in ("q", "qref")}  # fmt: skip
    settings = {
        "urdf": str(example_urdf("so101.urdf")), "columns": columns,
        "estimator": {"name": "simulation"}, "model": {"friction": "viscous+coulomb"},
        "controller": {"groups": {"servo": list(SERVOS)}},
        "identification": [{"log": str(path)} for path in sorted(folder.glob("*.parquet"))],
    }  # fmt: skip
    with TemporaryDirectory() as out:
        found, _ = run_job(job_from_settings(settings, "job.toml", folder), Path(out) / "out")
    inside = alike = total = 0
    for group in loop_runs(found.model, found.fit.simulator, found.estimate):
        for k in range(len(group.runs.h)):
            inside, alike, total = np.add((inside, alike, total), compared(group.runs, k))
    print(f"| so101 | {len(found.fitted)} | {100 * inside / total:.1f} % | "
          f"{100 * alike / total:.1f} % | {total} | |", flush=True)  # fmt: skip


def compared(runs, k):
    """Return how many values of a run are in the prediction of the others, in their mean, of all.

    Values that the run hardly determines are left out.
    """
    C = covariance_of(runs.H[k], runs.scale)
    x, others = C @ runs.h[k], runs.without(k)
    error, known = np.sqrt(np.diag(C)), np.sqrt(np.diag(C)) < runs.scale
    predicted = SpreadModel(runs).against_others(np.array([k]), is_unit=False).mixture
    ends = np.array([predicted.at((0, p)).ends for p in range(len(x))])
    inside = (ends[:, 0] < x) & (x < ends[:, 1])
    P = covariance_of(others.H.sum(axis=0), runs.scale)
    alone = np.abs(x - P @ others.h.sum(axis=0)) < 1.96 * np.sqrt(np.diag(P) + error**2)
    return (inside & known).sum(), (alone & known).sum(), known.sum()


def simulated(model, pi, rng, *, seconds=12.0, rate=60.0):
    """Return the log of an arm with viscous and Coulomb friction, by Pinocchio's RNEA."""
    t = np.arange(round(seconds * rate)) / rate
    q, v, a = random_fourier(model, rng, period=seconds).evaluate(t)
    robot = loaded(model, pi)
    data, n = robot.createData(), len(model.joints)
    names = model.layout.names
    tau = np.array([pin.rnea(robot, data, *state) for state in
                    zip(model.configurations(q), v, a, strict=True)])  # fmt: skip
    for j, joint in enumerate(model.joints):
        of = {term: pi[names.index(f"{joint}.{term}")] for term in model.layout.terms}
        tau[:, j] += of["armature"] * a[:, j] + of["viscous"] * v[:, j]
        tau[:, j] += of["coulomb"] * np.sign(v[:, j]) + of["offset"]
    tau += 0.02 * np.std(tau, axis=0) * rng.standard_normal((len(t), n))
    return Log(t=t, q=q, v=v, a=a, tau=tau, joints=model.joints)


def recorded(model, pi, rng, *, seconds=6.0, rate=200.0, gain=1.0, load=0.0, slip=0.0):
    """Return the log of an arm that MuJoCo simulates at 0.1 ms, under a controller at 1 kHz.

    The controller reads encoders of 18 bits and holds its torque; the log has the encoders and the
    torque with noise of 2 %, by ``gain`` too large at the elbow. The last link has a load [kg]. In
    the log, not in the controller, the encoder of the elbow has slipped [rad].
    """
    hold, step = 1e-3, 1e-4
    period = round(1.0 / (rate * hold))
    t = hold * np.arange(round(seconds / hold))
    q_ref, v_ref, _ = random_fourier(model, rng, period=seconds).evaluate(t)
    pi = pi.copy()
    pi[10 * len(model.layout.bodies) - 10] += load
    plant = mujoco.MjModel.from_xml_string(mjcf(model, pi, step))
    state = mujoco.MjData(plant)
    state.qpos[:], state.qvel[:] = q_ref[0], v_ref[0]
    kp, kd, steps = np.array([4e3, 3e3, 500.0]), np.array([200.0, 120.0, 15.0]), round(hold / step)
    v, before, rows = v_ref[0].copy(), quantised(q_ref[0]), []
    for k in range(len(t)):
        q = quantised(state.qpos)
        v += 0.2 * ((q - before) / hold - v)  # first-order filter
        before = q
        tau = kp * (q_ref[k] - q) + kd * (v_ref[k] - v)
        if k % period == 0:
            rows.append((t[k], q, tau))
        state.ctrl[:] = tau
        mujoco.mj_step(plant, state, steps)
    t, q, tau = map(np.array, zip(*rows, strict=True))
    tau = tau + 0.02 * np.std(tau, axis=0) * rng.standard_normal(tau.shape)
    q, tau = q + np.array([0.0, slip, 0.0]), tau * np.array([1.0, gain, 1.0])
    return Log(t=t, q=q, tau=tau, joints=model.joints)


def quantised(q):
    """Return positions as encoders of 18 bits a turn read them."""
    size = 2 * np.pi / 2**18
    return size * np.round(q / size)


def mjcf(model, pi, step):
    """Return a serial arm in MuJoCo's format, from Pinocchio's frames and parameters."""
    robot, names, body, end = loaded(model, pi), model.layout.names, "", ""
    for j, joint in enumerate(model.joints, start=1):
        of = {term: pi[names.index(f"{joint}.{term}")] for term in model.layout.terms}
        frame, inertia = robot.jointPlacements[j], robot.inertias[j]
        x, y, z, w = pin.Quaternion(frame.rotation).coeffs()
        moments = inertia.inertia
        axis = {"X": "1 0 0", "Y": "0 1 0", "Z": "0 0 1"}[robot.joints[j].shortname()[-1]]
        body += (
            f'<body pos="{numbers(frame.translation)}" quat="{numbers((w, x, y, z))}">'
            f'<inertial mass="{inertia.mass}" pos="{numbers(inertia.lever)}" fullinertia="'
            f'{numbers(moments[(0, 1, 2, 0, 0, 1), (0, 1, 2, 1, 2, 2)])}"/>'
            f'<joint name="{joint}" axis="{axis}" damping="{of["viscous"]}" '
            f'frictionloss="{of["coulomb"]}" armature="{of["armature"]}"/>'
        )
        end += "</body>"
    motors = "".join(f'<motor joint="{joint}"/>' for joint in model.joints)
    return (
        f'<mujoco><option timestep="{step}" integrator="implicitfast"/><worldbody>{body}{end}'
        f"</worldbody><actuator>{motors}</actuator></mujoco>"
    )


def numbers(values):
    return " ".join(map(str, np.asarray(values).tolist()))


def loaded(model, pi):
    """Return Pinocchio's model with the inertial parameters of pi."""
    robot = model.pin_model.copy()
    for k in range(len(model.layout.bodies)):
        robot.inertias[k + 1] = pin.Inertia.FromDynamicParameters(pi[10 * k : 10 * k + 10])
    return robot


def arm():
    model = RobotModel.from_urdf(example_urdf("ur5_robot.urdf"), joints=JOINTS)
    pi = model.standard_parameters()
    names = model.layout.names
    for joint, viscous, coulomb in zip(JOINTS, (6.0, 4.0, 1.5), (5.0, 3.0, 1.0), strict=True):
        pi[names.index(f"{joint}.viscous")], pi[names.index(f"{joint}.coulomb")] = viscous, coulomb
        pi[names.index(f"{joint}.armature")] = 0.3
    friction = [k for k, n in enumerate(names) if n.endswith(("viscous", "coulomb"))]
    return model, pi, friction


def groups(model, logs, unit):
    """Return the fit's information on each run."""
    signals = SignalSettings(cutoff=None, trim=0.0)
    return groups_of(model, [hold_log(model, log, signals) for log in logs], unit)


def groups_of(model, held, unit):
    """Return the fit's information on each run, from logs that were read."""
    held = [replace(log, unit=str(u)) for log, u in zip(held, unit, strict=True)]
    some = Recordings(model, structural_mapping(model), held)
    return solve_recordings(some, EstimatorSettings()).with_errors().runs


def fleets(count, units=20):
    """Print coverage for the next robot and of the spreads, of robots with 5 runs each."""
    model, pi, friction = arm()
    names, runs = model.layout.names, 5
    nexts, spreads, total, joint, box = 0, 0, 0, [], []

    def another(rng):
        """Return a robot; frictions of robots correlate by COMMON."""
        own, size = pi.copy(), len(friction)
        deviation = np.sqrt(COMMON) * rng.normal() + np.sqrt(1 - COMMON) * rng.normal(size=size)
        own[friction] *= 1 + BETWEEN * deviation
        return own

    for seed in range(count):
        rng = np.random.default_rng(seed)
        logs, robots = [], []
        for u in range(units + 1):
            robot = another(rng)
            robots.append(robot)
            for _ in range(runs if u < units else 0):
                own = robot.copy()
                own[friction] *= 1 + WITHIN * rng.normal(size=len(friction))
                logs.append(simulated(model, own, rng))
        unit = np.repeat([f"{u:02d}" for u in range(units)], runs)
        found = groups(model, logs, unit)
        variation = vary([str(k) for k in range(len(logs))], found)
        new = robots[-1] * (1 + WITHIN * rng.normal(size=len(pi)))
        for each in variation.parameters:
            k = names.index(each.name)
            if k in friction:
                low, high = each.prediction.ends
                nexts += low < new[k] < high
                first, last = each.prediction.spread_ends
                spreads += first < BETWEEN * pi[k] < last
                total += 1
        own = [
            p for p, each in enumerate(variation.parameters) if names.index(each.name) in friction
        ]
        order = [names.index(variation.parameters[p].name) for p in own]
        draws = drawn(variation, 4000, rng)[:, own]
        alone = np.column_stack([rng.permutation(x) for x in draws.T])  # a box: no correlation
        for _ in range(20):
            left = another(rng)
            x = left[order] + WITHIN * pi[order] * rng.normal(size=len(order))
            joint.append(mahalanobis_rank(draws, x))
            box.append(mahalanobis_rank(alone, x))
    print(f"| {count} fleets of {units} robots, {runs} runs each | of {total} |")
    print("|---|---|")
    for words, ranks in (("samples", joint), ("samples without correlation", box)):
        ranks = np.array(ranks)
        print(
            f"| robots left out, jointly within 95 % (50 %) of {words} | "
            f"{100 * np.mean(ranks < 0.95):.0f} % ({100 * np.mean(ranks < 0.5):.0f} %) |"
        )
    print(f"| next robot within 95 % | {100 * nexts / total:.0f} % |")
    print(
        f"| spread between robots within its 95 % | {100 * spreads / total:.0f} % |\n", flush=True
    )


def estimates(rng, x, unit):
    """Return the information of runs on three drives with four terms, whose values are x (k, 12).

    Errors are 2 % of a term and correlated; the plausible spread is 10 %.
    """
    found = []
    for j in range(3):
        A = 0.3 * rng.normal(size=(len(x), 4, 4)) + np.eye(4)
        H = np.einsum("kij,kil->kjl", A, A) / 0.02**2
        error = np.linalg.solve(
            np.linalg.cholesky(H).swapaxes(1, 2), rng.normal(size=(len(x), 4, 1))
        )
        h = np.einsum("kij,kj->ki", H, x[:, 4 * j : 4 * j + 4] + error[:, :, 0])
        names = tuple(f"joint_{j}.{term}" for term in ("viscous", "coulomb", "offset", "armature"))
        group = Group("drive", f"joint_{j}", names, ("N m",) * 4, np.eye(4), (0,))
        runs = Runs(H, h, np.asarray(unit), np.full(4, 0.1))
        found.append(RunsOf(group, np.ones(4), runs, 1.0))
    return found


def parameters_of(groups):
    """Return the variation of parameters, without a comparison of the runs."""
    unit = groups[0].runs.unit
    own = [each for group in groups for each in _parameters(group, SpreadModel(group.runs))]
    names = tuple(map(str, range(len(unit))))
    return Variation(names, int(unit.max()) + 1, tuple(own), (), of_runs=tuple(unit.tolist()))


def samples(count):
    """Print how many of 200 robots left out of each fleet are in the 95 % and 50 % regions.

    The standard error is that of fleets: robots of one fleet have the samples in common. Friction
    differs by BETWEEN between robots, other terms by 1 %; logs as WITHIN.
    """
    varies = np.tile([True, True, False, False], 3)
    blocks = np.arange(12) // 4
    kinds = {
        "independent": np.eye(12), "0.7 of all friction": 0.7 * np.outer(varies, varies),
        "0.8 within a joint": 0.8 * (blocks[:, None] == blocks) * np.outer(varies, varies),
        "0.9 of all friction": 0.9 * np.outer(varies, varies),
    }  # fmt: skip
    print("| correlation | robots | all: 95 % (50 %) | friction: 95 % (50 %) |\n|---|---|---|---|")
    for words, R in kinds.items():
        L = np.linalg.cholesky(np.where(np.eye(12) > 0, 1.0, R))
        L = L * np.where(varies, BETWEEN, 0.01)[:, None]
        within = np.where(varies, WITHIN, 0.01)
        for robots in (6, 10, 20):
            ranks = [[], []]
            for k in range(count):
                rng = np.random.default_rng([7, k, robots, len(words)])
                unit = np.repeat(np.arange(robots), rng.integers(3, 6))
                x = (rng.normal(size=(robots, 12)) @ L.T)[unit]
                x = x + within * rng.normal(size=x.shape)
                found = parameters_of(estimates(rng, x, unit))
                new = 1.0 + rng.normal(size=(200, 12)) @ L.T + within * rng.normal(size=(200, 12))
                draws = drawn(found, 2000, rng)
                for rank, own in zip(ranks, (slice(None), varies), strict=True):
                    rank.append(mahalanobis_rank(draws[:, own], new[:, own]))
            most = [100 * (np.array(r) < 0.95).mean(axis=1) for r in ranks]  # of each fleet
            half = [100 * np.mean(np.array(r) < 0.5) for r in ranks]
            cells = " | ".join(
                f"{x.mean():.0f} +- {x.std() / np.sqrt(count):.1f} % ({y:.0f} %)"
                for x, y in zip(most, half, strict=True)
            )
            print(f"| {words} | {robots} | {cells} |", flush=True)


def warm_up(honest, count):
    """Print how often a log has the finding drift, without and with a warm-up of the elbow.

    Its friction is higher at the start by a share that falls with a time constant of 20 s.
    """
    model, pi, friction = arm()
    names, seconds = model.layout.names, 40.0
    print("| friction at the start | logs | drift found | trend within 95 % |\n|---|---|---|---|")
    for share, logs in ((0.0, honest), (0.3, count), (0.15, count)):
        found = inside = 0
        for k in range(logs):
            rng = np.random.default_rng([5, k, round(100 * share)])
            own = pi.copy()
            own[friction] *= rng.uniform(0.5, 2.0, len(friction))
            log = simulated(model, own, rng, seconds=seconds)
            v, t = log.v[:, 1], log.t
            terms = [own[names.index(f"elbow_joint.{term}")] for term in ("coulomb", "viscous")]
            more, tau = share * np.exp(-t / 20.0), log.tau.copy()
            tau[:, 1] += more * (terms[0] * np.sign(v) + terms[1] * v)
            size = terms[0] + terms[1] * np.sqrt(np.mean(v**2))
            true = np.polyfit(t / 60.0, more * size, 1)[0]
            fit = identify(model, [replace(log, tau=tau)], estimator=EstimatorSettings(),
                           friction="viscous+coulomb", doctor=False)  # fmt: skip
            drifts = [f.evidence for f in fit.findings if f.code == "drift"]
            found += bool(drifts)
            inside += any(abs(e["trend"] - true) < 1.96 * e["trend_std_error"] for e in drifts)
        print(f"| {100 * share:.0f} % higher | {logs} | {found} | {inside} |", flush=True)


def unlike(count):
    """Print how often a run that differs is named with its cause, and false alarms."""
    model, pi, friction = arm()
    print(f"| one run of 6 differs, {count} sets of each | named | another | none |")
    print("|---|---|---|---|")
    for kind in ("alike", *KINDS):
        right = wrong = none = 0
        for seed in range(count):
            rng, logs = np.random.default_rng([seed, len(kind)]), []
            for run in range(6):
                own = pi.copy()
                own[friction] *= 1 + WITHIN * rng.normal(size=len(friction))
                if run == 2 and kind == "payload":
                    own[10 * len(model.layout.bodies) - 10] += 1.0
                if run == 2 and kind == "friction":
                    own[model.layout.names.index("elbow_joint.coulomb")] *= 2.5
                log = simulated(model, own, rng)
                if run == 2 and kind == "gain":
                    log = replace(log, tau=log.tau * np.array([1.0, 1.15, 1.0]))
                if run == 2 and kind == "zero":
                    log = replace(log, q=log.q + np.array([0.0, SLIP[0], 0.0]))
                logs.append(log)
            found = vary([str(k) for k in range(6)], groups(model, logs, ["a"] * 6)).unlike
            cause = {"friction": "drive"}.get(kind, kind)
            is_right = [(each.run, each.kind) == (2, cause) for each in found]
            right += any(is_right)
            wrong += not all(is_right)
            none += not found
        print(f"| {kind} | {right} | {wrong} | {none} |", flush=True)


class Plants:
    """Logs of arms that MuJoCo simulates: sets of 6 logs, and of 5 robots with 2 logs each.

    Sets are drawn from a pool of as many logs, or robots, as there are sets. Alike logs are
    compared about the fit to the whole pool.
    """

    def __init__(self, seed):
        self.model, self.pi, self.friction = arm()
        self.rng = np.random.default_rng([11, seed])

    def robot(self):
        """Return the parameters of another robot."""
        own = self.pi.copy()
        own[self.friction] *= 1 + BETWEEN * self.rng.normal(size=len(self.friction))
        return own

    def log(self, own, **changed):
        """Return a log of a robot; friction varies between logs."""
        own = own.copy()
        own[self.friction] *= 1 + WITHIN * self.rng.normal(size=len(self.friction))
        log = recorded(self.model, own, self.rng, **changed)
        return hold_log(self.model, log, SignalSettings())

    def chosen(self, found, logs, unit):
        """Return the variation of some logs of a pool, about the fit to all."""
        own = [
            replace(group, runs=replace(group.runs, H=group.runs.H[logs], h=group.runs.h[logs],
                                        unit=np.array(unit)))
            for group in found
        ]  # fmt: skip
        return vary([str(k) for k in range(len(logs))], own)


def alike_logs(count):
    """Print how often one of 6 alike logs has a finding."""
    plants = Plants(0)
    pool = groups_of(plants.model, [plants.log(plants.pi) for _ in range(count)], ["a"] * count)
    sets = [plants.rng.choice(count, 6, replace=False) for _ in range(count)]
    alarms = sum(bool(plants.chosen(pool, logs, [0] * 6).unlike) for logs in sets)
    print(f"| 6 alike logs | {count} | | {alarms} | {count - alarms} |", flush=True)


def alike_fleets(count):
    """Print how often 5 alike robots have a finding."""
    plants = Plants(1)
    logs = [plants.log(own) for own in (plants.robot() for _ in range(count)) for _ in range(2)]
    pool = groups_of(plants.model, logs, np.repeat(np.arange(count), 2))
    found = []
    for _ in range(count):
        robots = plants.rng.choice(count, 5, replace=False)
        own = np.column_stack([2 * robots, 2 * robots + 1]).ravel()
        found.append(plants.chosen(pool, own, np.repeat(np.arange(5), 2)))
    of_robots, of_logs = (
        sum(bool(f.unlike_units) for f in found),
        sum(bool(f.unlike) for f in found),
    )
    alarms = sum(bool(f.unlike_units or f.unlike) for f in found)
    print(f"| 5 alike robots, 2 logs each | {count} | | {alarms} ({of_robots} of robots, {of_logs} "
          f"of logs) | {count - alarms} |", flush=True)  # fmt: skip


def odd_fleets(count):
    """Print how often one of 5 robots that differs is named with its cause."""
    plants, joint = Plants(2), "elbow_joint"
    pool = [[plants.log(own), plants.log(own)] for own in (plants.robot() for _ in range(12))]
    for kind in KINDS:
        right = wrong = none = 0
        for _ in range(count):
            own = plants.robot()
            odd = {"gain": {"gain": 1.15}, "payload": {"load": 1.0}, "zero": {"slip": SLIP[1]}}
            changed = odd.get(kind, {})
            if kind == "friction":
                own[plants.model.layout.names.index(f"{joint}.coulomb")] *= 3.0
            others = plants.rng.choice(len(pool), 4, replace=False)
            logs = [plants.log(own, **changed), plants.log(own, **changed)]
            logs += [log for k in others for log in pool[k]]
            found = groups_of(plants.model, logs, np.repeat(np.arange(5), 2))
            each = vary([str(k) for k in range(10)], found)
            cause = {"friction": "drive"}.get(kind, kind)
            is_right = [(x.run, x.kind) == (0, cause) for x in each.unlike_units]
            right += any(is_right)
            wrong += not all(is_right) or bool(each.unlike)
            none += not is_right
        print(f"| one of 5 robots: {kind} | {count} | {right} | {wrong} | {none} |", flush=True)


if __name__ == "__main__":
    main()
