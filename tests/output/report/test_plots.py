"""Charts of an identification for a notebook, and rules of what is drawn."""

import numpy as np
from scipy.stats import norm

from robotid.diagnosis.residual.joint_torques import joint_torques
from robotid.output.report import pictures
from robotid.output.report.pictures import why_charts


def series(chart, label):
    (found,) = [s for s in chart.series if s.label.startswith(label)]
    return found


def test_torques_are_those_of_the_recording_kept_apart_or_of_the_one_asked_for(identified):
    j = identified.model.joints.index("elbow_joint")
    for shown, asked in ((identified.validation[0], None), (identified.fitted[1],) * 2):
        plot = pictures.plot_torques(identified, "elbow_joint", recording=asked)
        assert plot.title == f"Torques of {shown.recording.name}"
        measured = series(plot.charts[0][0], "measured").y
        tau = shown.recording.trajectory.tau[:, j]
        np.testing.assert_array_equal(measured[np.isfinite(measured)], tau)
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


def test_what_a_residual_follows_is_drawn_with_its_interval(identified):
    (j,) = (k for k, n in enumerate(identified.model.joints) if n == "wrist_2_joint")
    torque = joint_torques(identified)[j]
    charts = why_charts(torque)
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


def test_a_line_hides_four_times_as_high_as_the_others_and_gaps_of_a_pixel_are_one():
    flat = np.array([0.0, np.nan, 1.0])
    assert not pictures._dwarfs(np.array([-1.9, 2.0]), flat, flat)
    assert pictures._dwarfs(np.array([-1.9, np.nan, 2.2]), flat, flat)
    t, used = np.arange(1001) / 10, np.ones(1001, dtype=bool)  # a pixel is 0.2 s
    used[[0, 100, 102, 104, 110, 1000]] = False
    spans = pictures.unused_spans(t, used)
    wanted = [(0.0, 0.1), (9.9, 10.5), (10.9, 11.1), (99.9, 100.0)]
    np.testing.assert_allclose(spans, wanted)
