"""The charts that Python is given of a result: of the joints named, shown and kept as a page."""

import re
from dataclasses import replace
from html import unescape
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import norm

from robotid.base.exceptions import DataError
from robotid.diagnosis.residual.torque_split import joint_torques
from robotid.output.report import pictures
from robotid.output.report.pictures import why_charts


def series(chart, label):
    (found,) = [s for s in chart.series if s.label.startswith(label)]
    return found


def test_torques_are_those_of_the_recording_kept_apart_or_of_the_one_asked_for(identified):
    j = identified.model.joints.index("elbow_joint")
    for recording, asked in (
        (identified.validation[0], None),
        (identified.fitted[1], identified.fitted[1]),
    ):
        plot = pictures.plot_torques(identified, "elbow_joint", recording=asked)
        assert plot.title == f"Torques of {recording.recording.name}"
        (torque, _), (residual, _) = plot.charts
        t, tau = recording.recording.trajectory.t, recording.recording.trajectory.tau[:, j]
        kept = np.isin(torque.x, t) & np.isfinite(series(torque, "measured").y)
        np.testing.assert_array_equal(series(torque, "measured").y[kept], tau)
        left = (tau - recording.torques["estimate"][:, j])[recording.recording.mask[:, j]]
        drawn = series(residual, "residual").y
        np.testing.assert_allclose(drawn[np.isfinite(drawn)], left, atol=1e-12)
    assert len(pictures.plot_torques(identified).charts) == 2 * len(identified.model.joints)


def test_friction_and_reasons_are_of_the_joint_named(identified):
    plot = pictures.plot_friction(identified, "elbow_joint", "wrist_1_joint")
    captions = [caption for _, caption in plot.charts]
    assert captions == ["elbow_joint: friction and offset", "wrist_1_joint: friction and offset"]
    assert len(pictures.plot_friction(identified).charts) == 6
    why = pictures.plot_why(identified, "wrist_2_joint")
    assert all(caption.startswith("wrist_2_joint") for _, caption in why.charts)
    split = why.charts[0][0]
    parts = [s for s in split.series if s.kind == "area"]
    whole = np.sum([s.y for s in parts], axis=0)
    np.testing.assert_allclose(whole, series(split, "measured").y, atol=1e-9)


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
        getattr(pictures, plot)(identified, "elbow_joind")


def test_a_notebook_shows_the_page_that_is_written(identified, tmp_path):
    plot = pictures.plot_friction(identified, "elbow_joint")
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


@pytest.mark.parametrize("n", [301, 4001])
def test_friction_is_drawn_at_position_and_load_of_the_samples_used(rng, monkeypatch, n):
    """Of at most 800 samples, spread over the recording."""
    row = 1
    v, q = rng.standard_normal((2, n, 2))
    mask = rng.random((n, 2)) < 0.6
    q[~mask[:, row], row] += 50.0
    motion = SimpleNamespace(v=v, q=q)
    loads = rng.standard_normal((2, n)) * [[1.0], [4.0]]
    left, friction = rng.standard_normal((2, n, 2))
    drives = [SimpleNamespace(name=name) for name in ("a", "b")]
    layout = SimpleNamespace(own={"b": (SimpleNamespace(name="load"),)}, drives=drives)
    model = SimpleNamespace(
        row_names=("a", "b"), row_units=("N m", "N"), layout=layout, passive=(), joints=("a", "b"),
        n_rows=2,
    )  # fmt: skip
    evaluation = SimpleNamespace(recording=SimpleNamespace(trajectory=motion, mask=mask))
    found = SimpleNamespace(model=model, validation=(evaluation,), fitted=(), standard=None)
    given = []

    def curve(found, joint, speeds, **at):
        given.append((joint, at))
        return SimpleNamespace(torque=speeds**3, std=0.5 + speeds**2)

    monkeypatch.setattr(pictures, "friction_curve", curve)
    along = SimpleNamespace(load=loads)
    monkeypatch.setattr(pictures, "drive_motion_along", lambda model, motion: along)
    chart = pictures.friction_chart(found, "b", split=(left, friction))
    used = np.flatnonzero(mask[:, row])
    used = used[:: -(-len(used) // 800)]
    used = used[np.argsort(v[used, row])]
    load = np.sqrt(np.mean(loads[row, used] ** 2))
    assert given == [
        ("b", {"q": pytest.approx(np.median(q[used, row])), "load": pytest.approx(load)})
    ]
    drawn = np.isfinite(series(chart, "measured").y)
    speed = v[used, row]
    np.testing.assert_array_equal(chart.x[drawn], speed)
    np.testing.assert_array_equal(series(chart, "measured").y[drawn], left[used, row])
    np.testing.assert_array_equal(series(chart, "identified").y[drawn], friction[used, row])
    steady = series(chart, f"steady at a load of {load:.3g} N, 95 % band")
    np.testing.assert_array_equal(steady.y[drawn], speed**3)
    np.testing.assert_allclose(steady.half[drawn], 1.96 * (0.5 + speed**2))
    assert (chart.x_label, chart.y_label) == ("speed [m/s]", "friction [N]")
    mask[:, row] = False
    assert pictures.friction_chart(found, "b", split=(left, friction)) is None


def test_a_line_hides_four_times_as_high_as_the_others_and_gaps_of_a_pixel_are_one():
    flat = np.array([0.0, np.nan, 1.0])
    assert not pictures._dwarfs(np.array([-1.9, 2.0]), flat, flat)
    assert pictures._dwarfs(np.array([-1.9, np.nan, 2.2]), flat, flat)
    t, used = np.arange(1001) / 10, np.ones(1001, dtype=bool)  # a pixel is 0.2 s
    used[[0, 100, 102, 104, 110, 1000]] = False
    spans = pictures.unused_spans(t, used)
    wanted = [(0.0, 0.1), (9.9, 10.5), (10.9, 11.1), (99.9, 100.0)]
    np.testing.assert_allclose(spans, wanted)


def test_reasons_of_two_recordings_show_the_first_over_time(identified):
    (j,) = (k for k, n in enumerate(identified.model.joints) if n == "wrist_2_joint")
    torque = joint_torques(identified)[j]
    n = len(torque.rows.t)
    recording = (np.arange(n) >= n // 3).astype(int)
    two = replace(torque, rows=replace(torque.rows, recordings=("a", "b"), recording=recording))
    charts = why_charts(two, link="shared", points=7)
    own = np.linspace(0, n // 3 - 1, 7).round().astype(int)
    for name, label in (("split", "measured"), ("power", "torque × speed")):
        chart = charts[name]
        assert chart.link == "shared"
        drawn = np.isfinite(series(chart, label).y)
        np.testing.assert_array_equal(chart.x[drawn], torque.rows.t[own])
    speed = torque.quantities["speed"][1]
    heat = series(charts["power"], "into friction").y[drawn]
    np.testing.assert_allclose(heat, (torque.parts["friction"] * speed)[own])
    used = np.flatnonzero(torque.used)
    for dependence in two.follows[1:]:
        chart, name = charts[dependence.name], dependence.name
        assert chart.link == ""  # time of two recordings is not that of one
        x = two.rows.time if name == "time" else torque.quantities[name][1]
        rows = used[np.argsort(x[used])]
        rows = rows[np.linspace(0, len(rows) - 1, 7).round().astype(int)]
        np.testing.assert_array_equal(chart.x, x[rows])
        mean, error = dependence.at(x[rows])
        np.testing.assert_array_equal(series(chart, "mean").y, mean)
        np.testing.assert_allclose(series(chart, "mean").half, 1.96 * error)
    assert why_charts(torque, link="shared")["time"].link == "shared"
