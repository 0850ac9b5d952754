"""Fits of a hoist: figures as stored, and as an independent computation has them."""

import json
import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from helpers.figure_runs import CURRENTS
from helpers.hoist import INERTIAL, Drive, Hoist, own, parameters, regressor_torque, standardised
from helpers.stored import path_of

from robotid.output.files.exports import formats


@pytest.mark.parametrize("name", ["arm", "currents", "motors", "static"])
def test_all_figures_are_those_that_are_stored(same, name):
    same(name)


def test_every_format_of_exports_is_stored():
    stored = {
        **json.loads(path_of("arm").read_text()),
        **json.loads(path_of("commands").read_text()),
    }
    assert {f"exported {kind}" for kind in formats()} <= stored.keys()


def rms(x):
    return float(np.sqrt(np.mean(np.square(x))))


@pytest.mark.parametrize("name", ["arm", "motors"])
def test_estimates_scatter_about_the_truth_as_their_errors_say(ran, name):
    known = ran(name)[1]
    values = parameters(known["hoist"])
    if name == "arm":
        values |= {f"roll.{key}": x for key, x in vars(known["hoist"].coupled).items()}
    else:
        for joint, drive in zip(("swing", "lift"), known["drives"], strict=True):
            values |= {f"{joint}.{key}": x for key, x in vars(drive).items()}
    z = standardised(known["result"], values)
    assert 0.5 < rms(z) < 1.7
    assert np.abs(z).max() < 4


def test_gravity_is_found_of_slow_motion(ran):
    known = ran("static")[1]
    values = parameters(known["hoist"])
    entries = [
        entry for entry in known["result"]["base_parameters"]
        if entry["expression"].split()[0].rpartition(".")[2] in INERTIAL
    ]  # fmt: skip
    assert len(entries) == 5
    z = standardised({"base_parameters": entries}, values)
    assert 0.3 < rms(z) < 2
    assert "all parameters are physically consistent" in " ".join(
        known["result"]["verdict"]["reasons"]
    )


def test_currents_times_gains_are_the_torques_of_the_robot(ran):
    known = ran("currents")[1]
    values = parameters(known["hoist"]) | {f"{joint}.asymmetric": 0.0 for joint in CURRENTS}
    drives = [
        entry for entry in known["result"]["base_parameters"]
        if entry["name"].startswith(("lift.", "reach."))
    ]  # fmt: skip
    z = standardised({"base_parameters": drives}, values)
    assert len(z) >= 7
    assert np.abs(z).max() < 4


def test_sizes_rows_and_times_are_those_of_the_files(ran):
    known = ran("arm")[1]
    logs, inputs = known["logs"], known["result"]["inputs"][1:]
    for entry, name, (low, high), pieces in zip(
        inputs, ("first", "second", "kept"), ((51, 61.5), (-np.inf, np.inf), (3.5, np.inf)),
        (2, 1, 1), strict=True,
    ):  # fmt: skip
        t = logs[name][0]
        if name == "first":
            t = np.delete(t, slice(500, 560))
        t = t[(t >= low - 1e-9) & (t <= high + 1e-9)]
        assert entry["samples"] == len(t)
        assert entry["segments"] == pieces
        assert (entry["start"], entry["end"]) == pytest.approx((t[0], t[-1]))
        assert entry["rate"] == pytest.approx(1 / np.median(np.diff(t)))
        assert 3.0 * len(t) < entry["rows_used"] < 4 * len(t)
    per_joint = known["result"]["validation"][0]["per_joint"]
    assert inputs[2]["rows_used"] == sum(m["rows"] for m in per_joint.values())


def test_errors_are_shares_of_the_torque_that_the_robot_has(ran):
    """RMS error over its percentage is the torque's RMS; the error is the filtered noise."""
    known = ran("arm")[1]
    t, q, v, a, tau = known["logs"]["kept"]
    used = (t > 3.75) & (t < t[-1] - 0.25)
    fast = np.abs(v * [1, 1, 2 * np.pi / 0.5, 1]) > 0.03  # a slider by its range in a turn
    result = known["result"]
    values = {entry["name"]: entry["value"] for entry in result["standard_parameters"]}
    values |= {entry["name"]: entry["value"] for entry in result["drive_parameters"]}
    hoist = known["hoist"]
    drive = {
        k: values.pop(f"roll.{k}") for k in ("armature", "viscous", "coulomb", "offset", "load")
    }
    predicted = regressor_torque(hoist, values, q, v, a)
    ratios = np.array(hoist.coupling)
    rigid = replace(hoist, drives=dict.fromkeys(hoist.joints, Drive()), coupling=()).torque(q, v, a)
    load = rigid @ ratios / (ratios @ ratios)
    predicted += own(Drive(**drive), q @ ratios, v @ ratios, a @ ratios, load)[:, None] * ratios
    for j, (joint, m) in enumerate(result["validation"][0]["per_joint"].items()):
        rows = used & fast[:, j]
        assert m["rows"] == pytest.approx(rows.sum(), rel=0.05)
        expected = rms(tau[rows, j])
        assert 100 * m["rmse"] / m["relative_error_pct"] == pytest.approx(expected, rel=0.02)
        # what the estimate misses of the torque without noise is less than what it misses with it
        assert rms((predicted - tau)[rows, j]) < 1.1 * m["rmse"], joint
        assert m["unit"] == ("N" if joint == "reach" else "N m")


def test_the_written_robot_has_the_torque_of_the_estimate(ran):
    runs, known = ran("arm")
    result, hoist = known["result"], known["hoist"]
    values = {entry["name"]: entry["value"] for entry in result["standard_parameters"]}
    rng = np.random.default_rng(0)
    q, v, a = rng.uniform(-1, 1, (3, 20, 4))
    wanted = regressor_torque(hoist, values, q, v, a)
    for file in ("out/hoist.identified.urdf", "x.urdf"):
        text = (runs.folder / file).read_text()
        model = Hoist(text=text, bodies={}, gravity=hoist.gravity).model()
        data = model.createData()
        place = np.column_stack([q[:, :3], np.cos(q[:, 3]), np.sin(q[:, 3])])
        tau = [pin.rnea(model, data, *state) for state in zip(place, v, a, strict=True)]
        np.testing.assert_allclose(tau, wanted, rtol=1e-6, atol=1e-6)
    sidecar = (runs.folder / "out/hoist.identified.drive.json").read_text()
    for entry in result["drive_parameters"]:
        assert f"{entry['value']:.6g}"[:6] in sidecar or repr(entry["value"]) in sidecar
    total = sum(link["mass"] for link in result["consistency"]["links"])
    for file in ("x.xml", "x.sdf"):
        tree = ET.parse(runs.folder / file)
        masses = [float(x.get("mass")) for x in tree.iter("inertial") if x.get("mass")]
        masses += [float(x.text) for x in tree.iter("mass")]
        assert sum(masses) == pytest.approx(total, rel=1e-6)
    assert json.loads(sidecar)
