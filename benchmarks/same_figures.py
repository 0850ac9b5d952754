"""Do two trees of robotid give the same figures?

Runs every command and estimator with each: the job files of tests/jobs, logs simulated with a small
arm, some with faults, and the recordings found by ROBOTID_DATA. Compares every number of every file
written, and of what is printed: of JSON (that of the charts of pages included) and Parquet by its
place, of other text (CSV, XML, YAML, pages) by its order; no times, dates, versions and digests.

    python benchmarks/same_figures.py BEFORE [AFTER] [--jobs 2] [--only RUN ...] [--tolerance 1e-12]
    python benchmarks/same_figures.py BEFORE --keep FOLDER

BEFORE and AFTER are folders of two checkouts, or kept ones; AFTER: this one. --keep runs BEFORE and
keeps what it writes. Exits with 1 if a figure differs by more than the tolerance of its size, is
gone or new, or if a run ends otherwise.
"""

import argparse
import base64
import json
import math
import os
import re
import subprocess
import sys
import tempfile
import time
import tomllib
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import distribution
from itertools import product
from pathlib import Path

import numpy as np
from pyarrow import parquet

HERE = Path(__file__).parents[1]
FORMATS = ("urdf", "mjcf", "sdf", "isaac", "ranges")
TEXTS = (".csv", ".xml", ".html", ".txt", ".svg", *(f".{form}" for form in FORMATS))
READ = (".json", ".parquet", *TEXTS)
NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
DATA = re.compile(r'<script type="application/json"[^>]*>(.*?)</script>', re.DOTALL)
CODE = re.compile(r"<script.*?</script>|<style.*?</style>", re.DOTALL)
SPENT = re.compile(
    r"\d+(?:\.\d+)? (?:s|min|MB|MiB)\b|\d{4}-\d\d-\d\d[T ]\d\d:\d\d(?::\d\d)?|\b[0-9a-f]{32,}\b"
)
ESTIMATORS = ("consistent", "ols", "wls", "tls", "rls", "kalman", "prx", "gradient")
FAULTS = ("sign", "scale", "delay", "swap")
BOX = '<collision><geometry><box size="0.2 0.1 0.1"/></geometry></collision>'


def prepare(tree, data):
    """Write the inputs of the first stage into the working folder."""
    planar = (tree / "urdf/planar_2r.urdf").read_text().replace('xyz="0 0 1"', 'xyz="0 1 0"')
    planar = planar.replace("</inertial>", f"</inertial>{BOX}")
    Path("arm.urdf").write_text(planar.replace('"500.0"', '"2000.0"'))
    rows = ["time,q_joint_1,q_joint_2"]
    for t in (i / 1000 for i in range(8001)):
        one, two = math.sin(1.3 * t) + math.sin(4.1 * t), math.sin(1.9 * t) + math.sin(5.3 * t)
        rows.append(f"{t},{0.5 * one},{0.5 * two}")
    Path("motion.csv").write_text("\n".join(rows) + "\n")
    for job in (tree / "tests/jobs").rglob("*.toml"):
        Path(job.name).write_text(job.read_text())
    for name, estimator in product(("panda_inria", "ur10e"), ESTIMATORS[1:]):
        text = Path(f"{name}.toml").read_text() + f'[estimator]\nname = "{estimator}"\n'
        Path(f"{name}-{estimator}.toml").write_text(text)
    log, files = data / "commands/go2/chirp.parquet", distribution("example-robot-data").files
    urdf = next(file.locate() for file in files if file.name == "go2.urdf")
    Path("go2.toml").write_text(
        f'urdf = "{urdf}"\n[estimator]\nname = "simulation"\n[controller]\nkp = 20.0\nkd = 1.5\n'
        f'[[identification]]\nlog = "{log}"\nend = 14.0\n'
        f'[[validation]]\nlog = "{log}"\nstart = 14.1\n'
    )


def spoil():
    """Write logs with faults, and one with commands, from the simulated log."""
    if not (file := Path("simulate/log.csv")).is_file():  # not among the wanted runs
        return
    names = file.read_text().partition("\n")[0].split(",")
    log, motion = (np.loadtxt(f, delimiter=",", skiprows=1) for f in (file, "motion.csv"))
    one, two = names.index("tau_joint_1"), names.index("tau_joint_2")
    logs = {fault: log.copy() for fault in FAULTS}
    logs["sign"][:, two] *= -1.0
    logs["scale"][:, one] *= 1.6
    logs["delay"][20:, two] = log[:-20, two]
    logs["swap"][:, [one, two]] = log[:, [two, one]]
    logs["told"] = np.column_stack([log, motion[: len(log), 1:]])
    for fault, rows in logs.items():
        head = ",".join([*names, "qref_joint_1", "qref_joint_2"][: rows.shape[1]])
        np.savetxt(f"{fault}.csv", rows, delimiter=",", header=head, comments="")
    job = 'urdf = "arm.urdf"\n[estimator]\nname = "simulation"\n'
    Path("told.toml").write_text(job + '[[identification]]\nlog = "told.csv"\n')
    Path("units.csv").write_text("unit,log\na,simulate/log.csv\nb,scale.csv\n")


def stages(data):
    """Return what is run: by stage, each name of a run and its words; OUT is its folder."""
    panda, ur10e = data / "panda", data / "ur10e"
    urdf, log, result = "arm.urdf", "simulate/log.csv", "small-consistent"
    free, loaded = (ur10e / f"ident_20200219_14harm{end}.parquet" for end in ("", "_load"))
    gains = tomllib.loads(Path("ur10e.toml").read_text())["torque"]["gains"]
    stated = [word for joint, gain in gains.items() for word in ("--gain", f"{joint}={gain}")]
    robot, noise = ur10e / "robot.urdf", ("--torque-noise", "0.02")
    first = {
        "simulate": ["simulate", urdf, "motion.csv", "--out", "OUT/log.csv", *noise],
        "excite": ["excite", urdf, "--out", "OUT/m.csv", "--duration", "5"],
        "sweeps": ["excite", urdf, "--out", "OUT/m.csv", "--kind", "sweeps"],
        "go2": ["identify", "go2.toml", "--out", "OUT"],
        "demo": ["demo", "--out", "OUT"],
        "paper": ["paper", "--quick", "--out", "OUT"],
        "track": ["track", panda / "robot.urdf", panda / "panda_inria.parquet", "--out", "OUT"],
        "inspect": ["inspect", panda / "robot.urdf", "--base", "--json"],
        "preview": ["preview", urdf, "motion.csv", "--json"],
        "convert": ["convert", data / "kinova_gen3/gen3_1.parquet", "OUT/log.csv"],
        "schema": ["schema"],
        "payload": ["payload", robot, loaded, "--reference", free, "--json", *stated],
        "doctor": ["doctor", robot, free, "--json", *stated],
    }
    for job in sorted(Path().glob("*.toml")):
        first.setdefault(job.stem, ["identify", job.name, "--out", "OUT"])
    second = {
        "small-simulation": ["identify", "told.toml", "--out", "OUT"],
        "fleet": ["fleet", "units.csv", "--urdf", urdf, "--workers", "1", "--out", "OUT"],
        "convert-small": ["convert", log, "OUT/log.parquet"],
        "validate": ["validate", "ur10e", ur10e / "val_ptp10.parquet", "--json"],
    }
    for name in ESTIMATORS:
        second[f"small-{name}"] = ["identify", urdf, log, "--estimator", name, "--out", "OUT"]
    for fault in FAULTS:
        second[f"doctor-{fault}"] = ["doctor", urdf, f"{fault}.csv", "--json"]
        second[f"small-{fault}"] = ["identify", urdf, f"{fault}.csv", "--out", "OUT"]
    third = {
        "compare": ["compare", "small-consistent", "small-wls", "--out", "OUT/page.html", "--json"],
        "replay": ["replay", urdf, log, result, "--html", "OUT/page.html"],
        "preview-given": ["preview", urdf, "motion.csv", "--given", result, "--json"],
        "payload-small": ["payload", urdf, "scale.csv", "--reference", result, "--json"],
    }
    for form, name in product(FORMATS, ("ur10e", "go2", result)):
        words = ["export", name, "--format", form, "--out", f"OUT/x.{form}"]
        third[f"export-{form}-{name}"] = words
    return first, second, third


def run(tree, folder, only, jobs):
    """Write into a folder what a tree writes, one folder per run."""
    env = {**os.environ, "PYTHONPATH": str(tree), "OPENBLAS_NUM_THREADS": "1", "COLUMNS": "100"}
    data, begun = Path(os.environ["ROBOTID_DATA"]), time.monotonic()
    folder.mkdir(parents=True)
    os.chdir(folder)
    prepare(tree, data)

    def one(name, words):
        own = folder / name
        own.mkdir()
        line = [sys.executable, "-m", "robotid", *(str(w).replace("OUT", name) for w in words)]
        done = subprocess.run(line, env=env, capture_output=True, text=True)
        is_json = "--json" in words or name == "schema"
        (own / ("printed.json" if is_json else "printed.txt")).write_text(done.stdout)
        (own / "exit.json").write_text(json.dumps({"code": done.returncode}))
        if done.returncode not in (0, 1):  # 1: of a result that is not usable
            print(f"{tree}: {name} fails: {done.stderr[-600:]}")

    for stage in stages(data):
        with ThreadPoolExecutor(jobs) as pool:
            wanted = [name for name in stage if only.fullmatch(name)]
            list(pool.map(one, wanted, map(stage.get, wanted)))
        spoil()
    for file in (f for f in folder.glob("*/**/*") if f.suffix in (".json", *TEXTS)):
        file.write_text(file.read_text().replace(str(folder), "").replace(str(tree), ""))
    print(f"{tree}: {time.monotonic() - begun:.0f} s")


def figures(value, at=""):
    """Yield (place, value) of the numbers of a JSON value, also in its texts, and of its names."""
    if isinstance(value, dict) and {"data", "bits", "low", "high"} <= value.keys():
        codes = np.frombuffer(base64.b64decode(value["data"]), f"<u{value['bits'] // 8}")
        steps = (value["high"] - value["low"]) / (2 ** value["bits"] - 2)
        value = {**value, "data": (value["low"] + codes * steps).tolist()}
    if isinstance(value, dict | list):
        for key, inner in value.items() if isinstance(value, dict) else enumerate(value):
            yield from figures(inner, f"{at}/{key}")
    elif isinstance(value, str) and not at.endswith("version"):
        numbers = enumerate(NUMBER.findall(SPENT.sub("", value)))
        yield from ((f"{at}#{i}", float(x)) for i, x in numbers)
        if value.isidentifier():
            yield at, value
    elif isinstance(value, int | float):
        yield at, value


def read(file):
    """Return the numbers of a file by place."""
    if file.suffix == ".parquet":
        return dict(figures(parquet.read_table(file).to_pydict()))
    text = file.read_text()
    if file.suffix == ".json" and text:
        return dict(figures(json.loads(text)))
    found = dict(figures([json.loads(inner) for inner in DATA.findall(text)]))
    return found | dict(figures(CODE.sub("", text)))


def difference(x, y):
    if x == y or (x != x and y != y):
        return 0.0
    gap = math.nan if str in (type(x), type(y)) else abs(x - y) / max(abs(x), abs(y))
    return gap if gap == gap else math.inf


def compare(folders, only, tolerance, most):
    """Print the differences of two folders; return 1 if there are any, else 0."""
    largest, gone, same = 0.0, 0, 0
    files = {f.relative_to(folder) for folder in folders for f in folder.glob("*/**/*")}
    for file in sorted(f for f in files if f.suffix in READ and only.fullmatch(f.parts[0])):
        if missing := [str(folder) for folder in folders if not (folder / file).is_file()]:
            print(f"{file}: not in", *missing)
            gone += 1
            continue
        old, new = (read(folder / file) for folder in folders)
        changes = {k: difference(old[k], new[k]) for k in old.keys() & new.keys()}
        worst = max(changes.values(), default=0.0)
        odd, added = sorted(old.keys() - new.keys()), len(new.keys() - old.keys())
        other = sorted((k for k in changes if changes[k] > tolerance), key=changes.get)
        largest, gone, same = max(largest, worst), gone + len(odd) + added, same + len(changes)
        if other or odd or added:
            print(
                f"{file}: {len(new)} figures, {added} of them new, "
                f"largest relative difference {worst:.1g}; missing: {len(odd)}",
                *odd[:most],
                *(f"\n  {k}: {old[k]} -> {new[k]}" for k in other[::-1][:most]),
            )
    print(f"{same} figures; largest relative difference {largest:.1g}; missing or new: {gone}")
    return int(largest > tolerance or gone > 0)


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("before", type=Path)
    parser.add_argument("after", type=Path, nargs="?", default=HERE)
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="only keep what BEFORE writes")
    parser.add_argument("--jobs", type=int, default=1, help="runs at a time")
    parser.add_argument("--only", nargs="+", default=[".*"], help="runs, and those they read")
    parser.add_argument("--tolerance", type=float, default=1e-12, help="relative")
    parser.add_argument("--most", type=int, default=9, help="listed differences per file")
    options = parser.parse_args()
    only = re.compile("|".join(options.only))
    trees = [tree.resolve() for tree in (options.before, options.after)]
    if options.keep:
        return run(trees[0], options.keep.resolve(), only, options.jobs)
    with tempfile.TemporaryDirectory() as made:
        folders = []
        for name, tree in zip(("before", "after"), trees, strict=True):
            folders.append(tree)  # a kept one, unless it has the package
            if (tree / "robotid").is_dir():
                folders[-1] = Path(made).resolve() / name
                run(tree, folders[-1], only, options.jobs)
        return compare(folders, only, options.tolerance, options.most)


if __name__ == "__main__":
    sys.exit(main())
