"""Does a preview come true? Standard errors expected of a motion against what is found afterwards.

    python benchmarks/bench_preview.py [--runs 100] [--more] [--quick]

First table: a motion of 20 s at 200 Hz is previewed with the noise that its torque will have. Each
run draws another robot, whose bodies lie as far from the URDF as the prior takes to be plausible
("plausible") or nearer ("near", a quarter of that), with a tool of 1.2 kg and friction, simulates
its log and identifies it. Ratios are those of the expected standard error of each base parameter
to the root mean square of its error over the runs, and to that of the reported standard errors;
wanted 0.8-1.25. "white": noise of each sample, 0.3 to 10 % of the torque from joint to joint;
"coloured": the same as AR(1) with 0.9.

Second table: recordings of other laboratories, previewed from their positions alone, then
identified. Ratios are those of the reported standard error of each base parameter to the expected
one, with the noise that is assumed of a robot of which nothing is known, and with that of the
result. "next": the last log, or the last third of the only one, is previewed beside the result of
the others; reported is what both together then give.
"""

import setting  # noqa: I001 -- pins the threads of BLAS before numpy is imported

import argparse
from pathlib import Path

import numpy as np
import scipy.linalg
import scipy.signal

from robotid.cli.job import read_job
from robotid.cli.identify import identify
from robotid.design.previews import TorqueNoise
from robotid.design.previews import preview
from robotid.data.log import Log
from robotid.dynamics.torque import joint_torque_regressor
from robotid.robot.parameters import inertial_from_pseudo_inertia, pseudo_inertia
from robotid.dynamics.simulation.simulator import another_robot
from robotid.dynamics.simulation.motions import random_fourier

RATE, DURATION = 200.0, 20.0
COLOUR = 0.9
FAR = {"near": 0.1, "plausible": 0.4}  # of a body's own size, in each direction
JOBS = Path(__file__).parents[1] / "tests" / "jobs"


def another(model, rng, size):
    """Return a robot whose bodies J = L L^T became L A A^T L^T, A = exp(size normal numbers)."""
    pi = another_robot(model, rng)
    bodies = model.layout.n_inertial
    L = np.linalg.cholesky(pseudo_inertia(model.standard_parameters()[:bodies]))
    deform = np.array([scipy.linalg.expm(size * rng.standard_normal((4, 4))) for _ in L])
    moved = L @ deform
    J = moved @ moved.transpose(0, 2, 1)
    tool = pi[bodies - 10 : bodies] - model.standard_parameters()[bodies - 10 : bodies]
    pi[:bodies] = np.concatenate([inertial_from_pseudo_inertia(J_i) for J_i in J])
    pi[bodies - 10 : bodies] += np.where(size < 0.2, tool, 0.0)
    return pi


def coloured(white, kind):
    if kind == "white":
        return white
    return scipy.signal.lfilter([np.sqrt(1 - COLOUR**2)], [1.0, -COLOUR], white, axis=0)


def monte_carlo(name, kind, urdf, runs):
    """Yield estimator and ratios of the expected standard errors to errors and to reported ones."""
    model, rng = setting.robot(name), np.random.default_rng(0)
    t = np.arange(round(RATE * DURATION)) / RATE
    q, v, a = random_fourier(model, rng, period=DURATION / 2).evaluate(t)
    W = joint_torque_regressor(model, q, v, a)
    std = np.std((W @ another(model, rng, FAR[urdf])).reshape(v.shape), axis=0)
    std *= np.geomspace(0.003, 0.1, len(std))
    time = 0.0 if kind == "white" else (1 + COLOUR) / (1 - COLOUR) / RATE
    noise = TorqueNoise(std, np.full(len(std), time), ("stated",) * len(std))
    motion = Log(t=t, q=q, tau=np.zeros_like(q), joints=model.joints, v=v, a=a)
    expected = {
        key: preview(model, [motion], noise=noise, estimator=key).base_error
        for key in ("wls", "consistent")
    }
    found = {key: [] for key in expected}
    for run in range(runs):
        draw = np.random.default_rng([1, run])
        pi = another(model, draw, FAR[urdf])
        noisy = (W @ pi).reshape(v.shape) + std * coloured(draw.standard_normal(v.shape), kind)
        log = Log(t=t, q=q, tau=noisy, joints=model.joints, v=v, a=a)
        done = identify(model, [log], friction="none", doctor=False)
        truth = done.mapping.to_base(pi)
        found["wls"].append((done.wls.theta - truth, done.wls.std_error))
        found["consistent"].append((done.base - truth, done.base_error))
    for key, rows in found.items():
        finite = np.array([[np.where(np.isfinite(x), x, np.nan) for x in row] for row in rows])
        error, reported = np.sqrt(np.nanmean(finite**2, axis=0))
        yield key, expected[key] / error, expected[key] / reported


def recorded(name):
    """Yield what is compared, and ratios of reported to expected standard errors, by estimator."""
    job = read_job(JOBS / f"{name}.toml")
    model = job.model()
    logs = [job.read(entry, model) for entry in job.identification]
    if len(logs) == 1:
        cut = logs[0].t[0] + 2 / 3 * (logs[0].t[-1] - logs[0].t[0])
        parts = [logs[0].window(None, cut), logs[0].window(cut, None)]
    else:
        parts = logs
    options = {"signals": job.signals, "friction": job.friction, "doctor": False}
    whole = identify(model, logs, **options)
    first = identify(model, parts[:-1], **options)
    own = {d.joint: "+".join(d.families) for d in first.drives}
    both = identify(model, parts, **options | {"friction": job.friction | own})
    for key in ("wls", "consistent"):
        plain = preview(model, logs, signals=job.signals, estimator=key)
        yield key, "assumed", whole, plain
        noise = preview(model, logs[:1], signals=job.signals, estimator=key, given=whole).noise
        found = preview(whole.model, logs, signals=job.signals, estimator=key, noise=noise)
        yield key, "own", whole, found
        given = preview(model, parts[-1:], signals=job.signals, estimator=key, given=first)
        yield key, "next", both, given


def ratio(key, reported, expected):
    """Return reported over expected standard errors of the parameters that both have."""
    after = dict(zip(reported.mapping.base_names, errors(key, reported), strict=True))
    names = expected.expected.mapping.base_names
    pairs = [(after[n], e) for n, e in zip(names, expected.base_error, strict=True) if n in after]
    one, other = np.array(pairs).T
    return (one / other)[np.isfinite(one) & np.isfinite(other)]


def errors(key, found):
    return found.wls.std_error if key == "wls" else found.base_error


def cells(ratios):
    low, middle, high = np.quantile(ratios, [0.1, 0.5, 0.9])
    inside = 100 * np.mean((ratios >= 0.8) & (ratios <= 1.25))
    return f"{middle:.2f} | {low:.2f}-{high:.2f} | {inside:.0f} %"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument(
        "--more", action="store_true", help="also coloured noise, and a URDF close to the truth"
    )
    parser.add_argument("--quick", action="store_true", help="few runs of one robot, as a trial")
    options = parser.parse_args()
    runs = 3 if options.quick else options.runs
    cases = [("UR10", "white", "plausible"), ("panda", "white", "plausible")]
    if options.more:
        cases += [("UR10", "coloured", "plausible"), ("UR10", "white", "near")]
    names = ["ur10e", "kinova_gen3", "tx40"]
    if options.quick:
        cases, names = cases[:1], names[-1:]
    middle = "median | 10-90 % | in 0.8-1.25"
    print(f"{runs} runs each; expected / achieved\n")
    print(f"| robot | noise | truth | estimator | error: {middle} | reported: {middle} |")
    print("|---" * 10 + "|")
    for name, kind, urdf in cases:
        for key, *both in monte_carlo(name, kind, urdf, runs):
            shown = " | ".join(map(cells, both))
            print(f"| {name} | {kind} | {urdf} | {key} | {shown} |", flush=True)
    print(f"\n| recording | estimator | noise | achieved / expected: {middle} |")
    print("|---" * 6 + "|")
    for name in names:
        for key, what, found, ahead in recorded(name):
            shown = cells(ratio(key, found, ahead))
            print(f"| {name} | {key} | {what} | {shown} |", flush=True)
    print(f"\n{setting.machine()}")


if __name__ == "__main__":
    main()
