"""Every cell of the report's tables, against the result and against figures worked out again."""

import hashlib
import re
from dataclasses import asdict, replace
from decimal import Decimal
from html import unescape
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.figures import figures
from helpers.pages import number, percent, tables

from robotid.base.versions import versions
from robotid.estimation.estimators.determination import Group
from robotid.identification.summary import verdict_cell
from robotid.output.pages import html
from robotid.output.report.information_section import information
from robotid.output.report.steps import Origin
from robotid.output.report.tables import (
    _consistency_notes,
    _coverage,
    _drive_table,
    base_table,
    consistency_section,
)
from robotid.output.report.torque_section import shown_torques
from robotid.robot.parameters import INERTIAL_TERMS


@pytest.fixture(scope="module")
def shown(report):
    return tables(report)


def text_of(html):
    plain = re.sub(r"<style>.*?</style>|<svg.*?</svg>", "", html, flags=re.DOTALL)
    plain = re.sub(r"<wbr>", "", plain)
    return " ".join(re.sub(r"<[^>]*>", " ", plain).replace("&#x27;", "'").split())


def section(html, key):
    """Return what is folded under a key; the next thing with a key ends it."""
    return html.split(f'<details id="{key}">')[1].split("<details id=")[0].split("</section>")[0]


@pytest.mark.parametrize(
    ("caption", "role"),
    [("kept.csv 0-5.98 s: not fitted", "validation"), ("All fitted samples together", "fitted")],
)
def test_errors_are_those_of_estimate_wls_and_baselines(shown, identified, caption, role):
    evaluations = getattr(identified, role)
    rows = shown[caption].by_name()
    assert list(rows) == list(identified.model.joints)
    wanted = figures(identified, evaluations)
    for joint, row in rows.items():
        measured = wanted[joint]
        assert row == {
            "joint": joint,
            "error %": percent(measured["error"]),
            "verdict": verdict_cell(joint, asdict(identified.verdict.joints[joint])),
            "RMSE": number(measured["rmse"], ".3g"),
            "unit": "N m",
            "R²": number(measured["r2"], ".3f"),
            "samples": str(measured["rows"]),
            "WLS %": percent(measured["wls"]),
            "URDF %": percent(measured["urdf"]),
            "URDF + drives %": percent(measured["urdf_with_drives"]),
            "gravity only %": percent(measured["gravity_only"]),
        }
    # figures that are alike would hide a swap
    for one, other in (("error %", "WLS %"), ("WLS %", "URDF %"), ("URDF %", "gravity only %")):
        assert shown[caption].column(one) != shown[caption].column(other)


def test_the_verdict_stands_with_its_reasons_and_no_other(report, identified):
    box = report.split('<div class="verdict ')[1].split("</div>")[0]
    assert box.startswith(f'{identified.verdict.status}"')
    assert f"<strong>{identified.verdict.status}</strong>" in box
    said = [unescape(reason) for reason in re.findall(r"<li>(.*?)</li>", box)]
    assert said == list(identified.verdict.reasons)


def test_the_head_counts_parameters_samples_and_rows(report, identified):
    said = text_of(report.split("<header>")[1].split("</header>")[0])
    samples = sum(len(e.recording.trajectory.t) for e in identified.fitted)
    rows = sum(int(e.recording.mask.sum()) for e in identified.fitted)
    assert f"{len(identified.base)} base parameters of 6 joints" in said
    assert f"({samples} samples after filtering, {rows} torque values used)" in said
    assert "fitted to first.csv 0-3.58 s, second.csv 0-3.475 s (" in said
    assert "Validation: kept.csv 0-5.98 s." in said
    assert "consistent bodies and the URDF's values as prior (consistent)" in said


def relative(value, error):
    share = 100 * error / abs(value) if np.isfinite(error) else np.nan
    return "> 999" if share >= 1000 else percent(share)


def with_error(value, error):
    """Return a number to the second digit of its error, and the error, by decimal arithmetic."""
    if not np.isfinite(error):
        return number(value), "–"
    two = Decimal(f"{error:.1e}")
    last = two.adjusted() - 1  # place of its second digit
    size = max(Decimal(value).adjusted() if value else last + 1, last + 1)
    if size < -3:
        return number(value, f"z.{max(Decimal(value).adjusted() - last, 0)}e"), number(error, ".1e")
    step = Decimal(1).scaleb(min(last, 0))
    rounded = [Decimal(x).quantize(step) for x in (value, error)]
    return tuple(number(x or Decimal(0).quantize(step), "f") for x in rounded)  # no -0.0


def test_every_parameter_stands_beside_that_of_the_urdf(shown, identified):
    layout, rows = identified.model.layout, shown["Parameters of links and drives"].rows
    assert [".".join(row[:2]) for row in rows] == list(layout.names)
    bodies = [body.toDynamicParameters() for body in list(identified.model.pin_model.inertias)[1:]]
    urdf = [*np.concatenate(bodies), *[0.0] * 24]
    words = {"data": "data", "mixed": "data and prior", "prior": "prior"}
    words["bound"] = "at its bound"
    units = dict.fromkeys(("Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz", "armature"), "kg m^2")
    units |= {"m": "kg", "mcx": "kg m", "mcy": "kg m", "mcz": "kg m", "viscous": "N m s/rad"}
    units |= {"coulomb": "N m", "offset": "N m"}
    for i, row in enumerate(rows):
        source, value = identified.sources[i], identified.standard[i]
        error = np.sqrt(identified.standard_covariance[i, i])
        at_bound = source == "bound" and i >= layout.n_inertial
        said, uncertain = with_error(value, np.inf if at_bound else error)
        change = with_error(abs(value - urdf[i]), np.inf if at_bound else error)[0]
        if set(change) & set("123456789"):
            change = ("+" if value > urdf[i] else "−") + change
        else:
            change = "0"
        digits_of = np.inf if at_bound else error
        ends = [with_error(x, digits_of)[0] for x in identified.standard_interval[i]]
        assert row[2:5] == [number(urdf[i]), said, uncertain]
        assert row[5:] == [*ends, change, words[source], units[row[1]]]
    held = [".".join(row[:2]) for row in rows if row[8] == "at its bound" and row[4] == "–"]
    assert held == ["elbow_joint.viscous"]
    columns = shown["Parameters of links and drives"]
    assert columns.column("URDF") != columns.column("identified")
    assert set(columns.column("determined by")) == set(words.values())


@pytest.mark.parametrize(
    ("value", "error", "wanted"),
    [
        (1.23456, 0.0123, ("1.235", "0.012")),
        (-1.23456, 0.0996, ("−1.23", "0.10")),
        (1234.5, 123.0, ("1234", "123")),
        (-0.001, 0.5, ("0.00", "0.50")),
        (1.23456e-5, 1.2e-7, ("1.235e−05", "1.2e−07")),
        (0.0, 2e-6, ("0.0e+00", "2.0e−06")),
        (12.3456, np.inf, ("12.35", "–")),
    ],
)
def test_a_number_has_the_digits_of_its_error(value, error, wanted):
    assert tuple(cell.html for cell in html.with_error(value, error)) == wanted


def test_base_parameters_have_their_values_errors_and_expressions(shown, identified):
    mapping, rows = identified.mapping, shown["Base parameters"].rows
    assert [row[0] for row in rows] == list(mapping.base_names)
    assert len({row[2] for row in rows}) > 20  # errors differ: one for all would show
    open_ = (*identified.determination.undetermined, "elbow_joint.viscous")  # this at its bound
    assert [row[0] for row in rows if row[2] == "–"] == list(open_)
    for k, row in enumerate(rows):
        value, error = float(mapping.K[k] @ identified.standard), identified.base_error[k]
        error = np.inf if row[0] in open_ else error
        assert tuple(row[1:3]) == with_error(identified.base[k], error)
        assert row[3] == relative(value, error)
        assert row[4] == identified.model.layout.units[mapping.independent[k]]
        assert row[5] == mapping.expressions[k]


def test_a_base_parameter_that_is_not_determined_has_no_error(identified):
    names = identified.mapping.base_names
    group = replace(Group((names[3],), ()))
    known = replace(identified.determination, groups=(group,))
    rows = tables(base_table(replace(identified, determination=known)))
    dashed = [row[0] for row in rows["Base parameters"].rows if row[2:4] == ["–", "–"]]
    assert dashed == [names[3], "elbow_joint.viscous"]


def test_the_lines_of_the_urdf_that_change_stand_under_the_name_of_their_link(identified):
    diff = shown_torques(identified, Origin()).parameters
    links = re.findall(r"<strong>(.*?)</strong>", diff)
    held = ["ee_link", "tool0"]  # fixed to the last link, whose inertial has theirs
    assert links == [*identified.model.layout.bodies, *held]
    gone = re.findall(r"<del>-.*?mass value=&quot;(.*?)&quot;", diff)
    before, after = identified.prior[:60:10], identified.standard[:60:10]
    moved = before != after  # no torque shows the mass of the shoulder, which may stay to the digit
    assert moved[1:].all()
    assert [float(x) for x in gone] == [*before[moved].tolist(), 0.0, 0.0]
    masses = [float(x) for x in re.findall(r"<ins>\+.*?mass value=&quot;(.*?)&quot;", diff)]
    assert masses == after[moved].tolist()


def smallest_eigenvalue(pi):
    m, c, inertia = pi[0], pi[1:4], pi[[4, 5, 7, 5, 6, 8, 7, 8, 9]].reshape(3, 3)
    second = np.trace(inertia) / 2 * np.eye(3) - inertia
    return np.linalg.eigvalsh(np.block([[second, c[:, None]], [c[None], np.array([[m]])]]))[0]


def test_masses_and_eigenvalues_are_those_of_each_body(shown, identified):
    table = shown["Mass and pseudo-inertia of each body"]
    assert [row[0] for row in table.rows] == list(identified.model.layout.bodies)
    for i, row in enumerate(table.rows):
        before, after = (x[10 * i : 10 * i + 10] for x in (identified.prior, identified.standard))
        lows = [number(smallest_eigenvalue(pi), ".3g") for pi in (before, after)]
        assert row[1:] == [number(before[0]), number(after[0]), *lows, ""]
    totals = [number(x[:60:10].sum()) for x in (identified.prior, identified.standard)]
    assert table.foot[:3] == ["total", *totals]


def test_a_body_is_inconsistent_by_what_was_identified(identified):
    prior, standard = identified.prior.copy(), identified.standard.copy()
    prior[14], standard[24] = -1.0, -1.0  # moments of the second and of the third body
    found = SimpleNamespace(
        estimate=identified.estimate, mass_matrix=identified.mass_matrix, model=identified.model,
        sources=identified.sources, prior=prior, standard=standard, is_consistent=False,
    )  # fmt: skip
    said = consistency_section(found)
    assert "Not all bodies and drives are physically consistent" in said
    rows = tables(said)["Mass and pseudo-inertia of each body"].rows
    lows = [[smallest_eigenvalue(pi[k : k + 10]) for pi in (prior, standard)] for k in (10, 20)]
    assert [row[3:5] for row in rows[1:3]] == [[number(x, ".3g") for x in low] for low in lows]
    assert [row[-1] for row in rows] == ["", "", "inconsistent", "", "", ""]


def test_the_notes_on_consistency_are_those_of_the_fit(report, identified):
    said = text_of(section(report, "consistency"))
    kinds = {kind: identified.sources.count(kind) for kind in ("data", "mixed", "prior", "bound")}
    assert (
        f"Sources of the 84 parameters: {kinds['data']} the data, {kinds['mixed']} data and "
        f"URDF together, {kinds['prior']} the URDF; {kinds['bound']} are at a physical "
        "bound."
    ) in said
    prior = identified.estimate.details["prior"]
    assert f"its weight is {prior['weight']:.3g}, " in said
    check = identified.mass_matrix
    assert f"(smallest eigenvalue {check.smallest_eigenvalue:.3g})" in said
    assert "All bodies and drives are physically consistent." in said


def test_the_notes_on_consistency_state_every_figure_with_its_unit(identified):
    details = {
        "prior": {"metric": "entropic", "weight": 0.02345, "chosen_by": "cv"},
        "active": ["a", "b"],
        "relaxed": ["c"],
        "pinned": ["d", "e"],
    }
    check = SimpleNamespace(
        is_positive=False, positive_share=0.9734, poses=321, smallest_eigenvalue=-0.01234
    )
    estimate = replace(identified.estimate, details=details)
    found = SimpleNamespace(
        estimate=estimate, mass_matrix=check, model=identified.model, sources=identified.sources
    )
    said = text_of(_consistency_notes(found)).split(" The mass matrix")[1]
    assert said == (
        ", armatures included, is positive definite at 97.3 % of 321 random poses (smallest "
        "eigenvalue -0.0123). The prior is the distance from the URDF's values by the divergence "
        "of the pseudo-inertias (entropic); its weight is 0.0234, selected by cross-validation on "
        "the fitted logs. Active constraints: a, b. Extents that contradict the data: c. Fixed at "
        "the URDF's values: d, e."
    )
    sources = ["prior"] * len(identified.sources)
    sources[:3], sources[60:] = ["data", "mixed", "bound"], ["data"] * (len(sources) - 60)
    said = _coverage(SimpleNamespace(model=identified.model, sources=tuple(sources)))
    bodies = identified.model.layout.bodies
    assert said == (
        f"Sources of the {len(sources)} parameters: {len(sources) - 59} the data, 1 data and URDF "
        "together, 57 the URDF; 1 are at a physical bound. "
        f"The data do not determine {', '.join(bodies[1:])}: URDF only."
    )


def test_shares_of_the_data_are_listed_weakest_first(shown, identified):
    caption = "Base parameters that the data determine by less than 99 %, the weakest first"
    K, spread = identified.mapping.K, identified.prior_std
    before = np.einsum("bp,p,bp->b", K, spread**2, K)
    share = before / (before + identified.wls.std_error**2)
    order = [k for k in np.argsort(share, kind="stable") if share[k] < 0.99]
    wanted = [[identified.mapping.base_names[k], number(100 * share[k], ".1f")] for k in order]
    assert shown[caption].rows == wanted
    assert len(wanted) > 2


def test_the_strongest_correlations_are_named_with_their_sign(shown, identified):
    (caption,) = [name for name in shown if name.startswith("The strongest of")]
    names, r = identified.mapping.base_names, information(identified).correlation
    pairs = [(abs(r[i, j]), i, j) for i in range(len(r)) for j in range(i) if abs(r[i, j]) >= 0.8]
    assert caption == f"The strongest of {len(pairs)} correlations of 0.8 and more"
    pairs.sort(key=lambda pair: -pair[0])
    wanted = [[names[i], names[j], number(r[i, j], ".3f")] for _, i, j in pairs[:15]]
    assert shown[caption].rows == wanted


def test_what_is_open_is_named(report, shown, identified):
    layout, said = identified.model.layout, text_of(section(report, "open"))
    assert f"The data determine {identified.determination.rank} of {len(identified.base)} " in said
    assert f"condition number {identified.wls.condition:.3g} (" in said
    never = ", ".join(identified.mapping.unidentifiable)
    assert f"Parameters without effect on the torque {never} Structural" in said
    kept = [n for n, s in zip(layout.names, identified.sources, strict=True) if s == "prior"]
    title = "Standard parameters that remain at the URDF's values"
    assert said.endswith(f"{title} {', '.join(kept)}")
    for row in shown["Structural identifiability of each body"].rows:
        kinds = identified.mapping.described([f"{row[0]}.{term}" for term in INERTIAL_TERMS])
        names = [[n.rsplit(".", 1)[1] for n in kinds[k]] for k in ("alone", "in sums", "never")]
        assert row[1:] == [", ".join(part) or "–" for part in names]


def test_settings_are_those_used(shown, identified):
    rows = dict(shown["Model and estimator"].rows)
    assert rows["estimator"] == "consistent"
    assert rows["robust"] == identified.estimator.robust
    message, count = identified.estimate.message, identified.estimate.n_iter
    assert rows["solver"] == f"{message} ({count} iterations)"
    assert rows["drive terms"] == "armature, viscous, coulomb, offset"
    assert rows["gravity [m/s²]"] == "0, 0, -9.81"
    assert rows["base"] == "fixed"
    assert rows["joints"] == ", ".join(identified.model.joints)
    assert rows["locked joints"] == "none"
    (caption,) = [name for name in shown if name.startswith("Signals, as used")]
    wanted = [
        [e.recording.name, f"{s.cutoff:g} Hz, order {s.order}", f"{s.rate:g}", s.velocity,
         f"{s.trim:g}", f"{s.min_velocity:g}", f"{s.max_gap:g}"]
        for e in (*identified.fitted, *identified.validation)
        for s in [e.recording.signals]
    ]  # fmt: skip
    assert shown[caption].rows == wanted
    assert shown[caption].column("rate Hz") == ["50", "40", "50"]


def test_inputs_are_the_files_with_their_hashes(shown, identified):
    rows = shown["Files read"].rows
    roles = ["URDF", "fitted", "fitted", "validation"]
    assert [row[0] for row in rows] == roles
    recordings = [e.recording for e in (*identified.fitted, *identified.validation)]
    paths = [identified.model.tree.path, *[r.log.path for r in recordings]]
    assert [row[1] for row in rows] == [str(path) for path in paths]
    digests = [hashlib.sha256(Path(path).read_bytes()).hexdigest() for path in paths]
    assert [row[7] for row in rows] == digests
    assert [row[2:7] for row in rows[1:]] == [
        ["180", "50", "0", "3.58", "1"],
        ["140", "40", "0", "3.475", "1"],
        ["270", "50", "0", "5.98", "2"],
    ]


def test_versions_are_listed(shown):
    assert dict(shown["Versions that ran"].rows) == versions()


def test_a_drive_parameter_that_stands_on_a_misfit_says_so(identified):
    found = replace(identified, on_misfit=("elbow_joint.coulomb",))
    rows = tables(shown_torques(found, Origin()).parameters)["Parameters of links and drives"].rows
    marked = [row[:2] for row in rows if row[8].endswith(", model misfit")]
    assert marked == [["elbow_joint", "coulomb"]]


def test_drives_have_a_column_for_each_term_that_is_there_or_was_sought():
    stated = [
        ("link.m", 2.0, 0.1, "kg"), ("one.viscous", 0.0, 0.25, "N m s/rad"),
        ("one.coulomb", 0.0, None, "N m"), ("two.coulomb", 0.0, None, "N m"),
        ("two.offset", -1.5, None, "N m"), ("two.delay", 0.0125, 0.0005, "s"),
        ("two.kp", 300.0, None, "N m/rad"),
    ]  # fmt: skip
    entries = [
        dict(zip(("name", "value", "std_error", "unit"), one, strict=True)) for one in stated
    ]
    (table,) = tables(_drive_table(entries)).values()
    heads = ["kp [N m/rad]", "delay [ms]", "viscous [N m s/rad]", "offset [N m]"]
    assert table.headers == ["joint", *heads]
    assert table.rows == [
        ["one", "–", "–", "0.00 ± 0.25", "–"], ["two", "300", "12.50 ± 0.50", "–", "−1.5"],
    ]  # fmt: skip
    assert _drive_table(entries[:1]) == ""
    many = [("two.viscous", 1.5, None, "N"), *((f"two.t{k}", 1.0, 0.5, "N") for k in range(7))]
    found = [dict(zip(("name", "value", "std_error", "unit"), x, strict=True)) for x in many]
    (table,) = tables(_drive_table(found)).values()
    assert table.headers == ["term", "two"]
    assert [row[0] for row in table.rows] == ["viscous [N]", *(f"t{k} [N]" for k in range(7))]
