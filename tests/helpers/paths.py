"""Where the tests find what they read."""

import os
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
JOBS = ROOT / "tests" / "jobs"
DOCS = ROOT / "docs"
URDF = ROOT / "urdf"
IN_CI = os.environ.get("CI") == "true"
