"""The scenarios of tests/figures: small robots, rich settings, every command that states figures.

Each function takes an empty folder and returns the commands' documents beside what is known of the
robot that was simulated. Nothing that has a figure is at its default. In a command line @ is the
folder.
"""

from dataclasses import replace

import numpy as np

from helpers.corruptions import both, column, scaled, swap
from helpers.hoist import (
    DRIVES,
    NOISE,
    URDF,
    Drive,
    Hoist,
    Loop,
    follow,
    motion,
    record,
    write_table,
)
from helpers.stored import HERE, Runs

LEVEL = (0.0, 0.0, -9.81)
THREE = ("lift", "reach", "roll")
THREE_STILL = {"finger": 0.02, "swing": 0.4}
ROBOT = "--joints lift,reach,roll --lock finger=0.02 --lock swing=0.4"


def begun(folder, job=""):
    """Return the runs of a folder with the URDF, and a job of tests/figures/jobs."""
    (folder / "hoist.urdf").write_text(URDF)
    if job:
        (folder / "job.toml").write_text((HERE / "jobs" / f"{job}.toml").read_text())
    return Runs(folder)


def three(**more):
    """Return a hoist whose arm moves, on level ground."""
    return Hoist(THREE, locked=THREE_STILL, gravity=LEVEL, **more)


def columns_of(joints, q, **others):
    """Return the columns of a table by name, as q_lift."""
    return {
        f"{key}_{joint}": x[:, j]
        for j, joint in enumerate(joints)
        for key, x in {"q": q, **others}.items()
    }


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
    runs = begun(folder, "arm")
    logs = {
        name: record(
            folder / f"{name}.csv", hoist, seed, seconds=seconds, rate=rate, start=start,
            noise=noise, cut=(500, 560) * (seed == 1), scale={"time": 1e3, "q_": degrees},
        )
        for name, seed, seconds, rate, start, noise in (
            ("first", 1, 12, 100, 50, 1.0), ("second", 2, 8, 80, 7, 1.6),
            ("kept", 3, 7, 90, 3, 1.0), ("later", 4, 6, 110, 20, 2.0),
            ("faulty", 5, 5, 100, 11, 9.0),
        )
    }  # fmt: skip
    for path in folder.glob("*.csv"):
        path.write_text(path.read_text().replace("tau_swing", "M1", 1))
    head, rows = (folder / "faulty.csv").read_text().split("\n", 1)  # two torques exchanged:
    names = {"tau_lift": "tau_roll", "tau_roll": "tau_lift"}
    head = ",".join(names.get(name, name) for name in head.split(","))
    (folder / "faulty.csv").write_text(f"{head}\n{rows}")
    runs.run("doctor", "doctor @job.toml --verbose")
    runs.run("identify", "identify @job.toml --out @out --verbose")
    found = runs.keep("result.json", "out/result.json")
    runs.keep("report.html", "out/report.html")
    runs.keep("identified.urdf", "out/hoist.identified.urdf")
    runs.keep("sidecar", "out/hoist.identified.drive.json")
    runs.run("validate", "validate @out @later.csv")
    runs.run("validate --json", "validate @out @later.csv @faulty.csv --json", code=None)
    for form, file in zip(
        ("mjcf", "sdf", "urdf", "ranges"), ("x.xml", "x.sdf", "x.urdf", "r.yaml"), strict=True
    ):
        runs.run(f"export {form}", f"export @out --format {form} --out @{file}")
        runs.keep(f"exported {form}", file)
    runs.run("preview --given", "preview @job.toml --given @out --verbose")
    runs.run("achieved", "preview @job.toml --given @out --json")
    achieved = runs.documents["achieved"]
    for entry in achieved["base_parameters"]:
        del entry["expression"]  # as in the result
    runs.documents["achieved"] = {k: achieved[k] for k in ("achieved", "base_parameters", "noise")}
    runs.run("preview of another log", "preview @hoist.urdf @later.csv --given @out --verbose")
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


def amperes(name):
    return 1 / CURRENTS[name.removeprefix("current_")]


def currents(folder):
    """Flags in the place of a job: currents, measured velocities, a delay, weighted rows."""
    hoist = three(drives=DRIVES | {"roll": Drive(0.05, 0.35, 0.5, 0.11, ripple=0.25)})
    runs = begun(folder)
    logs = {
        name: record(
            folder / f"{name}.csv", hoist, seed, seconds=seconds, rate=rate, start=start,
            velocity=True, kind="current", scale={"current": amperes, "time": 1e6},
        )
        for name, seed, seconds, rate, start in (
            ("one", 11, 9, 160, 2.5), ("two", 12, 6, 90, 40.0), ("three", 13, 6, 100, 100.0),
        )
    }  # fmt: skip
    gains = " ".join(f"--gain {joint}={gain}" for joint, gain in CURRENTS.items())
    robot = (
        f"{ROBOT} --time-unit us --rate 75 --cutoff 7 --min-velocity 0.05 "
        f"--friction viscous+coulomb+asymmetric {gains}"
    )
    words = (
        f"@hoist.urdf @one.csv @two.csv --validate @three.csv {robot} --estimator wls --order 5 "
        "--trim 0.3 --friction-band 0.01 --max-gap 0.5 --torque-delay 0.004 "
        "--velocity-delay -0.003 --velocity measured --acceleration differentiated --ignore gravity"
    )
    runs.run("identify", f"identify {words} --out @out --verbose --no-report")
    found = runs.keep("result.json", "out/result.json", brief)
    runs.run("doctor --json", f"doctor {words} --json")
    runs.run("validate", "validate @out @three.csv")
    runs.run("track", f"track @hoist.urdf @three.csv {robot} --out @track")
    runs.keep("track.json", "track/track.json")
    return runs, {"hoist": hoist, "logs": logs, "result": found}


MATRIX, EFFICIENCY, ZEROS = np.array([[81.0, 0.0], [-40.0, 60.0]]), (0.85, 0.75), (0.1, -0.2)
MOTOR_GAINS = (0.11, 0.13)  # [N m/A]


def motors(folder):
    """Logs of coupled motors, in turns and amperes, by ordinary least squares."""
    joints = ("swing", "lift")
    drives = (Drive(1.6, 4.0, 3.0), Drive(1.2, 3.2, 2.2))  # at the motors' speeds over 81 and 60
    hoist = Hoist(joints, drives=dict.fromkeys(joints, Drive()), gravity=LEVEL,
                  locked={"finger": 0.01, "reach": 0.1, "roll": 0.3})  # fmt: skip
    runs = begun(folder, "motors")
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
        motor_currents = np.linalg.solve(MATRIX.T, tau.T).T / EFFICIENCY / MOTOR_GAINS
        table = {"time": start + t}
        for k, motor in enumerate(("m1", "m2")):
            table |= {f"qm_{motor}": turned[:, k], f"currentm_{motor}": motor_currents[:, k]}
        write_table(folder / f"{name}.csv", table)
    runs.run("identify", "identify @job.toml --out @out")
    found = runs.keep("result.json", "out/result.json", brief)
    return runs, {"hoist": hoist, "drives": drives, "result": found}


PAIR = """
urdf = "hoist.urdf"
joints = ["lift", "reach"]
locked = {{ swing = -0.2, roll = 0.5, finger = 0.01 }}
signals = {{ cutoff = 8.5 }}
model = {{ friction = "{friction}" }}
output = {{ report = false }}
identification = [{{ log = "one.csv" }}, {{ log = "two.csv" }}]
validation = [{{ log = "three.csv" }}]
{more}
"""
PAIR_STILL = {"finger": 0.01, "swing": -0.2, "roll": 0.5}


def pair(folder, drives=DRIVES, seconds=(8, 5, 5)):
    """Write three logs of two joints, and return the runs and the robot."""
    hoist = Hoist(("lift", "reach"), drives=drives, locked=PAIR_STILL, gravity=LEVEL)
    logs = (("one", 100, 4.0), ("two", 80, 0.5), ("three", 90, 60.0))
    for k, (name, rate, start) in enumerate(logs):
        record(folder / f"{name}.csv", hoist, 31 + k, seconds=seconds[k], rate=rate, start=start,
               noise=1.0 + 0.5 * k, speed=1.4)  # fmt: skip
    return begun(folder), hoist


ESTIMATORS = {
    "ols": 'name = "ols"',
    "huber": 'name = "wls"\nrobust = "huber"',
    "tls": 'name = "tls"\nregressor_noise = 0.02',
    "tukey": 'name = "consistent"\nrobust = "tukey"\nprior_weight = "evidence"',
    "rls": 'name = "rls"\nforgetting = 0.9995\nprior_weight = 0.5\nphysical = true',
    "kalman": 'name = "kalman"\nwalk = 1e-4\ngate = 0.999\nprior_weight = 2.0',
    "prx": 'name = "prx"\nprior_weight = 0.5',
    "gradient": 'name = "gradient"\nprior_weight = 0.5',
}
OF_ESTIMATORS = ("base_parameters", "drive_parameters", "consistency", "uncertainty",
                 "identification", "validation", "verdict")  # fmt: skip


def estimators(folder):
    """Every estimator with settings of its own on one pair of logs, and their comparison."""
    (runs, hoist), found = pair(folder), {}
    for name, settings in ESTIMATORS.items():
        more = f"[estimator]\n{settings}"
        job = PAIR.format(friction="viscous+coulomb", more=more)
        (folder / f"{name}.toml").write_text(job)
        runs.run(name, f"identify @{name}.toml --out @{name}")
        del runs.documents[name]  # the texts are those of other scenarios
        found[name] = runs.keep(
            name, f"{name}/result.json", lambda x: {key: brief(x)[key] for key in OF_ESTIMATORS}
        )
    chosen = "@huber/result.json @tukey/result.json @kalman/result.json"
    runs.run("compare", f"compare {chosen} --out @compared.html")
    runs.run("compare --json", f"compare {chosen} --json")
    runs.keep("compared.html", "compared.html")
    return runs, {"hoist": hoist, "results": found}


OF_CHOICE = ("friction", "warnings", "drive_parameters", "drive_moments", "uncertainty", "inputs",
             "identification", "validation")  # fmt: skip
CHOICE_DRIVES = DRIVES | {
    "lift": Drive(0.9, 2.2, 2.1, -0.8, load=0.12),
    "reach": Drive(2.4, 14.0, 6.0, 1.5, spring=35.0),
}


def choice(folder):
    """Friction that the logs ask for, and what a model that lacks it leaves: findings."""
    runs, hoist = pair(folder, CHOICE_DRIVES, (16, 12, 8))
    found, fit = {}, '[estimator]\nname = "wls"\n'
    stated = 'drives = { reach = ["spring", "cubic"] }\n'
    for name, friction, more in (
        ("chosen", "auto", fit),
        ("stated", "viscous+coulomb", fit),
        ("pieces", "viscous+coulomb+load", fit + "[reduction]\nrows_in_memory = 500\nworkers = 1"),
    ):
        job = PAIR.format(friction=friction, more=more)
        (folder / f"{name}.toml").write_text(stated + job if name == "pieces" else job)
        runs.run(name, f"identify @{name}.toml --out @{name} --verbose")
        found[name] = runs.keep(
            f"{name}.json", f"{name}/result.json",
            lambda x: {key: brief(x).get(key) for key in OF_CHOICE},
        )  # fmt: skip
    return runs, {"hoist": hoist, "results": found}


def static(folder):
    """Gravity alone, from slow sweeps."""
    hoist, runs = three(), begun(folder, "static")
    logs = (("slow", 41, 60, 9.0), ("other", 42, 40, 1.0), ("kept", 43, 30, 0.0))
    for name, seed, seconds, start in logs:
        about = {"seconds": seconds, "rate": 20, "start": start, "speed": 0.12}
        record(folder / f"{name}.csv", hoist, seed, **about)
    runs.run("identify", "identify @job.toml --out @out")
    found = runs.keep("result.json", "out/result.json", brief)
    return runs, {"hoist": hoist, "result": found}


LOOP = Loop({"lift": 900.0, "reach": 2500.0}, {"lift": 60.0, "reach": 130.0}, delay=0.012)
LOOP_DRIVES = {"lift": Drive(1.3, 3.0, 2.5, 0.7), "reach": Drive(3.0, 16.0, 5.0, -1.0)}
LOOP_STEP = 5e-4  # [s] semi-implicit: torques act half of it early


def commands(folder):
    """A robot that follows commands: loops fitted, judged, shown and exported; then by torque."""
    joints, step = ("lift", "reach"), LOOP_STEP
    hoist = Hoist(joints, bodies={}, drives=LOOP_DRIVES, locked=PAIR_STILL, gravity=LEVEL)
    runs = begun(folder, "commands")
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
        seen = q[rows] + 5e-5 * rng.standard_normal((2, len(told))).T
        table = {"time": start + told} | columns_of(joints, seen, qref=wanted[rows])
        write_table(folder / f"{name}.csv", table)
    runs.run("doctor", "doctor @job.toml --verbose")
    runs.run("identify", "identify @job.toml --out @out --verbose")
    found = runs.keep("result.json", "out/result.json")
    runs.keep("report.html", "out/report.html")
    runs.run("validate", "validate @out @three.csv")
    for form, file, more in (
        ("mjcf", "x.xml", "--step 0.002"), ("isaac", "i.yaml", "--step 0.004"),
        ("ranges", "r.yaml", ""),
    ):  # fmt: skip
        runs.run(f"export {form}", f"export @out --format {form} --out @{file} {more}")
        runs.keep(f"exported {form}", file)
    return runs, {"hoist": hoist, "result": found}


LOAD = (1.7, (0.03, -0.02, 0.12))  # kg, in the tool's frame


def payload(folder):
    """What hangs on the tool, from a log with it and one without; gains from its mass."""
    runs, robots = begun(folder), {}
    logs = (("bare", 61, (), 100), ("loaded", 62, LOAD, 90), ("more", 63, LOAD, 80))
    for name, seed, load, rate in logs:
        robots[name] = three(load=load)
        about = {"seconds": 8, "rate": rate, "start": seed, "speed": 1.5}
        record(folder / f"{name}.csv", robots[name], seed, **about)
        about |= {"kind": "current", "scale": {"current": amperes}}
        record(folder / f"{name}_i.csv", robots[name], seed, **about)
    robot = f"{ROBOT} --cutoff 9 --friction viscous+coulomb"
    base = "payload @hoist.urdf"
    torques = f"{base} @loaded.csv @more.csv --reference @bare.csv {robot}"
    runs.run("payload", f"{torques} --link tool")
    found = runs.run("payload --json", f"{torques} --link tool --json")
    runs.run("two links", f"{torques} --link tool --link slide --mass tool=1.7")
    by_gain = f"{base} @loaded_i.csv --reference @bare_i.csv {robot} --link tool --mass 1.7"
    by_gain += " --gains --gain roll=4.5"
    runs.run("gains", by_gain)
    gains = runs.run("gains --json", f"{by_gain} --json")
    return runs, {"robots": robots, "payload": found, "gains": gains}


def design(folder):
    """Motions designed within limits, foreseen, simulated with a plant that has everything."""
    runs, found = begun(folder), {}
    (folder / "plant.toml").write_text((HERE / "jobs" / "plant.toml").read_text())
    excite = f"excite @hoist.urdf {ROBOT} --seed 5 --starts 1"
    noise = "--noise lift=0.8 --noise reach=1.1 --noise roll=0.07"
    box = "--box post=-0.9,-0.5,0.2,-0.6,0.5,1.2"
    limits = (
        "--share 0.7 --max-acceleration lift=3 --max-jerk roll=90 --max-power reach=12 "
        f"--floor -0.4 --clearance 0.03 {box}"
    )
    around = f"--points 20 --share 0.6 --clearance 0.01 {box}"
    # the first motion of the search is taken: where it ends is a matter of rounding
    first = f"{limits} --seconds 0.001"
    for kind, words in (
        ("fourier", "--duration 5 --harmonics 3 --points 50 --criterion E "
         f"{first} --report @fourier.html"),
        ("sweeps", around),
        ("stands", around),
    ):  # fmt: skip
        line = f"{excite} {noise} --kind {kind} --out @{kind}.csv {words} --json"
        found[kind] = runs.run(f"excite {kind}", line)
        runs.keep(f"{kind}.csv", f"{kind}.csv")
    searched = f"--duration 4 --harmonics 2 --points 50 {limits} {noise} --json"
    found["searched"] = runs.run("searched", f"{excite} --out @searched.csv {searched}")
    del runs.documents["searched"]
    runs.keep("fourier.html", "fourier.html")
    again = "--kind sweeps --out @motion.yaml --share 0.5 --clearance none"
    runs.run("excite again", f"{excite} {again}")
    t = np.arange(301) / 50
    table = columns_of(THREE, **dict(zip(("q", "dq", "ddq"), motion(THREE, 91, t), strict=True)))
    write_table(folder / "motion.csv", {"time": t} | table)
    ahead = f"preview @hoist.urdf @motion.csv {ROBOT} {noise} --correlation 0.07"
    ahead += " --friction viscous+coulomb+load --cutoff 6"
    runs.run("preview", ahead)
    found["preview"] = runs.run("preview --json", f"{ahead} --json")
    simulate = f"simulate @hoist.urdf @motion.csv {ROBOT}"
    runs.run("simulate", f"{simulate} --plant @plant.toml --out @log.csv --urdf @true.urdf "
             "--duration 3")  # fmt: skip
    found["truth"] = runs.keep("truth.json", "log.truth.json")
    runs.keep("log.csv", "log.csv")
    runs.keep("true.urdf", "true.urdf")
    runs.run("simulate by flags", f"{simulate} --out @other.csv --rate 80 --duration 2 --seed 2 "
             "--perturb 0.2 --controller computed_torque --torque-noise 0.03 --limits 1.5 "
             "--payload 0.4 --json")  # fmt: skip
    runs.keep("other.csv", "other.csv")
    return runs, found


def faults(folder):
    """Logs with something wrong, and a URDF that cannot be: what the doctor says, and inspect."""
    hoist, runs, table, t = three(), begun(folder), {}, np.arange(900) / 100
    for seed in (71, 72):
        q, v, a = motion(hoist.joints, seed, t)
        rng = np.random.default_rng(seed)
        tau = hoist.torque(q, v, a)
        tau += np.array([0.4, 0.6, 0.04]) * rng.standard_normal(q.shape)
        q = q + 2e-5 * rng.standard_normal(q.shape)
        v = v + 2e-3 * rng.standard_normal(q.shape)
        table[seed] = {"time": t + 10 * (seed - 70)} | columns_of(THREE, q, dq=v, tau=tau)
    for name, change in FAULTS.items():
        for seed, columns in table.items():
            write_table(folder / f"{name}_{seed}.csv", change(columns))
        stated = "--torque-delay 0.012" if name == "late" else ""
        line = f"doctor @hoist.urdf @{name}_71.csv @{name}_72.csv {ROBOT} {stated} --json"
        runs.run(name, line, code=None)
    wrong = URDF
    for old, new in (
        ('"0.22 0.01 0.02"', '"0.9 0.01 0.02"'), ('izz="0.13"', 'izz="0.19"'),
        ('"0.03 0.02 0.09"', '"0 0 0.1"'), ('mass value="1.2"', 'mass value="90"'),
        ('ixx="0.006"', 'ixx="0.6"'), ('iyy="0.007"', 'iyy="0.7"'), ('izz="0.003"', 'izz="0.3"'),
    ):  # fmt: skip
        wrong = wrong.replace(old, new)
    (folder / "wrong.urdf").write_text(wrong)
    runs.run("inspect wrong", "inspect @wrong.urdf --verbose")
    runs.run("inspect", "inspect @hoist.urdf --base --json")
    runs.run("inspect floating", "inspect @hoist.urdf --free-flyer --base")
    return runs, {"hoist": hoist}


_CHANGES = {
    "time": lambda x: np.where(np.arange(len(x)) < 400, x, x + 0.35),
    "tau_lift": lambda x: x + 400.0 * np.isin(np.arange(len(x)), (200, 202, 204)),
    "tau_reach": lambda x: np.clip(x, -14.0, 11.0),
    "tau_roll": lambda x: np.round(x / 0.4) * 0.4,
    "q_reach": lambda x: np.where(np.arange(len(x)) // 60 == 10, x[600], x),
    "dq_lift": lambda x: np.roll(x, 3),
}
#: By name: what is done with the columns of a log.
FAULTS = {
    "late": both(
        column("tau_", lambda x, _t: np.roll(x, 4)), column("dq_reach", lambda x, _t: np.roll(x, 1))
    ),
    "swapped": swap(("tau_lift", "tau_reach")),
    "scaled": both(scaled("tau_lift", 0.5), scaled("dq_roll", 60 / (2 * np.pi))),
    "spoilt": lambda table: table | {key: change(table[key]) for key, change in _CHANGES.items()},
    "turned": both(scaled("tau_roll", -1), column("q_lift", lambda x, _t: x + 0.3)),
}  # fmt: skip


def tracked(folder):
    """A load picked up while a log is tracked; conversions, the schema, texts of the demo."""
    hoist, runs, t = three(), begun(folder), np.arange(2600) / 130
    q, v, a = motion(hoist.joints, 81, t)
    loaded = three(load=LOAD).torque(q, v, a)
    tau = np.where((t >= 12.0)[:, None], loaded, hoist.torque(q, v, a))
    rng = np.random.default_rng(81)
    tau += np.array([0.5, 0.5, 0.05]) * rng.standard_normal(tau.shape)
    write_table(folder / "log.csv", {"time": t + 30.0} | columns_of(THREE, q, tau=tau))
    words = "--cutoff 12 --min-velocity 0.03 --friction viscous+coulomb --out @out --verbose"
    runs.run("track", f"track @hoist.urdf @log.csv {ROBOT} {words}")
    found = runs.keep("track.json", "out/track.json")
    runs.run("convert", "convert @log.csv @log.npz --joints roll,lift --json")
    runs.run("convert back", "convert @log.npz @back.csv")
    runs.keep("back.csv", "back.csv")
    runs.run("replay", "replay @hoist.urdf @log.csv @out --html @replay.html")
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
