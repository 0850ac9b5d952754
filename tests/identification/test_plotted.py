"""The charts that Python is given of a result: of the joints named, shown and kept as a page."""

import re
from html import unescape

import numpy as np
import pytest

from robotid.exceptions import DataError


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


@pytest.mark.parametrize("plot", ["plot_torques", "plot_friction", "plot_why"])
def test_another_joint_is_refused_by_name(identified, plot):
    words = r"joint 'elbow_joind' is not among those identified: .*Did you mean 'elbow_joint'\?"
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
        "<Plot of Friction of elbow_joint against speed; .write('plot.html') keeps it>"
    )
    with pytest.raises(DataError, match="there is no folder"):
        plot.write(tmp_path / "none" / "friction.html")
