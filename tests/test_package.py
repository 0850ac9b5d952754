"""What describes the package is true: README, recipe, citation, the texts for coding assistants."""

import re
import tomllib

import numpy as np
import pytest
import yaml
from helpers.paths import DOCS, ROOT
from helpers.synthetic import exact_log, truth

import robotid
from robotid.base.versions import __version__
from robotid.cli import COMMANDS, main
from robotid.cli.job import job_from_settings
from robotid.data.files.read import write_log
from robotid.robot.examples import example_urdf

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
README = (ROOT / "README.md").read_text()
#: Names that differ on conda-forge.
CONDA = {"pin": "pinocchio", "meshcat": "meshcat-python"}


def test_the_conda_recipe_has_the_dependencies_and_version_of_the_package():
    recipe = yaml.safe_load((ROOT / ".conda/recipe.yaml").read_text())
    names = [re.fullmatch(r"([\w-]+)(>=.+)", each).groups() for each in PROJECT["dependencies"]]
    wanted = {f"{CONDA.get(name, name)} {bound}" for name, bound in names}
    assert set(recipe["requirements"]["run"]) == wanted | {"python " + PROJECT["requires-python"]}
    assert recipe["context"]["version"] == __version__
    assert recipe["about"]["license"] == PROJECT["license"]
    (entry,) = recipe["build"]["python"]["entry_points"]
    assert entry == f"robotid = {PROJECT['scripts']['robotid']}"


def test_the_citation_has_the_version_that_the_changelog_ends_with():
    citation = yaml.safe_load((DOCS / "CITATION.cff").read_text())
    assert citation["version"] == __version__
    released = re.findall(r"^## \[(\d[\d.]*)\] - (\S+)$", (ROOT / "CHANGELOG.md").read_text(), re.M)
    assert released[0] == (__version__, str(citation["date-released"]))


def test_the_texts_for_assistants_name_commands_and_pages_that_exist(capsys):
    texts = [(DOCS / name).read_text() for name in ("llms.txt", "skill/SKILL.md")]
    lines = re.findall(r"`robotid (\w+)((?: [^`]*)?)`", "\n".join(texts))
    assert len({command for command, _ in lines}) >= 10
    for command, words in lines:
        with pytest.raises(SystemExit):
            main([command, "--help"])
        main_help = capsys.readouterr().out
        assert command in COMMANDS
        for flag in re.findall(r"--[\w-]+", words):
            assert flag in main_help, (command, flag)
    pages = re.findall(r"\]\((\S+)\.html\)", texts[0])
    assert len(pages) > 4
    assert all((DOCS / f"{page}.md").is_file() for page in pages)


def test_extras_of_the_installation_page_are_those_of_the_package():
    page = (DOCS / "how_to/install.md").read_text()
    rows = re.findall(r"^\| (`.*?) \|", page, re.M)
    assert set(re.findall(r"`(\w+)`", " ".join(rows))) == set(PROJECT["optional-dependencies"])


def block(marker):
    """Return the code under an HTML comment."""
    found = re.search(rf"<!-- {marker} -->\n```\w+\n(.*?)```", README, re.DOTALL)
    assert found, f"the README has no block {marker!r}"
    return found.group(1)


@pytest.fixture(scope="module")
def logs(tmp_path_factory, ur5):
    """A folder with robot.urdf, first.csv and second.csv, as the quick starts expect."""
    folder = tmp_path_factory.mktemp("readme")
    rng = np.random.default_rng(0)
    text = example_urdf("ur5_robot.urdf").read_text()
    # without meshes, whose triangles take seconds to be thinned for the replay
    text = re.sub("<(visual|collision)>.*?</\\1>", "", text, flags=re.DOTALL)
    (folder / "robot.urdf").write_text(text)
    for name in ("first", "second"):
        log = exact_log(ur5, truth(ur5), rng, samples=800, rate=50.0, noise=0.1)
        write_log(log, folder / f"{name}.csv")
    return folder


@pytest.fixture
def folder(logs, monkeypatch):
    monkeypatch.chdir(logs)
    return logs


def test_its_links_and_pictures_exist():
    links = re.findall(r"\]\((?!http)([^)#]+)", README)
    assert len(links) > 15
    missing = [link for link in links if not (ROOT / link).is_file()]
    assert not missing
    pictures = [ROOT / link for link in links if link.endswith(".png")]
    assert len(pictures) == 2
    assert all(10_000 < picture.stat().st_size < 200_000 for picture in pictures)


def test_the_python_quick_start_runs_and_has_ten_lines(folder, capsys):
    code = block("python quick start")
    assert len(code.strip().splitlines()) <= 10
    names = {}
    exec(compile(code, "README.md", "exec"), names)
    printed = capsys.readouterr().out
    assert "verdict good" in printed
    assert "elbow_joint" in printed
    assert names["tau"].shape == (6,)
    loaded = robotid.load_result("result")
    np.testing.assert_allclose(loaded.parameters, names["found"].standard, rtol=1e-9, atol=1e-12)
    assert names["robot"].armature.all()
    assert {"report.html", "robot.identified.urdf"} <= {
        p.name for p in (folder / "result").iterdir()
    }


def test_the_command_line_quick_start_runs(folder, capsys):
    for line in block("cli quick start").strip().splitlines():
        program, *words = line.split()
        assert program == "robotid"
        assert main(words) == 0, line
    assert "verdict: good" in capsys.readouterr().out
    written = {path.name for path in (folder / "result").iterdir()}
    table = README.partition("## What you get")[2].partition("## ")[0]
    promised = set(re.findall(r"^\| `(\S+)`", table, re.MULTILINE))
    assert promised <= written, "the table of what you get names what identify writes"
    assert (folder / "result" / "replay.html").is_file()
    assert main(["validate", "result/result.json", "second.csv"]) == 0


def test_the_recipe_is_a_job_file_for_gripper_currents_and_coupling(folder):
    job = job_from_settings(tomllib.loads(block("job: arm")), "README.md", folder)
    parts = (job.identification, job.validation, job.locked, job.gains, job.couplings)
    assert all(parts)


def test_the_equations_of_the_paper_agree_with_pinocchio(monkeypatch):
    monkeypatch.chdir(ROOT)
    names = {}
    exec(compile(block("python paper"), "README.md", "exec"), names)
    torque = names["Y"] @ names["pi"]
    assert (abs(torque) > 1.0).all()
    P = names["parameters"](names["PAPER_LINKS"])
    equations = names["regressor"](names["q"], names["v"], names["a"]) @ P
    np.testing.assert_allclose(equations, torque, rtol=1e-12)


def test_its_commands_are_those_of_ci_and_fit_one_line():
    assert len(README.splitlines()) <= 150
    for marker, option in (("demo command", ""), ("test command", " --upgrade-deps")):
        (line,) = block(marker).strip().splitlines()
        assert line.startswith(f"python3 -m venv .venv{option} && .venv/bin/pip install")
    assert "install -q . &&" in block("demo command"), "the demo needs no extra"
    assert "<!-- test command -->" in (ROOT / ".ci" / "run").read_text()
    assert "## [Unreleased]" in (ROOT / "CHANGELOG.md").read_text()
