"""The first screen: bars, figures and steps against the result."""

import re
from dataclasses import replace
from html import unescape

import numpy as np
import pytest
from helpers.pages import bars

from robotid.diagnosis.verdict.verdict import GOOD, POOR
from robotid.output.report.next_steps import Origin, next_steps
from robotid.output.report.report_content import Residual, first_screen, torque_report, worst_second
from robotid.output.report.tables import worst_errors

ORIGIN = Origin(("arm.toml",), "out")


def screen_of(found, files=None):
    return first_screen(found, torque_report(found, ORIGIN), ORIGIN, files or {})


@pytest.fixture(scope="module")
def screen(identified):
    return screen_of(identified, {"urdf": "arm identified.urdf"})


def test_each_joint_has_a_bar_of_its_error_the_worst_first(screen, identified):
    (kept,) = identified.validation
    errors = {j: m.relative_error_pct for j, m in kept.metrics["estimate"].per_joint.items()}
    found = bars(screen)
    assert list(found) == sorted(errors, key=errors.get, reverse=True)
    for joint, (width, marks) in found.items():
        measured = kept.metrics["estimate"].per_joint[joint]
        wls = kept.metrics["wls"].per_joint[joint].relative_error_pct
        others = [measured.baselines[key] for key in ("urdf_with_drives", "gravity_only", "urdf")]
        assert 1.5 * width**2 / 100 == pytest.approx(errors[joint], rel=2e-3)
        wanted = [min(value, 150.0) for value in (wls, *others)]
        assert [1.5 * x**2 / 100 for x in marks] == pytest.approx(wanted, rel=2e-3)
    limits = re.findall(r'<line x1="([\d.]*)%"', screen)
    assert [1.5 * float(x) ** 2 / 100 for x in limits[:2]] == pytest.approx([GOOD, POOR], rel=2e-3)


def test_of_several_recordings_the_worst_counts(identified):
    (kept,) = identified.validation
    metrics = kept.metrics["estimate"]
    joint = next(iter(metrics.per_joint))
    worse = replace(metrics.per_joint[joint], relative_error_pct=99.0)
    better = {j: replace(m, relative_error_pct=0.1) for j, m in metrics.per_joint.items()}
    other = replace(metrics, per_joint=better | {joint: worse})
    second = replace(kept, metrics={**kept.metrics, "estimate": other})
    shown = torque_report(replace(identified, validation=(kept, second)), ORIGIN)
    errors = worst_errors(shown.counted)
    assert next(iter(errors)) == joint
    for name, measured in errors.items():
        wanted = worse if name == joint else metrics.per_joint[name]
        assert measured["relative_error_pct"] == wanted.relative_error_pct


def test_a_recording_that_was_fitted_is_none_that_was_predicted(identified):
    (kept,) = identified.validation
    metrics = kept.metrics["estimate"]
    worse = {j: replace(m, relative_error_pct=99.0) for j, m in metrics.per_joint.items()}
    changed = {**kept.metrics, "estimate": replace(metrics, per_joint=worse)}
    again = replace(kept, metrics=changed, is_refitted=True)

    def counted(**changes):
        return worst_errors(torque_report(replace(identified, **changes), ORIGIN).counted)

    for both in ((kept, again), (again, kept)):
        assert counted(validation=both) == counted()
    fitted, wls = identified.metrics(), identified.metrics("wls")
    for joint, own in counted(validation=(again,)).items():
        assert own["relative_error_pct"] == fitted.per_joint[joint].relative_error_pct
        assert own["wls_relative_error_pct"] == wls.per_joint[joint].relative_error_pct


def test_masses_and_sources_are_those_of_the_result(screen, identified):
    before, after = (pi[:60:10].sum() for pi in (identified.prior, identified.standard))
    assert f"{before:.2f} → {after:.2f} kg" in screen
    assert f"{identified.determination.rank} of {len(identified.base)}" in screen
    flex = {k: int(n) for k, n in re.findall(r'<i class="from-(\w+)" style="flex: (\d+)"', screen)}
    assert flex == {kind: identified.sources.count(kind) for kind in set(identified.sources)}
    assert '<a href="arm identified.urdf">URDF</a>' in screen


def test_the_steps_stand_in_order_with_what_to_copy(screen, identified):
    steps = next_steps(identified, ORIGIN)
    html = screen[screen.index('<ol class="next">') :]
    assert [unescape(x) for x in re.findall(r"<li><p>(.*?)</p>", html)] == [s.words for s in steps]
    blocks = re.findall(r'<pre class="command">(.*?)</pre>', html, re.DOTALL)
    typed = [unescape(x.replace("<span>", "").replace("</span>", "")) for x in blocks]
    assert typed == [block for step in steps for block in step.blocks]
    assert typed


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
