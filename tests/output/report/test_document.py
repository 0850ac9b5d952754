"""The report as a page: well-formed, whole and in order; it fetches nothing."""

import re
from dataclasses import replace
from html.parser import HTMLParser
from types import SimpleNamespace

import pytest

from robotid.output.report.motion_page import _collisions
from robotid.output.report.report_content import write_report

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

    def all(self, tag):
        return [attrs for name, attrs in self.elements if name == tag]


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


def test_verdict_comes_first_then_how_it_was_made(report, identified, findings):
    text, verdict = Reader(report).text, replace(identified, findings=findings).verdict
    order = [f"Verdict: {verdict.status}", verdict.reasons[0], "Total mass", "Do next"]
    fitted = [e.recording.extent for e in identified.fitted]
    samples, rows = sum(x.smooth for x in fitted), sum(x.rows_used for x in fitted)
    order.append(f"({samples} samples after filtering, {rows} torque values used)")
    order += ["cut-off 12 Hz, order 4", "velocity measured", "Errors", "Findings", "Torques"]
    order += ["Parameters", "Appendix", "Base parameters", "SHA-256"]
    places = [text.index(order[0])]
    for words in order[1:]:
        assert words in text[places[-1] :], words
        places.append(text.index(words, places[-1]))


def test_findings_stand_under_their_cause(report):
    assert re.findall(r'<div class="cause (\w+)" id="cause-(\w+)">', report) == [
        ("error", "alike"), ("warning", "late"), ("warning", "slow")
    ]  # fmt: skip


def test_a_joint_worse_than_the_urdf_is_flagged(identified, text_of):
    (kept,) = identified.validation
    metrics = kept.metrics["estimate"]
    worse = {
        joint: replace(m, relative_error_pct=60.0, baselines={**m.baselines, "urdf": 50.0})
        for joint, m in metrics.per_joint.items()
    }
    changed = {**kept.metrics, "estimate": replace(metrics, per_joint=worse)}
    text = text_of(replace(identified, validation=(replace(kept, metrics=changed),)))
    assert "Verdict: poor" in text
    assert "worse than the URDF" in text[text.index("100 |τ") :]


def test_the_distance_at_a_collision_is_its_margin_and_what_is_required():
    entry = {"margin": 0.012, "where": "a and b", "time": 1.5, "kept": 0.02}
    entry |= {"unread": [], "left_alone": ["c and d"], "built_near": []}
    course = SimpleNamespace(nearest=None, clearance=object())
    assert Reader(_collisions({"limits": {"collision": entry}}, course)).text == (
        "Smallest margin to a collision: a and b, distance 32 mm at 1.50 s. Required: 20 mm, also "
        "between samples. Not checked, since in contact by design: c and d."
    )


def test_without_a_validation_log_the_fitted_rows_are_drawn(identified, text_of):
    text = text_of(replace(identified, validation=()))
    assert "There is no validation log. The charts show the fitted logs." in text
    assert "first.csv 0-3.58 s, fitted" in text
    assert "fitted samples, without validation log" in text
