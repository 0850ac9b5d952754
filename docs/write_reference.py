"""Write the pages of the reference that follow from the code.

``python docs/write_reference.py`` writes the keys of job files and of plants, and the findings.
"""

import math
import re
from dataclasses import MISSING
from pathlib import Path
from string import Formatter

from robotid.base.settings import Settings
from robotid.cli.job import Job, LogEntry, PayloadEntry
from robotid.data.signal_settings import (
    BaseSource,
    LogSource,
    LogUnits,
    SignalSettings,
    Transmission,
)
from robotid.diagnosis.catalogue import entries
from robotid.dynamics.simulation.simulation_settings import Simulation
from robotid.estimation.fitting.estimator_settings import ESTIMATORS, ConstraintSettings
from robotid.identification.closed_loop.loop_settings import LogGains, LoopSettings
from robotid.robot.constraints import Contact, Loop
from robotid.robot.drives import AUTO, TERMS
from robotid.robot.parameters import Coupling

REFERENCE = Path(__file__).with_name("reference")
PLANT = """# Keys of a plant

`robotid simulate --plant plant.toml` reads these keys ([simulating a log](../how_to/simulate.md)). A flag overrides the file.
"""
START = """# Job file

A job file is TOML: `robotid identify job.toml`. Only `urdf` and one `[[identification]]` are needed. A misspelt key is an error that names the nearest right one. Paths are relative to the job
file, and `$NAME` in a path is an environment variable. `result.json` has the same keys under `settings`.

Two more pages have the keys for [logs and signals](job_signals.md) and for [estimators and controllers](job_estimators.md). `python docs/write_reference.py` writes these pages from the
settings in the code. `robotid schema > job.schema.json` writes a JSON schema: with `#:schema job.schema.json` in the first line, editors complete and check a job file.

<!-- example -->
```toml
urdf = "robot.urdf"
joints = ["joint_1", "joint_2"]
locked = { finger = 0.02 }

[signals]
cutoff = 8.0
min_velocity = 0.02

[log]
topic = "/joint_states"
joints = { joint_1 = "M1" }
effort = "current"

[torque]
gains = { joint_1 = 14.87, joint_2 = 11.3 }

[[coupling]]
name = "motor_2"
ratios = { joint_1 = 1.0, joint_2 = 1.0 }

[[transmission]]
joints = ["joint_1", "joint_2"]
motors = ["m1", "m2"]
matrix = [[101.0, 0.0], [50.0, 50.0]]
efficiency = [0.8, 0.7]

[estimator]
name = "consistent"
robust = "tukey"

[estimator.constraints]
mass = { forearm = [1.0, 3.0], wrist = 0.8 }
com = { forearm = [[-0.1, -0.1, 0.0], [0.1, 0.1, 0.4]] }
pinned = ["base"]

[[identification]]
log = "first.csv"
start = 0.5
end = 30.0

[[validation]]
log = "second.csv"
```
"""
TABLES = {
    "signals": SignalSettings,
    "log": LogSource,
    "units": LogUnits,
    "base": BaseSource,
    "controller": LoopSettings,
    "estimator.constraints": ConstraintSettings,
    "[transmission]": Transmission,
    "[coupling]": Coupling,
    "[contact]": Contact,
    "[loop]": Loop,
    "[identification]": LogEntry,
    "identification.controller": LogGains,
    "[payload_check]": PayloadEntry,
}
#: The page of a table that is not on that of the job file.
PAGES = dict.fromkeys(
    ("signals", "log", "units", "torque", "base", "transmission"), "job_signals.md"
) | dict.fromkeys(("estimator", "estimator.constraints", "controller"), "job_estimators.md")

#: Ranges of numbers as the tables have them.
SHORTER = {
    "1e-9 to 1e12: a number, or a table of numbers by joint": "> 0, also by joint",
    "0 to 1e12: a number, or a table of numbers by joint": "≥ 0, also by joint",
    ": a number, or a table of numbers by joint": ", also by joint",
    "0 or a positive number": "≥ 0",
    "a positive number": "> 0",
    "a positive, finite number": "> 0",
}

LOGS = """# Job file: logs and signals

Tables of a [job file](job_file.md) for columns, units, motors, floating base, and signal processing.
"""
ESTIMATION = """# Job file: estimators

Tables of a [job file](job_file.md) for the [estimator](../explanation/estimators.md), its constraints, and the controller of [closed-loop identification](closed_loop.md).
"""
#: Parts that are added to a sentence about the residual where there is more to report.
OPTIONAL = {
    "also",
    "asked",
    "bits_of",
    "change",
    "conclusion",
    "confirmed",
    "explained",
    "locked",
    "percent",
    "widened",
}
#: The pages of findings, by the key in the catalogue: title, and what the reader must know first.
FINDINGS = {
    "refused": ("Refused logs", """These errors cannot be ignored, and no result is written. The message in the terminal also names the place and the values."""),
    "logs": ("Logs: time stamps, motion, sensors", "These findings need no model of the robot."),
    "bases": ("Logs: floating bases, contacts, loops", """See [legged robots](../../how_to/legged.md) and [closed chains](../../how_to/closed_chains.md)."""),
    "torques": ("Logs: torques and the URDF", """Before the identification, each log is fitted with masses of 0 or more, friction and motor inertia. "Unexplained" is the share of the
torque's variance that this fit leaves. The best of several explanations is reported. A validation error below 5 % turns findings on masses, gravity and unexplained torque into
notes. A known payload determines [unknown gains](../../how_to/drive_gains.md)."""),
    "commands": ("Logs: commands and positions", """These findings describe the loop between the commanded and the measured position of each joint
([servo arm](../../tutorials/servo_arm.md))."""),
    "urdf": ("URDF", """`robotid inspect robot.urdf` reports these findings. `com_outside`, `density`, `gyration` and `ellipsoid` are reported for identified bodies,
too."""),
    "result": ("Result", "These findings describe the identified parameters."),
    "residual": ("Residual of the fit", """Each candidate is fitted beside all base parameters, and counts by the share of the squared residual that it explains on held-out segments. A
missing drive term (`friction_shape` to `drift`) is a warning if it explains 25 %, is 2 % of the torque, and validation logs confirm it. Its message names the setting that adds
it: `friction`, `[drives]` or `[[coupling]]` ([friction](../../explanation/friction.md)). `position_offset` and `gravity` ([torques](torques.md)) are also reported here."""),
    "closed_loop": ("Result of closed-loop identification", """These findings describe a fit with `[estimator] name = "simulation"`
([closed-loop identification](../closed_loop.md))."""),
    "prediction": ("Validation logs", """These findings describe whether the validation logs test a new motion of the same robot
([verdict](../../explanation/verdict.md))."""),
}  # fmt: skip
FINDINGS_INDEX = """# Findings

A finding is a statement about a log, a URDF or a result. It has a code, a severity, a place (log, joint, link), a message with the remedy, and figures. No
finding changes data. An example, as `robotid doctor` prints it:

```text
warning: clipped: first.csv: the torque of elbow_joint is at its limit -20 in
  31.6 % of the rows while the robot moves: it is clipped, and these rows are
  wrong; record a slower motion, or remove these rows
```

| severity | meaning |
|---|---|
| error | The result would be wrong. The verdict is *poor*, and no URDF is written. |
| warning | The result may be wrong. Many warnings limit the verdict to *usable*. |
| note | A fact. No action is needed unless the note names one. |

The tables state the typical severity; it depends on the figures and on the use of a channel. Words in italics are figures and names, which `--json` prints, too.

- `robotid inspect` reports errors of a URDF. In `robotid identify` they are warnings, and the nearest possible body is used.
- `--verbose` adds the notes. `result.json` has the errors, warnings and findings of the fit under [`warnings`](../result_files.md).
- If you know that a finding is wrong, `ignore = ["urdf_mismatch"]` under `[doctor]` (`--ignore CODE`) removes its effect on the verdict. Only errors and warnings that
  limit the verdict can be ignored.

This page and the tables are written by `python docs/write_reference.py` from `robotid/diagnosis/catalogue.toml`.
"""


def pages():
    """Return the texts of the pages, by file name."""
    first, *sections = job_file().split("\n## ")
    texts = {
        "job_file.md": [first],
        "job_signals.md": [LOGS],
        "job_estimators.md": [ESTIMATION],
        "plant.md": [plant()],
    }
    for section in sections:
        table = section.partition("]")[0].strip("`[")
        texts[PAGES.get(table, "job_file.md")].append(section)
    written = {name: "\n## ".join(parts).rstrip() + "\n" for name, parts in texts.items()}
    return written | findings()


def findings():
    """Return the texts of the pages on findings, by file name: an index, and a table for each group."""
    index, texts = [FINDINGS_INDEX], {}
    for page, (title, words) in FINDINGS.items():
        found = {c: e for c, e in entries().items() if e["page"] == page and ":" not in c}
        index.append(f"## {title}\n\n{', '.join(f'[`{c}`]({page}.md#{c})' for c in found)}\n")
        rows = [finding_row(code, entry) for code, entry in found.items()]
        head = "| code | message | cause | remedy |\n|---|---|---|---|"
        texts[f"findings/{page}.md"] = "\n".join([f"# {title}\n", f"{words}\n", head, *rows]) + "\n"
    return {"findings/index.md": "\n".join(index), **texts}


def finding_row(code, entry):
    """Return the line of a finding; what follows a colon in its message is the cause if none is stated."""
    subject, message, cause = re.fullmatch(
        r"((?:link )?\*\w+\*: )?(.*?)(?:: (.*))?", plain(entry, "message")
    ).groups("")
    if "*" in cause and "cause" not in entry:
        cause, message = "", f"{message}: {cause}"
    about = entry.get("term") or entry.get("about") or subject + message
    cells = (about, "" if "term" in entry else entry.get("cause", cause), plain(entry, "remedy"))
    shown = " | ".join(x if x[1:2].isupper() else x[:1].lower() + x[1:] for x in cells)
    return f"| `{code}`{{#{code}}} {entry['severity']} | {shown.replace('<', '&lt;')} |"


def plain(entry, part):
    """Return the first sentence of a template, its last choice, names of slots in italics."""
    text = entry.get(part, "")
    for _ in range(3):  # parts may contain others
        for name, parts in entry.items():
            if isinstance(parts, dict):
                chosen = [x for x in parts.values() if x != "; no action needed"]
                text = text.replace(f"{{{name}}}", "" if name in OPTIONAL else chosen[-1])
    shown = ""
    for literal, name, spec, _ in Formatter().parse(text.strip(" ;.:,")):
        unit = next((x for x in (" %", " ms") if spec and spec.rstrip("~").endswith(x)), "")
        shown += literal
        if name and name not in OPTIONAL:
            shown += f"*{name.replace('_', ' ')}*{unit}"
    shown = re.sub(r" \+- \*[\w ]+\*( ms)?| \([^()]*\*[^()]*\)", "", shown)  # errors, asides
    first = re.sub(r"^(: |\. |\*cure\*|This explains [^.]*\.? ?|no action needed)+", "", shown)
    return first.split(". ")[0].strip(" ;.:,")


def job_file():
    """Return the text on job files, with a section for each table."""
    own = {
        key.at or field.name: (field, key)
        for field, key in keys(Job)
        if (key.at or field.name)
        not in {
            *TABLES,
            "model",
            "estimator",
            "transmission",
            "coupling",
            "contact",
            "loop",
            "identification",
            "validation",
            "payload_check",
        }
    }
    tables = {}
    for at, (field, key) in own.items():
        table, _, name = at.rpartition(".")
        tables.setdefault(table, []).append(row(name, field, key))
    parts = [START, "## Keys at the top\n", *listing(tables.pop(""))]
    for name, kind in TABLES.items():
        title = f"[{name}]" + "` and `[[validation]]" * (kind is LogEntry)
        about = kind.__doc__.partition("\n\nAttributes")[0].replace("\n    ", "\n")
        parts += [f"\n## `{title}`\n", f"{about.strip()}\n"]
        parts += listing([row(key.at or field.name, field, key) for field, key in keys(kind)])
        if name == "signals":
            words = "What is identified, with which drive terms ([names](symbols.md#names-of-parameters)).\n"
            parts += ["\n## `[model]`\n", words, *drive_terms(tables.pop("model"))]
        if name == "units":
            for other, rows in tables.items():
                parts += [f"\n## `[{other}]`\n", *listing(rows)]
            parts += ["\n## `[estimator]`\n", *estimators()]
    return "\n".join(parts) + "\n"


def plant():
    """Return the text of the page on the keys of a plant."""
    tables = {}
    inside = [("", Simulation)]
    for at, kind in inside:
        for field, key in keys(kind):
            if hasattr(field.type, "entries"):
                inside.append((f"{at}.{field.name}".strip("."), field.type))
            else:
                tables.setdefault(at, []).append(row(field.name, field, key))
    parts = [PLANT, *listing(tables.pop(""))]
    for name, rows in tables.items():
        parts += [f"\n## `[{name}]`\n", *listing(rows)]
    return "\n".join(parts) + "\n"


def keys(kind):
    """Return each field of a table with what it says of itself."""
    return [(field, key) for field, key, _ in kind.entries()]


def estimators():
    """Return the lines on the estimators: what they are, and who has which setting."""
    yield "| `name` | estimator |\n|---|---|"
    for name, kind in ESTIMATORS.items():
        default = ", the default" if name == "consistent" else ""
        yield f"| `{name}`{default} | {kind.paths()['name'].text} |"
    yield "\nA setting of another estimator is an error.\n"
    yield "| key | default | of | meaning |\n|---|---|---|---|"
    said = {}
    for name, kind in ESTIMATORS.items():
        for field, key in keys(kind)[1:]:
            if field.name != "constraints":
                entry = (field.name, default_of(field), meaning(key))
                said.setdefault(entry, []).append(f"`{name}`")
    for (name, default, words), owners in said.items():
        yield f"| `{name}` | {default} | {', '.join(owners)} | {words} |"


def drive_terms(rows):
    """Return the lines on the terms of the drives, behind those of other keys."""
    rows += [f'| `friction` | `"{AUTO}"` | {Job.paths()["model.friction"].words} |']
    for name, term in TERMS.items():
        if not term.is_friction:
            units = ", or ".join(term.units)
            rows.append(f"| `{name}` | `true` | Whether it is identified [{units}] |")
    return listing(rows)


def listing(rows):
    """Return the lines of a table of keys."""
    return ["| key | default | meaning |\n|---|---|---|", *rows]


def row(name, field, key):
    """Return the line of a key."""
    return f"| `{name}` | {default_of(field)} | {meaning(key)} |"


def meaning(key):
    """Return what a key is, and the range of its numbers."""
    words = (key.words[:1].upper() + key.words[1:]).replace("<dynamics>", "`<dynamics>`")
    within = "" if key.within is None else key.within.words
    for long, short in SHORTER.items():
        within = within.replace(long, short)
    return f"{words} ({within})" if within else words


def default_of(field):
    """Return a default as TOML has it."""
    if field.default is MISSING and field.default_factory is MISSING:
        return "required"
    value = field.default_factory() if field.default is MISSING else field.default
    if value is None:
        return "-"
    if isinstance(value, float) and not math.isclose(value, round(value, 6), rel_tol=1e-12):
        return f"`{value!r}`"
    words = {True: "true", False: "false"} if isinstance(value, bool) else {}
    if isinstance(value, str):
        return f'`"{value}"`'
    if isinstance(value, Settings):
        return "-"
    if isinstance(value, tuple):
        return f"`{list(value)}`"
    return "`{}`" if isinstance(value, dict) else f"`{words.get(value, value)}`"


if __name__ == "__main__":
    for name, text in pages().items():
        (REFERENCE / name).write_text(text, encoding="utf-8")
