"""Run benchmarks and write the tables that they print as CSV files in docs/evidence/.

    python benchmarks/write_tables.py accuracy regressor ...

docs/evidence/tables.csv lists the tables: the command that prints each, versions and machine, what
is printed around it, and a digest, by which tests/test_docs.py notices figures typed by hand.
"""

import argparse
import csv
import hashlib
import re
import shlex
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "docs" / "evidence"
MACHINE = re.compile(r"Python \d.*(?:x86_64|aarch64|arm64).*")


def main():
    listed = [row for row in read("tables") if row[1].startswith("python ")]
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="+", choices=[row[0] for row in listed], metavar="TABLE")
    chosen = parser.parse_args().names
    for command in dict.fromkeys(row[1] for row in listed if row[0] in chosen):
        words = [sys.executable, *shlex.split(command)[1:]]
        run = subprocess.run(words, cwd=ROOT, stdout=subprocess.PIPE, text=True, check=True)
        made = version("robotid"), MACHINE.search(run.stdout)[0]
        names = [row[0] for row in listed if row[1] == command]
        for name, (table, notes) in zip(names, tables(run.stdout), strict=True):
            write(name, table, *made, notes)
            print(f"{name}.csv")


def tables(printed):
    """Yield the rows of each table that a benchmark printed, and the text before the next one."""
    before, *parts = re.split(r"((?:^\|.*\n)+)", MACHINE.sub("", printed), flags=re.MULTILINE)
    parts[1] = before + "\n" + parts[1]
    for table, notes in zip(parts[::2], parts[1::2], strict=True):
        lines = [line for line in table.splitlines() if not re.fullmatch(r"[| :-]+", line)]
        rows = [[cell.strip() for cell in line[1:-1].split("|")] for line in lines]
        yield rows, " ".join(notes.split())


def read(name):
    """Return the rows of a table, its head first."""
    with (FOLDER / f"{name}.csv").open(newline="") as file:
        return list(csv.reader(file))


def write(name, rows, *made):
    """Write a table; list its digest, and the version, machine and notes if these are given."""
    save(name, rows)
    listed = {row[0]: row for row in read("tables")}
    if made:
        listed[name][2:5] = made
    listed[name][5] = digest(name)
    save("tables", listed.values())


def save(name, rows):
    with (FOLDER / f"{name}.csv").open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(rows)


def digest(name):
    return hashlib.sha256((FOLDER / f"{name}.csv").read_bytes()).hexdigest()[:16]


if __name__ == "__main__":
    main()
