"""The report's plots, read back in the units of their axes, against the series they claim."""

import re
import xml.etree.ElementTree as ET

import numpy as np
import pytest
from helpers.figures import torques
from helpers.pages import assert_drawn, plot

from robotid.identification.information import information
from robotid.report.residuals import autocorrelation, spectrum
from robotid.robot.parameters import INERTIAL_TERMS

JOINTS = range(6)


@pytest.fixture(scope="module")
def kept(identified):
    return identified.validation[0]


@pytest.fixture(scope="module")
def predicted(identified, kept):
    return torques(identified, kept.recording.trajectory)["estimate"]


def stretches_of(used, segment):
    """Return how many uninterrupted runs of rows there are."""
    starts = used & ~np.r_[False, used[:-1] & (np.diff(segment) == 0)]
    return int(starts.sum())


@pytest.mark.parametrize("j", JOINTS)
def test_torque_is_drawn_as_measured_predicted_and_residual(report, kept, predicted, j):
    trajectory, used = kept.recording.trajectory, kept.recording.mask[:, j].astype(bool)
    t, tau, model = trajectory.t, trajectory.tau[:, j], predicted[:, j]
    upper, lower = plot(report, f"tau0-{j}", 1, x_of=2), plot(report, f"tau0-{j}", 2)
    runs = stretches_of(used, trajectory.segment)
    assert_drawn(upper.line("currentColor", 0.6), t, tau, parts=2)
    assert_drawn(upper.line("var(--predicted)"), t[used], model[used], parts=runs)
    assert_drawn(lower.line("var(--residual)"), t[used], (tau - model)[used], parts=runs)


@pytest.mark.parametrize("j", JOINTS)
def test_the_band_is_that_of_the_joint(report, identified, kept, j):
    trajectory, band = kept.recording.trajectory, identified.band(kept)
    drawn = np.vstack(plot(report, f"tau0-{j}", 2).patches("FillBetweenPolyCollection"))
    half = 1.96 * band.total[:, j]
    times = trajectory.t[band.samples]
    wanted = np.interp(drawn[:, 0], times, half)
    np.testing.assert_allclose(np.abs(drawn[:, 1]), wanted, atol=0.03 * half.max())
    assert (drawn[:, 1] > 0).sum() == pytest.approx((drawn[:, 1] < 0).sum(), abs=4)


def rows_of_friction(kept, j):
    return np.flatnonzero(kept.recording.mask[:, j])


@pytest.mark.parametrize("j", JOINTS)
def test_friction_is_drawn_against_speed(report, identified, kept, predicted, j):
    trajectory, rows = kept.recording.trajectory, rows_of_friction(kept, j)
    value = dict(zip(identified.model.layout.names, identified.standard, strict=True))
    joint, v = identified.model.joints[j], trajectory.v[rows, j]
    sign = np.sign(v) if trajectory.direction is None else trajectory.direction[rows, j]
    friction = value[f"{joint}.viscous"] * v + value[f"{joint}.coulomb"] * sign
    friction += value[f"{joint}.offset"]
    left = trajectory.tau[rows, j] - predicted[rows, j] + friction
    axes = plot(report, f"friction{j}")
    for colour, opacity, series in (
        ("currentColor", 0.4, left),
        ("var(--predicted)", 1.0, friction),
    ):
        dots = np.array([part[0] for part in axes.line(colour, opacity).parts])
        assert len(dots) == len(rows)
        np.testing.assert_allclose(dots[:, 0], v, atol=2e-3 * np.ptp(v))
        np.testing.assert_allclose(dots[:, 1], series, atol=3e-3 * np.ptp(left))


@pytest.mark.parametrize("j", JOINTS)
def test_the_spectrum_is_that_of_torque_and_residual(report, kept, predicted, j):
    recording = kept.recording
    trajectory, used = recording.trajectory, recording.mask[:, j].astype(bool)
    axes = plot(report, f"residual{j}", 1, log_y=True)
    tau, residual = trajectory.tau[:, j], (trajectory.tau - predicted)[:, j]
    for colour, opacity, x in (("currentColor", 0.6, tau), ("var(--residual)", 1.0, residual)):
        f, density = spectrum(x, used, trajectory.segment, 0.02)
        shown = (f > 0) & (f <= 24.0)  # twice the cut-off
        decades = np.log10(np.sqrt(density[shown]))
        points = np.vstack(axes.line(colour, opacity).parts)
        wanted = np.interp(points[:, 0], f[shown], decades)
        np.testing.assert_allclose(np.log10(points[:, 1]), wanted, atol=0.06)
        assert points[-1, 0] == pytest.approx(f[shown][-1], abs=0.05)


@pytest.mark.parametrize("j", JOINTS)
def test_the_autocorrelation_is_that_of_the_residual(report, kept, predicted, j):
    recording = kept.recording
    trajectory, used = recording.trajectory, recording.mask[:, j].astype(bool)
    residual = (trajectory.tau - predicted)[:, j]
    r = autocorrelation(residual, used, trajectory.segment, 99)  # 2 s at 50 Hz
    assert_drawn(plot(report, f"residual{j}", 2).line("var(--residual)"), 0.02 * np.arange(100), r)


def bars(axes):
    """Return the ends of the error bars, lowest row first."""
    return np.array(sorted(axes.patches("LineCollection"), key=lambda ends: ends[0, 1]))


@pytest.mark.parametrize("term", ["armature", "viscous", "coulomb", "offset"])
def test_drives_show_prior_spread_value_and_two_standard_errors(report, identified, term):
    joints, names = identified.model.joints, list(identified.model.layout.names)
    part = [names.index(f"{joint}.{term}") for joint in joints]
    axes = plot(report, f"{term}0")
    assert list(axes.y.names) == list(joints)
    heights = list(axes.y.names.values())
    prior, value = (x[part] for x in (identified.prior, identified.standard))
    error, spread = identified.standard_error[part], identified.prior_std[part]
    assert np.isinf(error).tolist() == [j == "elbow_joint" and term == "viscous" for j in joints]
    error = np.where(np.isinf(error), 0.0, error)  # at its bound: no bar
    reach = np.ptp([*(value - 2 * error), *(value + 2 * error), *prior])
    close = 5e-3 * reach
    lines = [line for line in axes.lines() if len(line.marks) == len(part)]
    before = lines[0]
    after = [line for line in lines if line.colour == "var(--predicted)"][-1]  # above its caps
    np.testing.assert_allclose(before.marks[:, 1], heights, atol=0.02)
    np.testing.assert_allclose(before.marks[:, 0], prior, atol=close)
    np.testing.assert_allclose(after.marks[:, 0], value, atol=close)
    np.testing.assert_allclose(after.marks[:, 1], heights, atol=0.02)
    drawn = bars(axes)
    np.testing.assert_allclose(drawn[:, 0, 1], heights, atol=0.02)
    np.testing.assert_allclose(drawn[:, 0, 0], value - 2 * error, atol=close)
    np.testing.assert_allclose(drawn[:, 1, 0], value + 2 * error, atol=close)
    widths = [np.ptp(corners[:, 0]) for corners in axes.patches() if len(corners) >= 4]
    np.testing.assert_allclose(widths[: len(part)], 2 * spread, rtol=1e-2, atol=close)


@pytest.mark.parametrize("i", JOINTS)
def test_bodies_show_the_urdf_beside_what_was_identified(report, identified, i):
    part = slice(10 * i, 10 * i + 10)
    prior, value, error, spread = (
        x[part]
        for x in (
            identified.prior,
            identified.standard,
            identified.standard_error,
            identified.prior_std,
        )
    )
    axes = plot(report, f"body{i}")
    assert list(axes.y.names) == list(INERTIAL_TERMS)
    heights = np.array(list(axes.y.names.values()))
    lines = [line for line in axes.lines() if len(line.marks) == 10]
    urdf = next(line for line in lines if line.colour == "currentColor")
    ours = [line for line in lines if line.colour == "var(--predicted)"][-1]  # above its caps
    close = 6e-3 * np.ptp([*urdf.marks[:, 0], *bars(axes)[:, :, 0].ravel()])
    np.testing.assert_allclose(urdf.marks[:, 0], prior / spread, atol=close)
    np.testing.assert_allclose(ours.marks[:, 0], value / spread, atol=close)
    assert (urdf.marks[:, 1] < heights).all()
    assert (ours.marks[:, 1] > heights).all()
    drawn = bars(axes)
    np.testing.assert_allclose(drawn[:, 0, 0], (value - 2 * error) / spread, atol=close)
    np.testing.assert_allclose(drawn[:, 1, 0], (value + 2 * error) / spread, atol=close)


def test_singular_values_are_those_of_the_regressor(report, identified):
    axes = plot(report, "singular", log_y=True)
    values, rank = information(identified).singular_values, identified.wls.rank
    determined = next(line for line in axes.lines() if line.colour == "var(--predicted)")
    np.testing.assert_allclose(determined.marks[:, 0], np.arange(1, rank + 1), atol=0.05)
    drawn = np.log10(determined.marks[:, 1])
    np.testing.assert_allclose(drawn, np.log10(values[:rank]), atol=0.02)


def test_correlations_are_drawn_in_their_cell_with_their_sign_and_strength(report, identified):
    svg = re.search(r'<svg class="map".*?</svg>', report, re.DOTALL)[0]
    r = information(identified).correlation
    b = len(r)
    root = ET.fromstring(svg)
    corner = min(
        float(text.get("x")) for text in root.iter("text") if text.get("text-anchor") is None
    )
    drawn = np.zeros((b, b))
    for path in root.iter("path"):
        sign = {"var(--predicted)": 1, "var(--residual)": -1}[path.get("fill")]
        for x, y in re.findall(r"M(\d+) (\d+)h", path.get("d")):
            i, j = round(int(y) / 11), round((int(x) - corner + 2) / 11)
            drawn[i, j] = sign * float(path.get("fill-opacity"))
    wanted = np.rint(8 * np.tril(r, -1)) / 8
    np.testing.assert_allclose(drawn, wanted, atol=1e-3)
    assert (wanted > 0).sum() != (wanted < 0).sum()
