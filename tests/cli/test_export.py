"""robotid export: a written result in the formats of simulators."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from helpers.paths import URDF
from helpers.synthetic import exact_log, truth

import robotid
from robotid.cli import main
from robotid.cli.identify import run_job
from robotid.cli.job import read_job
from robotid.robot.model import RobotModel


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    """The folder of a result; the URDF is kept elsewhere, with a mesh beside it."""
    folder, rng = tmp_path_factory.mktemp("export"), np.random.default_rng(0)
    (folder / "robot").mkdir()
    urdf, shape = folder / "robot" / "planar.urdf", '<geometry><mesh filename="{}"/></geometry>'
    shown = "".join(f"<visual>{shape.format(name)}</visual>" for name in ("link.obj", "no.dae"))
    text = (URDF / "planar_2r.urdf").read_text()
    urdf.write_text(text.replace('<link name="link_1">', f'<link name="link_1">{shown}'))
    (folder / "robot" / "link.obj").write_text(
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    )
    model = RobotModel.from_urdf(urdf)
    log = exact_log(model, truth(model), rng, samples=400, noise=0.1)
    robotid.write_log(log, folder / "first.csv")
    (folder / "job.toml").write_text(f'urdf = "{urdf}"\n[[identification]]\nlog = "first.csv"\n')
    job = replace(read_job(folder / "job.toml"), report=False)
    run_job(job, folder / "out")
    return folder / "out"


def export(result, kind, target, capsys, *flags):
    code = main(["export", str(result), "--format", kind, "--out", str(target), *flags])
    return code, *capsys.readouterr()


def test_a_result_that_must_not_be_used_is_not_exported(result, tmp_path, capsys):
    content = json.loads((result / "result.json").read_text())
    shutil.copytree(result, tmp_path / "bad")
    for key in ("urdf", "sidecar"):
        del content["outputs"][key]
    ranges = content.pop("ranges")
    (tmp_path / "bad" / "result.json").write_text(json.dumps(content))
    for kind in ("urdf", "mjcf", "sdf", "ranges"):
        code, _, err = export(tmp_path / "bad", kind, tmp_path / "a", capsys)
        assert code == 1
        assert "because its parameters are wrong or impossible" in err
    ranges["robot"] = 3
    (tmp_path / "bad" / "result.json").write_text(json.dumps(content | {"ranges": ranges}))
    code, _, err = export(tmp_path / "bad", "ranges", tmp_path / "a", capsys)
    assert code == 1
    assert "result.json.ranges.robot is 3, expected text" in err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bad"]


def test_neither_inputs_nor_files_of_a_user_are_replaced(result, tmp_path, capsys):
    """A result's own URDF or log, its URDF under another name, notes; an export may be repeated."""
    inputs = ["first.csv", "robot/planar.urdf", "out/result.json", "out/planar.identified.urdf"]
    (tmp_path / "notes.txt").write_text("mine")
    files = [*(result.parent / name for name in inputs), tmp_path / "notes.txt"]
    before = [path.read_bytes() for path in files]
    for kind in ("urdf", "mjcf", "sdf", "ranges"):
        for path in files:
            code, _, err = export(result, kind, path, capsys)
            assert code == 2
            assert f"{str(path)!r}" in err.replace("\n  ", " ")
            assert "not replaced" in " ".join(err.split())
        target = tmp_path / f"again.{kind}"
        assert [export(result, kind, target, capsys)[0] for _ in range(2)] == [0, 0]
    assert [path.read_bytes() for path in files] == before
