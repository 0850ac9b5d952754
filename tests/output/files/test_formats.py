"""The formats of robotid export: each is written and read back, and stands wherever formats do."""

import re
import xml.etree.ElementTree as ET

import mujoco
import numpy as np
import pytest
import yaml
from helpers.commanded_results import written_result
from helpers.mujoco_plant import plant
from helpers.paths import DOCS, ROOT

from robotid.cli.export import export
from robotid.output.files.exports import formats
from robotid.output.files.result_file import load_result
from robotid.robot.tree import read_with_yourdfpy

#: How the consumer of each format reads the stiffness or the Coulomb friction of a joint.
CONSUMERS = {
    "urdf": lambda path, joint: float(_named(read_with_yourdfpy(path), joint).dynamics.friction),
    "mjcf": lambda path, joint: (
        mujoco.MjModel.from_xml_path(str(path)).joint(joint).frictionloss[0]
    ),
    "sdf": lambda path, joint: float(
        ET.parse(path).find(f".//joint[@name='{joint}']/axis/dynamics/friction").text
    ),
    "isaac": lambda path, joint: _group(path, joint)["friction"],
    "ranges": lambda path, joint: yaml.safe_load(path.read_text())["drives"][joint]["coulomb"][
        "nominal"
    ],
}


def _named(robot, joint):
    return next(each for each in robot.joints if each.name == joint)


def _group(path, joint):
    groups = yaml.safe_load(path.read_text())["actuators"].values()
    return next(group for group in groups if joint in group["joint_names_expr"])


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    """The folder of a result with gains, which every format can state."""
    leg = plant("leg", np.random.default_rng(0))
    return written_result(leg, tmp_path_factory.mktemp("formats") / "out")


@pytest.mark.parametrize("kind", formats())
def test_each_format_is_read_back_by_its_consumer(kind, result, tmp_path):
    target = tmp_path / f"robot{formats()[kind].suffix}"
    done = export(result, kind, target)
    assert done["files"][0] == str(target)
    loaded = load_result(result)
    for drive in loaded.commanded:
        assert CONSUMERS[kind](target, drive.joint) == pytest.approx(drive.coulomb, rel=1e-4)


def test_the_pages_name_each_format():
    readme, page = (
        path.read_text() for path in (ROOT / "README.md", DOCS / "reference" / "export_formats.md")
    )
    for kind in formats():
        assert re.search(rf"`{kind}`|--format {kind} ", readme)
        assert f"--format {kind} --out" in page
