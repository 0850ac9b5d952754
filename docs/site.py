"""Hooks of the site: a page for each command, for each robot of the gallery, and the notebook.

``mkdocs build -f .mkdocs.yml`` calls them. The gallery and the outputs of the notebook are built
where build/gallery and build/notebook are missing: remove these folders to build them again.
"""

import argparse
import json
import re
import shutil
import sys
from functools import cache
from html import escape
from importlib import import_module
from pathlib import Path

from mkdocs.structure.files import File

from robotid.cli import COMMANDS

sys.path.append(str(Path(__file__).parent))
import gallery
import notebook


def on_config(config):
    """Build what is missing, and add the robots of the gallery to the navigation."""
    if not notebook.OUTPUTS.exists():
        notebook.run()
    if not (gallery.GALLERY / "entries.json").exists():
        gallery.build_entries()
    for part in config["nav"]:
        if "Gallery" in part:
            part["Gallery"] = ["gallery.md", *(f"gallery/{name}.md" for name in entries())]


def on_files(files, config):
    """Add the pages of the commands, of the robots of the gallery, and that of the notebook."""
    for entry in entries().values():
        text = gallery_page(entry)
        files.append(File.generated(config, f"gallery/{entry['name']}.md", content=text))
    files.append(File.generated(config, "tutorials/first_steps.md", content=notebook.page()))
    for name in COMMANDS:
        text = command_page(name)
        files.append(File.generated(config, f"reference/commands/{name}.md", content=text))
    return files


def on_page_markdown(markdown, page, **_):
    """Fill in the gallery and the demo on the landing page; link the notebook's page."""
    if page.file.src_uri != "tutorials/first_steps.md":
        markdown = markdown.replace("first_steps.ipynb)", "first_steps.md)")
    if page.file.src_uri == "gallery.md":
        cards = "\n".join(map(gallery_card, entries().values()))
        return f'{markdown}\n<div class="robots">\n{cards}\n</div>\n'
    if page.file.src_uri == "index.md" and "demo" in entries():
        pictures = re.compile("<!-- demo -->.*?<!-- end of demo -->", re.DOTALL)
        return pictures.sub(frames("gallery/demo"), markdown)
    return markdown


def on_post_build(config):
    """Copy the reports and replays of the gallery, and the outputs of the notebook."""
    for made, folder in ((gallery.GALLERY, "gallery"), (notebook.OUTPUTS, "tutorials/first_steps")):
        if made.exists():
            shutil.copytree(made, Path(config["site_dir"]) / folder, dirs_exist_ok=True)


@cache
def entries():
    """Return the entries of the gallery by name."""
    return {e["name"]: e for e in json.loads((gallery.GALLERY / "entries.json").read_text())}


def gallery_card(entry):
    """Return the card of a robot: its picture, what it teaches and the command."""
    picture = (gallery.GALLERY / entry["name"] / "picture.svg").read_text()
    return (
        f'<div class="robot">\n<a href="gallery/{entry["name"]}.html">{picture}'
        f"<strong>{entry['title']}</strong></a>\n"
        f"<p>{entry['lesson']}</p>\n<code>{escape(entry['command'])}</code>\n</div>"
    )


def gallery_page(entry):
    """Return the page of one robot: its facts, the command, the live report and replay."""
    facts = "\n".join(f"- {key}: {value}" for key, value in entry["facts"].items())
    command = f"```bash\n{entry['command']}\n```"
    parts = [f"# {entry['title']}", entry["lesson"], facts, command, frames(entry["name"])]
    return "\n\n".join(parts) + "\n"


def frames(folder):
    """Return the report and the replay in a folder, each loaded when it is scrolled to."""
    return "\n\n".join(
        f'<iframe src="{folder}/{page}.html" title="{page} of {Path(folder).name}" '
        f'loading="lazy" style="width:100%;height:36rem;border:1px solid #8884"></iframe>\n\n'
        f'<a href="{folder}/{page}.html" target="_blank">Open the {page} in a tab of its own</a>'
        for page in ("report", "replay")
    )


def command_page(name):
    """Return the page of a command: what it does, its arguments and its flags, group by group."""
    module = import_module(f"robotid.cli.{name}")
    parser = argparse.ArgumentParser(prog=f"robotid {name}")
    module.add_flags(parser)
    parts = [f"# robotid {name}\n", f"{COMMANDS[name][:1].upper()}{COMMANDS[name][1:]}.\n"]
    usage = [a.metavar or a.dest for a in parser._actions if not a.option_strings]
    parts += [f"```text\nrobotid {' '.join([name, *map(shown, usage)])} [flags]\n```\n"]
    for group in parser._action_groups:
        actions = [a for a in group._group_actions if a.dest != "help"]
        if actions:
            parts += [f"## {title_of(group.title)}\n", *map(definition, actions)]
    return "\n".join(parts)


def title_of(title):
    """Return the heading of a group of flags."""
    return {"positional arguments": "Arguments", "options": "Flags"}.get(title, title)


def shown(metavar):
    """Return the words that stand for an argument."""
    return " ".join(metavar) if isinstance(metavar, tuple) else metavar


def definition(action):
    """Return an argument or a flag, with its help below."""
    values = ""
    if action.nargs != 0:
        choices = "|".join(map(str, action.choices or ()))
        values = shown(action.metavar or choices or action.dest.upper())
    words = (action.help or "").replace("%%", "%").replace("<", "&lt;") or "See above."
    return f"`{' '.join([*action.option_strings, values]).strip()}`\n:   {words}\n"
