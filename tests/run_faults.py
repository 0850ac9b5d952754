"""Put deliberate faults into a copy of the package, and see whether the tests notice.

    python tests/run_faults.py [--hand N] [--tool N] [--since COMMIT] [--seed WORD] [--jobs 2]

Faults by hand are those of faults.toml: a file, a text that occurs in it once, the faulty text for
it, and the tests that must fail then. Faults by a tool are mutations of cosmic-ray on lines that
changed since a commit (on all without one), for the tests of the package that has the line. --hand
and --tool choose N of each by the seed alone. Exit code 1 if a fault by hand is missed or does not
fit the code any more; a mutation may change nothing, so those that are missed are only printed.
"""

import argparse
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TIMEOUT = 300  # [s] tests that take longer show nothing
COPIED = ("robotid", "tests", "urdf", "docs", "benchmarks", "README.md", "pyproject.toml")
EMPTY = "4b825dc642cb6eb9a060e54bf8d69288fbee4904"  # git's tree without files
OPERATORS = re.compile(r"/(Replace(Bin|Un|Comp|And|Or|True|False)|NumberReplacer|AddNot)")


@dataclass(frozen=True)
class Fault:
    """A text of a file that becomes a faulty one, and the tests that are to notice."""

    file: str
    code: str  # the whole file with the fault
    label: str
    tests: list[str]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--hand", type=int, metavar="N", help="faults by hand; all without --tool")
    parser.add_argument("--tool", type=int, metavar="N", default=0, help="mutations of cosmic-ray")
    parser.add_argument("--since", metavar="COMMIT", help="mutate only lines changed since then")
    parser.add_argument("--seed", default="", help="any word; the same word chooses the same")
    parser.add_argument("--only", default="", help="faults whose file contains this")
    parser.add_argument("--jobs", type=int, default=2, help="how many at a time")
    options = parser.parse_args()
    rng = random.Random(options.seed)
    entries = tomllib.loads((ROOT / "tests" / "faults.toml").read_text())["fault"]
    stale = [problem for entry in entries if (problem := misfit(entry))]
    print(*(f"stale   {problem}" for problem in stale), sep="\n")
    by_hand = [entry for entry in entries if options.only in entry["file"] and not misfit(entry)]
    count = len(by_hand) if options.hand is None and not options.tool else options.hand or 0
    hand = [stated(entry) for entry in rng.sample(by_hand, min(count, len(by_hand)))]
    tool = list(mutations(options.tool, options.since, options.only, rng)) if options.tool else []
    with ThreadPoolExecutor(options.jobs) as pool:
        caught = list(pool.map(try_fault, hand + tool))
    missed = caught[: len(hand)].count(False)
    print(f"{len(hand) - missed} of {len(hand)} faults by hand caught; {len(entries)} in the list")
    print(f"{sum(caught[len(hand) :])} of {len(tool)} mutations caught")
    return 1 if missed or stale else 0


def misfit(entry: dict[str, str | list[str]]) -> str | None:
    """Return why an entry of faults.toml does not fit the tree, if so."""
    path = ROOT / entry["file"]
    count = path.read_text().count(entry["text"]) if path.is_file() else 0
    absent = [test for test in entry["tests"] if not (ROOT / test.split("::")[0]).exists()]
    if count != 1:
        return f"{entry['file']}: the text occurs {count} times, expected once: {entry['text']!r}"
    return f"{entry['file']}: there is no {absent[0]}" if absent else None


def stated(entry: dict[str, str | list[str]]) -> Fault:
    code = (ROOT / entry["file"]).read_text().replace(entry["text"], entry["faulty"])
    return Fault(entry["file"], code, repr(entry["faulty"]), entry["tests"])


def mutations(count: int, since: str | None, only: str, rng: random.Random) -> Iterator[Fault]:
    """Yield mutations of chosen lines, each in a function's body."""
    from cosmic_ray.ast import ast_nodes, get_ast
    from cosmic_ray.mutating import mutate_code
    from cosmic_ray.plugins import get_operator, operator_names

    names = [name for name in operator_names() if OPERATORS.search(name)]
    lines = [place for place in changed_lines(since) if only in place[0]]
    rng.shuffle(lines)
    for file, line in lines:
        if count == 0:
            return
        before = (ROOT / file).read_text()
        nodes = list(ast_nodes(get_ast(before)))
        for name in rng.sample(names, len(names)):
            occurrence = first_in_line(nodes, line, get_operator(name)())
            if occurrence is not None:
                code = mutate_code(before, get_operator(name)(), occurrence)
                count -= 1
                label = f"{line}: {code.splitlines()[line - 1].strip()}"
                yield Fault(file, code, label, tests_of(Path(file)))
                break


def changed_lines(since: str | None) -> list[tuple[str, int]]:
    """Return (file, line) of each line inside a function that changed since a commit, or of all."""
    command = ["git", "diff", "-U0", since or EMPTY, "--", "robotid/*.py"]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    pairs, file = [], ""
    for row in run.stdout.splitlines():
        if row.startswith("+++ "):
            file = row.removeprefix("+++ b/")
        elif hunk := re.match(r"@@ -\S+ \+(\d+)(?:,(\d+))? @@", row):
            pairs += [(file, int(hunk[1]) + k) for k in range(int(hunk[2] or 1))]
    code = {file: (ROOT / file).read_text().splitlines() for file, _ in pairs}
    return [(file, k) for file, k in pairs if code[file][k - 1].startswith("    ")]


def first_in_line(nodes: list, line: int, operator) -> int | None:
    """Return which occurrence of an operator is the first in a line."""
    occurrence = 0
    for node in nodes:
        for (start, _), _ in operator.mutation_positions(node):
            if start == line:
                return occurrence
            occurrence += 1
    return None


def tests_of(file: Path) -> list[str]:
    """Return the tests of the nearest folder there is of a file's package, its own first."""
    folder = Path("tests", *file.parts[1:-1])
    while not (ROOT / folder).is_dir() or folder == Path("tests", "estimation"):
        folder = folder.parent
    found = [path.relative_to(ROOT) for path in (ROOT / folder).rglob("test_*.py")]
    found.sort(key=lambda path: (path.stem != f"test_{file.stem}", path))
    return [*map(str, found), "tests/figures"]


def try_fault(fault: Fault) -> bool:
    """Return whether the related tests fail in a copy of the tree with one fault."""
    start = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="robotid-fault-") as name:
        tree = Path(name)
        for part in COPIED:
            copy = shutil.copytree if (ROOT / part).is_dir() else shutil.copy
            copy(ROOT / part, tree / part)
        faulty = tree / fault.file
        faulty.write_text(fault.code)
        compiled = [*faulty.parent.glob(f"__pycache__/{faulty.stem}.*")]
        if faulty.stem.endswith("lanes"):  # Numba's; one of these files is compiled into the others
            compiled += [*tree.rglob("*.nbi"), *tree.rglob("*.nbc")]
        for path in compiled:
            path.unlink(missing_ok=True)
        result = outcome(tree, fault.tests)
    seconds = time.monotonic() - start
    print(f"{result:7} {seconds:4.0f} s  {fault.file}: {fault.label}", flush=True)
    return result == "caught"


def outcome(tree: Path, tests: list[str]) -> str:
    """Run tests in a tree: "caught" if one fails or cannot be read, "missed" if none does."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *tests]
    environment = os.environ | {"PYTHONPATH": str(tree), "PYTHONDONTWRITEBYTECODE": "1"}
    try:
        run = subprocess.run(
            command, cwd=tree, env=environment, capture_output=True, text=True, timeout=TIMEOUT
        )
    except subprocess.TimeoutExpired:
        return "hangs"
    if run.returncode not in (0, 1, 2):
        print(run.stdout[-1500:], run.stderr[-500:])
        return "broken"
    return "caught" if run.returncode else "missed"


if __name__ == "__main__":
    sys.exit(main())
