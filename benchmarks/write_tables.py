"""Run benchmarks and write what they print into the pages under docs/.

    python benchmarks/write_tables.py validation regressor startup ...

What stands between the marks of a page is what the benchmark printed, with its command, versions
and machine; the mark keeps a digest of it, so that tests/test_docs.py sees a figure typed by hand.
A mark with "-" for its digest holds figures of an earlier run, to be written anew.
"""

import argparse
import hashlib
import platform
import re
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGES = {
    "five_minutes": "tutorials/first_arm.md",
    "validation": "evidence/accuracy.md",
    "priors": "evidence/new_motion.md",
    "uncertainty": "evidence/intervals.md",
    "end_to_end": "evidence/speed.md",
    "figaroh": "evidence/speed.md",
    "fuzz": "reference/limits.md",
    "friction": "evidence/friction.md",
    "regressor": "evidence/speed.md",
    "startup": "evidence/speed.md",
    "scaling": "evidence/speed.md",
    "workers": "how_to/long_logs.md",
    "memory": "how_to/long_logs.md",
    "verdict": "evidence/verdicts.md",
    "preview": "how_to/preview.md",
    "excitation": "evidence/excitation.md",
    "designs": "evidence/excitation.md",
    "motions": "evidence/excitation.md",
    "commands": "evidence/closed_loop.md",
}
BLOCK = re.compile(
    r"<!-- table of bench_(?P<name>\w+), (?P<digest>[-\w]+) -->\n"
    r"(?P<body>.*?)<!-- end of table -->",
    re.DOTALL,
)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="+", choices=PAGES)
    parser.add_argument("--options", default="", help='of the benchmark: --options="--cpu"')
    options = parser.parse_args()
    for name in options.names:
        words = [f"benchmarks/bench_{name}.py", *options.options.split()]
        run = subprocess.run(
            [sys.executable, *words], cwd=ROOT, stdout=subprocess.PIPE, text=True, check=True
        )
        page = ROOT / "docs" / PAGES[name]
        page.write_text(put(page.read_text(), name, body(run.stdout, " ".join(words))))
        print(f"{page.relative_to(ROOT)}: table of bench_{name}")


def body(printed, command):
    """Return what a page shows of a benchmark's output."""
    is_table = any(line.startswith("|") for line in printed.splitlines())
    shown = printed.strip() if is_table else f"```text\n{printed.strip()}\n```"
    made = f"`python {command}`, robotid {version('robotid')}"
    if not re.search(r"Python \d", printed):
        made += f", Python {platform.python_version()}, {platform.machine()}"
    return f"{shown}\n\n*{made}*\n"


def put(text, name, shown):
    """Return a page with the table of a benchmark replaced."""
    old = next((m for m in BLOCK.finditer(text) if m["name"] == name), None)
    if old is None:
        raise SystemExit(f"the page has no '<!-- table of bench_{name}, - -->' to write to")
    mark = f"<!-- table of bench_{name}, {digest(shown)} -->\n{shown}<!-- end of table -->"
    return text[: old.start()] + mark + text[old.end() :]


def digest(shown):
    return hashlib.sha256(shown.encode()).hexdigest()[:16]


if __name__ == "__main__":
    main()
