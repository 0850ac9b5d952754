import os
import re
from dataclasses import replace
from html import escape
from html.parser import HTMLParser

import numpy as np
import pytest
from helpers.pages import chart, tables

from robotid.base.exceptions import DataError
from robotid.base.files import write_text
from robotid.base.findings import Finding
from robotid.base.versions import versions
from robotid.data.log import Log
from robotid.data.signal_settings import SignalSettings
from robotid.dynamics.torque import joint_torque_regressor
from robotid.identification.pipeline import identify
from robotid.output.pages.html import number, percent
from robotid.output.report.document import write_report
from robotid.output.report.information_section import information
from robotid.robot.model import RobotModel

NAME = '<b>x</b>"'
URDF = """<robot name="&lt;b&gt;x&lt;/b&gt;&quot;">
  <link name="base"/>
  <link name="upper &lt;arm&gt;"><inertial><origin xyz="0.2 0 0.01"/><mass value="2"/>
    <inertia ixx="0.01" ixy="0" ixz="0" iyy="0.05" iyz="0" izz="0.05"/></inertial></link>
  <link name="forearm"><inertial><origin xyz="0.1 0.02 0"/><mass value="1"/>
    <inertia ixx="0.005" ixy="0" ixz="0" iyy="0.02" iyz="0" izz="0.02"/></inertial></link>
  <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper &lt;arm&gt;"/>
    <axis xyz="0 1 0"/><limit lower="-2" upper="2" velocity="3" effort="50"/></joint>
  <joint name="elbow &amp; &lt;i&gt;$x$" type="continuous"><parent link="upper &lt;arm&gt;"/>
    <child link="forearm"/><origin xyz="0.4 0 0"/><axis xyz="0 1 0"/></joint>
</robot>"""
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


def make_log(model, seed, *, gap=None, path=""):
    """Return the exact torques of a sum of sines, with a little noise; rows of the gap missing."""
    rng = np.random.default_rng(seed)
    t = np.arange(800) / 100.0
    w = np.array([[1.0, 1.7], [2.3, 3.1], [4.1, 5.3]])  # [rad/s]
    A = rng.uniform(0.2, 0.5, w.shape) / w
    phase = np.einsum("t,hj->thj", t, w) + rng.uniform(0, 6, w.shape)
    q, v, a = (
        np.sum(x, axis=1)
        for x in (A * np.sin(phase), A * w * np.cos(phase), -A * w**2 * np.sin(phase))
    )
    pi = model.standard_parameters()
    pi[: model.layout.n_inertial] *= 1.2
    pi[model.layout.n_inertial :] = [0.05, 0.4, 0.3, 0.1] * 2
    tau = (joint_torque_regressor(model, q, v, a) @ pi).reshape(v.shape)
    tau += 0.01 * rng.standard_normal(tau.shape)
    kept = np.ones(len(t), dtype=bool)
    if gap:
        kept[slice(*gap)] = False
    return Log(
        t=t[kept],
        q=q[kept],
        tau=tau[kept],
        v=v[kept],
        a=a[kept],
        joints=model.joints,
        path=path,
        notes=("column 'gripper <w>' is ignored",),
    )


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    path = tmp_path_factory.mktemp("urdf") / "arm.urdf"
    path.write_text(URDF)
    return RobotModel.from_urdf(path)


@pytest.fixture(scope="module")
def found(model):
    logs = [make_log(model, 1, path="runs/a&b.csv")]
    kept = [make_log(model, 2, gap=(300, 420), path="runs/<kept>.csv")]
    return identify(model, logs, validation=kept, signals=SignalSettings(cutoff=10.0))


@pytest.fixture(scope="module")
def html(found, tmp_path_factory):
    findings = [
        *found.findings,
        Finding("a", "note", "x.csv", "a small thing"),
        Finding("b", "error", "shoulder", "a <grave> thing"),
    ]
    folder = tmp_path_factory.mktemp("report")
    path = write_report(replace(found, findings=findings), folder / "report.html")
    assert path == folder / "report.html"
    assert [p.name for p in folder.iterdir()] == ["report.html"]
    return path.read_text(encoding="utf-8")


def test_the_page_is_well_formed_and_fetches_nothing(html):
    reader = Reader(html)
    words = re.sub(r"<script.*?</script>", "", html, flags=re.DOTALL)  # a licence has an address
    assert "http:" not in words
    assert "https:" not in words
    assert not {"link", "img", "iframe", "object", "image"} & {e for e, _ in reader.elements}
    for tag, attributes in reader.elements:
        assert "src" not in attributes
        assert attributes.get("href", "#").startswith("#"), tag
    assert "url(" not in words
    assert len(html) < 3_000_000


def test_ids_are_unique_and_every_reference_finds_one(html):
    elements = Reader(html).elements
    ids = [attributes["id"] for _, attributes in elements if "id" in attributes]
    assert len(ids) == len(set(ids))
    used = [a["href"][1:] for _, a in elements if "href" in a]
    used += [a["aria-labelledby"] for _, a in elements if "aria-labelledby" in a]
    assert set(used) <= set(ids)


def test_names_cannot_inject_markup(html):
    assert NAME not in html
    for name in ("<b>", "<i>", "<kept>", "<arm>", "<grave>", "<w>"):
        assert name not in html
    text = Reader(html).text
    for name in (NAME, "upper <arm>", "elbow & <i>$x$", "<kept>.csv", "a&b.csv", "gripper <w>"):
        assert name in text


def test_verdict_comes_first_then_how_it_was_made(html, found):
    text = Reader(html).text
    order = [f"Verdict: {found.verdict.status}", found.verdict.reasons[0], "Total mass", "Do next"]
    order += ["cut-off 10 Hz, order 4", "velocity measured", "Errors", "Findings", "Torques"]
    order += [
        "Parameters",
        "Changes of the URDF",
        "Appendix",
        "Base parameters",
        "total",
        "SHA-256",
    ]
    places = [text.index(order[0])]
    for words in order[1:]:
        assert words in text[places[-1] :], words
        places.append(text.index(words, places[-1]))


def test_samples_and_rows_are_those_of_the_fitted_logs_together(report, identified):
    fitted, (kept,) = [e.recording for e in identified.fitted], identified.validation
    samples, rows = sum(len(r.mask) for r in fitted), sum(r.mask.sum() for r in fitted)
    first, second = (recording.name for recording in fitted)
    said = " ".join(Reader(report).text.split())
    assert (
        f"{len(identified.base)} base parameters of 6 joints were fitted to {first}, {second} "
        f"({samples} samples after filtering, {rows} torque values used) by " in said
    )
    assert f"Validation: {kept.recording.name}. " in said
    counts = [identified.sources.count(source) for source in ("data", "mixed")]
    assert min(counts) > 0
    every = len(identified.sources)
    assert f"{sum(counts)} of {every} determined by the data, fully or partly" in said
    before, after = (pi[:60:10].sum() for pi in (identified.prior, identified.standard))
    assert (
        f"Total mass {before:.2f} -> {after:.2f} kg. Gravity torque relative to the URDF: " in said
    )
    shares = [f"{x} {100 * share:.0f} %" for x, share in identified.scale_check.friction.items()]
    assert len(shares) > 1
    assert f"Friction relative to the torque: {', '.join(shares[:-1])}" in said
    assert f"{shares[-1]}. " in said


def test_every_joint_has_its_error_its_parameters_and_its_plot(html, found):
    text = Reader(html).text
    for joint in found.model.joints:
        measured = found.validation[0].metrics["estimate"].per_joint[joint]
        assert f"not fitted: error {percent(measured.relative_error_pct).html} %" in text
        assert f"{joint}coulomb" in text  # two cells
        assert chart(html, f"Torque of {joint} over time: measured")
    assert text.count("<kept>.csv 0-7.99 s: not fitted") == 1
    for name in found.mapping.expressions:
        assert name in text


def test_tables_have_captions_scopes_and_a_box_to_scroll_in(html):
    reader = Reader(html)
    assert len(reader.all("table")) == len(reader.all("caption")) == html.count('class="scroll"')
    assert all(attributes["scope"] in ("col", "row") for attributes in reader.all("th"))
    assert len(reader.all("h1")) == 1
    for svg in reader.all("svg"):
        if svg.get("aria-hidden") == "true":
            continue
        assert svg["role"] == "img"
        assert "aria-labelledby" in svg or svg["aria-label"]


def test_findings_are_ranked_and_notes_of_the_logs_are_added(html):
    text = Reader(html).text
    assert text.index("a <grave> thing") < text.index("a small thing")
    assert text.count("column 'gripper <w>' is ignored") == 1  # of both logs


def test_findings_stand_under_their_cause_and_their_joint(html):
    assert re.findall(r'<div class="cause (\w+)" id="cause-(\w+)">', html) == [
        ("error", "b"), ("warning", "gap"), ("note", "log_note"), ("note", "a")
    ]  # fmt: skip
    (row,) = tables(html)["Findings by joint, the worst first"].rows
    assert row == ["shoulder", "b", "–"]


def test_every_joint_has_its_residual_its_friction_and_bars(html, found):
    text = Reader(html).text
    for joint in found.model.joints:
        assert f"{joint}: correlation falls below 0.2 after" in text
        assert chart(html, f"Friction of {joint} against speed")
    for term in found.model.layout.terms:
        assert chart(html, f"{term} of each drive")


def test_the_correlation_map_has_every_name_and_a_cell_per_pair(html, found):
    figure = html[html.index('<svg class="map"') :].split("</svg>")[0]
    texts = re.findall(r"<text[^>]*>([^<]*)</text>", figure)
    names = [escape(name) for name in found.mapping.base_names]
    assert texts[::2] == [f"{name} {i}" for i, name in enumerate(names, start=1)]
    r = information(found).correlation
    shown = np.abs(np.tril(r, -1)) >= 0.5 / 8  # a shade
    assert figure.count("h-10z") == shown.sum()


def test_excitation_names_the_condition_and_the_strongest_correlation(html, found):
    text = Reader(html).text
    assert f"Condition number {found.wls.condition:.3g} (regressor, unit columns); singular" in text
    assert "Correlation of errors" in text


def test_the_audit_of_the_mass_matrix_is_shown(html):
    assert "random poses" in Reader(html).text


def test_versions_are_those_that_run(html):
    text = Reader(html).text
    for name in ("robotid", "pinocchio", "numpy", "scipy", "clarabel", "python", "platform"):
        assert f"{name}{versions()[name]}" in text
    assert versions()["numpy"] == np.__version__


def test_a_joint_worse_than_the_urdf_is_flagged(model, tmp_path):
    log = make_log(model, 1)
    wrong = make_log(model, 2)
    exact = joint_torque_regressor(model, wrong.q, wrong.v, wrong.a) @ model.standard_parameters()
    wrong = Log(
        t=wrong.t, q=wrong.q, v=wrong.v, tau=exact.reshape(wrong.q.shape), joints=model.joints
    )
    found = identify(model, [log], validation=[wrong])
    text = Reader(write_report(found, tmp_path / "r.html").read_text(encoding="utf-8")).text
    assert "Verdict: poor" in text
    assert "worse than the URDF" in text[text.index("100 |τ") :]


def test_without_a_validation_log_the_fitted_rows_are_drawn(model, tmp_path):
    found = identify(model, [make_log(model, 1, path="a.csv")])
    text = Reader(write_report(found, tmp_path / "r.html").read_text(encoding="utf-8")).text
    assert "There is no validation log. The charts show the fitted logs." in text
    assert "a.csv 0-7.99 s, fitted" in text
    assert "fitted samples, without validation log" in text


def test_long_recordings_stay_small(model, html, tmp_path):
    """Lines are thinned: of 24 times as many samples the page is hardly larger."""
    log, many = make_log(model, 1), 12
    repeated = Log(
        t=np.arange(many * 800) / 100.0,
        **{key: np.tile(getattr(log, key), (many, 1)) for key in ("q", "v", "tau")},
        joints=model.joints,
    )
    signals = SignalSettings(cutoff=None, trim=0.0)
    found = identify(
        model, [log], validation=[repeated] * 2, signals=signals, estimator="wls", doctor=False,
        friction="viscous+coulomb",
    )  # fmt: skip
    size = write_report(found, tmp_path / "r.html").stat().st_size
    assert size < len(html) + 400_000


def test_the_same_result_gives_the_same_file(found, tmp_path):
    first = write_report(found, tmp_path / "1.html").read_text(encoding="utf-8")
    assert write_report(found, tmp_path / "2.html").read_text(encoding="utf-8") == first


def test_a_failure_leaves_the_old_file_and_nothing_beside_it(found, tmp_path, monkeypatch):
    target = tmp_path / "report.html"
    write_text("old", target)

    def refuse(*_):
        raise OSError("disk full")

    monkeypatch.setattr(os, "replace", refuse)
    with pytest.raises(OSError, match="disk full"):
        write_report(found, target)
    assert target.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"]


def test_a_missing_folder_is_named(found, tmp_path):
    with pytest.raises(DataError, match=r"the folder '.*nowhere' of r\.html does not exist"):
        write_report(found, tmp_path / "nowhere" / "r.html")


def test_numbers_that_do_not_exist_are_dashes():
    assert [number(x).html for x in (None, np.inf, np.nan)] == ["–", "–", "–"]
    assert [percent(x).html for x in (0.123, 12.34, 1234.5, None)] == ["0.12", "12.3", "1234", "–"]
    edges = [0.0, 0.994, 0.996, 9.96, 99.96, 999.9, 1000.0, -2.5, np.inf]
    assert [percent(x).html for x in edges] == [
        "0.00", "0.99", "1.0", "10.0", "100.0", "999.9", "1000", "−2.50", "–"
    ]  # fmt: skip
