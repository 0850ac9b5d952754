"""The page of the paper's simulation: figures and tables with explanations."""

from collections.abc import Mapping
from html import escape
from typing import Any

import numpy as np

from robotid.base.versions import __version__
from robotid.output.pages.html import Cell, code, figure, number, page, table, text
from robotid.paper.study import CASES


def paper_page(content: Mapping[str, Any], figures: Mapping[str, tuple[str, str]]) -> str:
    """Return the page."""
    shown = {name: figure(escape(caption), svg) for name, (caption, svg) in figures.items()}
    first = [shown[name] for name in ("figure_3a", "figure_3b", "figure_4a", "figure_4b")]
    sections = {
        "result": (
            "Accuracy of the estimates",
            _result_table(content) + _parameter_tables(content) + _vector_table(content),
        ),
        "figures": ("The paper's figures", "".join([*first, shown["figure_5"]])),
        "convergence": ("Proximity and error", shown["convergence"]),
        "disturbance": ("Disturbance and noise", _disturbance(content) + shown["disturbance"]),
        "trajectories": ("Random trajectories", _trajectories(content) + shown["trajectories"]),
        "errata": ("Errata", _errata(content)),
        "energy": ("Energy", _energy(content) + shown["energy"]),
        "settings": ("Settings", _settings(content)),
    }
    return page("The paper's simulation", _summary(content), sections)


def _summary(content: Mapping[str, Any]) -> str:
    models = content["models"]
    last = {name: model["relative_error"][-1] for name, model in models.items()}
    status = "good" if max(last.values()) <= 1e-4 else "poor"
    count = len(next(iter(models.values()))["relative_error"]) - 1
    reached = "".join(
        f"<li>{escape(name)}: relative error {number(error, '.2g').html}; with a start on the "
        "program instead of one degree off it: "
        f"{number(content['on_program'][name]['relative_error'][-1], '.2g').html}</li>"
        for name, error in last.items()
    )
    beside = np.degrees(np.max(np.abs(content["settings"]["start_beside_program_rad"])))
    gains = [content["on_program"][n]["relative_error"][-1] / error for n, error in last.items()]
    start = (
        f"<p>These errors depend on the start, {beside:.3g} degree off the program: the transient "
        "of the controller excites the parameters more than the program does. With a start on the "
        f"program, the error after the same {count} iterations is {min(gains):.2g} to "
        f"{max(gains):.2g} times as large.</p>\n"
    )
    return (
        "<h1>Extracting inertial parameters: the paper's simulation</h1>\n"
        f'<div class="verdict {status}"><p>After <strong>{count} iterations</strong> from half of '
        f"the parameters</p><ul>{reached}</ul>{start}</div>\n"
        "<p>The parameters of the planar arm of G. V. Tzvetkova's paper are identified during the "
        "program motion (28). One iteration is one run of that motion. There are three models: "
        "as printed, with the corrected regressor (five columns), and the physical arm (four "
        "parameters).</p>\n"
        f'<p class="note">Written by robotid {__version__}. Numbers of equations are those of the '
        "paper.</p>\n"
    )


def _result_table(content: Mapping[str, Any]) -> str:
    rows = []
    for name, model in content["models"].items():
        errors = model["relative_error"]
        picked = [number(errors[k], ".2g") for k in (0, min(1, len(errors) - 1))]
        picked.append(number(errors[10] if len(errors) > 10 else None, ".2g"))
        picked.append(number(errors[-1], ".2g"))
        rows.append(
            [
                text(name),
                *picked,
                number(content["on_program"][name]["relative_error"][-1], ".2g"),
                number(model["NA"], "d"),
                number(content["one_shot"][name], ".2g"),
            ]
        )
    headers = ["model", "start", "after 1", "after 10", "at the end", "start on program"]
    headers += ["NA (25)", "one-shot (18)"]
    note = (
        "<p>The paper does not state where the robot starts. With a start exactly on the program, "
        "the samples of all runs are near one curve and the error decreases slowly. In the main "
        "simulation joint 1 starts one degree off the program. NA is the iteration in which PRX "
        "(23) is zero for the first time; a dash: not within the allowed iterations. Without "
        "disturbance, the one-shot update (18) needs a single run.</p>\n"
    )
    return note + table("Relative error |P̂ − P| / |P|", headers, rows)


def _parameter_tables(content: Mapping[str, Any]) -> str:
    parts = []
    for name, model in content["models"].items():
        rows = [
            [code(parameter), number(true), number(found, ".7g"), number(found - true, ".1e")]
            for parameter, true, found in zip(
                model["names"], model["P_true"], model["P_hat"][-1], strict=True
            )
        ]
        headers = ["parameter", "true", "estimate", "difference"]
        parts.append(table(f"{name}: parameters at the end [kg m²]", headers, rows))
    return "".join(parts)


def _vector_table(content: Mapping[str, Any]) -> str:
    vector = content["inertial_vector"]
    values = zip(vector["names"], vector["true"], vector["identified"], strict=True)
    rows = [[code(name), number(true), number(found, ".7g")] for name, true, found in values]
    return (
        "<p>The physical arm's inertial parameters in the order of (9)-(10), about the joint "
        "frames. The torque determines four sums of the twenty. The identified values are those "
        "nearest to the initial values (half of the true ones) that have the four sums P̂. "
        "Parameters without effect on the torque are equal to the initial values.</p>\n"
        + table("Inertial vector (9)-(10), SI units", ["parameter", "true", "identified"], rows)
    )


def _disturbance(content: Mapping[str, Any]) -> str:
    rows = [
        [
            text(name),
            text(CASES[case].title),
            number(entry["relative_error"][-1], ".2g"),
            number(entry["last_tenth"], ".2g"),
            number(entry["averaged"], ".2g"),
            text("yes" if entry["converged"] else "no", flag=not entry["converged"]),
        ]
        for case in ("disturbed", "noisy", "noisy_dead_zone")
        for name, entry in content[case].items()
    ]
    headers = ["model", "case", "at the end", "mean of last tenth", "of averaged P̂", "≤ 10⁻⁴"]
    reason = next(iter(content["disturbed"].values()))["reason"]
    return f"<p>{escape(reason)}</p>\n" + table("Relative error at the end", headers, rows)


def _trajectories(content: Mapping[str, Any]) -> str:
    rows = []
    for key, start in (
        ("trajectories", "up to 0.05 rad off"),
        ("trajectories_on_program", "on"),
    ):
        for name, found in content[key].items():
            reached = found["iterations"] or [float("nan")]
            rows.append(
                [
                    text(name),
                    text(f"{start} the program"),
                    number(found["runs"], "d"),
                    number(found["converged"], "d"),
                    *(number(float(np.percentile(reached, p)), ".0f") for p in (0, 50, 90, 100)),
                    number(found["most_iterations"], "d"),
                ]
            )
    headers = ["model", "start", "runs", "converged", "least", "median", "90 %", "most", "allowed"]
    note = (
        "<p>Random motions (28), initial values (0.3 to 1.7 times each parameter), gains and "
        "starts. A run has converged if its relative error is below 10⁻³.</p>\n"
    )
    parts = [note, table("Iterations to a relative error of 10⁻³", headers, rows)]
    for key, title in (("trajectories", ""), ("trajectories_on_program", ", start on the program")):
        parts.append(_failure_table(content[key], title))
    return "".join(parts)


def _failure_table(by_model: Mapping[str, Any], title: str) -> str:
    rows: list[list[Cell]] = []
    for name, found in by_model.items():
        kinds: dict[str, list[float]] = {}
        for failure in found["failures"]:
            kind = failure["reason"].split(":")[0].split(" in iteration")[0].split(",")[0]
            kinds.setdefault(kind, []).append(failure["relative_error"])
        for kind, errors in kinds.items():
            cells = [number(len(errors), "d"), number(float(np.median(errors)), ".2g")]
            rows.append([text(name), text(kind), *cells, number(max(errors), ".2g")])
    if not rows:
        return ""
    headers = ["model", "reason", "runs", "median error", "largest error"]
    return table(f"Runs without convergence{title}; all are listed in paper.json", headers, rows)


def _errata(content: Mapping[str, Any]) -> str:
    rows = [
        [
            code(entry["where"]),
            Cell(escape(entry["printed"])),
            Cell(escape(entry["corrected"])),
            number(entry["max_torque_difference"], ".1f"),
            number(entry["max_torque_difference_on_program"], ".1f"),
        ]
        for entry in content["errata"]
    ]
    headers = ["where", "printed", "corrected", "anywhere [N m]", "on the program [N m]"]
    return (
        "<p>Largest torque difference on the physical arm. Anywhere: random states within π rad, "
        "10 rad/s and 20 rad/s². (23) changes no torque of the arm. Its row is the residual "
        "ΨP̂ + u with the printed sign at the true parameters, where it should be 0: with this "
        "sign the procedure never stops.</p>\n"
        "<p>(22) in (23): u of (21) is linear in P̂, so that u = ΨP̂ with its gradient Ψ (22), and "
        "PRX = Ψᵀ(ΨP̂ − u) = 0 for every P̂: as printed, λ is 0 and no parameter is updated. "
        "Therefore the regressor in (23) is that of the measured acceleration, Ψ = G(q, q̇, q̈). "
        "The row is its residual ΨP̂ − u at half of the parameters, where the printed one is 0."
        "</p>\n" + table("Errata", headers, rows)
    )


def _energy(content: Mapping[str, Any]) -> str:
    drift = content["energy_drift"]
    rows = [
        [text(name), number(100 * value, ".3g")] for name, value in drift["max_relative"].items()
    ]
    return (
        f"<p>Free motion for {drift['duration']:g} s from q = (0, 1) rad, q̇ = (1, 2) rad/s: no "
        "torque, no friction, no gravity. The energy of rigid bodies is constant. That of the "
        "printed arm is not, nor that of five columns with p3 ≠ p4 as in the paper's steady "
        "state.</p>\n" + table("Largest change of energy", ["model", "%"], rows)
    )


def _settings(content: Mapping[str, Any]) -> str:
    rows = [
        [text(_named(key)), text(_written(value))] for key, value in content["settings"].items()
    ]
    return table("Settings", ["setting", "value"], rows)


def _named(key: str) -> str:
    """Return the name of a setting as text, with its unit, as "duration [s]"."""
    words, _, unit = key.rpartition("_")
    name = f"{words} [{unit}]" if unit in ("rad", "s") else key
    return name.replace("_", " ")


def _written(value: object) -> str:
    """Return the value of a setting as text; numbers of a list with commas."""
    if isinstance(value, list):
        return ", ".join(map(_written, value))
    return f"{value:.4g}" if isinstance(value, float) else str(value)
