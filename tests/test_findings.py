"""Findings, the causes they are merged into, and the catalogue of their sentences."""

import tomllib
from dataclasses import replace
from string import Formatter

import pytest
from helpers.paths import ROOT

from robotid.base.findings import Finding, by_severity, grouped, listed, toml_key
from robotid.diagnosis.catalogue import entries, finding, reason_of, step_of


@pytest.mark.parametrize("code", entries())
def test_each_entry_is_complete(code):
    entry, steps = entries()[code], {"", "doctor", "scale", "gains", "delay", "locks", "zeros"}
    steps |= {"payload", "unclipped", "terms", "as_found", "validate", "watch", "richer", "inspect"}
    assert entry["severity"] in ("note", "warning", "error")
    assert step_of(code) in steps
    assert (ROOT / f"docs/reference/findings/{entry['page']}.md").exists()
    tables = {key for key, value in entry.items() if isinstance(value, dict)}
    texts = [entry["message"], entry.get("remedy", "")]
    texts += [text for key in tables for text in entry[key].values()]
    slots = {name for text in texts for _, name, _, _ in Formatter().parse(text) if name}
    assert tables <= slots | {"what", "cure", "todo"}, "a choice that no sentence has"


def test_names_stand_in_a_sentence_and_a_long_list_is_cut():
    assert listed([]) == "none"
    assert listed(["a", "b"]) == "a, b"
    assert listed("abcdef", 2) == "a, b and 4 more"
    assert listed("ab", 2) == "a, b"


def test_errors_come_first_and_the_order_of_each_kind_is_kept():
    kinds = ["note", "error", "warning", "error", "note"]
    found = [Finding(str(k), kind, "x", "y") for k, kind in enumerate(kinds)]
    assert [f.code for f in by_severity(found)] == ["1", "3", "2", "0", "4"]


def test_a_finding_has_its_subject_its_figures_and_its_sentence():
    one = finding("spikes", "a.csv", "lift", subject="tau_lift", channel="tau", rows=2,
                  largest=7.25, when="3.5")  # fmt: skip
    assert (one.where, one.log, one.joints) == ("a.csv: tau_lift", "a.csv", ("lift",))
    assert one.evidence == {"rows": 2.0, "largest": 7.25}
    assert one.message == (
        "a.csv: tau of lift has spikes of up to 7.25 in 2 rows, the first at t = 3.5 s; remove "
        "these rows from the recording"
    )
    harmless = one.reworded(severity="note", remedy="; no action needed")
    assert harmless.message.endswith("at t = 3.5 s; no action needed")
    slow = finding("torque_delay", "a.csv", sense=False, todo="none", delay=-0.0021,
                   std_error=0.001)  # fmt: skip
    assert slow.message == (
        "a.csv: the torque leads the position by 2.1 +- 1.0 ms, which is not significant; no "
        "action needed"
    )
    assert reason_of(slow) == (
        "the torque is delayed by -0.002 s relative to the position (negative: early)"
    )


def still(log, joint, size, severity="warning"):
    return finding("static_joint", log, joint, severity=severity, range=size, unit="rad",
                   moving_share=0.0)  # fmt: skip


def test_findings_of_one_code_are_one_cause_and_say_what_they_share_once():
    findings = [
        still("b.csv", "arm_7", 1e-4),
        still("a.csv", "arm_1", 3e-4),
        still("a.csv", "arm_7", 2e-4, "error"),
        Finding("bent", "warning", "arm_1", "arm_1: bent in 2 places"),
        Finding("bent", "warning", "arm_1", "arm_1: bent throughout"),
        Finding("old", "note", "urdf", "the URDF is of 2020"),
    ]
    rest, bent, old = grouped(findings, ["arm_1", "arm_7", "arm_70"])
    assert (rest.code, rest.severity) == ("static_joint", "error")
    assert rest.joints == ("arm_1", "arm_7")  # in the order of the robot
    assert rest.findings == (findings[2], findings[0], findings[1])
    assert rest.messages[0].startswith("a.csv, b.csv: arm_7, arm_1 at rest (range 0.0001 to 0.0003")
    assert len(rest.messages) == 1
    assert bent.messages == ("arm_1: bent in 2 places", "arm_1: bent throughout")
    assert (bent.severity, bent.joints) == ("warning", ("arm_1",))
    assert (old.severity, old.joints, old.messages) == ("note", (), ("the URDF is of 2020",))
    assert grouped([]) == ()


def test_logs_with_other_joints_are_named_one_by_one():
    """No sentence on all three joints, because none of the logs has them all."""
    joints = ["j1", "j2", "j3"]
    sizes = {"a.csv": {"j2": 1e-4, "j3": 3e-4}, "b.csv": {"j1": 2e-4, "j3": 5e-4},
             "c.csv": {"j2": 4e-4, "j3": 2e-4}}  # fmt: skip
    findings = [still(log, *pair) for log, of_log in sizes.items() for pair in of_log.items()]
    (cause,) = grouped(findings, joints)
    first, second = cause.messages
    assert first.startswith("a.csv, c.csv: j2, j3 at rest (range 0.0001 to 0.0004 rad)")
    assert second.startswith("b.csv: j1, j3 at rest (range 0.0002 to 0.0005 rad)")
    everywhere = [still("d.csv", joint, 6e-4) for joint in joints]  # true of d.csv
    (cause,) = grouped([*findings, *everywhere], joints)
    (message,) = cause.messages
    assert message.startswith("a.csv, b.csv, c.csv, d.csv: j2, j3, j1 at rest (range 0.0001 to")


def late(log, seconds):
    return finding("torque_delay", log, severity="warning", sense=True, todo="filter",
                   delay=seconds, std_error=0.001, total=seconds)  # fmt: skip


def test_what_is_typed_keeps_one_value_unless_the_values_are_far_apart():
    (cause,) = grouped([late("c", 0.0201), late("a", 0.0199), late("b", 0.02)])
    (message,) = cause.messages
    assert message.startswith("c, a, b: the torque lags the position by 19.9 to 20.1 +- 1.0 ms")
    assert "torque_delay = 0.0200 (--torque-delay 0.0200)" in message
    (cause,) = grouped([late("a", 0.02), late("b", 0.03)])
    assert [m.partition(" +-")[0] for m in cause.messages] == [
        "a: the torque lags the position by 20.0", "b: the torque lags the position by 30.0",
    ]  # fmt: skip


def test_the_largest_or_the_smallest_stands_for_several_where_the_sentence_says_so():
    sizes = [("a", 7.25, 2), ("b", 3.5, 4)]
    found = [finding("spikes", log, "lift", channel="tau", rows=rows, largest=size, when="3")
             for log, size, rows in sizes]  # fmt: skip
    (message,) = grouped(found)[0].messages
    assert "a, b: tau of lift has spikes of up to 7.25 in 2 to 4 rows" in message
    steps = [finding("jitter", log, shortest=low, longest=high, median=0.01, relative_spread=0.1)
             for log, low, high in (("a", 0.008, 0.02), ("b", 0.009, 0.03))]  # fmt: skip
    assert "vary from 8 to 30 ms about 10 ms" in grouped(steps)[0].messages[0]


def test_of_decreases_the_worst_is_stated_as_a_decrease():
    sizes = {"a": (1.02, 0.0039), "b": (0.87, 0.0056)}
    found = [
        finding("joint_order", log, ("x", "y"), unexplained=before, unexplained_so_read=after)
        for log, (before, after) in sizes.items()
    ]
    (cause,) = grouped(found)
    (message,) = cause.messages
    assert "decreases from 87 to 0.56 %" in message


def test_what_is_typed_for_several_joints_is_typed_for_each():
    places = (("a", "j6", 0.1824), ("b", "j6", 0.1824), ("a", "j7", 1.0))
    found = [
        finding("locked_position", log, joint, what="stands", todo="stands", default=True,
                unit="rad", stated=0.0, median=at, range=0.0, percent="",
                setting=f"locked = {{ {joint} = {at} }}", flag=f"--lock {joint}={at}")
        for log, joint, at in places
    ]  # fmt: skip
    (cause,) = grouped(found, ["j6", "j7"])
    assert cause.messages == (
        "a, b: j6, j7 is locked at 0 rad but is at 0.1824 to 1 rad in the log; state locked = "
        "{ j6 = 0.1824 }, locked = { j7 = 1.0 } (--lock j6=0.1824 --lock j7=1.0)",
    )


def test_other_words_are_other_sentences_and_quoted_names_are_quoted_one_by_one():
    links = [finding("zero_mass", subject=f"link {x}", link=x) for x in ("a b", "c")]
    assert grouped(links)[0].messages[0].startswith("link 'a b', 'c' has the mass 0 kg")
    rest = [finding("standstill", log, before=2.0, after=0.0, start=start, end="9")
            for log, start in (("a", "2.33"), ("b", "4.1"))]  # fmt: skip
    assert len(grouped(rest)[0].messages) == 2
    assert len(grouped([rest[0], replace(rest[0], log="b")])[0].messages) == 1


def test_a_name_is_quoted_as_a_key_where_it_needs_it():
    for name in ("arm_1-x", "a.b", 'say "x"', "", "gel\u00e4nk"):
        assert tomllib.loads(f"{toml_key(name)} = 1") == {name: 1}
    assert toml_key("arm_1-x") == "arm_1-x"
