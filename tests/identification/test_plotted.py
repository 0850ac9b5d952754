"""The charts that Python is given of a result: of the joints named, shown and kept as a page."""

import re
from html import unescape
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.signal
from scipy.stats import norm

from robotid.diagnosis.torque_split import joint_torques
from robotid.exceptions import DataError
from robotid.identification.pictures import residual_charts
from robotid.identification.why_pictures import why_charts
from robotid.logs.data import Trajectory
from robotid.logs.settings import SignalSettings


def series(chart, label):
    (found,) = [s for s in chart.series if s.label.startswith(label)]
    return found


def test_torques_are_those_of_the_recording_kept_apart_or_of_the_one_asked_for(identified):
    j = identified.model.joints.index("elbow_joint")
    for recording, asked in (
        (identified.validation[0], None),
        (identified.fitted[1], identified.fitted[1]),
    ):
        plot = identified.plot_torques("elbow_joint", recording=asked)
        assert plot.title == f"Torques of {recording.recording.name}"
        (torque, _), (residual, _) = plot.charts
        t, tau = recording.recording.trajectory.t, recording.recording.trajectory.tau[:, j]
        kept = np.isin(torque.x, t) & np.isfinite(series(torque, "measured").y)
        np.testing.assert_array_equal(series(torque, "measured").y[kept], tau)
        left = (tau - recording.torques["estimate"][:, j])[recording.recording.mask[:, j]]
        drawn = series(residual, "residual").y
        np.testing.assert_allclose(drawn[np.isfinite(drawn)], left, atol=1e-12)
    assert len(identified.plot_torques().charts) == 2 * len(identified.model.joints)


def test_friction_and_reasons_are_of_the_joint_named(identified):
    plot = identified.plot_friction("elbow_joint", "wrist_1_joint")
    captions = [caption for _, caption in plot.charts]
    assert captions == ["elbow_joint: friction and offset", "wrist_1_joint: friction and offset"]
    assert len(identified.plot_friction().charts) == 6
    why = identified.plot_why("wrist_2_joint")
    assert all(caption.startswith("wrist_2_joint") for _, caption in why.charts)
    split = why.charts[0][0]
    parts = [s for s in split.series if s.kind == "area"]
    whole = np.sum([s.y for s in parts], axis=0)
    np.testing.assert_allclose(whole, series(split, "measured").y, atol=1e-9)


@pytest.mark.parametrize("cutoff", [30.0, None])
def test_a_spectrum_goes_to_twice_the_cut_off_and_lags_to_two_seconds(rng, cutoff):
    """Of a recording at 1024 Hz, of whose lags every fifth is shown."""
    rate = 1024.0
    t = 3.0 + np.arange(6000) / rate
    tau, predicted = rng.standard_normal((2, len(t), 2)).cumsum(axis=1)
    still = np.zeros_like(tau)
    motion = Trajectory(t, still, still, still, tau, ("a", "b"), rate, np.zeros(len(t), dtype=int))
    recording = SimpleNamespace(
        trajectory=motion, mask=np.ones(tau.shape), signals=SignalSettings(cutoff=cutoff)
    )
    evaluation = SimpleNamespace(recording=recording, torques={"estimate": predicted})
    found = SimpleNamespace(model=SimpleNamespace(row_names=("a", "b"), row_units=("N m", "N")))
    power, lags = residual_charts(found, evaluation, 1)
    residual = (tau - predicted)[:, 1]
    for x, label in ((tau[:, 1], "torque"), (residual, "residual")):
        window = np.hanning(5122)[1:-1]
        f, density = scipy.signal.welch(x, rate, window, nperseg=5120, detrend=False)
        shown = (f > 0) & (f <= (np.inf if cutoff is None else 60.0))
        np.testing.assert_allclose(power.x, f[shown])
        np.testing.assert_allclose(series(power, label).y, np.sqrt(density[shown]))
    ks = np.arange(0, 2049, 5)
    np.testing.assert_allclose(lags.x, ks / rate)
    pairs = [(residual[: len(t) - k], residual[k:]) for k in ks]
    wanted = [a @ b / np.sqrt((a @ a) * (b @ b)) for a, b in pairs]
    np.testing.assert_allclose(series(lags, "residual").y, wanted, atol=1e-9)
    marks = () if cutoff is None else (30.0,), () if cutoff is None else (1 / 60.0,)
    assert (power.marks, lags.marks) == (marks[0], pytest.approx(marks[1]))
    assert (power.y_label, lags.x_label) == ("density [N/√Hz]", "lag [s]")
    recording.mask[:, 1] = 0.0
    assert residual_charts(found, evaluation, 1) is None


def test_what_a_residual_follows_is_drawn_with_its_interval_and_what_friction_takes(identified):
    (j,) = (k for k, n in enumerate(identified.model.joints) if n == "wrist_2_joint")
    torque = joint_torques(identified)[j]
    charts = why_charts(torque)
    speed = torque.quantities["speed"][1]
    assert [d.name for d in torque.follows if d.name in charts] == [
        "position", "speed", "acceleration", "load", "time",
    ]  # fmt: skip
    for dependence in torque.follows[1:]:
        chart = charts[dependence.name]
        x = torque.quantities.get(dependence.name, ("s", torque.rows.time))[1][torque.used]
        left = torque.against_time[0] if dependence.name == "time" else torque.residual
        order = np.argsort(x)
        np.testing.assert_array_equal(chart.x, x[order])
        np.testing.assert_array_equal(series(chart, "residual").y, left[torque.used][order])
        mean = series(chart, "mean")
        own = (dependence.centres, dependence.means, dependence.errors)
        wanted, error = (np.interp(chart.x, own[0], y, np.nan, np.nan) for y in own[1:])
        np.testing.assert_array_equal(mean.y, wanted)
        np.testing.assert_allclose(mean.half, norm.ppf(0.975) * error, rtol=1e-4)
    power = charts["power"]
    whole, heat = (series(power, label).y for label in ("torque", "into friction"))
    drawn = np.isfinite(whole)  # a gap has no line
    np.testing.assert_allclose(whole[drawn], torque.tau * speed)
    np.testing.assert_allclose(heat[drawn], torque.parts["friction"] * speed)


@pytest.mark.parametrize("plot", ["plot_torques", "plot_friction", "plot_why"])
def test_another_joint_is_refused_by_name(identified, plot):
    words = (
        r"joint 'elbow_joind' is not among the identified joints: .*Did you mean 'elbow_joint'\?"
    )
    with pytest.raises(DataError, match=words):
        getattr(identified, plot)("elbow_joind")


def test_a_notebook_shows_the_page_that_is_written(identified, tmp_path):
    plot = identified.plot_friction("elbow_joint")
    path = plot.write(tmp_path / "friction.html")
    page = path.read_text()
    assert page.count('<figure class="chart"') == 1
    assert "Content-Security-Policy" in page
    (inside,) = re.findall(r'<iframe [^>]*srcdoc="([^"]*)"', plot._repr_html_())
    assert unescape(inside) == page
    assert repr(plot) == (
        "<Plot of Friction of elbow_joint against speed; .write('plot.html') saves it>"
    )
    with pytest.raises(DataError, match="does not exist; create it"):
        plot.write(tmp_path / "none" / "friction.html")
