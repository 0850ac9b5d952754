"""The content of a report on an identification that predicts positions."""

from collections.abc import Iterator, Sequence
from html import escape
from statistics import geometric_mean

import numpy as np

from robotid.base.findings import listed
from robotid.base.typing import Array
from robotid.base.versions import versions
from robotid.diagnosis.verdict.parameter_table import parameter_entries
from robotid.identification.closed_loop.from_commands import PositionIdentification
from robotid.identification.closed_loop.position_errors import (
    DRIFTS,
    PositionEvaluation,
    pool_positions,
)
from robotid.output.files.entries import input_entries, loop_parameters
from robotid.output.pages.charts import Chart, Series, chart_html
from robotid.output.pages.html import block, code, number, table, text
from robotid.output.report.dock import Residual
from robotid.output.report.errors import POSITION, Errors, errors_of, worst_errors
from robotid.output.report.next_steps import Origin, next_steps
from robotid.output.report.report_page import Report, curves_section
from robotid.output.report.tables import (
    input_table,
    pairs_table,
    parameter_section,
    variation_section,
    version_table,
)

_NAMED = 7  # joints in the chart of errors over the horizon


def position_report(found: PositionIdentification, origin: Origin, replay: str = "") -> Report:
    """Return the content of a report on an identification that predicts positions."""
    is_driven, validation = found.loop.kind == "torque", found.validation
    runs = validation or found.fitted
    together = runs[0].name if len(runs) == 1 else f"{len(runs)} logs together"
    moving = pool_positions(runs, moving=True).to_dict()["per_joint"]
    counted = [Errors(together, moving, is_fitted=not validation)]
    entries = [x for part in parameter_entries(found) for x in part] + loop_parameters(found)
    verdict, worst = found.verdict.to_dict(), [*worst_errors(counted)]
    source, kind = ("torque-driven simulation", "driven") if is_driven else ("commands", "position")
    rate = "none" if found.loop.rate is None else f"{found.loop.rate}"
    controller = {"kind": found.loop.kind, "rate": rate}
    return Report(
        title=f"{found.model.name}: drives from {source}",
        robot=found.model.name,
        rows=found.model.joints,
        verdict=verdict,
        findings=found.findings,
        quantity=POSITION,
        counted=counted,
        recordings=errors_of(found),
        facts=_facts(found),
        steps=next_steps(found, origin),
        made=f"<p>{escape(_method(found))}</p>\n",
        errors=(block(f"report.{kind}_errors", drift=f"{DRIFTS:g}"), _horizons(runs)),
        curves=("Positions", _positions(found, worst, origin, replay)),
        why="",
        parameters=parameter_section(
            found.model,
            found.standard if found.has_urdf else None,
            entries,
            block(f"report.{kind}_parameters"),
        ),
        entries=entries,
        variation=variation_section(found.variation, {}),
        appendix={
            "open": ("Parameters not identifiable", _open_section(found)),
            "settings": ("Controller", pairs_table("Controller", controller)),
            "inputs": ("Inputs", input_table(input_entries(found))),
            "versions": ("Versions", version_table(versions())),
        },
    )  # fmt: skip


def _unit(run: PositionEvaluation) -> str:
    """Return the unit of the errors, "mrad or mm" if some joints are prismatic."""
    return " or ".join(f"{POSITION.prefix}{unit}" for unit in dict.fromkeys(run.units))


def _mean(errors: Array | None) -> float | None:
    """Return the geometric mean of the joints' errors; None if there is none."""
    return None if errors is None or not (errors > 0).all() else geometric_mean(errors)


def _facts(found: PositionIdentification) -> dict[str, str]:
    """Return the mean error on the first validation log, and those of other predictions."""
    run = (found.validation or found.fitted)[0]
    kind, ours = "not fitted" if found.validation else "fitted", _mean(run.rmse)
    over = f" over {DRIFTS:g} s" if run.is_driven else ""
    error = number(None if ours is None else ours / POSITION.scale, ".3g").html
    facts = {
        f"Simulated position error{over}, {kind}": f"<strong>{error} {_unit(run)}</strong>, "
        f"geometric mean of {len(run.rmse)} joint{'s' * (len(run.rmse) > 1)}"
    }
    times = [
        f"{mark.words} {(ratio := theirs / ours):{'.2g' if ratio < 99.5 else '.0f'}} ×"
        for key, mark in POSITION.marks.items()
        if ours and (theirs := _mean(run.baselines.get(key)))
    ]
    return facts | (
        {"Other predictions, relative to this error": ", ".join(times)} if times else {}
    )


def _method(found: PositionIdentification) -> str:
    """Return a description of the fit and its logs."""
    fitted, validation = ([e.name for e in part] for part in (found.fitted, found.validation))
    return (
        f"{len(found.estimate.theta)} parameters of {len(found.model.joints)} joints were fitted "
        f"to {listed(fitted)} by {found.estimator.name}. "
        + (f"Validation: {listed(validation)}." if validation else "There is no validation log.")
    )


def _horizons(runs: Sequence[PositionEvaluation]) -> str:
    """Return errors over the horizon of the simulation: a chart of the worst joints, and tables."""
    joints, parts = runs[0].log.joints, list[str]()
    for run in runs:
        whole = {} if run.is_driven else {run.extent.end - run.extent.start: run.rmse}
        errors = {h: x / POSITION.scale for h, x in sorted((dict(run.horizons) | whole).items())}
        if not parts and errors:
            y = np.stack([*errors.values()])  # (horizons, n)
            worst = np.argsort(-run.rmse)[:_NAMED]
            series = [
                Series(joints[j], y[:, j], f"tone-{k + 1}", is_weak=True)
                for k, j in enumerate(worst)
            ]
            chart = Chart(
                "position error over the horizon of the simulation", np.array([*errors]),
                tuple(series), "horizon [s]", f"RMSE [{_unit(run)}]", logarithmic="xy", height=220,
            )  # fmt: skip
            parts.append(chart_html(chart, f"Error over horizon: {escape(run.name)}"))
        rows = [
            [code(joint), *(number(float(x[j]), "#.3g") for x in errors.values())]
            for j, joint in enumerate(joints)
        ]
        foot = [text("geometric mean"), *(number(_mean(x), "#.3g") for x in errors.values())]
        caption = f"{run.name}: error over the horizon, {_unit(run)}"
        heads = ["joint", *(f"{h:.4g} s" for h in errors)]
        parts.append(table(caption, heads, rows, foot, is_data=True))
    return "".join(parts)


def _positions(
    found: PositionIdentification, worst: Sequence[str], origin: Origin, replay: str
) -> str:
    """Return charts of each joint in every log."""
    kind = "driven" if found.loop.kind == "torque" else "position"
    intro = block(f"report.{kind}s", drift=f"{DRIFTS:g}")

    def charts(run: PositionEvaluation, row: int, link: str, points: int) -> str:
        kind = "not fitted" if run in found.validation else "fitted"
        return _charts(run, kind, row, link=link, points=points)

    def residuals(row: int) -> Iterator[Residual]:
        for e in found.validation or found.fitted:
            yield Residual(e.name, e.log.name, e.log.t, (e.log.q - e.q)[:, row])

    every = (*found.validation, *found.fitted)
    units = every[0].units
    return curves_section(
        found, every, worst, (replay, origin), intro, charts, residuals, POSITION, units, most=1
    )


def _charts(run: PositionEvaluation, kind: str, j: int, *, link: str, points: int) -> str:
    """Return charts of positions and position errors of a joint in a log."""
    log, joint, unit = run.log, run.log.joints[j], run.units[j]
    q, q_sim = log.q[:, j], run.q[:, j]
    positions = [Series("measured", q, "text"), Series("simulated", q_sim, "predicted")]
    left = [Series("measured − simulated", (q - q_sim) / POSITION.scale, "residual")]
    if log.q_ref is not None and not run.is_driven:
        positions.insert(0, Series("commanded", log.q_ref[:, j], "tone-5"))
        far = (q - log.q_ref[:, j]) / POSITION.scale
        left.insert(0, Series("measured − commanded", far, "tone-5", is_hidden=True))
    above = Chart(
        f"position of {joint}", log.t, tuple(positions), "time [s]", f"position [{unit}]", link=link
    )
    below = Chart(
        f"position error of {joint}", log.t, tuple(left), "time [s]", f"error [m{unit}]",
        link=link, height=110,
    )  # fmt: skip
    caption = f"{escape(run.name)}, {kind}: RMSE {run.rmse[j] / POSITION.scale:.3g} m{unit}"
    return chart_html(above, caption, points=points) + chart_html(below, "", points=points)


def _open_section(found: PositionIdentification) -> str:
    """Return the parameters that positions and commands do not determine."""
    words = ["The logs determine all free parameters."]
    if found.undetermined:
        words = [f"The logs do not determine {listed(found.undetermined)}."]
    words += [f"Indistinguishable: {listed(names)}." for names in found.correlated]
    if found.is_scaled_by_gain:
        words.append(
            "Positions and commands determine torques up to a common factor: gains, inertias, "
            "friction and masses multiplied by this factor cause the same motion. Stated "
            "parameters and the masses of the URDF determine the factor."
        )
    return "".join(f"<p>{escape(sentence)}</p>\n" for sentence in words)
