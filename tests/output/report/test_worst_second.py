"""The worst second of a joint: its window, its figures, and the link that opens it in a replay."""

import re
from html import unescape
from urllib.parse import parse_qs, urlsplit

import numpy as np
import pytest

from robotid.output.report.dock import Dock
from robotid.output.report.steps import Origin
from robotid.output.report.torque_section import torques_section
from robotid.output.report.worst_second import Residual, worst_html, worst_second

T = 100.0 + np.arange(1000) / 100  # [s] 10 s at 100 Hz


def residual(values, t=T, name="a.csv"):
    return Residual(f"{name} window", name, t, np.asarray(values, dtype=float))


def burst(start, size, length=1.0, noise=0.1):
    inside = (start <= T) & (start + length - 0.005 > T)
    return np.where(inside, size, noise)


def test_the_window_is_where_the_burst_is():
    others = [residual(burst(107.0, 1.0, noise=x), name="b.csv") for x in (0.1, 1e-3)]
    worst = worst_second([others[0], residual(burst(103.5, 2.0)), others[1]])
    assert (worst.of.file, worst.start, worst.end) == ("a.csv", pytest.approx(103.5), 104.5)
    assert worst.rms == pytest.approx(2.0)
    whole = np.sqrt(0.1 * 2.0**2 + 0.9 * 0.1**2)
    assert worst.ratio == pytest.approx(2.0 / whole)


def test_the_figure_is_that_of_every_window():
    values = np.random.default_rng(3).standard_normal(1000) * (1 + np.sin(T))
    rms = [np.sqrt(np.mean(values[k : k + 100] ** 2)) for k in range(901)]
    worst = worst_second([residual(values)])
    assert worst.rms == pytest.approx(max(rms))
    assert worst.start == pytest.approx(T[int(np.argmax(rms))])


@pytest.mark.parametrize("share", [0.4, 0.6])
def test_a_window_needs_half_of_its_samples(share):
    values = burst(102.0, 5.0)
    unused = (T > 101.0) & (T < 104.0) & ~((T >= 102.0) & (102.0 + share - 0.005 > T))
    values[unused] = np.nan
    worst = worst_second([residual(values)])
    assert worst.rms == pytest.approx(5.0 if share > 0.5 else 0.1)


def test_a_window_at_a_gap_has_half_of_its_samples_at_least():
    t = np.where(T < 105.0, T, T + 60.0)
    values = np.full(1000, 0.1)
    values[490:500] = 9.0  # the last 0.1 s before the gap
    worst = worst_second([residual(values, t)])
    assert worst.start == pytest.approx(104.5, abs=0.011)
    assert worst.rms == pytest.approx(np.sqrt((10 * 81 + 40 * 0.01) / 50), rel=0.02)


EXACT = np.arange(128) / 64  # [s] a clock without rounding


def test_the_last_window_ends_at_the_last_sample():
    worst = worst_second([residual(np.arange(128) == 127, EXACT)])
    assert (worst.start, worst.end) == (1.0, EXACT[-1])
    assert worst.rms == pytest.approx(1 / 8)


def test_a_window_has_its_number_of_samples_also_with_jitter():
    early = np.where(np.arange(128) == 64, EXACT - 0.375 / 64, EXACT)
    worst = worst_second([residual(np.arange(128) % 64 == 0, early)])
    assert worst.rms == pytest.approx(1 / 8)
    half = np.where(np.arange(128) % 2, np.nan, 1.0)
    assert worst_second([residual(half, EXACT)]).rms == pytest.approx(1.0)


def test_a_short_recording_is_one_window_and_an_unused_one_none():
    worst = worst_second([residual(np.arange(30), T[:30])])
    assert (worst.start, worst.end, worst.ratio) == (100.0, pytest.approx(100.29), 1.0)
    assert worst_second([residual([3.0, np.nan], T[:2])]).rms == pytest.approx(3.0)
    assert worst_second([residual(np.zeros(1000))]).ratio == 0.0
    assert worst_second([residual([1.0], T[:1])]) is None
    assert worst_second([residual(np.where(np.arange(1000) % 3, np.nan, 1.0))]) is None
    assert worst_second([residual(np.full(1000, np.nan))]) is None
    assert worst_second([]) is None
    assert worst_html(None, "j", "N m", Dock("replay.html")) == ""


def test_figures_have_their_unit_and_names_are_escaped():
    worst = worst_second([residual(burst(103.5, 0.002, noise=1e-5), name='a "&<b>.csv')])
    html = worst_html(worst, "odd & <j>", "mrad", Dock('my "replay".html'), 1e-3)
    assert "103.50 to 104.50 s, RMS 2 mrad, " in html
    assert not re.search("<[bj]>", html)
    link = urlsplit(unescape(re.search(r'href="([^"]*)" target="replay"', html)[1]))
    assert link.path == "my%20%22replay%22.html"
    fragment = {key: value[0] for key, value in parse_qs(link.fragment).items()}
    assert fragment == {"t": "103.500", "joint": "odd & <j>", "log": 'a "&<b>.csv'}
    plain = worst_html(worst, "j", "N m", Dock())
    assert "href" not in plain
    assert "RMS 0.002 N m, " in plain


def test_each_joint_of_a_report_has_its_own_worst_second(identified):
    (kept,) = identified.validation
    html = torques_section(identified, {}, ["elbow_joint"], Origin(), "replay.html")
    motion = kept.recording.trajectory
    parts = html.split('<details id="joint-')[1:]
    assert len(parts) == 6
    for j, part in enumerate(parts):
        used = kept.recording.mask[:, j].astype(bool)
        left = motion.tau[:, j] - kept.torques["estimate"][:, j]
        (said,) = re.findall(r'<p class="worst">(.*?)<a href="(.*?)"', part)
        start, end, rms, ratio = map(
            float,
            re.search(r"s, ([\d.]+) to ([\d.]+) s, RMS (\S+) N m, (\S+) times", said[0]).groups(),
        )
        inside = (motion.t >= start - 0.006) & (motion.t < end - 0.006) & used
        assert np.sqrt(np.mean(left[inside] ** 2)) == pytest.approx(rms, rel=0.02)
        assert rms / np.sqrt(np.mean(left[used] ** 2)) == pytest.approx(ratio, rel=0.06)
        assert f"joint={identified.model.joints[j]}&amp;log=kept.csv" in said[1]
    assert [" open>" in part.split("<summary")[0] for part in parts] == [
        joint == "elbow_joint" for joint in identified.model.joints
    ]
