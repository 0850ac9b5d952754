"""Every cell of the report's tables, against the result and against figures worked out again."""

from dataclasses import asdict, replace
from decimal import Decimal

import numpy as np
import pytest
from helpers.figures import figures
from helpers.pages import number, percent, tables

from robotid.identification.summary import verdict_cell
from robotid.output.report.next_steps import Origin
from robotid.output.report.report_content import torque_report


@pytest.fixture(scope="module")
def shown(report):
    return tables(report)


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


def test_a_drive_parameter_that_stands_on_a_misfit_says_so(identified):
    found = replace(identified, on_misfit=("elbow_joint.coulomb",))
    rows = tables(torque_report(found, Origin()).parameters)["Parameters of links and drives"].rows
    marked = [row[:2] for row in rows if row[8].endswith(", model misfit")]
    assert marked == [["elbow_joint", "coulomb"]]
