import os, re, subprocess, sys, json
from pathlib import Path

os.chdir("/work/wt/robotlogs")
out = subprocess.run(
    [
        "/work/main/.venv/bin/ruff",
        "check",
        "--select",
        "E501",
        "--output-format",
        "json",
        "robotid",
        "tests",
    ],
    capture_output=True,
    text=True,
).stdout
for e in sorted(json.loads(out), key=lambda e: -e["location"]["row"]):
    p = Path(e["filename"])
    ls = p.read_text().split("\n")
    i = e["location"]["row"] - 1
    l = ls[i]
    m = re.match(r'^(\s*)(.*?)(f?)(["\'])(.*)$', l)
    if not m:
        print("??", l)
        continue
    start = m.start(5)
    depth = 0
    best = None
    for k in range(start, min(len(l), 98)):
        c = l[k]
        if c == "{":
            depth += 1
        elif c == "}":
            depth -= 1
        elif c == " " and depth == 0:
            best = k
    if best is None:
        print("??", l)
        continue
    q = m.group(4)
    head = l[: best + 1] + q
    tail = l[best + 1 :]
    body = tail
    pre = m.group(3) if re.search(r"[{]", tail) else ""
    ind = " " * (m.start(3))
    ls[i : i + 1] = [head, ind + pre + q + tail]
    p.write_text("\n".join(ls))
