"""The page of the paper's simulation: its figures for all three models, tables, explanations."""

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from robotid.base.typing import Array
from robotid.base.versions import __version__
from robotid.output.pages.html import Chart, Series, block, chart_html, listing, number, page, text
from robotid.paper.study import CASES, DURATION, PROGRAM, EnergyDrift, ModelStudy

_SHOWN = (1, 2, 5, 20, 100)  # iterations drawn in figure 4
_DRAWN_CASES = {
    "clean": "clean", "disturbed": "torque ±10 %", "noisy": "noise",
    "noisy_dead_zone": "noise, ε₂ = 1",
}  # fmt: skip

_RESULT = (
    ("model", "text", "name"), ("start", ".2g", "start"), ("after 1", ".2g", "first"),
    ("after 10", ".2g", "tenth"), ("at the end", ".2g", "last"),
    ("start on program", ".2g", "on_program"), ("NA (25)", "d", "NA"),
    ("one-shot (18)", ".2g", "one_shot"),
)  # fmt: skip
_PARAMETERS = (
    ("parameter", "code", "name"), ("true", ".4g", "true"), ("estimate", ".7g", "estimate"),
    ("difference", ".1e", "difference"),
)  # fmt: skip
_VECTOR = (
    ("parameter", "code", "name"), ("true", ".4g", "true"), ("identified", ".7g", "identified"),
)  # fmt: skip
_DISTURBED = (
    ("model", "text", "name"), ("case", "text", "case"), ("at the end", ".2g", "last"),
    ("mean of last tenth", ".2g", "last_tenth"), ("of averaged P̂", ".2g", "averaged"),
    ("≤ 10⁻⁴", "text", "converged"),
)  # fmt: skip
_RANDOM = (
    ("model", "text", "name"), ("start", "text", "start"), ("runs", "d", "runs"),
    ("converged", "d", "converged"), ("least", ".0f", "0"), ("median", ".0f", "50"),
    ("90 %", ".0f", "90"), ("most", ".0f", "100"), ("allowed", "d", "most_iterations"),
)  # fmt: skip
_ERRATA = (
    ("where", "code", "where"), ("printed", "text", "printed"), ("corrected", "text", "corrected"),
    ("anywhere [N m]", ".1f", "max_torque_difference"),
    ("on the program [N m]", ".1f", "max_torque_difference_on_program"),
)  # fmt: skip
_ENERGY = (("model", "text", "name"), ("%", ".3g", "change"))
_SETTINGS = (("setting", "text", "name"), ("value", "text", "value"))


def paper_page(
    content: Mapping[str, Any],
    studies: Sequence[ModelStudy],
    drift: EnergyDrift,
) -> str:
    """Return the page.

    References:
        Tzvetkova, figures 3 to 5.
    """
    result = block("paper.result") + _result_table(content) + _parameter_tables(content)
    figures = _program_figures() + _control_figures(studies) + _estimate_figures(studies)
    disturbed = _disturbance(content) + _disturbed_figures(studies)
    sections = {
        "result": ("Accuracy of the estimates", result + _vector_table(content)),
        "figures": ("The paper's figures", figures),
        "convergence": ("Proximity and error", _convergence_figures(studies)),
        "disturbance": ("Disturbance and noise", disturbed),
        "trajectories": ("Random trajectories", _trajectories(content)),
        "errata": ("Errata", block("paper.errata") + listing("Errata", _ERRATA, content["errata"])),
        "energy": ("Energy", _energy(content) + _energy_figure(drift)),
        "settings": ("Settings", _settings(content)),
    }
    return page("The paper's simulation", _summary(content), sections)


def _summary(content: Mapping[str, Any]) -> str:
    models, on_program = content["models"], content["on_program"]
    last = {name: model["relative_error"][-1] for name, model in models.items()}
    others = {name: on_program[name]["relative_error"][-1] for name in models}
    gains = [others[name] / error for name, error in last.items()]
    reached = "".join(
        block(
            "paper.reached",
            name=escape(name),
            error=number(error, ".2g").html,
            on_program=number(others[name], ".2g").html,
        )
        for name, error in last.items()
    )
    beside = np.degrees(np.max(np.abs(content["settings"]["start_beside_program_rad"])))
    return block(
        "paper.summary",
        status="good" if max(last.values()) <= 1e-4 else "poor",
        count=len(next(iter(models.values()))["relative_error"]) - 1,
        reached=reached,
        beside=f"{beside:.3g}",
        least=f"{min(gains):.2g}",
        most=f"{max(gains):.2g}",
        version=__version__,
    )


# ---- tables ---------------------------------------------------------------------------------


def _result_table(content: Mapping[str, Any]) -> str:
    rows = []
    for name, model in content["models"].items():
        errors = model["relative_error"]
        rows.append(
            {"name": name, "start": errors[0], "first": errors[min(1, len(errors) - 1)],
             "tenth": errors[10] if len(errors) > 10 else None, "last": errors[-1],
             "on_program": content["on_program"][name]["relative_error"][-1],
             "NA": model["NA"], "one_shot": content["one_shot"][name]}
        )  # fmt: skip
    return listing("Relative error |P̂ − P| / |P|", _RESULT, rows)


def _parameter_tables(content: Mapping[str, Any]) -> str:
    html = ""
    for name, model in content["models"].items():
        values = zip(model["names"], model["P_true"], model["P_hat"][-1], strict=True)
        rows = [
            {"name": parameter, "true": P, "estimate": P_hat, "difference": P_hat - P}
            for parameter, P, P_hat in values
        ]
        html += listing(f"{name}: parameters at the end [kg m²]", _PARAMETERS, rows)
    return html


def _vector_table(content: Mapping[str, Any]) -> str:
    vector = content["inertial_vector"]
    values = zip(vector["names"], vector["true"], vector["identified"], strict=True)
    rows = [{"name": name, "true": pi, "identified": x} for name, pi, x in values]
    return block("paper.vector") + listing("Inertial vector (9)-(10), SI units", _VECTOR, rows)


def _disturbance(content: Mapping[str, Any]) -> str:
    rows = [
        {**entry, "name": name, "case": CASES[case].title, "last": entry["relative_error"][-1],
         "converged": text("yes" if entry["converged"] else "no", flag=not entry["converged"])}
        for case in ("disturbed", "noisy", "noisy_dead_zone")
        for name, entry in content[case].items()
    ]  # fmt: skip
    reason = next(iter(content["disturbed"].values()))["reason"]
    return f"<p>{escape(reason)}</p>\n" + listing("Relative error at the end", _DISTURBED, rows)


def _trajectories(content: Mapping[str, Any]) -> str:
    starts = {
        "trajectories": "up to 0.05 rad off the program",
        "trajectories_on_program": "on the program",
    }
    rows = []
    for key, start in starts.items():
        for name, run in content[key].items():
            reached = run["iterations"] or [float("nan")]
            quantiles = {f"{p}": float(np.percentile(reached, p)) for p in (0, 50, 90, 100)}
            rows.append({**run, **quantiles, "name": name, "start": start})
    table = listing("Iterations to a relative error of 10⁻³", _RANDOM, rows)
    return block("paper.trajectories") + table


def _energy(content: Mapping[str, Any]) -> str:
    drift = content["energy_drift"]
    rows = [{"name": name, "change": 100 * x} for name, x in drift["max_relative"].items()]
    table = listing("Largest change of energy", _ENERGY, rows)
    return block("paper.energy", duration=f"{drift['duration']:g}") + table


def _settings(content: Mapping[str, Any]) -> str:
    rows = []
    for key, value in content["settings"].items():
        words, _, unit = key.rpartition("_")
        name = f"{words} [{unit}]" if unit in ("rad", "s") else key
        rows.append({"name": name.replace("_", " "), "value": _written(value)})
    return listing("Settings", _SETTINGS, rows)


def _written(value: object) -> str:
    """Return the value of a setting as text; numbers of a list with commas."""
    if isinstance(value, list):
        return ", ".join(map(_written, value))
    return f"{value:.4g}" if isinstance(value, float) else str(value)


# ---- figures --------------------------------------------------------------------------------


def _plots(*charts: Chart) -> str:
    """Return charts side by side, each under its title."""
    html = "".join(chart_html(chart, escape(chart.title)) for chart in charts)
    return f'<div class="plots">\n{html}</div>\n'


def _lines(values: Mapping[str, Array], first: int = 1, *, is_weak: bool = False) -> list[Series]:
    """Return lines over iterations, filled up with NaN to the longest."""
    count = max(map(len, values.values()))
    padded = {k: np.append(y, np.full(count - len(y), np.nan)) for k, y in values.items()}
    return [
        Series(name, y, f"tone-{k}", is_weak=is_weak)
        for k, (name, y) in enumerate(padded.items(), start=first)
    ]


def _over_iterations(title: str, label: str, series: Sequence[Series], axis: str = "") -> Chart:
    x = np.arange(len(series[0].y), dtype=float)
    return Chart(title, x, tuple(series), "iteration", label, logarithmic=axis)


def _program_figures() -> str:
    """Return the program motion (28) of both links."""
    t = np.linspace(0.0, DURATION, 201)
    names = ("position [rad]", "velocity [rad/s]", "acceleration [rad/s²]")
    charts = [
        Chart(
            f"Figure 3({'ab'[j]}). Program motion of link {j + 1}, (28)", t,
            (Series(name, part[:, j], f"tone-{k}"),), "time [s]", name, height=120,
        )
        for j in range(2)
        for k, (name, part) in enumerate(zip(names, PROGRAM.evaluate(t), strict=True), start=1)
    ]  # fmt: skip
    return _plots(*charts)


def _control_figures(studies: Sequence[ModelStudy]) -> str:
    """Return the control (21) of both joints in successive iterations, and less the last one."""
    charts = []
    for study in studies:
        stored = study.history.torques
        if stored is None:
            continue
        t, program = study.program_control(stored.shape[1] + 1)
        for j in range(2):
            torques, last = stored[:, :, 0, j], stored[-1, :, 0, j]
            drawn = {f"iteration {k}": torques[k - 1] for k in _SHOWN if k <= len(torques)}
            title = f"Figure 4({'ab'[j]}). {study.name}: control u{j + 1} (21)"
            series = [*_lines(drawn), Series("program control", program[:-1, j], "text")]
            less = _lines({name: u - last for name, u in drawn.items()})
            label = f"torque u{j + 1} [N m]"
            charts.append(Chart(title, t[:-1], tuple(series), "time [s]", label))
            charts.append(Chart(f"{title}, minus the last", t[:-1], tuple(less), "time [s]", label))
    return _plots(*charts)


def _estimate_figures(studies: Sequence[ModelStudy]) -> str:
    """Return the estimated parameters (24) over the iterations, and the true ones."""
    charts = []
    for study in studies:
        names, P_hat = study.dynamics.names, study.history.estimates[:, 0]
        lines = _lines(dict(zip(names, P_hat.T, strict=True)))
        true = {
            f"{name}, true": np.full(len(P_hat), x) for name, x in zip(names, study.P, strict=True)
        }
        title = f"Figure 5. {study.name}: estimates (24)"
        series = [*lines, *_lines(true, is_weak=True)]
        charts.append(_over_iterations(title, "estimate [kg m²]", series))
    return _plots(*charts)


def _convergence_figures(studies: Sequence[ModelStudy]) -> str:
    """Return PRX (23) and the parameter error over the iterations."""
    prx = _lines({s.name: np.append(np.nan, s.history.prx[:, 0]) for s in studies})
    errors = _lines({study.name: study.errors() for study in studies})
    on_program = {f"{s.name}, start on program": s.errors("on_program") for s in studies}
    errors += _lines(on_program, is_weak=True)
    label = "|P̂ − P| / |P|"
    return _plots(
        _over_iterations("Largest entry of PRX (23)", "PRX [N m/s²]", prx, "y"),
        _over_iterations("Parameter error", label, errors, "y"),
    )


def _disturbed_figures(studies: Sequence[ModelStudy]) -> str:
    """Return the parameter error under disturbance and noise."""
    return _plots(*(
        _over_iterations(
            f"{study.name}: parameter error with disturbed torque and noisy sensors",
            "|P̂ − P| / |P|",
            _lines({label: study.errors(case) for case, label in _DRAWN_CASES.items()}),
            "y",
        )
        for study in studies
    ))  # fmt: skip


def _energy_figure(drift: EnergyDrift) -> str:
    """Return the energy gained by each model in free motion."""
    lines = _lines({name: 100 * gained for name, gained in drift.gained.items()})
    title = "Energy gained in free motion"
    return _plots(Chart(title, drift.t, tuple(lines), "time [s]", "energy gained [%]"))
