"""Check what the wheel and the sdist contain: licences, type marker, data, documentation."""

import sys
import tarfile
import zipfile
from pathlib import Path

WHEEL = (
    *(path.as_posix() for path in sorted(Path("robotid").rglob("assets/*"))),
    "robotid/output/pages/assets/uPlot.LICENSE.txt",
    "robotid/output/pages/assets/charts.js",
    "robotid/py.typed",
    "dist-info/licenses/LICENSE",
)
SDIST = (
    "README.md",
    "CHANGELOG.md",
    "docs/index.md",
    "docs/pictures/report.png",
)

wheel, sdist = map(Path, sys.argv[1:])
with zipfile.ZipFile(wheel) as archive:
    inside = archive.namelist()
    licence = archive.read(next(name for name in inside if name.endswith("uPlot.LICENSE.txt")))
missing = [name for name in WHEEL if not any(path.endswith(name) for path in inside)]
missing += [path for path in inside if path.startswith(("tests/", "docs/", "urdf/"))]
with tarfile.open(sdist) as archive:
    packed = archive.getnames()
missing += [name for name in SDIST if not any(path.endswith(name) for path in packed)]
if missing or b"MIT" not in licence or b"Leon Sorokin" not in licence:
    sys.exit(f"wrong in {wheel.name} or {sdist.name}: {missing or 'the licence of uPlot'}")
print(f"{wheel.name}: {len(inside)} files; {sdist.name}: {len(packed)} files")
