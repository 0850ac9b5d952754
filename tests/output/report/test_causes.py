"""Findings by cause and by joint: counts, order and links."""

import re

import pytest
from helpers.pages import tables

from robotid.base.findings import Finding, grouped
from robotid.output.report.report_page import _by_joint, _cause, findings_line

JOINTS = ("one", "two", "three")


def finding(code, severity, where, message=""):
    if message:
        return Finding(code, severity, where, message)
    words = {"joint": where}
    return Finding(code, severity, where, f"{where} has {code}", joints=(where,), words=words,
                   fault=f"{{joint}} has {code}")  # fmt: skip


MANY = [
    finding("late", "warning", "two"), finding("late", "warning", "one"),
    finding("spikes", "error", "two"), finding("slow", "note", "two"),
    finding("slow", "note", "three"), finding("gap", "note", "a.csv"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("findings", "worst", "line"),
    [
        ([], "two", "none"),
        (MANY[3:4], "two", "1 note"),
        (MANY[3:], "two", "2 notes"),
        (MANY, "t<o", "2 findings, 2 causes; worst: t&lt;o; 2 notes"),
        (MANY[2:4], "", "1 finding, 1 cause; 1 note"),
        (MANY[:2], "one", "1 finding, 1 cause; worst: one"),
    ],
)
def test_the_line_counts_what_is_grave_its_causes_and_notes(findings, worst, line):
    assert findings_line(findings, JOINTS, worst) == line


def test_each_joint_has_its_causes_the_worst_first_and_notes_apart():
    causes = grouped(MANY, JOINTS)
    html = _by_joint(["two", "three", "one"], causes) + "".join(map(_cause, causes))
    assert tables(html)["Findings by joint, the worst first"].rows == [
        ["two", "spikes, late", "slow"], ["three", "–", "slow"], ["one", "late", "–"],
    ]  # fmt: skip
    assert re.findall(r'<div class="cause (\w+)" id="cause-(\w+)">', html) == [
        ("error", "spikes"), ("warning", "late"), ("note", "slow"), ("note", "gap"),
    ]  # fmt: skip
    assert set(re.findall(r'href="#cause-(\w+)"', html)) == {"spikes", "late", "slow"}
