"""Every cell of the report's tables, against the result and against figures worked out again."""

import hashlib
import re
from dataclasses import asdict, replace
from html import unescape
from pathlib import Path

import numpy as np
import pytest
from helpers.figures import figures
from helpers.pages import number, percent, tables

from robotid.identification.information import information
from robotid.identification.summary import verdict_cell
from robotid.report import tables as report_tables
from robotid.robot.parameters import INERTIAL_TERMS
from robotid.versions import versions


@pytest.fixture(scope="module")
def shown(report):
    return tables(report)


def text_of(html):
    plain = re.sub(r"<style>.*?</style>|<svg.*?</svg>", "", html, flags=re.DOTALL)
    plain = re.sub(r"<wbr>", "", plain)
    return " ".join(re.sub(r"<[^>]*>", " ", plain).replace("&#x27;", "'").split())


def section(html, key):
    return html.split(f'<h2 id="{key}">')[1].split("</section>")[0]


@pytest.mark.parametrize(
    ("caption", "role"),
    [("kept.csv 0-5.98 s: not fitted", "validation"), ("All fitted rows together", "fitted")],
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
            "RMSE": number(measured["rmse"], ".3g"),
            "unit": "N m",
            "R²": number(measured["r2"], ".3f"),
            "rows": str(measured["rows"]),
            "WLS %": percent(measured["wls"]),
            "URDF %": percent(measured["urdf"]),
            "URDF + drives %": percent(measured["urdf_with_drives"]),
            "gravity only %": percent(measured["gravity_only"]),
            "zero %": "100.0",
            "verdict": verdict_cell(joint, asdict(identified.verdict.joints[joint])),
            "remark": "",
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
    assert f"({samples} samples after filtering, {rows} torque rows used)" in said
    assert "fitted to first.csv 0-3.58 s, second.csv 0-3.475 s (" in said
    assert "Kept apart for validation: kept.csv 0-5.98 s." in said
    assert "possible and leaves the URDF's value where the data say nothing (consistent)" in said


def relative(value, error):
    share = 100 * error / abs(value) if np.isfinite(error) else np.nan
    return "> 999" if share >= 1000 else percent(share)


def test_drive_parameters_have_their_values_errors_units_and_sources(shown, identified):
    layout = identified.model.layout
    rows = shown["Armature, friction and torque offset"].rows
    assert len(rows) == 24
    units = {"armature": "kg m^2", "viscous": "N m s/rad", "coulomb": "N m", "offset": "N m"}
    for row in rows:
        i = layout.names.index(row[0])
        value, error = identified.standard[i], np.sqrt(identified.standard_covariance[i, i])
        unit = units[row[0].rsplit(".", 1)[1]]
        said = [number(value), number(error, ".2g"), relative(value, error)]
        if identified.sources[i] == "bound":
            assert 0.0 <= value < 1e-6
            said = ["0, at its bound", "–", "–"]
        assert row[1:] == [*said, unit, identified.sources[i]]
    assert [row[0] for row in rows if row[1] == "0, at its bound"] == ["elbow_joint.viscous"]


def test_base_parameters_have_their_values_errors_and_expressions(shown, identified):
    mapping, rows = identified.mapping, shown["Base parameters"].rows
    assert [row[0] for row in rows] == list(mapping.base_names)
    assert len({row[2] for row in rows}) > 20  # errors differ: one for all would show
    for k, row in enumerate(rows):
        value, error = float(mapping.K[k] @ identified.standard), identified.base_error[k]
        assert row[1] == number(value) == number(identified.base[k])
        assert row[2:4] == [number(error, ".2g"), relative(value, error)]
        assert row[4] == identified.model.layout.units[mapping.independent[k]]
        assert row[5] == mapping.expressions[k]


def test_standard_parameters_stand_beside_those_of_the_urdf(shown, identified):
    layout, rows = identified.model.layout, shown["Standard parameters of the bodies"].rows
    assert [row[0] for row in rows] == [f"{b}.{t}" for b in layout.bodies for t in INERTIAL_TERMS]
    urdf = np.concatenate(
        [body.toDynamicParameters() for body in list(identified.model.pin_model.inertias)[1:]]
    )
    for i, row in enumerate(rows):
        error = np.sqrt(identified.standard_covariance[i, i])
        unit = "kg" if i % 10 == 0 else "kg m" if i % 10 < 4 else "kg m^2"
        assert row[1] == number(urdf[i])
        assert row[2:] == [
            number(identified.standard[i]), number(error, ".2g"), unit, identified.sources[i]
        ]  # fmt: skip
    columns = shown["Standard parameters of the bodies"]
    assert columns.column("URDF") != columns.column("identified")
    assert len(set(columns.column("source"))) > 1


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


def test_the_notes_on_consistency_are_those_of_the_fit(report, identified):
    said = text_of(section(report, "consistency"))
    kinds = {kind: identified.sources.count(kind) for kind in ("data", "mixed", "prior", "bound")}
    assert (
        f"of 84 parameters {kinds['data']} come from the data, {kinds['mixed']} from data and "
        f"URDF together, {kinds['prior']} from the URDF; {kinds['bound']} are at a bound of "
        "physics."
    ) in said
    prior = identified.estimate.details["prior"]
    assert f"its weight is {prior['weight']:.3g}, " in said
    check = identified.mass_matrix
    assert f"(smallest eigenvalue {check.smallest_eigenvalue:.3g})" in said
    assert "Every body and drive is physically possible." in said


def test_shares_of_the_data_are_listed_weakest_first(shown, identified):
    caption = "Base parameters that the data settle by less than 99 %, the weakest first"
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
    assert f"Parameters that no motion can show {never} What any motion" in said
    kept = [n for n, s in zip(layout.names, identified.sources, strict=True) if s == "prior"]
    title = "Standard parameters that remain as the URDF has them, or nearly"
    assert said.endswith(f"{title} {', '.join(kept)}")
    for row in shown["What any motion can show of each body"].rows:
        kinds = identified.mapping.in_words([f"{row[0]}.{term}" for term in INERTIAL_TERMS])
        names = [[n.rsplit(".", 1)[1] for n in kinds[k]] for k in ("alone", "in sums", "never")]
        assert row[1:] == [", ".join(part) or "–" for part in names]


def test_settings_are_those_used(shown, identified):
    rows = dict(shown["Model and estimator"].rows)
    assert rows["estimator"] == "consistent"
    assert rows["robust"] == identified.estimator.robust
    assert rows["margin"] == str(identified.estimator.margin)
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


def test_findings_stand_under_their_severity_with_code_message_and_place(shown, findings):
    assert shown["Errors: 1"].rows == [["alike", "a column is there twice", "elbow_joint"]]
    assert shown["Warnings: 2"].rows == [
        [f.code, f.message, f.where] for f in findings if f.severity == "warning"
    ]


def test_versions_are_listed(shown):
    assert dict(shown["Versions that ran"].rows) == versions()


def test_a_drive_parameter_that_stands_on_a_misfit_says_so(identified):
    found = replace(identified, on_misfit=("elbow_joint.coulomb",))
    rows = re.split("</tr>", report_tables.tables(found)["drives"].replace("<wbr>", ""))
    marked = [row for row in rows if "on a misfit" in row]
    assert len(marked) == 1
    assert "elbow_joint.coulomb" in marked[0]
