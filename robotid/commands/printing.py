"""What the commands found as text: lines that fit the terminal, columns, a little colour."""

import re
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robotid._text import columns, in_digits_of, terminal_width, tinted, wrapped
from robotid.findings import Finding, grouped, listed

if TYPE_CHECKING:
    from robotid.report.advice import Step

__all__ = ["print_content", "print_files", "print_steps", "say"]


_TERM = re.compile(r" [+-] ")  # what stands before each further term of an expression


def say(text: str, hang: str = "", tone: str = "") -> None:
    """Print text in lines that the terminal holds.

    Args:
        text: The text.
        hang: What a line that goes on begins with.
        tone: A word of it that is shown in its colour, as "error" is, on a terminal that has some;
            the environment variable NO_COLOR ends it.
    """
    print(tinted(wrapped(text, terminal_width(), hang), tone, tone, sys.stdout))


def print_content(
    command: str, content: dict[str, Any], *, is_verbose: bool = False, with_base: bool = False
) -> None:
    """Print what a command found.

    Args:
        command: Its name.
        content: What it prints with ``--json``.
        is_verbose: Whether to print notes, too.
        with_base: Whether "inspect" prints the base parameters.
    """
    prints: Mapping[str, Callable[[dict[str, Any]], None]] = {
        "paper": _print_paper,
        "inspect": partial(_print_inspection, is_verbose=is_verbose, with_base=with_base),
        "identify": partial(_print_result, is_verbose=is_verbose),
        "preview": partial(_print_preview, is_verbose=is_verbose),
        "track": _print_track,
        "doctor": partial(_print_examination, is_verbose=is_verbose),
        "validate": _print_validation,
        "payload": _print_payload,
        "report": lambda done: print(f"written: {done['report']}"),
        "compare": _print_comparison,
        "excite": _print_motion,
        "export": _print_export,
        "convert": _print_conversion,
        "simulate": _print_simulation,
    }
    prints[command](content)


def print_files(folder: str, names: Sequence[str]) -> None:
    """Print which files were written, each on a line of its own.

    Args:
        folder: Where.
        names: Their names.
    """
    print("\nwritten:")
    for name in names:
        print(f"  {Path(folder) / name}")


def print_steps(steps: "Sequence[Step]") -> None:
    """Print what to do next, each step with what to type, on lines to copy.

    Args:
        steps: The steps.
    """
    print("\ndo next:")
    for number, step in enumerate(steps, start=1):
        say(f"  {number}. {step.words}", "   ")
        for block in step.blocks:
            print("\n".join(f"       {line}" for line in block.split("\n")))


def _print_block(*lines: str) -> None:
    print("\n" + "\n".join(lines))


def _print_causes(
    findings: Sequence[Mapping[str, Any]],
    joints: Sequence[str],
    *,
    is_verbose: bool,
    worst: str = "",
    said: Sequence[str] = (),
) -> None:
    """Print findings by their cause, then how many there are; notes only where they are wanted.

    Args:
        findings: As a command has them, with code, severity, message and where.
        joints: Names, of joints or links, that findings may be about.
        is_verbose: Whether notes are printed.
        worst: What is worst off.
        said: Messages that are printed elsewhere.
    """
    shown = [f for f in findings if is_verbose or f["severity"] != "note"]
    causes = grouped([Finding(**_finding(f)) for f in shown], joints)
    for cause in causes:
        for message in cause.messages:
            if message not in said:
                say(f"{cause.severity}: {cause.code}: {message}", "  ", cause.severity)
    hidden = len(findings) - len(shown)
    notes = f"{_some(hidden, 'note')} hidden (--verbose)" if hidden else ""
    if shown:
        count = f"{_some(len(shown), 'finding')}, {_some(len(causes), 'cause')}"
        notes = count + (f"; worst: {worst}" if worst else "") + (f"; {notes}" if notes else "")
    say(notes or "nothing was found")


def _finding(found: Mapping[str, Any]) -> dict[str, Any]:
    return {key: found[key] for key in ("code", "severity", "where", "message")}


def _some(count: int, what: str) -> str:
    return f"{count} {what}{'' if count == 1 else 's'}"


def _print_result(result: dict[str, Any], *, is_verbose: bool) -> None:
    from robotid.identification.summary import error_lines, friction_lines

    if "simulation" in result:
        _print_commanded(result, is_verbose=is_verbose)
        return
    structure, wls, width = result["structure"], result["wls"], terminal_width()
    before, after, _ = result["witness"]["masses"]
    say(
        f"\n{result['robot']}: {len(result['joints'])} joints, {structure['base']} base parameters "
        f"({structure['base_inertial']} inertial), condition number {structure['condition']:.3g}, "
        f"total mass {before:.2f} -> {after:.2f} kg"
    )
    fitted, kept = (_recordings(result["inputs"], of) for of in ("identification", "validation"))
    say(f"\nfitted: {', '.join(fitted)}", "  ")
    print("\n".join(error_lines(result["identification"], wls["identification"], width)))
    for name, ours, theirs in zip(kept, result["validation"], wls["validation"], strict=True):
        say(f"\nnot fitted: {name}", "  ")
        print("\n".join(error_lines(ours, theirs, width)))
    if lines := friction_lines(result["friction"]):
        _print_block(*(wrapped(line, width, "  ") for line in lines))
    print()
    verdict = result["verdict"]
    _print_causes(
        result["warnings"],
        result["joints"],
        is_verbose=is_verbose,
        worst="" if verdict["status"] == "good" else _worst(result),
        said=verdict["reasons"],
    )
    _print_verdict(verdict)


def _print_commanded(result: dict[str, Any], *, is_verbose: bool) -> None:
    """Print what was found from commands: open loops beside plainer models, drives, the verdict."""
    found, fit = result["simulation"], result["simulation"]["fit"]
    say(
        f"\n{result['robot']}: {len(result['joints'])} joints, {fit['parameters']} unknowns; "
        f"{fit['message']}"
    )
    for role, words in (("identification", "fitted"), ("validation", "not fitted")):
        for run in found[role]:
            _print_open_loop(run, f"{words}: ")
    rows = []
    for entry in result["drive_parameters"]:
        error = entry["std_error"]
        if error is not None:
            rows.append((entry["name"], f"{entry['value']:.4g}", f"{error:.2g}", entry["unit"]))
    heads = ("parameter", "value", "+-", "unit")
    print("\n" + "\n".join(columns(heads, rows)) + "\n")
    _print_causes(result["warnings"], result["joints"], is_verbose=is_verbose)
    _print_verdict(result["verdict"])


def _print_open_loop(run: Mapping[str, Any], before: str = "") -> None:
    """Print how far open loops run from a log, beside plainer models."""
    from robotid.commanded.errors import DRIFTS  # imports numpy

    kinds = {"rmse": "open loop", "second_order_rmse": "2nd order", "urdf_rmse": "URDF",
             "rows_rmse": "torques alone", "command_rmse": "command",
             "steady_rmse": "same speed"}  # fmt: skip
    joints = run["per_joint"]
    kinds = {
        k: v for k, v in kinds.items() if any(own.get(k) is not None for own in joints.values())
    }
    is_driven = any("steady_rmse" in own for own in joints.values())
    over = f" over {DRIFTS:g} s" if is_driven else ""
    say(f"\n{before}{_window(Path(run['log']).name or 'log', run)}, position missed{over}", "  ")
    rows = []
    for joint, own in joints.items():
        shown = ("-" if own[key] is None else f"{1e3 * own[key]:.2f}" for key in kinds)
        rows.append((joint, *shown, f"m{own['unit']}"))
    print("\n".join(columns(("joint", *kinds.values(), ""), rows)))


def _recordings(inputs: Sequence[Mapping[str, Any]], role: str) -> list[str]:
    """Return the file of each recording of a role, with its path if others have its name."""
    paths = {Path(entry["path"]) for entry in inputs}
    names = [path.name for path in paths]
    files = {str(path): path.name if names.count(path.name) == 1 else str(path) for path in paths}
    return [
        _window(files[str(Path(entry["path"]))] or "log", entry)
        for entry in inputs
        if entry["role"] == role
    ]


def _window(name: str, entry: Mapping[str, Any]) -> str:
    """Return the name of a recording with the stretch of its log."""
    return f"{name} {entry['start']:.4g}-{entry['end']:.4g} s"


def _worst(result: Mapping[str, Any]) -> str:
    """Return the joint whose torque is explained least, and how much of it is missed."""
    errors = [
        (m["relative_error_pct"], joint)
        for metrics in result["validation"] or [result["identification"]]
        for joint, m in metrics["per_joint"].items()
        if m["relative_error_pct"] is not None
    ]
    return "{1}, {0:.1f} % of its torque is missed".format(*max(errors)) if errors else ""


def _print_verdict(verdict: Mapping[str, Any]) -> None:
    from robotid.identification.summary import verdict_lines

    first, *others = verdict_lines(verdict)
    say(f"\n{first}", tone=verdict["status"])
    for line in others:
        status = line.partition(": ")[2].partition(":")[0]
        say(line, "  ", "" if line.startswith("  - ") else status)


def _print_validation(found: dict[str, Any]) -> None:
    from robotid.identification.summary import error_lines

    say(f"predicted with {found['predicted_with']}")
    for recording in found["validation"]:
        if "horizons" in recording:
            _print_open_loop(recording)
            continue
        say(f"\n{recording['name']}", "  ")
        print("\n".join(error_lines(recording, width=terminal_width())))
    _print_verdict(found["verdict"])


def _print_inspection(content: dict[str, Any], *, is_verbose: bool, with_base: bool) -> None:
    structure, joints = content["structure"], content["joints"]
    findings = [
        {**finding, "where": finding.get("link") or finding.get("joint") or ""}
        for finding in content["findings"]
    ]
    if content["robot"]:
        say(f"{content['robot']}: {len(joints)} joints: {listed(joints)}", "  ")
    if structure:
        say(
            f"{structure['standard']} standard inertial parameters, {structure['base_inertial']} "
            f"base; with drives {structure['base']}"
        )
    names = list(dict.fromkeys([*joints, *(finding["where"] for finding in findings)]))
    _print_causes(findings, [name for name in names if name], is_verbose=is_verbose)
    if with_base:
        print("\nbase parameters, inertial")
        for group in content["base_groups"]:
            say(f"  {group}", "    ")
    elif structure:
        say("the base parameters: --base")


def _print_examination(content: dict[str, Any], *, is_verbose: bool) -> None:
    findings, joints = content["findings"], content["joints"]
    _print_causes(findings, joints, is_verbose=is_verbose, worst=_worst_of(findings, joints))


def _worst_of(findings: Sequence[Mapping[str, Any]], joints: Sequence[str]) -> str:
    """Return the joint that most errors are about, then warnings, then the gravest by figure."""
    ranks = dict.fromkeys(joints, (0, 0, 0.0))
    for finding in findings:
        (cause,) = grouped([Finding(**_finding(finding))], joints)
        for joint in cause.joints:
            errors, warnings, share = ranks[joint]
            ranks[joint] = (
                errors + (cause.severity == "error"),
                warnings + (cause.severity == "warning"),
                max(share, finding["evidence"].get("share", 0.0)),
            )
    worst = max(ranks, key=lambda joint: ranks[joint], default="")
    return worst if any(ranks.get(worst, ())[:2]) else ""


def _print_motion(content: dict[str, Any]) -> None:
    done = f"in {content['seconds']:.1f} s"
    if content["starts"]:
        plural = "start" if content["starts"] == 1 else "starts"
        done = f"{content['starts']} {plural} {done}, "
        done += "settled" if content["converged"] else "not settled: more --seconds may improve it"
    condition = content["condition_number"]
    say(
        f"{content['robot']}: a motion of {content['duration']:g} s for {len(content['joints'])} "
        f"joints, condition number {'infinite' if condition is None else format(condition, '.0f')};"
        f" {done}"
    )
    if "widest" in content:
        names = content["widest"]
        say(f"made for what the logs given know the least: {listed(names, 5)}", "  ")
    print("\nwhat it leaves of each limit, least where")
    for name, margin in content["limits"].items():
        say(f"  {name:13} {_margin(name, margin)}", 16 * " ")
    if "payload" in content:
        print()
        for words in content["payload"]["words"]:
            say(words)


def _margin(name: str, margin: Mapping[str, Any]) -> str:
    """Return in words what a motion leaves of a limit."""
    if name != "collision":
        return f"{100 * margin['margin']:5.1f} %  {margin['where']}"
    said = "no links or obstacles come near each other"
    if margin["margin"] is not None:
        apart, time = 1e3 * margin["margin"], margin["time"]
        kept = 1e3 * margin["kept"]
        said = f"{apart:5.1f} mm beyond {kept:.0f} mm, {margin['where']} at {time:.2f} s"
    if margin["unread"]:
        said += f"; not looked at, since no shape can be read: {listed(margin['unread'])}"
    if margin["left_alone"]:
        said += f"; made to touch and not looked at: {listed(margin['left_alone'])}"
    if margin["built_near"]:
        said += f"; built near each other, kept apart by: {listed(margin['built_near'])}"
    return said


def _print_comparison(content: dict[str, Any]) -> None:
    from robotid.identification.summary import cell

    results = content["results"]
    labels = [result["label"] for result in results]
    for result in results:
        verdict = result["verdict"]["status"]
        said = f"{result['label']}  {verdict:7} {result['estimator']:10} "
        print(tinted(f"{said}{result['path']}", verdict, verdict, sys.stdout))
    for remark in content["remarks"]:
        say(f"- {remark}", "  ")
    alike = "" if content["fitted_alike"] else "; other recordings, not comparable"
    tables = [
        (f"not fitted: {_window(entry['name'], entry)}, error %", entry["per_joint"])
        for entry in content["validation"]
    ]
    tables.append((f"fitted recordings of each, error %{alike}", content["fitted"]))
    for title, per_joint in tables:
        rows = [[e["joint"], *map(cell, e["relative_error_pct"])] for e in per_joint]
        say(f"\n{title}", "  ")
        print("\n".join(columns(["joint", *labels], rows)))
    _print_base_parameters(content, labels)
    for key in ("settings", "versions"):
        for row in content[key]:
            say(f"{key}: {row['name']}: {' | '.join(v or '-' for v in row['values'])}", "  ")
    for row in content["inputs"]:
        if not all(row["in"]):
            read = listed(label for label, has in zip(labels, row["in"], strict=True) if has)
            name = row["path"] if row["start"] is None else _window(row["path"], row)
            say(f"only {read} read {name} ({row['role']})", "  ")


def _print_base_parameters(content: Mapping[str, Any], labels: Sequence[str]) -> None:
    say(
        "\nbase parameters to the second digit of their standard errors; last columns: difference "
        f"to {labels[0]} over the combined standard error, the largest first"
    )
    rows = []
    for entry in content["base_parameters"]:
        pairs = zip(entry["values"], entry["std_errors"], strict=True)
        values = ["-" if x is None else in_digits_of(x, error)[0] for x, error in pairs]
        differences = [
            "-" if x is None else f"{round(x, 1) + 0.0:.1f}" for x in entry["differences"]
        ]
        rows.append([entry["name"], *values, entry["unit"], *differences])
    heads = ["", *labels, "", *[f"{label}-{labels[0]}" for label in labels[1:]]]
    print("\n".join(columns(heads, rows, left=(0, len(labels) + 1))))


def _print_preview(content: dict[str, Any], *, is_verbose: bool) -> None:
    motions = _recordings(content["motions"], "motion")
    count = f"{content['structure']['base']} base parameters, by {content['estimator']}"
    say(f"{content['robot']}: {', '.join(motions)}; {count}", "  ")
    say("\nbase parameters: standard errors to be expected, and the share of the plausible spread")
    keys = {"std_error_before": "before", "gain": "gain", "achieved_std_error": "achieved",
            "ratio": "ratio"}  # fmt: skip
    keys = {key: head for key, head in keys.items() if key in content["base_parameters"][0]}
    rows = []
    for entry in content["base_parameters"]:
        error, more = entry["std_error"], len(_TERM.findall(entry["expression"]))
        short = f"{entry['name']} + {more} more" if more else entry["name"]
        left = "open" if error is None else f"{100 * min(error / entry['plausible'], 1):.0f} %"
        name = entry["expression"] if is_verbose else short
        rows.append([name, _two_digits(error), entry["unit"], left,
                     *(_two_digits(entry[key]) for key in keys)])  # fmt: skip
    print("\n".join(columns(["", "+-", "", "left", *keys.values()], rows, left=(0, 2))))
    parameters = [*content["standard_parameters"], *content["drive_parameters"]]
    sources = [entry["source"] for entry in parameters]
    counts = [f"{sources.count(source)} {source}" for source in dict.fromkeys(sources)]
    say(f"\nstandard parameters, given the URDF: by {listed(counts)}", "  ")
    if is_verbose:
        rows = [
            [e["name"], f"{e['prior']:.4g}", _two_digits(e["std_error"]), e["unit"], e["source"]]
            for e in parameters
        ]
        print("\n".join(columns(["", "prior", "+-", "", "by"], rows, left=(0, 3, 4))))
    else:
        say("each of them, and what is in each base parameter: --verbose")
    _print_expected_torque(content)
    say(f"\n{content['words']}", "  ")
    if "achieved" in content:
        achieved = content["achieved"]
        say(
            f"\nthese logs were identified: {achieved['count']} standard errors became "
            "{:.2f} to {:.2f} times what was expected, eight of ten; median {:.2f}".format(
                *achieved["range_80"], achieved["median"]
            )
        )


def _print_expected_torque(content: Mapping[str, Any]) -> None:
    """Print each joint's torque with its band, and the noise that all rests on."""
    say(
        "\ntorque of the motion, 95 % band of a measurement about its prediction, and the part of "
        "that which is due to the parameters"
    )
    rows, noises = [], content["noise"].values()
    found = ["achieved"] if all("achieved" in noise for noise in noises) else []
    for (joint, torque), noise in zip(content["torque"].items(), noises, strict=True):
        cells = [f"{torque[key]:.3g}" for key in ("rms", "half_width", "of_parameters")]
        achieved = [_two_digits(noise[key]) for key in found]
        rows.append([joint, *cells, _two_digits(noise["std"]), *achieved, torque["unit"],
                     f"{noise['correlation']:.2g} s", noise["is"]])  # fmt: skip
    heads = ["joint", "torque", "band", "part", "noise", *found, "", "over", ""]
    print("\n".join(columns(heads, rows, left=(0, len(heads) - 3, len(heads) - 1))))
    if any(noise["is"] == "assumed" for noise in noises):
        say(
            "assumed noise is 1 % of the URDF's effort limit, or of the bodies' largest torque "
            "where there is none. Standard errors are in proportion to it: state it with --noise "
            "JOINT=N_M, or take it from a run before with --given RESULT",
            "  ",
        )


def _two_digits(value: float | None) -> str:
    return "-" if value is None else f"{value:.2g}"


def _print_track(found: dict[str, Any]) -> None:
    converged = found["converged_at"]
    when = "not converged" if converged is None else f"converged at {converged:.2f} s"
    say(
        f"{found['robot']}: {found['samples']} samples, estimate {1e3 * found['delay']:.0f} ms "
        f"behind, {when}, excitation {found['excitation']:.2f}"
    )
    for change in found["changes"]:
        load = change["payload"]
        mass, error = in_digits_of(load["mass"], load["std_error"])
        say(
            f"step change at {change['onset']:.2f} s, flagged at {change['flagged']:.2f} s; as a "
            f"load on {load['body']}: {mass} +- {error} kg",
            "  ",
        )
    rows = []
    for entry in found["base_parameters"]:
        value, error = in_digits_of(entry["value"], entry["std_error"])
        rows.append([entry["name"], value, f"+- {error}", entry["unit"]])
    print("\n".join(columns(["", "", "", ""], rows, left=(0, 2, 3))[1:]))


def _print_payload(content: dict[str, Any]) -> None:
    from robotid.identification.summary import cell

    for found in content["payloads"]:
        _print_one_payload(found)
    errors = [f"{joint} {cell(x)} %" for joint, x in content["relative_error_pct"].items()]
    say(f"torque left unexplained: {listed(errors)}", "  ")
    if "gains" in content:
        print("\n[torque.gains]")
        for joint, gain in content["gains"].items():
            low, high = gain["interval"]
            value, _ = in_digits_of(gain["gain"], gain["std_error"])
            print(f"{joint} = {value}  # 95 % interval {low:.4g} to {high:.4g}")


def _print_one_payload(found: Mapping[str, Any]) -> None:
    link, (low, high) = found["link"], found["mass_interval"]
    mass, error = in_digits_of(found["mass"], found["mass_std_error"])
    print(f"payload on {link}")
    if error == "-":
        print(f"  mass {found['mass']:g} kg, stated")
    else:
        low, high = (in_digits_of(end, found["mass_std_error"])[0] for end in (low, high))
        say(
            f"  mass {mass} kg (95 % interval {low} to {high}, in the scale of the torques: gains "
            "that are too large make it too large)",
            "  ",
        )
    if found["com"] is not None:
        print(f"  centre of mass in the frame of {link} [m]")
        rows = [
            [axis, *_with_error(x, error)]
            for axis, x, error in zip("xyz", found["com"], found["com_std_error"], strict=True)
        ]
        _print_values(rows)
    if found["inertia"] is not None:
        for where, key in (
            ("its centre of mass", "inertia"),
            (f"the origin of {link}", "inertia_at_link"),
        ):
            say(f"  inertia about {where}, axes of {link} [kg m^2]", "  ")
            errors = found["inertia_std_error"] if key == "inertia" else None
            rows = [
                [f"I{'xyz'[i]}{'xyz'[j]}", *_with_error(found[key][i][j], errors and errors[i][j])]
                for i in range(3)
                for j in range(i, 3)
            ]
            _print_values(rows)
    for name, reason in found["reasons"].items():
        what = "centre of mass" if name == "com" else name
        say(f"  {what}: not determined; {reason}", "  ")


def _with_error(value: float, error: float | None) -> list[str]:
    """Return a value in the digits of its error, and that error, as cells."""
    shown, half = in_digits_of(value, error)
    return [shown, "" if half == "-" else f"+- {half}"]


def _print_values(rows: Sequence[Sequence[str]]) -> None:
    for line in columns([""] * len(rows[0]), rows, left=(0, 2))[1:]:
        print(f"  {line}")


def _print_export(done: dict[str, Any]) -> None:
    print(f"written: {', '.join(done['files'])}")
    for note in done["not_stated"]:
        say(f"  {note}", "  ")


def _print_conversion(done: dict[str, Any]) -> None:
    print(f"{done['path']}: {done['samples']} samples of {len(done['joints'])} joints")
    say(f"  columns {', '.join(done['columns'])}", "  ")
    if done["ignored"]:
        say(f"  not of a joint, left out: {', '.join(done['ignored'])}", "  ")


def _print_paper(result: dict[str, Any]) -> None:
    cases = {"disturbed": "disturbed", "noisy": "noisy", "on_program": "on program"}
    print("relative error of the parameters; the last three cases at the end")
    print("  model       start   after 1   at end   " + "  ".join(cases.values()) + "   NA")
    for name, model in result["models"].items():
        errors = model["relative_error"]
        ends = [result[case][name]["relative_error"][-1] for case in cases]
        cells = [errors[0], errors[1], errors[-1], *ends]
        print(f"  {name:10}" + "".join(f"{cell:9.2g}" for cell in cells) + f"   {model['NA']}")
    print("\nrandom motions that converged to 1e-3")
    for name, found in result["trajectories"].items():
        print(f"  {name:10} {found['converged']} of {found['runs']}")


def _print_simulation(content: dict[str, Any]) -> None:
    print(
        f"{content['robot']}: {content['samples']} samples over {content['duration']:g} s, seed "
        f"{content['settings']['seed']}"
    )
    noise = content["settings"].get("sensors", {}).get("noise", {})
    if not any(noise.get(kind) for kind in ("tau", "torque")):
        say(
            "no noise was added to the torques: errors of parameters from this log are smaller "
            "than those of a recorded one, and than those of a preview, which takes noise into "
            "account; state it with --torque-noise 0.02, a share of the torque"
        )
    head = "error of the position"
    width = max(len(head), *(len(joint) for joint in content["joints"]))
    print(f"\n{head:{width}}  rms, largest")
    for joint in content["following"]:
        line = f"{joint['joint']:{width}}  {joint['rms']:.2g}, {joint['largest']:.2g}"
        line += f" {joint['unit']}"
        if joint["at_limit"] > 0:
            line += f"; at its effort limit for {100 * joint['at_limit']:.2g} % of the time"
        print(line)
