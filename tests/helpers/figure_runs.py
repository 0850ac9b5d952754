"""The scenarios of tests/figures: small robots, rich settings, every command that states figures.

Each function takes an empty folder and returns the commands' documents beside what is known of the
robot that was simulated. Nothing that has a figure is at its default.
"""

from dataclasses import replace

import numpy as np

from helpers.hoist import (
    BODIES,
    DRIVES,
    NOISE,
    Drive,
    Hoist,
    Loop,
    follow,
    motion,
    record,
    urdf,
    write_table,
)
from helpers.stored import Runs

ARM_JOB = """
urdf = "hoist.urdf"
locked = { finger = 0.012 }
gravity = [1.2, -0.9, -9.6]
drives = { swing = [{ term = "Stribeck", speed = 0.25 }], lift = ["load"], roll = ["load"] }
columns = { tau_swing = "M1" }
[signals]
cutoff = 9.0
order = 3
trim = 0.25
min_velocity = 0.03
friction_band = 0.004
velocity = "differentiated"
[model]
friction = "viscous+coulomb"
[units]
time = "ms"
angle = "deg"
[output]
dynamics = true
[doctor]
ignore = ["payload_change"]
[estimator]
name = "consistent"
prior_weight = 0.4
[estimator.constraints]
mass = { hand = [1.0, 1.65] }
total_mass = [12.0, 16.5]
com = { boom = [[0.1, -0.1, -0.1], [0.5, 0.1, 0.1]] }
[[coupling]]
name = "roll"
ratios = { lift = 0.4, roll = 1.0 }
replaces = true
[[identification]]
log = "first.csv"
start = 51.0
end = 61.5
[[identification]]
log = "second.csv"
[[validation]]
log = "kept.csv"
start = 3.5
"""
TURNS = (0.0, 0.4, 0.0, 1.0)  # of the last motor, by joint
ARM_DRIVES = DRIVES | {
    "swing": Drive(1.1, 3.0, 4.0, 0.6, stribeck=2.5),
    "lift": Drive(0.9, 2.2, 2.1, -0.8, load=0.08),
    "roll": Drive(),
}


def degrees(name):
    return 1.0 if name.endswith("reach") else 180 / np.pi


def arm(folder):
    """Every setting of a fit: identified, judged, validated, exported, foreseen, replayed."""
    hoist = Hoist(drives=ARM_DRIVES, coupling=TURNS, coupled=Drive(0.07, 0.4, 0.6, 0.15, load=0.05))
    (folder / "hoist.urdf").write_text(urdf())
    units = {"time": 1e3, "q_": degrees}
    logs = {
        name: record(folder / f"{name}.csv", hoist, seed, scale=dict(units), **about)
        for name, seed, about in (
            ("first", 1, {"seconds": 12, "rate": 100, "start": 50, "cut": (500, 560)}),
            ("second", 2, {"seconds": 8, "rate": 80, "start": 7, "noise": 1.6}),
            ("kept", 3, {"seconds": 7, "rate": 90, "start": 3}),
            ("later", 4, {"seconds": 6, "rate": 110, "start": 20, "noise": 2.0}),
            ("faulty", 5, {"seconds": 5, "rate": 100, "start": 11, "noise": 9.0}),
        )
    }
    for path in folder.glob("*.csv"):
        path.write_text(path.read_text().replace("tau_swing", "M1", 1))
    runs = Runs(folder)
    turned = (folder / "faulty.csv").read_text().replace("tau_lift", "tau_", 1)
    turned = turned.replace("tau_roll", "tau_lift", 1).replace("tau_,", "tau_roll,", 1)
    (folder / "faulty.csv").write_text(turned)  # two torques exchanged
    (folder / "job.toml").write_text(ARM_JOB)
    out = folder / "out"
    runs.run("doctor", "doctor", folder / "job.toml", "--verbose")
    runs.run("identify", "identify", folder / "job.toml", "--out", out, "--verbose")
    found = runs.keep("result.json", "out/result.json")
    runs.keep("report.html", "out/report.html")
    runs.keep("identified.urdf", "out/hoist.identified.urdf")
    runs.keep("sidecar", "out/hoist.identified.drive.json")
    others = [folder / "later.csv", folder / "faulty.csv"]
    runs.run("validate", "validate", out, others[0])
    runs.run("validate --json", "validate", out, *others, "--json", code=None)
    for form, file in (
        ("mjcf", "x.xml"),
        ("sdf", "x.sdf"),
        ("urdf", "x.urdf"),
        ("ranges", "r.yaml"),
    ):
        runs.run(f"export {form}", "export", out, "--format", form, "--out", folder / file)
        runs.keep(f"exported {form}", file)
    runs.run("preview --given", "preview", folder / "job.toml", "--given", out, "--verbose")
    return runs, {"hoist": hoist, "logs": logs, "result": found}


def brief(result):
    """Return what a result holds but for what another scenario shows in full."""
    kept = {
        k: x for k, x in result.items() if k not in ("standard_parameters", "ranges", "settings")
    }
    shown = ("name", "value", "std_error", "interval_95", "source", "with_urdf")
    return kept | {
        key: [{k: x for k, x in entry.items() if k in shown} for entry in result[key]]
        for key in ("base_parameters", "drive_parameters")
    }


CURRENTS = {"lift": 21.0, "reach": 33.0, "roll": 4.5}  # [N m/A or N/A]


def currents(folder):
    """Flags in the place of a job: currents, measured velocities, a delay, weighted rows."""
    joints = ("lift", "reach", "roll")
    drives = DRIVES | {"roll": Drive(0.05, 0.35, 0.5, 0.11, ripple=0.25)}
    hoist = Hoist(joints, drives=drives, locked={"finger": 0.02, "swing": 0.4},
                  gravity=(0.0, 0.0, -9.81))  # fmt: skip
    (folder / "hoist.urdf").write_text(urdf())

    def amperes(name):
        return 1 / CURRENTS[name.removeprefix("current_")]

    logs = {}
    for name, seed, seconds, rate, start in (
        ("one", 11, 9, 160, 2.5), ("two", 12, 6, 90, 40.0), ("three", 13, 6, 100, 100.0),
    ):  # fmt: skip
        logs[name] = record(
            folder / f"{name}.csv", hoist, seed, seconds=seconds, rate=rate, start=start,
            velocity=True, kind="current", scale={"current": amperes, "time": 1e6},
        )  # fmt: skip
    runs, out = Runs(folder), folder / "out"
    robot = [
        "--joints", "lift,reach,roll", "--lock", "finger=0.02", "--lock", "swing=0.4",
        "--time-unit", "us", "--rate", "75", "--cutoff", "7", "--min-velocity", "0.05",
        "--friction", "viscous+coulomb+asymmetric",
        *(word for joint, gain in CURRENTS.items() for word in ("--gain", f"{joint}={gain}")),
    ]  # fmt: skip
    words = [
        "identify", folder / "hoist.urdf", folder / "one.csv", folder / "two.csv",
        "--validate", folder / "three.csv", *robot, "--estimator", "wls", "--order", "5",
        "--trim", "0.3", "--friction-band", "0.01", "--max-gap", "0.5",
        "--torque-delay", "0.004", "--velocity-delay", "-0.003", "--velocity", "measured",
        "--acceleration", "differentiated", "--ignore", "gravity",
    ]  # fmt: skip
    runs.run("identify", *words, "--out", out, "--verbose", "--no-report")
    found = runs.keep("result.json", "out/result.json", brief)
    runs.run("doctor --json", "doctor", *words[1:], "--json")
    runs.run("validate", "validate", out, folder / "three.csv")
    runs.run("track", "track", folder / "hoist.urdf", folder / "three.csv", *robot, "--out",
             folder / "track")  # fmt: skip
    runs.keep("track.json", "track/track.json")
    return runs, {"hoist": hoist, "logs": logs, "result": found}


MOTORS_JOB = """
urdf = "hoist.urdf"
joints = ["swing", "lift"]
locked = { "*" = 0.0, reach = 0.1, roll = 0.3, finger = 0.01 }
mimic = "independent"
[signals]
cutoff = 10.0
trim = 0.1
min_velocity = 0.04
[model]
friction = "viscous+coulomb"
offset = false
[output]
report = false
[torque]
gains = { m1 = 0.11, m2 = 0.13 }
[estimator]
name = "ols"
[[transmission]]
joints = ["swing", "lift"]
motors = ["m1", "m2"]
matrix = [[81.0, 0.0], [-40.0, 60.0]]
efficiency = [0.85, 0.75]
offset = [0.1, -0.2]
[[identification]]
log = "one.csv"
[[identification]]
log = "two.csv"
end = 26.0
[[validation]]
log = "three.csv"
"""
MATRIX, EFFICIENCY, ZEROS = np.array([[81.0, 0.0], [-40.0, 60.0]]), (0.85, 0.75), (0.1, -0.2)
MOTOR_GAINS = (0.11, 0.13)  # [N m/A]


def motors(folder):
    """Logs of coupled motors, in turns and amperes, by ordinary least squares."""
    joints = ("swing", "lift")
    still = {"finger": 0.01, "reach": 0.1, "roll": 0.3}
    free = {j: Drive() for j in joints}
    drives = (Drive(1.6, 4.0, 3.0), Drive(1.2, 3.2, 2.2))  # at the motors' speeds over 81 and 60
    gravity = (0.0, 0.0, -9.81)
    hoist = Hoist(joints, drives=free, locked=still, gravity=gravity)
    (folder / "hoist.urdf").write_text(urdf())
    T = MATRIX / np.max(MATRIX, axis=1)[:, None]
    for name, seed, seconds, rate, start in (
        ("one", 21, 8, 100, 5.0), ("two", 22, 7, 80, 20.0), ("three", 23, 5, 90, 0.0),
    ):  # fmt: skip
        t = np.arange(round(seconds * rate)) / rate
        q, v, a = motion(joints, seed, t)
        tau, rng = hoist.torque(q, v, a), np.random.default_rng(seed)
        for row, drive in zip(T, drives, strict=True):
            w, dw = v @ row, a @ row
            own = drive.armature * dw + drive.viscous * w + drive.coulomb * np.sign(w)
            tau += own[:, None] * row
        tau += np.array([NOISE[j] for j in joints]) * rng.standard_normal(tau.shape)
        turned = np.round((q - ZEROS) @ MATRIX.T / 0.15) * 0.15  # steps of the encoders
        amperes = np.linalg.solve(MATRIX.T, tau.T).T / EFFICIENCY / MOTOR_GAINS
        table = {"time": start + t}
        for k, motor in enumerate(("m1", "m2")):
            table |= {f"qm_{motor}": turned[:, k], f"currentm_{motor}": amperes[:, k]}
        write_table(folder / f"{name}.csv", table)
    (folder / "job.toml").write_text(MOTORS_JOB)
    runs = Runs(folder)
    runs.run("identify", "identify", folder / "job.toml", "--out", folder / "out")
    found = runs.keep("result.json", "out/result.json", brief)
    return runs, {"hoist": hoist, "drives": drives, "result": found}


PAIR = """
urdf = "hoist.urdf"
joints = ["lift", "reach"]
locked = {{ swing = -0.2, roll = 0.5, finger = 0.01 }}
[signals]
cutoff = 8.5
[model]
friction = "{friction}"
[output]
report = false
{more}
[[identification]]
log = "one.csv"
[[identification]]
log = "two.csv"
{last}
"""
KEPT = '[[validation]]\nlog = "three.csv"'
PAIR_STILL = {"finger": 0.01, "swing": -0.2, "roll": 0.5}


def pair(folder, drives=DRIVES, seconds=(8, 5, 5)):
    """Write the URDF and three logs of two joints, and return the robot."""
    hoist = Hoist(("lift", "reach"), drives=drives, locked=PAIR_STILL, gravity=(0.0, 0.0, -9.81))
    (folder / "hoist.urdf").write_text(urdf())
    for k, (name, rate, start) in enumerate(
        (("one", 100, 4.0), ("two", 80, 0.5), ("three", 90, 60.0))
    ):
        record(folder / f"{name}.csv", hoist, 31 + k, seconds=seconds[k], rate=rate, start=start,
               noise=1.0 + 0.5 * k, speed=1.4)  # fmt: skip
    return hoist


ESTIMATORS = {
    "ols": 'name = "ols"',
    "huber": 'name = "wls"\nrobust = "huber"',
    "tls": 'name = "tls"\nregressor_noise = 0.02',
    "tukey": 'name = "consistent"\nrobust = "tukey"\nprior_weight = "evidence"',
    "rls": 'name = "rls"\nforgetting = 0.9995\nprior_weight = 0.5\nphysical = true',
    "kalman": 'name = "kalman"\nwalk = 1e-4\ngate = 0.999\nprior_weight = 2.0',
    "prx": 'name = "prx"\npasses = 2\nmetric = "rows"\nseed = 4\nprior_weight = 0.5',
    "gradient": 'name = "gradient"\npasses = 3\nstep_size = 0.7\naverage = false\nseed = -1\n'
    "prior_weight = 0.5",
}
OF_ESTIMATORS = ("base_parameters", "drive_parameters", "consistency", "uncertainty",
                 "identification", "validation", "verdict")  # fmt: skip


def _of_estimators(result):
    short = brief(result)
    return {key: short[key] for key in OF_ESTIMATORS}


def estimators(folder):
    """Every estimator with settings of its own on one pair of logs, and their comparison."""
    hoist, runs = pair(folder), Runs(folder)
    found = {}
    for name, settings in ESTIMATORS.items():
        more = f"[estimator]\n{settings}"
        job = PAIR.format(friction="viscous+coulomb", more=more, last=KEPT)
        (folder / f"{name}.toml").write_text(job)
        runs.run(name, "identify", folder / f"{name}.toml", "--out", folder / name)
        del runs.documents[name]  # the texts are those of other scenarios
        found[name] = runs.keep(name, f"{name}/result.json", _of_estimators)
    chosen = [folder / name / "result.json" for name in ("huber", "tukey", "kalman")]
    page = folder / "compared.html"
    runs.run("compare", "compare", *chosen, "--out", page)
    runs.run("compare --json", "compare", *chosen, "--json")
    runs.keep("compared.html", "compared.html")
    return runs, {"hoist": hoist, "results": found}


CHOICE_DRIVES = DRIVES | {
    "lift": Drive(0.9, 2.2, 2.1, -0.8, load=0.12),
    "reach": Drive(2.4, 14.0, 6.0, 1.5, spring=35.0),
}
OF_CHOICE = ("friction", "warnings", "drive_parameters", "drive_moments", "uncertainty", "inputs",
             "identification", "validation")  # fmt: skip


def _of_choice(result):
    short = brief(result)
    return {key: short[key] for key in OF_CHOICE if key in short}


def choice(folder):
    """Friction that the logs ask for, and what a model that lacks it leaves: findings."""
    hoist = pair(folder, CHOICE_DRIVES, (16, 12, 8))
    runs, found = Runs(folder), {}
    fit = '[estimator]\nname = "wls"\n'
    stated = 'drives = { reach = ["spring", "cubic"] }\n'
    for name, friction, more in (
        ("chosen", "auto", fit),
        ("stated", "viscous+coulomb", fit),
        ("pieces", "viscous+coulomb+load", fit + "[reduction]\nrows_in_memory = 500\nworkers = 1"),
    ):
        job = PAIR.format(friction=friction, more=more, last=KEPT)
        job = stated + job if name == "pieces" else job
        (folder / f"{name}.toml").write_text(job)
        runs.run(name, "identify", folder / f"{name}.toml", "--out", folder / name, "--verbose")
        found[name] = runs.keep(f"{name}.json", f"{name}/result.json", _of_choice)
    return runs, {"hoist": hoist, "results": found}


STATIC_JOB = """
urdf = "hoist.urdf"
joints = ["lift", "reach", "roll"]
locked = { swing = 0.4, finger = 0.02 }
[model]
dynamics = "static"
friction = "coulomb"
[output]
report = false
[estimator]
prior_weight = 0.8
[[identification]]
log = "slow.csv"
[[identification]]
log = "other.csv"
[[validation]]
log = "kept.csv"
"""


def static(folder):
    """Gravity alone, from slow sweeps."""
    hoist = Hoist(("lift", "reach", "roll"), locked={"finger": 0.02, "swing": 0.4},
                  gravity=(0.0, 0.0, -9.81))  # fmt: skip
    (folder / "hoist.urdf").write_text(urdf())
    for name, seed, seconds, start in (
        ("slow", 41, 60, 9.0),
        ("other", 42, 40, 1.0),
        ("kept", 43, 30, 0.0),
    ):
        record(
            folder / f"{name}.csv", hoist, seed, seconds=seconds, rate=20, start=start, speed=0.12
        )
    (folder / "job.toml").write_text(STATIC_JOB)
    runs = Runs(folder)
    runs.run("identify", "identify", folder / "job.toml", "--out", folder / "out")
    found = runs.keep("result.json", "out/result.json", brief)
    return runs, {"hoist": hoist, "result": found}


LOOP_JOB = """
urdf = "hoist.urdf"
joints = ["lift", "reach"]
locked = { swing = -0.2, roll = 0.5, finger = 0.01 }
[model]
friction = "viscous+coulomb"
[estimator]
name = "simulation"
window = 0.9
lead = 0.2
step = 4e-3
bodies = 0.08
[controller]
kp = { lift = 900.0, reach = 2500.0 }
kd = { lift = 60.0, reach = 130.0 }
delays = "group"
groups = { hinge = ["lift"], rail = ["reach"] }
limit = { reach = 80.0 }
[[identification]]
log = "one.csv"
end = 7.6
[[identification]]
log = "two.csv"
[[validation]]
log = "three.csv"
"""
LOOP = Loop({"lift": 900.0, "reach": 2500.0}, {"lift": 60.0, "reach": 130.0}, delay=0.012)
LOOP_DRIVES = {"lift": Drive(1.3, 3.0, 2.5, 0.7), "reach": Drive(3.0, 16.0, 5.0, -1.0)}
LOOP_STEP = 5e-4  # [s] semi-implicit: torques act half of it early


def commands(folder):
    """A robot that follows commands: loops fitted, judged, shown and exported; then by torque."""
    joints = ("lift", "reach")
    hoist = Hoist(joints, bodies=BODIES, drives=LOOP_DRIVES, locked=PAIR_STILL,
                  gravity=(0.0, 0.0, -9.81))  # fmt: skip
    (folder / "hoist.urdf").write_text(urdf())
    step = LOOP_STEP
    for name, seed, seconds, rate, start in (
        ("one", 51, 4, 200, 3.8), ("two", 52, 1.9, 250, 0.4), ("three", 53, 3, 200, 70.0),
    ):  # fmt: skip
        t = np.arange(round(seconds / step)) * step
        every = round(1 / (rate * step))
        told = t[::every]
        chirp = np.sin(2 * np.pi * (0.5 * told + 0.9 * told**2)[:, None] + [seed, 2 * seed])
        wanted = motion(joints, seed, told, 1.4)[0] + np.array([0.03, 0.006]) * chirp
        wanted = np.repeat(wanted, every, axis=0)[: len(t)]
        q, _, _ = follow(hoist, replace(LOOP, limit={"reach": 80.0}), wanted, step=step)
        rng, rows = np.random.default_rng(seed), slice(None, None, every)
        table = {"time": start + t[rows]}
        for j, joint in enumerate(joints):
            count = len(t[rows])
            table[f"q_{joint}"] = q[rows, j] + 5e-5 * rng.standard_normal(count)
            table[f"qref_{joint}"] = wanted[rows, j]
        write_table(folder / f"{name}.csv", table)
    (folder / "job.toml").write_text(LOOP_JOB)
    runs, out = Runs(folder), folder / "out"
    runs.run("doctor", "doctor", folder / "job.toml", "--verbose")
    runs.run("identify", "identify", folder / "job.toml", "--out", out, "--verbose")
    found = runs.keep("result.json", "out/result.json")
    runs.keep("report.html", "out/report.html")
    runs.run("validate", "validate", out, folder / "three.csv")
    for form, file, *more in (
        ("mjcf", "x.xml", "--step", "0.002"), ("isaac", "i.yaml", "--step", "0.004"),
        ("ranges", "r.yaml"),
    ):  # fmt: skip
        runs.run(f"export {form}", "export", out, "--format", form, "--out", folder / file, *more)
        runs.keep(f"exported {form}", file)
    return runs, {"hoist": hoist, "result": found}


LOAD = (1.7, (0.03, -0.02, 0.12))  # kg, in the tool's frame


def payload(folder):
    """What hangs on the tool, from a log with it and one without; gains from its mass."""
    joints = ("lift", "reach", "roll")
    still = {"finger": 0.02, "swing": 0.4}
    (folder / "hoist.urdf").write_text(urdf())
    robots = {}
    for name, seed, load, rate in (
        ("bare", 61, (), 100),
        ("loaded", 62, LOAD, 90),
        ("more", 63, LOAD, 80),
    ):
        robots[name] = Hoist(joints, locked=still, gravity=(0.0, 0.0, -9.81), load=load)
        about = {"seconds": 8, "rate": rate, "start": seed, "speed": 1.5}
        record(folder / f"{name}.csv", robots[name], seed, **about)
        record(folder / f"{name}_i.csv", robots[name], seed, kind="current",
               scale={"current": lambda column: 1 / CURRENTS[column[8:]]}, **about)  # fmt: skip
    runs = Runs(folder)
    robot = ["--joints", ",".join(joints), "--lock", "finger=0.02", "--lock", "swing=0.4",
             "--cutoff", "9", "--friction", "viscous+coulomb"]  # fmt: skip
    base = ["payload", folder / "hoist.urdf"]
    torques = [
        *base,
        folder / "loaded.csv",
        folder / "more.csv",
        "--reference",
        folder / "bare.csv",
        *robot,
    ]
    runs.run("payload", *torques, "--link", "tool")
    found = runs.run("payload --json", *torques, "--link", "tool", "--json")
    runs.run("two links", *torques, "--link", "tool", "--link", "slide", "--mass", "tool=1.7")
    amperes = [*base, folder / "loaded_i.csv", "--reference", folder / "bare_i.csv", *robot]
    amperes += ["--link", "tool", "--mass", "1.7", "--gains", "--gain", "roll=4.5"]
    runs.run("gains", *amperes)
    gains = runs.run("gains --json", *amperes, "--json")
    return runs, {"robots": robots, "payload": found, "gains": gains}


DESIGN = """
seed = 3
rate = 125.0
[truth]
inertials = 0.15
values = { "lift.stribeck" = 1.5 }
[drives]
lift = [{ term = "Stribeck", speed = 0.2 }]
[controller]
kind = "pd"
kp = { lift = 2500.0 }
bandwidth = 25.0
[actuator]
limits = { reach = 120.0 }
[sensors]
torque_delay = 0.004
jitter = 1e-4
dropped = 0.05
noise = { tau = 0.02, q = 1e-5 }
step = { q = 2e-5, tau = 0.01 }
[payload]
link = "tool"
mass = 0.9
com = [0.02, 0.0, 0.05]
start = 2.0
"""


def design(folder):
    """Motions designed within limits, foreseen, simulated with a plant that has everything."""
    (folder / "hoist.urdf").write_text(urdf())
    (folder / "plant.toml").write_text(DESIGN)
    runs = Runs(folder)
    robot = ["--joints", "lift,reach,roll", "--lock", "finger=0.02", "--lock", "swing=0.4"]
    excite = ["excite", folder / "hoist.urdf", *robot, "--seed", "5", "--starts", "1"]
    noise = ["--noise", "lift=0.8", "--noise", "reach=1.1", "--noise", "roll=0.07"]
    limits = ["--share", "0.7", "--max-acceleration", "lift=3", "--max-jerk", "roll=90",
              "--max-power", "reach=12", "--floor", "-0.4", "--clearance", "0.03",
              "--box", "post=-0.9,-0.5,0.2,-0.6,0.5,1.2"]  # fmt: skip
    around = ["--share", "0.6", "--clearance", "0.01", "--box", "post=-0.9,-0.5,0.2,-0.6,0.5,1.2"]
    found = {}
    # the first motion of the search is taken: where it ends is a matter of rounding
    first = ["--seconds", "0.001"]
    loaded = ["--link", "tool", "--mass", "1.5", "--com", "0.02,0,0.1", "--moving", "lift,roll"]
    for name, kind, *words in (
        ("fourier", "fourier", "--duration", "5", "--harmonics", "3", "--points", "50",
         "--criterion", "E", *limits, *first, "--report", folder / "fourier.html"),
        ("bspline", "bspline", "--duration", "4", "--harmonics", "2", "--points", "40",
         "--criterion", "A", *limits, *first),
        ("sweeps", "sweeps", "--points", "20", *around),
        ("stands", "stands", "--points", "20", *around),
        ("payload", "payload", "--duration", "5", "--harmonics", "2", *loaded, *limits, *first),
    ):  # fmt: skip
        file = folder / f"{name}.csv"
        line = [*excite, *noise, "--kind", kind, "--out", file, *words, "--json"]
        found[name] = runs.run(f"excite {name}", *line)
        runs.keep(f"{name}.csv", f"{name}.csv")
    searched = ["--duration", "4", "--harmonics", "2", "--points", "50", *limits, *noise, "--json"]
    found["searched"] = runs.run("searched", *excite, "--out", folder / "searched.csv", *searched)
    del runs.documents["searched"]
    runs.keep("fourier.html", "fourier.html")
    runs.run("excite again", *excite, "--kind", "sweeps", "--out", folder / "motion.yaml",
             "--share", "0.5", "--clearance", "none")  # fmt: skip
    t, joints = np.arange(301) / 50, ("lift", "reach", "roll")
    motion_file, table = folder / "motion.csv", {"time": t}
    for key, values in zip(("q", "dq", "ddq"), motion(joints, 91, t), strict=True):
        table |= {f"{key}_{joint}": values[:, j] for j, joint in enumerate(joints)}
    write_table(motion_file, table)
    ahead = ["preview", folder / "hoist.urdf", motion_file, *robot, *noise, "--correlation", "0.07",
             "--friction", "viscous+coulomb+load", "--cutoff", "6"]  # fmt: skip
    runs.run("preview", *ahead)
    found["preview"] = runs.run("preview --json", *ahead, "--json")
    log = folder / "log.csv"
    runs.run("simulate", "simulate", folder / "hoist.urdf", motion_file, "--plant",
             folder / "plant.toml", "--out", log, "--urdf", folder / "true.urdf", "--duration", "3",
             *robot)  # fmt: skip
    found["truth"] = runs.keep("truth.json", "log.truth.json")
    runs.keep("log.csv", "log.csv")
    runs.keep("true.urdf", "true.urdf")
    runs.run("simulate by flags", "simulate", folder / "hoist.urdf", motion_file, "--out",
             folder / "other.csv", *robot, "--rate", "80", "--duration", "2", "--seed", "2",
             "--perturb", "0.2", "--controller", "computed_torque", "--torque-noise", "0.03",
             "--limits", "1.5", "--payload", "0.4", "--json")  # fmt: skip
    runs.keep("other.csv", "other.csv")
    return runs, found


def faults(folder):
    """Logs with something wrong, and a URDF that cannot be: what the doctor says, and inspect."""
    hoist = Hoist(("lift", "reach", "roll"), locked={"finger": 0.02, "swing": 0.4},
                  gravity=(0.0, 0.0, -9.81))  # fmt: skip
    (folder / "hoist.urdf").write_text(urdf())
    runs = Runs(folder)
    table = {}
    t = np.arange(900) / 100
    for seed in (71, 72):
        q, v, a = motion(hoist.joints, seed, t)
        rng = np.random.default_rng(seed)
        tau = hoist.torque(q, v, a)
        tau += np.array([0.4, 0.6, 0.04]) * rng.standard_normal(q.shape)
        q = q + 2e-5 * rng.standard_normal(q.shape)
        v = v + 2e-3 * rng.standard_normal(q.shape)
        columns = {"time": t + 10 * (seed - 70)}
        for j, name in enumerate(hoist.joints):
            columns |= {f"q_{name}": q[:, j], f"dq_{name}": v[:, j], f"tau_{name}": tau[:, j]}
        table[seed] = columns
    robot = ["--joints", "lift,reach,roll", "--lock", "finger=0.02", "--lock", "swing=0.4"]
    for name, change in FAULTS.items():
        logs = []
        for seed, columns in table.items():
            spoilt = {key: x.copy() for key, x in columns.items()}
            change(spoilt)
            logs.append(folder / f"{name}_{seed}.csv")
            write_table(logs[-1], spoilt)
        stated = ["--torque-delay", "0.012"] if name == "late" else []
        words = [folder / "hoist.urdf", *logs, *robot, *stated, "--json"]
        runs.run(name, "doctor", *words, code=None)
    wrong = BODIES | {
        "boom": (4.0, (0.9, 0.01, 0.02), (0.02, 0.12, 0.19)),
        "hand": (90.0, (0.0, 0.0, 0.1), (0.6, 0.7, 0.3)),
    }
    (folder / "wrong.urdf").write_text(urdf(wrong))
    runs.run("inspect wrong", "inspect", folder / "wrong.urdf", "--verbose")
    runs.run("inspect", "inspect", folder / "hoist.urdf", "--base", "--json")
    runs.run("inspect floating", "inspect", folder / "hoist.urdf", "--free-flyer", "--base")
    return runs, {"hoist": hoist}


def _late(columns):
    for name in [key for key in columns if key.startswith("tau_")]:
        columns[name] = np.roll(columns[name], 4)
    columns["dq_reach"] = np.roll(columns["dq_reach"], 1)


def _swapped(columns):
    columns["tau_lift"], columns["tau_reach"] = columns["tau_reach"], columns["tau_lift"]


def _scaled(columns):
    columns["tau_lift"] *= 0.5
    columns["dq_roll"] *= 60 / (2 * np.pi)


def _spoilt(columns):
    columns["time"][400:] += 0.35
    columns["tau_lift"][200:206:2] += 400.0
    columns["tau_reach"] = np.clip(columns["tau_reach"], -14.0, 11.0)
    columns["tau_roll"] = np.round(columns["tau_roll"] / 0.4) * 0.4
    columns["q_reach"][600:660] = columns["q_reach"][600]
    columns["dq_lift"] = np.roll(columns["dq_lift"], 3)


def _turned(columns):
    columns["tau_roll"] *= -1
    columns["q_lift"] += 0.3


FAULTS = {
    "late": _late,
    "swapped": _swapped,
    "scaled": _scaled,
    "spoilt": _spoilt,
    "turned": _turned,
}


def tracked(folder):
    """A load picked up while a log is tracked; conversions, the schema, texts of the demo."""
    hoist = Hoist(("lift", "reach", "roll"), locked={"finger": 0.02, "swing": 0.4},
                  gravity=(0.0, 0.0, -9.81))  # fmt: skip
    (folder / "hoist.urdf").write_text(urdf())
    t = np.arange(2600) / 130
    q, v, a = motion(hoist.joints, 81, t)
    tau = np.where(
        (t >= 12.0)[:, None], replace(hoist, load=LOAD).torque(q, v, a), hoist.torque(q, v, a)
    )
    rng = np.random.default_rng(81)
    tau += np.array([0.5, 0.5, 0.05]) * rng.standard_normal(tau.shape)
    columns = {"time": t + 30.0}
    for j, name in enumerate(hoist.joints):
        columns |= {f"q_{name}": q[:, j], f"tau_{name}": tau[:, j]}
    write_table(folder / "log.csv", columns)
    runs = Runs(folder)
    robot = ["--joints", "lift,reach,roll", "--lock", "finger=0.02", "--lock", "swing=0.4"]
    out = folder / "out"
    words = [folder / "hoist.urdf", folder / "log.csv", *robot, "--cutoff", "12",
             "--min-velocity", "0.03", "--friction", "viscous+coulomb"]  # fmt: skip
    runs.run("track", "track", *words, "--out", out, "--verbose")
    found = runs.keep("track.json", "out/track.json")
    runs.run(
        "convert",
        "convert",
        folder / "log.csv",
        folder / "log.npz",
        "--joints",
        "roll,lift",
        "--json",
    )
    runs.run("convert back", "convert", folder / "log.npz", folder / "back.csv")
    runs.keep("back.csv", "back.csv")
    runs.run("replay", "replay", *words[:2], out, "--html", folder / "replay.html")
    runs.keep("replay.html", "replay.html")
    runs.run("schema", "schema")
    return runs, {"hoist": hoist, "track": found, "t": t, "q": q, "tau": tau}


SCENARIOS = {
    f.__name__: f
    for f in (
        arm, currents, motors, estimators, choice, static, commands, payload, design, faults,
        tracked,
    )
}  # fmt: skip
