"""Where the tests find what they read."""

import os
from pathlib import Path

__all__ = ["DOCS", "IN_CI", "JOBS", "ROOT", "URDF"]

ROOT = Path(__file__).resolve().parents[2]
JOBS = ROOT / "tests" / "jobs"
DOCS = ROOT / "docs"
URDF = ROOT / "urdf"
IN_CI = os.environ.get("CI") == "true"
