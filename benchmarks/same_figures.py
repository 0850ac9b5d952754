"""Do two trees of robotid give the same figures?

Runs the job files of tests/jobs, the demo, ``paper --quick`` and a ``track`` with each of two
trees, one after the other in one environment, and compares every number of every JSON file written.
The recordings are found by ROBOTID_DATA.

    python benchmarks/same_figures.py BEFORE [AFTER]    # folders of two checkouts; AFTER: this one

Exits with 1 if a figure differs by more than 1e-12 of its size, or is gone.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).parents[1]
SAME = 1e-12  # largest relative difference


def run(tree, folder, data):
    """Write the figures of a tree into a folder."""
    env = {**os.environ, "PYTHONPATH": str(tree), "OPENBLAS_NUM_THREADS": "1"}
    panda = data / "panda"
    commands = {job.stem: ["identify", job] for job in sorted((tree / "tests/jobs").glob("*.toml"))}
    commands["demo"] = ["demo"]
    commands["paper"] = ["paper", "--quick"]
    commands["track"] = ["track", panda / "robot.urdf", panda / "panda_inria.parquet"]
    for name, (command, *words) in commands.items():
        line = [sys.executable, "-m", "robotid", command, *words, "--out", folder / name]
        subprocess.run(line, env=env, cwd=tree, check=True, stdout=subprocess.DEVNULL)


def figures(value, at=""):
    """Yield (place, number) of every number in a JSON value."""
    if isinstance(value, dict | list):
        items = value.items() if isinstance(value, dict) else enumerate(value)
        for key, inner in items:
            yield from figures(inner, f"{at}/{key}")
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield at, value


def difference(x, y):
    return 0.0 if x == y else abs(x - y) / max(abs(x), abs(y))


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("before", type=Path)
    parser.add_argument("after", type=Path, nargs="?", default=HERE)
    options = parser.parse_args()
    data, largest, gone = Path(os.environ["ROBOTID_DATA"]), 0.0, 0
    with tempfile.TemporaryDirectory() as made:
        folders = Path(made, "before"), Path(made, "after")
        for tree, folder in zip((options.before, options.after), folders, strict=True):
            run(tree.resolve(), folder, data)
        files = {f.relative_to(folder) for folder in folders for f in folder.rglob("*.json")}
        for file in sorted(files):
            old, new = (dict(figures(json.loads((f / file).read_text()))) for f in folders)
            worst = max((difference(old[k], new[k]) for k in old.keys() & new.keys()), default=0.0)
            odd = sorted(old.keys() - new.keys())
            print(
                f"{file}: {len(new)} figures, {len(new.keys() - old.keys())} of them new, "
                f"largest relative difference {worst:.1g}; gone: {len(odd)}",
                *odd[:9],
            )
            largest, gone = max(largest, worst), gone + len(odd)
    print(f"largest relative difference {largest:.1g}; figures gone: {gone}")
    return int(largest > SAME or gone > 0)


if __name__ == "__main__":
    sys.exit(main())
