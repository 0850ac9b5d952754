import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest

from robotid.base.findings import Finding
from robotid.data.log import Log
from robotid.data.signal_settings import SignalSettings
from robotid.dynamics.torque import joint_torque_regressor
from robotid.identification.pipeline import identify
from robotid.output.report.report_page import write_report
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


def test_verdict_comes_first_then_how_it_was_made(html, found):
    text = Reader(html).text
    order = [f"Verdict: {found.verdict.status}", found.verdict.reasons[0], "Total mass", "Do next"]
    order += ["cut-off 10 Hz, order 4", "velocity measured", "Errors", "Findings", "Torques"]
    order += ["Parameters", "Appendix", "Base parameters", "SHA-256"]
    places = [text.index(order[0])]
    for words in order[1:]:
        assert words in text[places[-1] :], words
        places.append(text.index(words, places[-1]))


def test_findings_stand_under_their_cause(html):
    assert re.findall(r'<div class="cause (\w+)" id="cause-(\w+)">', html) == [
        ("error", "b"), ("warning", "gap"), ("note", "log_note"), ("note", "a")
    ]  # fmt: skip


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
