import re, sys
from pathlib import Path

pat = re.compile(r"(\\*)\[('[^'\[\]{}\n]*'(?:, '[^'\n\[\]{}]*')*)\\*\]")
pat2 = re.compile(r"(\\*)\[('[^'\[\]\n]*'(?:, '[^'\n\[\]]*')*)\\*\]")
for f in sys.argv[1:]:
    p = Path(f)
    s = p.read_text()
    n = pat2.sub(lambda m: ", ".join(x.strip()[1:-1] for x in m.group(2).split(", ")), s)
    n = n.replace("columns found: []", "columns found: none").replace(
        "found: \\[\\]", "found: none"
    )
    if n != s:
        for a, b in zip(s.split("\n"), n.split("\n")):
            if a != b:
                print(f.split("/")[-1], "|", b.strip()[:150])
        p.write_text(n)
