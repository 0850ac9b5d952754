"""Every robot of example-robot-data: inspected once, for the tables in the docs, too."""

import json
import os
from collections import Counter
from functools import lru_cache

import pytest
from helpers.paths import DOCS

from robotid.doctor.urdf import inspect_urdf
from robotid.regressor.base_parameters import structural_mapping
from robotid.robot import geometry
from robotid.robot.examples import example_urdfs
from robotid.robot.model import RobotModel

AUDIT, COUNTS = DOCS / "urdf_audit.md", DOCS / "base_counts.md"


@pytest.fixture(scope="module")
def inspections():
    """The inspection of every example robot by its path; robots of a family share meshes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(geometry, "read_surfaces", lru_cache(128)(geometry.read_surfaces))
        return {path: inspect_urdf(path) for path in example_urdfs()}


def test_every_example_robot_can_be_inspected(inspections):
    unusable = {}
    for path, inspection in inspections.items():
        content = json.loads(json.dumps(inspection.to_dict(), allow_nan=False))
        assert set(content) == {"robot", "joints", "structure", "base_groups", "findings"}
        for finding in content["findings"]:
            wanted = {"code", "severity", "message", "evidence"}
            wanted |= set(finding) & {"link", "joint"}
            assert set(finding) == wanted
            assert finding["severity"] in ("note", "warning", "error")
        if content["structure"] is None:
            (finding,) = [f for f in content["findings"] if f["code"] == "unusable"]
            unusable[path.name] = finding["message"]
    assert set(unusable) == {"ur3.urdf", "quadrotor_base.urdf", "iris_simple.urdf"}
    assert "<robot> has no name" in unusable["ur3.urdf"]


def test_the_table_of_all_example_robots_is_the_documents(inspections):
    lines = ["| robot | joints | errors | warnings | which |", "|---|---|---|---|---|"]
    for path, found in inspections.items():
        graves = [f for f in found.findings if f.severity != "note"]
        counts = Counter(f.code for f in graves)
        errors = sum(f.severity == "error" for f in graves)
        which = ", ".join(f"{code} {count}" for code, count in sorted(counts.items()))
        name = f"{path.parent.parent.name}/{path.name}"
        cells = [name, len(found.joints), errors, len(graves) - errors, which or "–"]
        lines.append(f"| {' | '.join(map(str, cells))} |")
    table = "\n".join(lines) + "\n"
    if os.environ.get("ROBOTID_WRITE_AUDIT"):
        AUDIT.write_text(AUDIT.read_text().split("| robot |")[0] + table)
    assert AUDIT.read_text().endswith(table)


def test_table_of_every_example_robot_is_the_one_in_the_docs(inspections):
    lines = [
        "| robot | joints | standard | base, fixed | base, floating |",
        "|---|---|---|---|---|",
    ]
    for path, inspection in inspections.items():
        if inspection.structure is None:
            continue
        fixed = inspection.structure
        floating = RobotModel.from_urdf(path, terms=(), free_flyer=True)
        counts = fixed.base_inertial, len(structural_mapping(floating).K)
        assert counts[0] <= counts[1] <= floating.layout.n_inertial
        lines.append(
            f"| {path.parent.parent.name}/{path.name} | {len(inspection.joints)} | "
            f"{fixed.standard} | {counts[0]} | {counts[1]} |"
        )
    assert len(lines) == 2 + 66
    table = "\n".join(lines) + "\n"
    if os.environ.get("ROBOTID_WRITE_COUNTS"):
        COUNTS.write_text(COUNTS.read_text().split("| robot |")[0] + table)
    assert table in COUNTS.read_text()
