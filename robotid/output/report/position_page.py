"""The content of a report on an identification that predicts positions."""

from collections.abc import Iterator, Sequence
from html import escape
from statistics import geometric_mean

from robotid.base.findings import listed
from robotid.base.typing import Array
from robotid.diagnosis.verdict.parameter_table import parameter_entries
from robotid.identification.closed_loop.loop_result import PositionIdentification
from robotid.identification.closed_loop.position_errors import (
    DRIFTS,
    PositionEvaluation,
    pool_positions,
)
from robotid.output.files.entries import loop_parameters
from robotid.output.pages.charts import Chart, Series, chart_html
from robotid.output.pages.html import block, code, number, paragraphs, table, text
from robotid.output.report.errors import POSITION, Errors, worst_errors
from robotid.output.report.next_steps import Origin
from robotid.output.report.report_page import Report, Residual, curves_section
from robotid.output.report.tables import (
    pairs_table,
    parameter_section,
    sources_of,
    variation_section,
)


def position_report(found: PositionIdentification, origin: Origin, replay: str = "") -> Report:
    """Return the content of a report on an identification that predicts positions."""
    is_driven, validation = found.loop.kind == "torque", found.validation
    runs = validation or found.fitted
    together = runs[0].name if len(runs) == 1 else f"{len(runs)} logs together"
    moving = pool_positions(runs, moving=True).to_dict()["per_joint"]
    counted = [Errors(together, moving, is_fitted=not validation)]
    entries = [x for part in parameter_entries(found) for x in part] + loop_parameters(found)
    source, kind = ("torque-driven simulation", "driven") if is_driven else ("commands", "position")
    rate = "none" if found.loop.rate is None else f"{found.loop.rate}"
    controller = {"kind": found.loop.kind, "rate": rate}
    worst = next(iter(worst_errors(counted)))
    return Report(
        title=f"{found.model.name}: drives from {source}",
        quantity=POSITION,
        counted=counted,
        facts=_facts(found),
        made=f"<p>{escape(_method(found))}</p>\n",
        errors=(block(f"report.{kind}_errors", drift=f"{DRIFTS:g}"), _horizons(runs)),
        curves=("Positions", _positions(found, worst, kind, origin, replay)),
        parameters=parameter_section(entries, block(f"report.{kind}_parameters")),
        entries=entries,
        variation=variation_section(found.variation, {}),
        appendix={
            "open": ("Parameters not identifiable", _open_section(found)),
            "settings": ("Controller", pairs_table("Controller", controller)),
            **sources_of(found),
        },
    )


def _unit(run: PositionEvaluation) -> str:
    """Return the unit of the errors, "mrad or mm" if some joints are prismatic."""
    return " or ".join(f"{POSITION.prefix}{unit}" for unit in dict.fromkeys(run.units))


def _mean(errors: Array | None) -> float | None:
    """Return the geometric mean of the joints' errors; None if there is none."""
    return None if errors is None or not (errors > 0).all() else geometric_mean(errors)


def _facts(found: PositionIdentification) -> dict[str, str]:
    run = (found.validation or found.fitted)[0]
    kind, ours = "not fitted" if found.validation else "fitted", _mean(run.rmse)
    over = f" over {DRIFTS:g} s" if run.is_driven else ""
    error = number(None if ours is None else ours / POSITION.scale, ".3g").html
    return {
        f"Simulated position error{over}, {kind}": f"<strong>{error} {_unit(run)}</strong>, "
        f"geometric mean of {len(run.rmse)} joint{'s' * (len(run.rmse) > 1)}"
    }


def _method(found: PositionIdentification) -> str:
    fitted, validation = ([e.name for e in part] for part in (found.fitted, found.validation))
    return (
        f"{len(found.estimate.theta)} parameters of {len(found.model.joints)} joints were fitted "
        f"to {listed(fitted)} by {found.estimator.name}. "
        + (f"Validation: {listed(validation)}." if validation else "There is no validation log.")
    )


def _horizons(runs: Sequence[PositionEvaluation]) -> str:
    """Return errors over the horizon of the simulation: tables."""
    joints, parts = runs[0].log.joints, list[str]()
    for run in runs:
        whole = {} if run.is_driven else {run.extent.end - run.extent.start: run.rmse}
        errors = {h: x / POSITION.scale for h, x in sorted((dict(run.horizons) | whole).items())}
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
    found: PositionIdentification, worst: str, kind: str, origin: Origin, replay: str
) -> str:
    intro = block(f"report.{kind}s", drift=f"{DRIFTS:g}")

    def charts(run: PositionEvaluation, row: int, link: str, points: int) -> str:
        kind = "not fitted" if run in found.validation else "fitted"
        return _charts(run, kind, row, link, points)

    def residuals(row: int) -> Iterator[Residual]:
        for e in found.validation or found.fitted:
            yield Residual(e.name, e.log.name, e.log.t, (e.log.q - e.q)[:, row])

    runs = (*found.validation, *found.fitted)
    return curves_section(
        found, runs, worst, (replay, origin), intro, charts, residuals, POSITION, runs[0].units
    )


def _charts(run: PositionEvaluation, kind: str, j: int, link: str, points: int) -> str:
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
    return paragraphs(words)
