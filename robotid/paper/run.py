"""Run the paper's simulation and write its results, and a page of its figures and tables."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from robotid.base.files import check_folder, folder_beside, write_json
from robotid.base.typing import Array, ProgressCallback, ignore_progress
from robotid.base.versions import __version__
from robotid.dynamics.base_parameters import structural_mapping
from robotid.dynamics.torque import joint_torque_regressor
from robotid.output.pages.html import (
    Chart,
    Series,
    block,
    chart_html,
    listing,
    number,
    page,
    plain,
    text,
)
from robotid.output.viewer.replays import Torques, replay
from robotid.paper.planar_2r import urdf_text
from robotid.paper.study import (
    AMPLITUDE,
    CASES,
    DURATION,
    MODELS,
    PROGRAM,
    LoopSettings,
    ModelStudy,
    PaperSettings,
    RandomRuns,
    energy_drift,
    errata,
    paper_arm,
    random_runs,
    study_model,
)
from robotid.robot.model import RobotModel
from robotid.robot.parameters import PAPER_TERMS, to_paper_order

_ENOUGH = 1e-4  # [-] relative error at which the simulation has converged
_SAMPLES = 241  # of the replay
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
    ("difference", ".2g", "difference"),
)  # fmt: skip
_VECTOR = (
    ("parameter", "code", "name"), ("true", ".4g", "true"), ("identified", ".7g", "value"),
    ("determined by the torque", "text", "determined"),
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


def run_paper(
    folder: str | Path,
    *,
    settings: PaperSettings | None = None,
    progress: ProgressCallback | None = None,
) -> dict[str, Any]:
    """Run the paper's simulation with its three models, write it and return paper.json's content.

    Every file is written in a temporary folder inside the target and then moved.
    """
    chosen = settings or PaperSettings()
    report = progress or ignore_progress
    target = Path(folder)
    check_folder(target, ["paper.html", "paper.json", "planar_2r.urdf", "replay.html"])
    target.mkdir(parents=True, exist_ok=True)
    studies = [
        study_model(name, chosen, progress=_counter(name, chosen.iterations, report))
        for name in MODELS
    ]
    near = _random_motions(chosen, "off", 0.05, chosen.patience, report)
    exact = _random_motions(chosen, "on", 0.0, min(chosen.patience, chosen.iterations), report)
    drift = energy_drift()
    physical = studies[list(MODELS).index("physical")]
    content = _content(chosen, studies, near, exact, drift)
    report("drawing", 0, 1, "pages")
    with folder_beside(target) as beside:
        (beside / "planar_2r.urdf").write_text(urdf_text(), encoding="utf-8")
        arm = RobotModel.from_urdf(beside / "planar_2r.urdf")
        content["inertial_vector"] = _inertial_vector(arm, physical)
        _write_replay(arm, physical, beside / "replay.html")
        html = paper_page(content, studies, drift)
        (beside / "paper.html").write_text(html, encoding="utf-8")
        write_json(content, beside / "paper.json")
    return content


def _random_motions(
    settings: PaperSettings, where: str, largest: float, most: int, report: ProgressCallback
) -> dict[str, RandomRuns]:
    """Return the random motions of each model; they differ between the models."""
    found = {}
    for k, name in enumerate(MODELS):
        rng = np.random.default_rng([settings.seed, k, int(largest > 0)])
        what = f"{name}, {settings.runs} motions from {where} the program"
        counter = _counter(what, most, report)
        found[name] = random_runs(
            *paper_arm(name), settings.runs, most, rng, largest_offset=largest, progress=counter
        )
    return found


def _content(
    settings: PaperSettings,
    studies: list[ModelStudy],
    near: Mapping[str, RandomRuns],
    exact: Mapping[str, RandomRuns],
    drift: tuple[Array, Mapping[str, Array]],
) -> dict[str, Any]:
    loop, (t, gained) = LoopSettings(), drift
    return {
        "schema_version": 1,
        "robotid": __version__,
        "settings": {
            "iterations": settings.iterations,
            "updates_per_iteration": loop.updates,
            "amplitude_rad": list(AMPLITUDE),
            "duration_s": DURATION,
            "alpha": loop.alpha,
            "beta": loop.beta,
            "first_guess": "P / 2",
            "start_beside_program_rad": list(CASES["clean"].offset),
            "most_iterations_until_PRX_is_zero": settings.longest,
            "random_motions": settings.runs,
            "seed": settings.seed,
        },
        "models": {study.name: _model(study) for study in studies},
        "one_shot": {study.name: study.one_shot_error for study in studies},
        **{case: {s.name: _case(s, case) for s in studies} for case in CASES if case != "clean"},
        "trajectories": {name: runs.to_dict() for name, runs in near.items()},
        "trajectories_on_program": {name: runs.to_dict() for name, runs in exact.items()},
        "errata": errata(np.random.default_rng(settings.seed)),
        "energy_drift": {
            "duration": float(t[-1]),
            "max_relative": {name: float(np.abs(E).max()) for name, E in gained.items()},
        },
    }


def _model(study: ModelStudy) -> dict[str, Any]:
    return {
        "names": list(study.dynamics.names),
        "P_true": study.P.tolist(),
        "P_hat": study.history.estimates[:, 0].tolist(),
        "relative_error": study.errors().tolist(),
        "prx_norm": study.history.prx[:, 0].tolist(),
        "NA": study.NA,
        "converged": bool(study.errors()[-1] <= _ENOUGH),
    }


def _case(study: ModelStudy, case: str) -> dict[str, Any]:
    errors = study.errors(case)
    tenth = max(1, len(errors) // 10)
    estimates = study.history.estimates[-5 * tenth :, list(CASES).index(case)]  # the later half
    averaged = np.linalg.norm(estimates.mean(axis=0) - study.P) / np.linalg.norm(study.P)
    return {
        "conditions": CASES[case].title,
        "relative_error": errors.tolist(),
        "last_tenth": float(errors[-tenth:].mean()),
        "averaged": float(averaged),
        "converged": bool(errors[-1] <= _ENOUGH),
        "reason": _reason(case, errors),
    }


def _reason(case: str, errors: Array) -> str:
    if errors[-1] <= _ENOUGH:
        return "converged"
    if case == "on_program":
        return "slow: every run follows the same curve, which excites the parameters too little"
    return (
        "A disturbance v is part of the deviation, η = D⁻¹(ΨP̃ + v), and the step (24) does not "
        "decrease with it. The estimate does not converge: it remains in a band about the true "
        "value, with a width proportional to v. Small samples have the same weight as large ones, "
        "since the step is divided by |Ψ|²; a larger ε₂ excludes them."
    )


def _inertial_vector(arm: RobotModel, study: ModelStudy) -> dict[str, Any]:
    """Return the arm's inertial parameters in the order of (9)-(10), true and identified.

    The identified ones are those nearest to the initial values (half of the true ones) with the
    torque of the estimate, W_b beta = G P^: the torque determines four sums of the twenty.
    """
    pi = arm.standard_parameters()[: arm.layout.n_inertial]
    q, v, a = np.random.default_rng(0).uniform(-1.0, 1.0, (3, 20, 2))
    mapping = structural_mapping(arm, inertial_only=True)
    W_b = joint_torque_regressor(arm, q, v, a)[:, mapping.independent]  # (40, b)
    u = study.dynamics.torque(q, v, a, study.history.estimates[-1, 0])  # (20, 2)
    beta = np.linalg.lstsq(W_b, u.ravel())[0]
    names = [f"{body}.{term}" for body in arm.layout.bodies for term in PAPER_TERMS]
    return {
        "names": names,
        "sums": [next((x for x in mapping.expressions if name in x.split()), "") for name in names],
        "true": to_paper_order(pi).tolist(),
        "identified": to_paper_order(mapping.to_standard(beta, pi / 2)).tolist(),
    }


def _write_replay(arm: RobotModel, study: ModelStudy, target: Path) -> None:
    t = np.linspace(0.0, DURATION, _SAMPLES)
    q, v, a = PROGRAM.evaluate(t)
    estimates = study.history.estimates[:, 0]
    label = f"after {len(estimates) - 1} iterations"
    torques = Torques(
        t,
        study.dynamics.torque(q, v, a, study.P),
        {
            "initial values": study.dynamics.torque(q, v, a, estimates[0]),
            label: study.dynamics.torque(q, v, a, estimates[-1]),
        },
    )
    notes = ["Program motion (28). Colour of the arcs: residual of the initial values."]
    replay(arm, t, q, torques=torques, notes=notes).write(target)


def _counter(what: str, most: int, report: ProgressCallback) -> Callable[[int], None]:
    return lambda number: report(what, number, most, "iterations")


# ---- the page -------------------------------------------------------------------------------


def paper_page(
    content: Mapping[str, Any],
    studies: Sequence[ModelStudy],
    drift: tuple[Array, Mapping[str, Array]],
) -> str:
    """Return the page, with figures 3 to 5 of the paper."""
    result = block("paper.result") + _result_table(content) + _parameter_tables(content)
    figures = _program_figures() + _control_figures(studies) + _estimate_figures(studies)
    disturbed = _disturbance(content) + _disturbed_figures(studies)
    corrections = block("paper.errata") + listing("Errata", _ERRATA, content["errata"])
    sections = {
        "result": ("Accuracy of the estimates", result),
        "vector": ("Inertial vector", _vector_table(content), "three of twenty determined", False),
        "figures": ("The paper's figures", figures),
        "convergence": ("Proximity and error", _convergence_figures(studies)),
        "disturbance": ("Disturbance and noise", disturbed, "of the torque, of the sensors", False),
        "trajectories": ("Random trajectories", _trajectories(content), "iterations needed", False),
        "errata": ("Errata", corrections, "equations that need a correction", False),
        "energy": ("Energy", _energy(*drift), "of free motion", False),
        "settings": ("Settings", _settings(content), "of this run", False),
    }
    return page("The paper's simulation", _summary(content), sections)


def _summary(content: Mapping[str, Any]) -> str:
    models, on_program = content["models"], content["on_program"]
    last = {name: model["relative_error"][-1] for name, model in models.items()}
    others = {name: on_program[name]["relative_error"][-1] for name in models}
    ratios = sorted({f"{others[name] / error:.2g}" for name, error in last.items()}, key=float)
    reached = "".join(
        block(
            "paper.reached", name=escape(name), error=number(error, ".2g").html,
            on_program=number(others[name], ".2g").html,
        )
        for name, error in last.items()
    )  # fmt: skip
    count, usual = content["settings"]["iterations"], PaperSettings().iterations
    beside = np.degrees(np.max(np.abs(content["settings"]["start_beside_program_rad"])))
    return block(
        "paper.summary",
        status="good" if max(last.values()) <= _ENOUGH else "poor",
        count=count,
        trial=block("paper.trial", count=count, usual=usual) if count < usual else "",
        reached=reached,
        beside=f"{beside:.3g}",
        ratios=" to ".join(dict.fromkeys((ratios[0], ratios[-1]))),
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
    html = '<div class="plots tables">'
    for name, model in content["models"].items():
        values = zip(model["names"], model["P_true"], model["P_hat"][-1], strict=True)
        rows = [
            {"name": parameter, "true": P, "estimate": P_hat, "difference": P_hat - P}
            for parameter, P, P_hat in values
        ]
        html += listing(f"{name}: parameters at the end [kg m²]", _PARAMETERS, rows)
    return f"{html}</div>"


def _vector_table(content: Mapping[str, Any]) -> str:
    vector = content["inertial_vector"]
    rows = [
        {"name": name, "true": vector["true"][k],
         "value": vector["identified"][k] if known == name else None,
         "determined": "yes" if known == name else f"only {known}" if known else "no"}
        for k, (name, known) in enumerate(zip(vector["names"], vector["sums"], strict=True))
    ]  # fmt: skip
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
    rows = []
    for key, start in (
        ("trajectories", "up to 0.05 rad off the program"),
        ("trajectories_on_program", "on the program"),
    ):
        for name, run in content[key].items():
            reached = run["iterations"] or [float("nan")]
            quantiles = {f"{p}": float(np.percentile(reached, p)) for p in (0, 50, 90, 100)}
            rows.append({**run, **quantiles, "name": name, "start": start})
    table = listing("Iterations to a relative error of 10⁻³", _RANDOM, rows)
    return block("paper.trajectories") + table


def _energy(t: Array, gained: Mapping[str, Array]) -> str:
    changes = {name: 100 * share for name, share in gained.items()}
    rows = [{"name": name, "change": np.abs(x).max()} for name, x in changes.items()]
    table = listing("Largest change of energy", _ENERGY, rows)
    title, lines = "Energy gained in free motion", tuple(_lines(changes))
    figure = _plots(Chart(title, t, lines, "time [s]", "energy gained [%]"))
    return block("paper.energy", duration=f"{t[-1]:g}") + table + figure


def _settings(content: Mapping[str, Any]) -> str:
    rows = []
    for key, value in content["settings"].items():
        words, _, unit = key.rpartition("_")
        name = f"{words} [{unit}]" if unit in ("rad", "s") else key
        rows.append({"name": name.replace("_", " "), "value": plain(value)})
    return listing("Settings", _SETTINGS, rows)


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
        control = study.history.torques
        t, program = study.program_control(control.shape[1] + 1)
        for j in range(2):
            torques, last = control[:, :, j], control[-1, :, j]
            drawn = {f"iteration {k}": torques[k - 1] for k in _SHOWN if k <= len(torques)}
            title = f"Figure 4({'ab'[j]}). {study.name}: control u{j + 1} (21)"
            series = [*_lines(drawn), Series("program control", program[:-1, j], "text")]
            less = _lines({name: u - last for name, u in drawn.items()})
            label = f"torque u{j + 1} [N m]"
            for what, lines in ((title, series), (f"{title}, minus the last", less)):
                charts.append(Chart(what, t[:-1], tuple(lines), "time [s]", label, height=120))
    return _plots(*charts)


def _estimate_figures(studies: Sequence[ModelStudy]) -> str:
    charts = []
    for study in studies:
        names, P_hat = study.dynamics.names, study.history.estimates[:, 0]
        lines = [Series(name, P_hat[:, k], f"tone-{name[1:]}") for k, name in enumerate(names)]
        for line, P in zip(tuple(lines), study.P, strict=True):
            true = np.full(len(P_hat), P)
            lines.append(replace(line, label=f"{line.label}, true", y=true, is_weak=True))
        title = f"Figure 5. {study.name}: estimates (24)"
        charts.append(_over_iterations(title, "estimate [kg m²]", lines))
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
    return _plots(*(
        _over_iterations(
            f"{study.name}: parameter error with disturbed torque and noisy sensors",
            "|P̂ − P| / |P|",
            _lines({label: study.errors(case) for case, label in _DRAWN_CASES.items()}),
            "y",
        )
        for study in studies
    ))  # fmt: skip
