"""Whatever a robot, a joint, a file or a verdict is called: on every page it is text."""

import json
from html import escape

import numpy as np
import pytest
from helpers.paths import URDF
from helpers.synthetic import exact_log, truth

from robotid.base.exceptions import DataError
from robotid.cli import main
from robotid.data.files.read import write_log
from robotid.output.files.result_file import read_result
from robotid.output.pages.html import page
from robotid.output.report import comparison
from robotid.robot.model import RobotModel

MARKUP = "<script>alert(1)<!--'\""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two results of a robot whose names are all markup, of files and folders that are, too."""
    folder = tmp_path_factory.mktemp("markup")
    text = (URDF / "planar_2r.urdf").read_text()
    for name in ("planar_2r", "link_1", "link_2", "joint_1", "joint_2"):
        text = text.replace(f'"{name}"', f'"{escape(MARKUP + name)}"')
    urdf = folder / f"{MARKUP}.urdf"
    urdf.write_text(text)
    model, rng = RobotModel.from_urdf(urdf), np.random.default_rng(0)
    assert model.joints == (f"{MARKUP}joint_1", f"{MARKUP}joint_2")
    for name in ("fit", "keep"):
        log = exact_log(model, truth(model), rng, samples=1000, rate=100.0, noise=0.1)
        write_log(log, folder / f"{MARKUP}{name}.parquet")
    logs = [str(folder / f"{MARKUP}{name}.parquet") for name in ("fit", "keep")]
    for estimator in ("consistent", "wls"):
        words = ["identify", str(urdf), logs[0], "--validate", logs[1], "--estimator", estimator]
        assert main([*words, "--out", str(folder / f"<b>{estimator}")]) == 0
    results = [str(folder / f"<b>{name}") for name in ("consistent", "wls")]
    assert main(["compare", *results, "--out", str(folder / "compare.html")]) == 0
    words = ["replay", str(urdf), logs[0], *results, "--ghost", logs[1]]
    assert main([*words, "--html", str(folder / "replay.html")]) == 0
    return folder


def test_no_name_becomes_markup(folder):
    pages = sorted(folder.rglob("*.html"))
    assert len(pages) == 4
    for made in pages:
        text = made.read_text(encoding="utf-8")
        assert "alert(1)" in text
        assert "<script>alert" not in text, made.name
        assert "<b>" not in text.partition("<body>")[2].partition("<script")[0], made.name


def test_a_status_of_another_program_is_refused_and_escaped(folder, tmp_path):
    result = json.loads((folder / "<b>wls" / "result.json").read_text())
    result["verdict"]["status"] = 'good"><script>alert(1)</script>'
    path = tmp_path / "result.json"
    path.write_text(json.dumps(result))
    with pytest.raises(DataError, match=r"verdict.status is .*, wanted one of good, usable"):
        read_result(path)
    shown = {"label": "A", "name": "", "path": "", "estimator": "", "verdict": result["verdict"]}
    text = page("", comparison._verdict(shown), {})
    assert "<script>alert" not in text
