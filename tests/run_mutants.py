"""Put deliberate faults into a copy of the package, and see whether the related tests fail.

    python tests/run_mutants.py [--only TEXT] [--rotate N --seed WORD] [--jobs 2]

Each entry of mutants.toml names a file, a text that occurs in it exactly once, the faulty text to
put in its place, and the tests that must fail then. ``--rotate`` tries N of them, chosen by the
seed alone (CI gives the commit). Exit code 1 if a fault is missed, a text no longer occurs once or
a test does not exist.
"""

import argparse
import concurrent.futures
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
TIMEOUT = 600  # [s] tests that take longer show nothing
COPIED = ("robotid", "tests", "urdf", "docs", "benchmarks", "README.md", "pyproject.toml")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--file", type=Path, default=ROOT / "tests" / "mutants.toml")
    parser.add_argument("--only", default="", help="faults whose file or texts contain this")
    parser.add_argument("--rotate", type=int, metavar="N", help="try N faults chosen by the seed")
    parser.add_argument("--seed", default="", help="any word; the same word chooses the same")
    parser.add_argument("--jobs", type=int, default=2, help="how many at a time")
    options = parser.parse_args()
    faults = read(options.file)
    stale = [problem for fault in faults if (problem := stale_text(fault))]
    for problem in stale:
        print(f"stale   {problem}")
    chosen = [f for f in faults if options.only in f"{f['file']}{f['text']}{f['faulty']}"]
    if options.rotate is not None:
        chosen = rotated(chosen, options.rotate, options.seed)
    with concurrent.futures.ThreadPoolExecutor(options.jobs) as pool:
        missed = sum(not caught for caught in pool.map(try_fault, chosen))
    print(f"{len(chosen) - missed} of {len(chosen)} faults caught; {len(faults)} in the list")
    return 1 if missed or stale else 0


def read(path: Path) -> list[dict[str, Any]]:
    """Return the faults of a file."""
    return tomllib.loads(path.read_text())["mutant"]


def stale_text(fault: dict[str, Any]) -> str | None:
    """Return what is wrong with an entry, if anything."""
    path = ROOT / fault["file"]
    count = path.read_text().count(fault["text"]) if path.is_file() else 0
    tests = [test.split("::")[0] for test in fault["tests"] if test.startswith("tests/")]
    absent = [test for test in tests if not (ROOT / test).exists()]
    if absent:
        return f"{fault['file']}: there is no {absent[0]}, which is to notice {fault['faulty']!r}"
    if count == 1 and fault["text"] != fault["faulty"]:
        return None
    return f"{fault['file']}: the text occurs {count} times, wanted once: {fault['text']!r}"


def rotated(faults: list[dict[str, Any]], number: int, seed: str) -> list[dict[str, Any]]:
    """Return the faults that a seed chooses, the same for the same seed."""
    return random.Random(seed).sample(faults, min(number, len(faults)))


def try_fault(fault: dict[str, Any]) -> bool:
    """Return whether the related tests fail in a copy of the tree with one fault."""
    if stale_text(fault):
        return False
    start = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="robotid-fault-") as name:
        tree = Path(name)
        for part in COPIED:
            source, target = ROOT / part, tree / part
            if source.is_dir():
                shutil.copytree(source, target)
            else:
                shutil.copy(source, target)
        faulty = tree / fault["file"]
        faulty.write_text(faulty.read_text().replace(fault["text"], fault["faulty"]))
        forget(tree, faulty)
        result = outcome(tree, fault["tests"])
    seconds = time.monotonic() - start
    print(f"{result:7} {seconds:4.0f} s  {fault['file']}: {fault['faulty']!r}", flush=True)
    return result == "caught"


def forget(tree: Path, faulty: Path) -> None:
    """Remove what was compiled with the text that a fault replaces."""
    compiled = [*faulty.parent.glob(f"__pycache__/{faulty.stem}.*")]
    if faulty.stem.endswith(
        ("lanes", "laws")
    ):  # Numba's; one of these files is compiled into the others
        compiled += [*tree.rglob("*.nbi"), *tree.rglob("*.nbc")]
    for path in compiled:
        path.unlink(missing_ok=True)


def outcome(tree: Path, tests: list[str]) -> str:
    """Run tests in a tree: "caught" if one fails, "missed" if none does, else "broken", "hangs"."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *tests]
    environment = os.environ | {"PYTHONPATH": str(tree), "PYTHONDONTWRITEBYTECODE": "1"}
    try:
        run = subprocess.run(
            command, cwd=tree, env=environment, capture_output=True, text=True, timeout=TIMEOUT
        )
    except subprocess.TimeoutExpired:
        return "hangs"
    if run.returncode == 1:
        return "caught"
    if run.returncode != 0:
        print(run.stdout[-1500:], run.stderr[-500:])
    return "missed" if run.returncode == 0 else "broken"


if __name__ == "__main__":
    sys.exit(main())
