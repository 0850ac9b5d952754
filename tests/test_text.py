"""Text for people: lines, columns, digits."""

import io
import shlex

import pytest

from robotid.base.text import columns, command_lines, in_digits_of, period, tinted, wrapped


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
