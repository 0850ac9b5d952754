"""Is the verdict right? Verdicts and causes named, over robots x faults of simulated recordings.

    python benchmarks/bench_verdict.py [--quick] [--seed 0] [--robots ur5 panda] [--cases clean]
        [--jobs 2] [--list FILE]

Every pair of a robot and a case gets a true robot, motions and noise of its own, from the seed, and
goes through what ``robotid identify`` does with files: reader, doctor, fit, verdict. Each case says
beforehand which verdicts are right and which finding must name its cause. A cause is named by a
finding that the user sees: a warning, an error, or a refusal. A false alarm is a clean case with
another verdict than "good" or with a warning.
"""

import setting  # noqa: I001 -- pins the threads of BLAS before numpy is imported

import argparse
import itertools
import json
import logging
import re
import tempfile
import time
import zlib
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from verdict_cases import CASES, GOOD, ROBOTS, make

from robotid import identify
from robotid.cli.job import Job, LogEntry
from robotid.base.exceptions import RobotIdError
from robotid.data.files.read import write_columns

QUICK = ("ur5",), ("clean, far from the URDF", "torque 20 ms late", "all torques x 0.8")

OF_URDF = ("rounded_rpy",)  # true of the URDF, whatever was recorded
UNCHECKED = "absolute scale not verified"
NOTE = re.compile(r"doctor: \w+: (?P<code>\w+): ")


@dataclass(frozen=True)
class Answer:
    """What was said of a case on a robot."""

    robot: str
    case: str
    status: str  # "good", "usable", "poor" or "refused"
    codes: tuple[str, ...]  # of warnings and errors
    reasons: tuple[str, ...]
    held: float  # share of the true parameters that lie in their 95 % intervals [-]
    worst: float  # largest error of a joint on the validation recording [%]
    seconds: float

    @property
    def is_right(self):
        case = CASES[self.case]
        return self.status in case.right or (case.is_hidden and self.says_unchecked)

    @property
    def says_unchecked(self):
        """Whether it states that the absolute scale is not verified."""
        return any(UNCHECKED in reason for reason in self.reasons)

    @property
    def is_named(self):
        return not set(CASES[self.case].names).isdisjoint(self.codes)

    @property
    def is_alarm(self):
        """Whether a clean case was not called so."""
        return not (self.is_right and set(self.codes) <= {*CASES[self.case].allowed, *OF_URDF})

    @property
    def described(self):
        return f"{self.status}: {', '.join(self.codes) or 'nothing'}"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="one robot, three cases")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--robots", nargs="+", choices=ROBOTS)
    parser.add_argument("--cases", nargs="+", choices=CASES)
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--list", type=Path, help="append each answer to this file, as JSON lines")
    options = parser.parse_args()
    robots, cases = QUICK if options.quick else (ROBOTS, CASES)
    pairs = itertools.product(options.robots or robots, options.cases or cases)
    tasks = [(robot, case, options.seed) for robot, case in pairs]
    answers = []
    for answer in run(tasks, options.jobs):
        if answer is None:
            continue
        answers.append(answer)
        if options.list:
            line = asdict(answer) | {"right": answer.is_right, "named": answer.is_named}
            with options.list.open("a") as file:
                file.write(json.dumps(line) + "\n")
    summary(answers, options.seed)
    table("What is clean", [a for a in answers if CASES[a.case].right == GOOD])
    table("What is not", [a for a in answers if is_fault(a)])
    table("What another robot may look like, too", [a for a in answers if CASES[a.case].is_hidden])
    print(f"\n{setting.machine()}")


def is_fault(answer):
    case = CASES[answer.case]
    return case.right != GOOD and not case.is_hidden


def run(tasks, jobs):
    if jobs == 1:
        yield from map(ask, tasks)
        return
    with ProcessPoolExecutor(jobs) as pool:
        yield from pool.map(ask, tasks)


def ask(task):
    """Return what robotid says of a case on a robot, or None if there is no such case."""
    name, what, seed = task
    logging.getLogger("robotid").setLevel(logging.ERROR)
    robot, case = ROBOTS[name], CASES[what]
    key = (seed, zlib.crc32(name.encode()), zlib.crc32(what.encode()))
    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder)
        recording = make(robot, case, key, folder)
        if recording is None:
            return None
        for stem, columns in (("fitted", recording.fitted), ("kept", recording.kept)):
            write_columns(columns, folder / f"{stem}.csv")
        start = time.perf_counter()
        try:
            job = Job(urdf=recording.urdf, joints=robot.joints, gravity=robot.gravity,
                      locked=recording.arm.model.locked)  # fmt: skip
            model = job.model()
            logs = [
                job.read(LogEntry(folder / f"{stem}.csv"), model) for stem in ("fitted", "kept")
            ]
            result = identify(model, logs[:1], validation=logs[1:])
        except RobotIdError as error:
            seconds = time.perf_counter() - start
            said = (str(error), *getattr(error, "__notes__", ()))
            codes = (getattr(error, "code", type(error).__name__), *codes_of_notes(said))
            return Answer(name, what, "refused", codes, said, np.nan, np.nan, seconds)
    seconds = time.perf_counter() - start
    verdict = result.verdict
    codes = tuple(dict.fromkeys(f.code for f in result.findings if f.severity != "note"))
    errors = [m.relative_error_pct for e in result.validation
              for m in e.metrics["estimate"].per_joint.values()]  # fmt: skip
    worst = max((error for error in errors if error is not None), default=np.nan)
    return Answer(
        name, what, verdict.status, codes, verdict.reasons,
        held(result, recording.truth, case.terms), worst, seconds,
    )  # fmt: skip


def codes_of_notes(said):
    """Return the codes of what the doctor adds to an error."""
    found = (NOTE.match(words) for words in said)
    return dict.fromkeys(match["code"] for match in found if match)


def held(result, truth, terms):
    """Return the share of the true base parameters inside their intervals.

    Sums with a drive term whose true value is unknown (NaN in ``terms``) are left out.
    """
    known = dict(zip(result.model.with_terms({}).layout.names, truth, strict=True))
    names = result.mapping.names
    pi = np.array([known.get(x, terms.get(x.rpartition(".")[2], 0.0)) for x in names])
    is_known = ~result.mapping.K[:, np.isnan(pi)].any(axis=1)
    beta = result.mapping.to_base(np.nan_to_num(pi))
    low, high = result.base_interval.T
    return float(np.mean(((low <= beta) & (beta <= high))[is_known]))


def summary(answers, seed):
    clean = [a for a in answers if CASES[a.case].right == GOOD]
    faults = [a for a in answers if is_fault(a)]
    hidden = [a for a in answers if CASES[a.case].is_hidden]
    robots, cases = {a.robot for a in answers}, {a.case for a in answers}
    print(f"{len(robots)} robots, {len(cases)} cases, seed {seed}\n")
    print("| | wanted | found |\n|---|---|---|")
    shown = [*clean, *faults]
    print(f"| right verdict | 95 % | {share(a.is_right for a in shown)} |")
    told = [a for a in faults if CASES[a.case].names]
    print(f"| cause named | 90 % | {share(a.is_named for a in told)} |")
    print(f"| false warnings on clean recordings | <= 2 % | {share(a.is_alarm for a in clean)} |")
    print(f"| hidden faults with a warning | | {share(a.is_right for a in hidden)} |")
    for case in dict.fromkeys(a.case for a in clean):
        inside = [a.held for a in clean if a.case == case and np.isfinite(a.held)]
        if inside:
            mean = f"{100 * np.mean(inside):.1f} %"
            print(f"| true parameters in their 95 % intervals, {case} | 95 % | {mean} |")
    seconds = sum(a.seconds for a in answers) / max(len(answers), 1)
    print(f"| time of a case | | {seconds:.1f} s |")


def share(hits):
    hits = list(hits)
    return f"{sum(hits)} of {len(hits)}, {100 * sum(hits) / max(len(hits), 1):.1f} %"


def table(title, answers):
    if not answers:
        return
    is_clean = CASES[answers[0].case].right == GOOD
    print(f"\n### {title}\n")
    second = "no warning" if is_clean else "cause named"
    print(f"| case | right verdict | {second} | interval coverage | other findings |")
    print("|---|---|---|---|---|")
    for case in dict.fromkeys(a.case for a in answers):
        of_case = [a for a in answers if a.case == case]
        count = len(of_case)
        right = sum(a.is_right for a in of_case)
        codes = ", ".join(CASES[case].names)
        named = sum((not a.is_alarm) if is_clean else a.is_named for a in of_case)
        said = f"{named}/{count}" if codes or is_clean else "-"
        inside = [100 * a.held for a in of_case if np.isfinite(a.held)]
        wrong = Counter(a.described for a in of_case if is_off(a))
        others = "; ".join(f"{words} (x {times})" for words, times in wrong.most_common(2)) or "-"
        middle = f"{np.mean(inside):.0f} %" if inside else "-"
        print(f"| {case} | {right}/{count} | {said} | {middle} | {others} |")


def is_off(answer):
    case = CASES[answer.case]
    if case.right == GOOD:
        return answer.is_alarm
    return not answer.is_right or (bool(case.names) and not answer.is_named)


if __name__ == "__main__":
    main()
