"""Do two trees of robotid give the same figures?

Runs the job files of tests/jobs, the demo, ``paper --quick``, a ``track``, a fit of commands, and
the commands that design, foresee, simulate, weigh and export, with each of two trees, one after the
other in one environment. Compares every number of every file written, and of what is printed:
of JSON by its place, of other text (CSV, XML, YAML, pages with their charts) by its order.
The recordings are found by ROBOTID_DATA.

    python benchmarks/same_figures.py BEFORE [AFTER] [--only RUN ...] [--tolerance 1e-12] [--most 9]

BEFORE and AFTER are folders of two checkouts; AFTER: this one. Exits with 1 if a figure differs by
more than the tolerance of its size, or is gone, or a text has another number of figures.
"""

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

from robotid.robot.examples import example_urdf

HERE = Path(__file__).parents[1]
TEXTS = (".csv", ".xml", ".urdf", ".sdf", ".py", ".yaml", ".toml", ".script", ".html", ".txt")
NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
CODE = re.compile(r"<script>.*?</script>|<style.*?</style>", re.DOTALL)  # of a page, not its data
SPENT = re.compile(r"\d+(?:\.\d+)? (?:s|min|MB|MiB)\b|\d{4}-\d\d-\d\d[T ]\d\d:\d\d(?::\d\d)?")


def commands(tree, data):
    """Yield the name of each run and its words, OUT being its folder; later ones read earlier."""
    for job in sorted((tree / "tests/jobs").glob("*.toml")):
        yield job.stem, ["identify", job, "--out", "OUT"]
    panda, ur10e, go2 = data / "panda", data / "ur10e", data / "commands/go2/chirp.parquet"
    urdf, robot = tree / "urdf/planar_2r.urdf", ur10e / "robot.urdf"
    yield "demo", ["demo", "--out", "OUT"]
    yield "paper", ["paper", "--quick", "--out", "OUT"]
    yield "track", ["track", panda / "robot.urdf", panda / "panda_inria.parquet", "--out", "OUT"]
    yield "inspect", ["inspect", panda / "robot.urdf", "--json"]
    short = ["--duration", "5", "--seconds", "5", "--starts", "1", "--clearance", "none"]
    yield "excite", ["excite", urdf, "--out", "OUT/m.csv", *short]
    yield "simulate", ["simulate", urdf, "OUT/../excite/m.csv", "--out", "OUT/log.csv"]
    yield "preview", ["preview", urdf, "OUT/../excite/m.csv", "--json"]
    arm = ["identify", urdf, "OUT/../simulate/log.csv", "--out", "OUT"]
    yield "small", arm
    yield "small wls", [*arm, "--estimator", "wls"]
    yield "compare", ["compare", "OUT/../small", "OUT/../small wls", "--json"]
    loads = ["ident_20200219_14harm.parquet", "ident_20200219_14harm_load.parquet"]
    free, loaded = (ur10e / file for file in loads)
    gains = tomllib.loads((tree / "tests/jobs/ur10e.toml").read_text())["torque"]["gains"]
    stated = [word for joint, gain in gains.items() for word in ("--gain", f"{joint}={gain}")]
    yield "payload", ["payload", robot, loaded, "--reference", free, "--json", *stated]
    yield "doctor", ["doctor", robot, free, "--json", *stated]
    yield "validate", ["validate", "OUT/../ur10e", ur10e / "val_ptp10.parquet", "--json"]
    for form, file in (
        ("mjcf", "x.xml"),
        ("sdf", "x.sdf"),
        ("urdf", "x.urdf"),
        ("ranges", "x.yaml"),
    ):
        yield f"export {form}", ["export", "OUT/../ur10e", "--format", form, "--out", f"OUT/{file}"]
    if go2.is_file():
        yield "go2", ["identify", "OUT/../go2.toml", "--out", "OUT"]


GO2 = """urdf = "{urdf}"
[estimator]
name = "simulation"
[controller]
kp = 20.0
kd = 1.5
[[identification]]
log = "{log}"
end = 14.0
[[validation]]
log = "{log}"
start = 14.1
"""


def run(tree, folder, names):
    """Write the figures of a tree into a folder."""
    env = {**os.environ, "PYTHONPATH": str(tree), "OPENBLAS_NUM_THREADS": "1", "COLUMNS": "100"}
    data = Path(os.environ["ROBOTID_DATA"])
    folder.mkdir()
    log = data / "commands/go2/chirp.parquet"
    (folder / "go2.toml").write_text(GO2.format(urdf=example_urdf("go2.urdf"), log=log))
    for name, words in commands(tree, data):
        if names and name not in names:
            continue
        own = folder / name
        own.mkdir(parents=True)
        line = [str(word).replace("OUT/..", str(folder)).replace("OUT", str(own)) for word in words]
        done = subprocess.run(
            [sys.executable, "-m", "robotid", *line],
            env=env,
            cwd=tree,
            capture_output=True,
            text=True,
        )
        if done.returncode not in (0, 1):  # 1: of a result that is not usable
            sys.exit(f"{tree}: {name}: {done.stderr}")
        text = done.stdout.replace(str(folder), "").replace(str(tree), "")
        (own / ("printed.json" if "--json" in words else "printed.txt")).write_text(text)


def figures(value, at=""):
    """Yield (place, number) of every number in a JSON value."""
    if isinstance(value, dict | list):
        items = value.items() if isinstance(value, dict) else enumerate(value)
        for key, inner in items:
            yield from figures(inner, f"{at}/{key}")
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield at, value


def read(file, folder):
    """Return the numbers of a file by place."""
    text = file.read_text()
    if file.suffix == ".json":
        return dict(figures(json.loads(text)))
    text = SPENT.sub("", CODE.sub("", text.replace(str(folder), "")))
    return {str(i): float(x) for i, x in enumerate(NUMBER.findall(text))}


def difference(x, y):
    return 0.0 if x == y else abs(x - y) / max(abs(x), abs(y))


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("before", type=Path)
    parser.add_argument("after", type=Path, nargs="?", default=HERE)
    parser.add_argument("--only", nargs="+", default=[], help="names of runs")
    parser.add_argument("--tolerance", type=float, default=1e-12, help="relative")
    parser.add_argument(
        "--most", type=int, default=9, help="maximum number of listed differences per file"
    )
    options = parser.parse_args()
    largest, gone = 0.0, 0
    with tempfile.TemporaryDirectory() as made:
        folders = Path(made, "before"), Path(made, "after")
        for tree, folder in zip((options.before, options.after), folders, strict=True):
            run(tree.resolve(), folder, options.only)
        files = {f.relative_to(folder) for folder in folders for f in folder.rglob("*.*")}
        for file in sorted(f for f in files if f.suffix in (".json", *TEXTS)):
            if not all((folder / file).is_file() for folder in folders):
                print(f"{file}: only in one of the two trees")
                gone += 1
                continue
            old, new = (read(folder / file, folder) for folder in folders)
            changes = {k: difference(old[k], new[k]) for k in old.keys() & new.keys()}
            worst = max(changes.values(), default=0.0)
            odd = sorted(old.keys() - new.keys())
            other = sorted((k for k in changes if changes[k] > options.tolerance), key=changes.get)
            print(
                f"{file}: {len(new)} figures, {len(new.keys() - old.keys())} of them new, "
                f"largest relative difference {worst:.1g}; missing: {len(odd)}",
                *odd[: options.most],
                *(f"\n  {k}: {old[k]} -> {new[k]}" for k in other[::-1][: options.most]),
            )
            largest, gone = max(largest, worst), gone + len(odd)
    print(f"largest relative difference {largest:.1g}; missing figures: {gone}")
    return int(largest > options.tolerance or gone > 0)


if __name__ == "__main__":
    sys.exit(main())
