"""The formats of robotid export: each is written and read back, and stands wherever formats do."""

import re
import sys
import xml.etree.ElementTree as ET
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import yaml
from helpers.commanded_results import written_result
from helpers.mujoco_plant import plant
from helpers.paths import DOCS, ROOT

from robotid.cli import main
from robotid.cli.export import export
from robotid.output.files import exports
from robotid.output.files.exports import Format, Option, Written, formats, writers
from robotid.output.files.result_file import load_result
from robotid.output.report.steps import Origin, exports_of
from robotid.robot.urdf_text import read_with_yourdfpy

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


def test_a_new_format_is_a_module(result, tmp_path, capsys, monkeypatch):
    names = ["exports", "isaac", "mjcf", "ranges", "sdf", "toy"]

    def export(result, target, *, grain="fine"):
        target.write_text(f"{result.robot.name} {grain}")
        return Written((target,), ["no place for gears"], {})

    toy = Format("toy", "a toy", ".toy", use_of_gains="Play with it.",
                 options={"grain": Option("size of its grains", "G")})  # fmt: skip
    monkeypatch.setattr(
        exports.pkgutil, "iter_modules", lambda _: [SimpleNamespace(name=x) for x in names]
    )
    module = SimpleNamespace(export=export, FORMAT=toy)
    monkeypatch.setitem(sys.modules, "robotid.output.files.toy", module)
    writers.cache_clear()

    with pytest.raises(SystemExit):
        main(["export", "--help"])
    said = " ".join(capsys.readouterr().out.split())
    assert ",sdf,toy}" in said
    assert "toy: a toy" in said
    assert "--grain G toy: size of its grains" in said
    words = ["export", str(result), "--format", "toy", "--out", str(tmp_path / "a.toy")]
    assert main([*words, "--grain", "coarse"]) == 0
    assert "no place for gears" in capsys.readouterr().out
    assert (tmp_path / "a.toy").read_text().endswith(" coarse")
    last = exports_of("go2", Origin((), "out"), has_gains=True)[-1]
    assert last.words == "Play with it."
    assert last.blocks[0].endswith(".toy")
    writers.cache_clear()
