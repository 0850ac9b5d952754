"""Hostile inputs of every kind: how many were tried, and how many broke robotid.

    python benchmarks/bench_fuzz.py --inputs 3000 --seed 1 [--only TEXT] [--verbose]

Each kind is tried by a process of its own, so that one that is aborted is seen and counted. A
traceback is any exception that the command line does not tell in words; half-written is a file that
a refused command left or changed; a hang is an input that takes longer than a minute. Kinds whose
inputs each take a whole identification or more are tried a tenth as often.
"""

import argparse
import json
import resource
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from pathlib import Path

from setting import machine

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

from helpers.hostile_commands import COMMAND_KINDS
from helpers.hostile_inputs import KINDS as INPUT_KINDS
from hypothesis import HealthCheck, Phase, given, seed, settings

KINDS = INPUT_KINDS | COMMAND_KINDS
SLOW = ("values, identified", "result.json", "loop of a job")
LONGEST = 60  # [s] for one input
MEMORY = 8 * 2**30  # [bytes] of a process
COUNTS = ["inputs", "tracebacks", "aborts", "half-written", "hangs"]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--inputs", type=int, default=3000, help="inputs of each kind")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", help="kinds whose name contains this")
    parser.add_argument("--verbose", action="store_true", help="print failing inputs on stderr")
    parser.add_argument("--quick", action="store_true", help="30 inputs of each kind")
    parser.add_argument("--work", help=argparse.SUPPRESS)  # the kind that this process tries
    options = parser.parse_args()
    if options.work is not None:
        work(options.work, options.inputs, options.seed)
        return
    each = 30 if options.quick else options.inputs
    rows = []
    for kind in [kind for kind in KINDS if options.only in kind]:
        count = max(each // 10, 1) if kind in SLOW else each
        rows.append((kind, *tried(kind, count, options.seed, options.verbose)))
    print(f"| kind of input | {' | '.join(COUNTS)} | s |")
    print("|---|" + "---:|" * (len(COUNTS) + 1))
    for kind, found, seconds in rows:
        print(f"| {kind} | {' | '.join(str(found[name]) for name in COUNTS)} | {seconds:.0f} |")
    total = sum((found for _, found, _ in rows), Counter())
    print(f"| all | {' | '.join(str(total[name]) for name in COUNTS)} | |")
    print(f"\n{machine()}")
    sys.exit(any(total[name] for name in COUNTS[1:]))


def tried(kind, count, number, verbose):
    """Return the counts of a kind and the time that it took [s]; an abort starts a new process."""
    found, start = Counter(), time.monotonic()
    while found["inputs"] < count:
        words = ["--work", kind, "--inputs", str(count - found["inputs"])]
        words += ["--seed", str(number + found["aborts"])]
        run = subprocess.run(
            [sys.executable, __file__, *words], stdout=subprocess.PIPE, text=True,
            stderr=None if verbose else subprocess.DEVNULL,
        )  # fmt: skip
        marks = Counter(line.split()[0] for line in run.stdout.splitlines() if line[:1] != " ")
        found += marks
        if verbose:
            print("\n".join(f"{kind}: {line}" for line in run.stdout.splitlines()
                            if line.strip() != "inputs"), file=sys.stderr)  # fmt: skip
        if run.returncode != 0 and not marks["inputs"]:
            raise SystemExit(f"{kind}: no input could be made; see --verbose")
        if run.returncode != 0:
            found["aborts"] += 1
        elif not marks["inputs"]:
            break
        else:
            count = found["inputs"]  # there may be no more inputs of this kind
    return found, time.monotonic() - start


def work(kind, count, number):
    """Try inputs of a kind, and print a word for each, and for each that broke."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    signal.signal(signal.SIGALRM, late)
    strategy, run = KINDS[kind]
    seen = set()

    @seed(number)
    @settings(max_examples=count, database=None, deadline=None, phases=[Phase.generate],
              suppress_health_check=list(HealthCheck))  # fmt: skip
    @given(strategy)
    def try_one(example):
        print("inputs", flush=True)
        signal.alarm(LONGEST)
        try:
            with tempfile.TemporaryDirectory() as folder:
                run(example, Path(folder))
        except TimeoutError:
            print("hangs", flush=True)
        except Exception as error:
            is_half = "half-written" in str(error) or "left behind" in str(error)
            print("half-written" if is_half else "tracebacks", flush=True)
            frames = traceback.extract_tb(error.__traceback__)
            own = [f for f in frames if "/robotid/" in f.filename] or frames
            at = " < ".join(f"{Path(f.filename).name}:{f.lineno}" for f in own[:-5:-1])
            what = f"{type(error).__name__}: {str(error)[:150]!r} at {at}"
            if at not in seen:
                print(" ", what, json.dumps(repr(example)[:600]), flush=True)
            seen.add(at)
        finally:
            signal.alarm(0)

    try_one()


def late(*_):
    raise TimeoutError


if __name__ == "__main__":
    main()
