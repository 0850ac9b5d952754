"""What describes the package is true: recipe, citation, the texts for coding assistants."""

import re
import tomllib

import pytest
import yaml
from helpers.paths import DOCS, ROOT

from robotid.base.versions import __version__
from robotid.cli import COMMANDS, main

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
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
        assert command in COMMANDS
        for flag in re.findall(r"--[\w-]+", words):
            main_help = help_of(command, capsys)
            assert flag in main_help, (command, flag)
    pages = re.findall(r"\]\((\S+)\.html\)", texts[0])
    assert len(pages) > 4
    assert all((DOCS / f"{page}.md").is_file() for page in pages)


def help_of(command, capsys):
    with pytest.raises(SystemExit):
        main([command, "--help"])
    return capsys.readouterr().out


def test_extras_of_the_installation_page_are_those_of_the_package():
    page = (DOCS / "how_to/install.md").read_text()
    listed = {
        name
        for row in re.findall(r"^\| (`.*?) \|", page, re.M)
        for name in re.findall(r"`(\w+)`", row)
    }
    assert listed == set(PROJECT["optional-dependencies"])
