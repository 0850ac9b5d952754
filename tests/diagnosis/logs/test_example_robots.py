"""Robots of example-robot-data: inspected once, for the tables in the docs, too."""

import json
import os
import sys
from collections import Counter

import pytest
from helpers.paths import ROOT

from robotid.diagnosis.urdf.inspection import inspect_urdf
from robotid.dynamics.base_parameters import structural_mapping
from robotid.robot.examples import example_urdfs
from robotid.robot.model import RobotModel

sys.path.append(str(ROOT / "benchmarks"))
from write_tables import read, write

WRITES = "ROBOTID_WRITE_DOCS" in os.environ
#: Take nine tenths of the time, and have no finding that no other robot has. All are inspected to
#: write the tables; every robot is opened in tests/robot/test_model.py.
LARGE = {
    "tiago_dual", "a1", "alex_nub_hands", "tiago", "so101", "talos_full_v2", "tiago_pro", "pr2",
    "g1_29dof_with_hand_rev_1_0", "b1-z1", "z1", "g1_29dof_rev_1_0", "anymal-kinova", "kinova",
    "alex_psyonic_hands", "romeo", "human", "icub", "romeo_laas_small", "talos_full_v2_box",
    "alexander_v1.lowerBodyOnly", "alex_sake_hands", "baxter", "romeo_small", "icub_reduced",
    "talos_reduced_corrected", "talos_reduced_box", "panda_collision", "ur3_joint_limited_robot",
    "ur5_joint_limited_robot", "ur10_joint_limited_robot", "talos_reduced", "ur10_robot",
    "ur5_gripper", "ur3_gripper", "tiago_no_hand", "simple_humanoid_classical", "laikago", "go1",
    "solo12",
}  # fmt: skip


@pytest.fixture(scope="module")
def inspections():
    """The inspection of example robots by path; robots of a family share meshes."""
    chosen = [path for path in example_urdfs() if WRITES or path.stem not in LARGE]
    assert WRITES or len(chosen) == 69 - len(LARGE)
    return {path: inspect_urdf(path) for path in chosen}


def assert_documented(name, rows):
    """Assert that a table has the head and these rows, none twice; write it if asked for."""
    if WRITES:
        write(name, rows)
    assert [row for row in read(name) if row in rows] == rows


def test_example_robots_can_be_inspected(inspections):
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


def test_the_table_of_example_robots_is_the_documents(inspections):
    rows = [["robot", "joints", "errors", "warnings", "which"]]
    for path, found in inspections.items():
        graves = [f for f in found.findings if f.severity != "note"]
        counts = Counter(f.code for f in graves)
        errors = sum(f.severity == "error" for f in graves)
        which = ", ".join(f"{code} {count}" for code, count in sorted(counts.items()))
        name = f"{path.parent.parent.name}/{path.name}"
        cells = [name, len(found.joints), errors, len(graves) - errors, which or "–"]
        rows.append([str(cell) for cell in cells])
    assert_documented("urdf_audit", rows)


def test_table_of_every_example_robot_is_the_one_in_the_docs(inspections):
    rows = [["robot", "joints", "standard", "base, fixed", "base, floating"]]
    for path, inspection in inspections.items():
        if inspection.structure is None:
            continue
        fixed = inspection.structure
        floating = RobotModel.from_urdf(path, terms=(), free_flyer=True)
        counts = fixed.base_inertial, len(structural_mapping(floating).K)
        assert counts[0] <= counts[1] <= floating.layout.n_inertial
        name = f"{path.parent.parent.name}/{path.name}"
        rows.append([name, *map(str, (len(inspection.joints), fixed.standard, *counts))])
    assert_documented("base_counts", rows)
