"""Findings, their causes and sentences; text for people: lines, columns, digits."""

import io
import shlex
import tomllib
from dataclasses import replace
from string import Formatter

import pytest
from helpers.paths import ROOT

from robotid.base.findings import Finding, by_severity, grouped, listed, sentence, toml_key
from robotid.base.text import columns, command_lines, in_digits_of, period, tinted, wrapped
from robotid.diagnosis.catalogue import entries, finding, reason_of, step_of


def test_lines_fit_and_keep_their_indentation():
    text = "  - the robot has to be weighed\nverdict: good"
    assert wrapped(text, 20, "  ") == "  - the robot has to\n    be weighed\nverdict: good"
    assert wrapped(text, None) == text


def test_neither_names_nor_quoted_paths_are_broken():
    path = "'/data of mine/long-named-folder/first run.csv'"
    assert path in wrapped(f"there is no log file {path} in it", 24)
    assert wrapped("predicted within 5.5 % of it", 20) == "predicted within\n5.5 % of it"
    assert wrapped("it weighs 2 or so, 1.25 s", 20) == "it weighs 2 or so,\n1.25 s"
    assert "left_shoulder-roll-joint-of-arm" in wrapped("a left_shoulder-roll-joint-of-arm", 20)


def test_columns_stand_apart_and_those_that_do_not_fit_are_named():
    rows = [["elbow", "-0.0002363", "1"], ["x", "2", "12345"]]
    assert columns(["joint", "A", "B-A"], rows) == [
        "  joint           A    B-A",
        "  elbow  -0.0002363      1",
        "  x               2  12345",
    ]
    narrow = columns(["joint\n", "A\n[m]", "URDF\n%"], rows, needed=1, width=20)
    assert narrow[1:] == [
        "                [m]",
        "  elbow  -0.0002363",
        "  x               2",
        "  in wider terminals: URDF %",
    ]


@pytest.mark.parametrize(
    ("value", "error", "shown"),
    [
        (8.5624, 0.0231, ("8.562", "0.023")),
        (8.5624, 0.0996, ("8.56", "0.10")),  # not 0.100
        (1234.4, 120.0, ("1230", "120")),
        (-0.0001, 0.1, ("0.00", "0.10")),  # not -0.00
        (-2.83e-7, 1.2e-6, ("-0.3e-06", "1.2e-06")),
        (3.2e-5, 1.1e-7, ("3.200e-05", "0.011e-05")),
        (3e-9, 1.2e-5, ("0", "1.2e-05")),  # not 0.0e-05
        (-2e-8, 5e-5, ("0", "5.0e-05")),
        (2.0, None, ("2", "-")),
        (2.0, 0.0, ("2", "-")),
        (2.34567, float("inf"), ("2.346", "-")),
    ],
)
def test_the_last_digit_of_a_value_is_the_second_of_its_error(value, error, shown):
    assert in_digits_of(value, error) == shown


@pytest.mark.parametrize(
    ("start", "end", "shown"),
    [
        (5.0167e-6, 49.99, "0-49.99 s"),
        (5.0, 7.4, "5-7.4 s"),
        (0.2, 5.998, "0.2-5.998 s"),
        (1.7e9 + 0.126, 1.7e9 + 12.5, "1700000000.1-1700000012.5 s"),
        (-1e-9, 1234.56, "0-1235 s"),
        (3.0, 3.0, "3-3 s"),
    ],
)
def test_a_range_of_time_has_no_exponent(start, end, shown):
    assert period(start, end) == shown


def test_lines_of_a_command_break_between_arguments_and_paste_as_one():
    command = "robotid identify 'my robot.urdf' first-log.csv --lock gripper=0 --out result"
    lines = command_lines(command, 34)
    assert lines == [
        "robotid identify 'my robot.urdf' \\",
        "    first-log.csv --lock \\",
        "    gripper=0 --out result",
    ]
    assert shlex.split(" ".join(lines).replace("\\ ", "")) == shlex.split(command)
    assert command_lines(command, 100) == [command]
    assert command_lines("a --flag=a-very-long-value b", 10) == [
        "a \\", "    --flag=a-very-long-value \\", "    b"
    ]  # fmt: skip


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_colour_is_for_terminals_and_no_color_ends_it(monkeypatch):
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.delenv("NO_COLOR", raising=False)
    said = "verdict: poor, so poor"
    assert tinted(said, "poor", "poor", Terminal()) == "verdict: \x1b[31mpoor\x1b[0m, so poor"
    assert tinted(said, "poor", "bad", Terminal()) == said
    assert tinted(said, "poor", "poor", io.StringIO()) == said
    for name, value in (("NO_COLOR", "1"), ("TERM", "dumb")):
        with monkeypatch.context() as changed:
            changed.setenv(name, value)
            assert tinted(said, "poor", "poor", Terminal()) == said


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
    wanted = "the torque is delayed by -0.002 s relative to the position (negative: early)"
    assert reason_of(slow) == wanted


def test_of_several_numbers_a_sentence_has_the_range_or_the_one_that_its_slot_asks_for():
    fault = "{x:.1f} m, {x!l:.0f}, {x!h:.0f}, {x!w:.0f}, type {x!t:.0f}"
    sizes = (3.0, 1.0, 4.0, 2.0)
    some = [Finding("a", "note", "b", "", {"x": x}, "log", fault=fault) for x in sizes]
    assert sentence(some) == "log: 1.0 to 4.0 m, 1, 4, 4, type 2"
    assert sentence(some[:1]) == "log: 3.0 m, 3, 3, 3, type 3"
    lists = [Finding("a", "note", "b", "", words={"x": x}, fault="{x!q}") for x in ("j, k", "k")]
    assert sentence(lists) == "'j', 'k'"


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
        still("c.csv", "arm_1", 1e-4, "note"),
    ]
    rest, bent, old, small = grouped(findings, ["arm_1", "arm_7", "arm_70"])
    assert (rest.code, rest.severity) == ("static_joint", "error")
    assert rest.joints == ("arm_1", "arm_7")  # in the order of the robot
    assert rest.findings == (findings[2], findings[0], findings[1])
    assert rest.messages[0].startswith("a.csv, b.csv: arm_7, arm_1 did not move (range 0.0001")
    assert len(rest.messages) == 1
    assert bent.messages == ("arm_1: bent in 2 places", "arm_1: bent throughout")
    assert (bent.severity, bent.joints) == ("warning", ("arm_1",))
    assert (old.severity, old.joints, old.messages) == ("note", (), ("the URDF is of 2020",))
    assert (small.code, small.severity) == ("static_joint", "note"), "a cause of its own"
    assert grouped([]) == ()


def test_logs_with_other_joints_are_named_one_by_one():
    """No sentence on all three joints, because none of the logs has them all."""
    joints = ["j1", "j2", "j3"]
    sizes = {"a.csv": {"j2": 1e-4, "j3": 3e-4}, "b.csv": {"j1": 2e-4, "j3": 5e-4},
             "c.csv": {"j2": 4e-4, "j3": 2e-4}}  # fmt: skip
    findings = [still(log, *pair) for log, of_log in sizes.items() for pair in of_log.items()]
    (cause,) = grouped(findings, joints)
    first, second = cause.messages
    assert first.startswith("a.csv, c.csv: j2, j3 did not move (range 0.0001 to 0.0004 rad)")
    assert second.startswith("b.csv: j1, j3 did not move (range 0.0002 to 0.0005 rad)")
    everywhere = [still("d.csv", joint, 6e-4) for joint in joints]  # true of d.csv
    (cause,) = grouped([*findings, *everywhere], joints)
    (message,) = cause.messages
    assert message.startswith("a.csv, b.csv, c.csv, d.csv: j2, j3, j1 did not move (range 0.0001")


def late(log, seconds):
    return finding("torque_delay", log, severity="warning", sense=True, todo="filter",
                   delay=seconds, std_error=0.001, total=seconds)  # fmt: skip


def test_what_is_typed_keeps_one_value_unless_the_values_are_far_apart():
    (cause,) = grouped([late("c", 0.0201), late("a", 0.0199), late("b", 0.02)])
    (message,) = cause.messages
    assert message.startswith("c, a, b: the torque lags the position by 19.9 to 20.1 +- 1.0 ms")
    assert "torque_delay = 0.0200 (--torque-delay 0.0200)" in message
    (cause,) = grouped([late("a", 0.02), late("b", 0.03)])
    of_joints = [("a", "x", 1.0), ("b", "y", 2.0), ("c", "x", 1.0)]  # far apart, but not those of x
    found = [Finding("k", "note", joint, "", {"n": n}, log, (joint,), fault="{n!t:.1f}")
             for log, joint, n in of_joints]  # fmt: skip
    assert grouped(found)[0].messages == ("a, c: 1.0", "b: 2.0")
    assert [m.partition(" +-")[0] for m in cause.messages] == [
        "a: the torque lags the position by 20.0", "b: the torque lags the position by 30.0",
    ]  # fmt: skip


def test_the_largest_or_the_smallest_stands_for_several_where_the_sentence_says_so():
    sizes = [("a", 7.25, 2), ("b", 3.5, 4)]
    found = [finding("spikes", log, "lift", channel="tau", rows=rows, largest=size, when="3")
             for log, size, rows in sizes]  # fmt: skip
    (message,) = grouped(found)[0].messages
    assert "a, b: tau of lift has spikes of up to 7.25 in 2 to 4 rows" in message
    figures = {"median": 0.01, "relative_spread": 0.1, "what": False, "cure": False}
    steps = [finding("jitter", log, shortest=low, longest=high, **figures)
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
        "a, b: j6, j7 is locked at 0 rad but is at 0.1824 to 1 rad in the log; set locked = "
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
