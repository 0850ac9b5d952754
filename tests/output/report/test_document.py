"""The report as a page: well-formed, whole and in order; it fetches nothing."""

import re
from dataclasses import replace
from html.parser import HTMLParser
from types import SimpleNamespace

import numpy as np
import pytest

from robotid.output.report.motion_page import _collisions
from robotid.output.report.next_steps import Origin
from robotid.output.report.report_content import (
    Residual,
    report_html,
    torque_report,
    worst_second,
    write_report,
)
from robotid.output.report.tables import worst_errors

VOID = {"meta", "br", "wbr", "link", "img", "input", "hr", "path", "use"}


class Reader(HTMLParser):
    """Collects elements and text, and complains about elements that are not closed."""

    def __init__(self, html):
        super().__init__()
        self.open, self.elements, self.words = [], [], []
        self.feed(html)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        if tag not in VOID:
            assert self.open.pop() == tag

    def handle_data(self, data):
        if not self.open or self.open[-1] not in ("style", "script"):
            self.words.append(data)

    @property
    def text(self):
        return " ".join("".join(self.words).split())


def with_errors(evaluation, errors, **baselines):
    """Return an evaluation with other errors of the joints [%], of all or by joint."""
    metrics = evaluation.metrics["estimate"]
    per_joint = {
        joint: replace(
            m, baselines={**m.baselines, **baselines},
            relative_error_pct=errors[joint] if isinstance(errors, dict) else errors,
        )
        for joint, m in metrics.per_joint.items()
    }  # fmt: skip
    changed = {**evaluation.metrics, "estimate": replace(metrics, per_joint=per_joint)}
    return replace(evaluation, metrics=changed)


@pytest.fixture
def text_of(tmp_path):
    def written(found):
        return Reader(write_report(found, tmp_path / "r.html").read_text(encoding="utf-8")).text

    return written


def test_the_page_is_well_formed_and_fetches_nothing(report):
    reader = Reader(report)
    words = re.sub(r"<script.*?</script>", "", report, flags=re.DOTALL)  # a licence has an address
    assert "http:" not in words
    assert "https:" not in words
    assert not {"link", "img", "iframe", "object", "image"} & {e for e, _ in reader.elements}
    for tag, attributes in reader.elements:
        assert "src" not in attributes
        assert attributes.get("href", "#").startswith("#"), tag
    assert "url(" not in words
    assert len(report) < 3_000_000


def test_ids_are_unique_and_every_reference_finds_one(report):
    elements = Reader(report).elements
    ids = [attributes["id"] for _, attributes in elements if "id" in attributes]
    assert len(ids) == len(set(ids))
    used = [a["href"][1:] for _, a in elements if "href" in a]
    used += [a["aria-labelledby"] for _, a in elements if "aria-labelledby" in a]
    assert set(used) <= set(ids)


def test_findings_stand_under_their_cause(report):
    assert re.findall(r'<div class="cause (\w+)"><h3><strong>\w+</strong> (\w+)', report) == [
        ("error", "alike"), ("warning", "late"), ("warning", "slow")
    ]  # fmt: skip


def test_each_residual_analysis_has_the_number_of_its_joint(report, identified):
    folds = re.findall(r'<details id="why-(\d+)".*?<summary>(.*?): ', report)
    joints = [identified.model.joints[int(row)] for row, _ in folds]
    assert [re.sub("<.*?>", "", name) for _, name in folds] == joints
    assert len(joints) == 6


def test_a_joint_worse_than_the_urdf_is_flagged(identified, text_of):
    (kept,) = identified.validation
    text = text_of(replace(identified, validation=(with_errors(kept, 60.0, urdf=50.0),)))
    assert "Verdict: poor" in text
    assert "worse than the URDF" in text[text.index("100 |τ") :]


def test_the_distance_at_a_collision_is_its_margin_and_what_is_required():
    entry = {"margin": 0.012, "where": "a and b", "time": 1.5, "kept": 0.02}
    entry |= {"unread": [], "left_alone": ["c and d"], "built_near": []}
    course = SimpleNamespace(nearest=None, clearance=object())
    assert Reader(_collisions({"limits": {"collision": entry}}, course)).text == (
        "Smallest margin to a collision: a and b are 32 mm apart at 1.50 s. Their clearance (the "
        "smallest allowed distance) is 20 mm, also between samples. Not checked, because these "
        "links touch by design: c and d."
    )


def test_without_a_validation_log_the_fitted_rows_are_drawn(identified, text_of):
    text = text_of(replace(identified, validation=()))
    assert "There is no validation log. The charts show the fitted logs." in text
    assert "first.csv 0-3.58 s, fitted" in text
    assert "order 4 run forward and backward" in text
    assert ", velocity measured" in text
    assert "fitted samples, without validation log" in text


ORIGIN = Origin(("arm.toml",), "out")


def test_of_several_recordings_the_worst_counts(identified):
    (kept,) = identified.validation
    errors = {j: m.relative_error_pct for j, m in kept.metrics["estimate"].per_joint.items()}
    joint = next(iter(errors))
    second = with_errors(kept, dict.fromkeys(errors, 0.1) | {joint: 99.0})
    shown = torque_report(replace(identified, validation=(kept, second)), ORIGIN)
    counted = worst_errors(shown.counted)
    assert next(iter(counted)) == joint
    found = {name: measured["relative_error_pct"] for name, measured in counted.items()}
    assert found == {**errors, joint: 99.0}
    html = report_html(replace(identified, validation=(kept, second)), origin=ORIGIN)
    assert html.count('<rect width="99.00%" height="9"/>') == 1  # the axis ends at 100 %


def test_a_recording_that_was_fitted_is_none_that_was_predicted(identified):
    (kept,) = identified.validation
    again = replace(with_errors(kept, 99.0), is_refitted=True)

    def counted(**changes):
        return worst_errors(torque_report(replace(identified, **changes), ORIGIN).counted)

    for both in ((kept, again), (again, kept)):
        assert counted(validation=both) == counted()
    fitted, wls = identified.metrics(), identified.metrics("wls")
    for joint, own in counted(validation=(again,)).items():
        assert own["relative_error_pct"] == fitted.per_joint[joint].relative_error_pct
        assert own["wls_relative_error_pct"] == wls.per_joint[joint].relative_error_pct


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
