"""The report's charts: the data in the page against the series they claim."""

import numpy as np
import pytest
from helpers.figures import torques
from helpers.pages import chart

JOINTS = range(6)


@pytest.fixture(scope="module")
def kept(identified):
    return identified.validation[0]


@pytest.fixture(scope="module")
def predicted(identified, kept):
    return torques(identified, kept.recording.trajectory)["estimate"]


def close(drawn, wanted):
    """Assert that a series is the data, to what 16 bits tell apart."""
    assert np.isnan(drawn).tolist() == np.isnan(wanted).tolist()
    np.testing.assert_allclose(drawn, wanted, atol=2e-5 * (np.nanmax(wanted) - np.nanmin(wanted)))


@pytest.mark.parametrize("j", JOINTS)
def test_torque_is_drawn_as_measured_identified_urdf_and_residual(
    report, identified, kept, predicted, j
):
    name, motion = identified.model.joints[j], kept.recording.trajectory
    used, tau = kept.recording.mask[:, j].astype(bool), motion.tau[:, j]
    upper = chart(report, f"Torque of {name} over time:")
    lower = chart(report, f"Residual of {name} over time, m")
    # the rows that the page has, between them one that breaks the line at the gap
    t = np.insert(motion.t, np.flatnonzero(np.diff(motion.segment)) + 1, np.nan)
    assert motion.t[0] == pytest.approx(upper["x"][0], abs=1e-6)  # the log's own time
    np.testing.assert_allclose(upper["x"][np.isfinite(t)], motion.t, atol=1e-6)
    blank = np.where(used, 0.0, np.nan)
    urdf, measured, ours = (series["y"][np.isfinite(t)] for series in upper["series"])
    close(measured, tau)
    close(ours, predicted[:, j] + blank)
    close(urdf, kept.torques["urdf"][:, j] + blank)
    close(lower["series"][1]["y"][np.isfinite(t)], tau - predicted[:, j] + blank)
    assert np.isnan(upper["series"][1]["y"]).sum() == np.isnan(t).sum() == 1
    assert upper["link"] == lower["link"] != ""


@pytest.mark.parametrize("j", JOINTS)
def test_the_band_is_that_of_the_joint(report, identified, kept, j):
    name, band = identified.model.joints[j], identified.band(kept)
    t = kept.recording.trajectory.t
    for title in ("Torque of {} over time:", "Residual of {} over time, m"):
        what = chart(report, title.format(name))
        (series,) = [series for series in what["series"] if series["half"] is not None]
        known = np.isfinite(series["half"])
        half = np.interp(what["x"][known], t[band.samples], 1.96 * band.total[:, j])
        np.testing.assert_allclose(series["half"][known], half, rtol=0.02)


@pytest.mark.parametrize("j", JOINTS)
def test_friction_is_drawn_against_speed(report, identified, kept, predicted, j):
    motion, rows = kept.recording.trajectory, np.flatnonzero(kept.recording.mask[:, j])
    value = dict(zip(identified.model.layout.names, identified.standard, strict=True))
    joint, v = identified.model.joints[j], motion.v[rows, j]
    sign = np.sign(v) if motion.direction is None else motion.direction[rows, j]
    own = [value[f"{joint}.{term}"] for term in ("viscous", "coulomb", "offset")]
    friction = own[0] * v + own[1] * sign + own[2]
    left = motion.tau[rows, j] - predicted[rows, j] + friction
    what = chart(report, f"Friction of {joint} against speed")
    known = np.isfinite(what["series"][0]["y"])
    order = np.argsort(v, kind="stable")
    np.testing.assert_allclose(what["x"][known], v[order], atol=1e-6)
    dots, ours, steady = (series["y"][known] for series in what["series"])
    close(dots, left[order])
    close(ours, friction[order])
    close(steady, own[0] * v[order] + own[1] * np.sign(v[order]) + own[2])
    assert known.sum() == len(known) - 1  # dry friction jumps: the line breaks where it turns
