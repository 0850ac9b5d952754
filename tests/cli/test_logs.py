"""The logs of a job: in memory or in pieces, from whom they are told, as their robots hear them."""

from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from robotid.base.exceptions import DataError, SettingsError
from robotid.cli import logs as module
from robotid.cli.job import Job, LogEntry
from robotid.cli.logs import (
    examine_logs,
    locked_as_logged,
    log_of_commands,
    survey_logs,
    units_of_logs,
)
from robotid.estimation.fitting.estimator_settings import SimulationSettings
from robotid.identification.closed_loop.loop_settings import LoopSettings

HAND = """<robot name="hand"><link name="base"/><link name="a"/><link name="b"/><link name="c"/>
<link name="d"/>
<joint name="ja" type="revolute"><parent link="base"/><child link="a"/><axis xyz="0 0 1"/>
<limit lower="-1" upper="2" effort="7" velocity="1"/></joint>
<joint name="slide" type="prismatic"><parent link="a"/><child link="b"/><axis xyz="0 1 0"/>
<limit lower="-3" upper="2.5" effort="8" velocity="2"/></joint>
<joint name="jc" type="revolute"><parent link="b"/><child link="c"/><axis xyz="0 1 0"/>
<limit lower="-1" upper="1" effort="9" velocity="3"/></joint>
<joint name="jd" type="revolute"><parent link="b"/><child link="d"/><axis xyz="0 1 0"/>
<limit lower="-1" upper="1" effort="9" velocity="3"/><mimic joint="jc" multiplier="2"/></joint>
</robot>"""


@pytest.fixture
def hand(tmp_path):
    path = tmp_path / "hand.urdf"
    path.write_text(HAND)
    return Job(path, joints=("ja", "slide"))


@pytest.mark.parametrize(
    ("locked", "wanted"),
    [({}, ()), ({"*": 0.1}, ("jc", "jd")), ({"jc": 0.2}, ("jc", "jd")), ({"jd": 0.2}, ("jd",))],
)
def test_joints_stand_where_the_job_says_or_their_leader_does(hand, locked, wanted):
    job = replace(hand, locked=locked)
    assert sorted(job.placed(job.model())) == list(wanted)


def test_what_is_read_is_what_the_job_says_of_windows_and_of_joints_that_slide(hand, monkeypatch):
    told = {}
    monkeypatch.setattr(
        "robotid.cli.job.read_log", lambda path, **stated: told.update(stated, path=path)
    )
    job = replace(hand, gains={"ja": 2.0}, columns={"q_ja": "angle"})
    job.read(LogEntry(Path("a.csv"), 1.5, 7.25), job.model(), needs="motion")
    assert (told["path"], told["needs"]) == (Path("a.csv"), "motion")
    assert (told["start"], told["end"]) == (1.5, 7.25)
    assert (told["joints"], told["prismatic"]) == (("ja", "slide"), ("slide",))
    assert (told["gains"], told["columns"]) == ({"ja": 2.0}, {"q_ja": "angle"})
    assert (told["units"], told["source"], told["transmissions"]) == (job.units, job.source, [])


@dataclass(frozen=True)
class _Surveyed:
    name: str
    unit: str = ""
    time: float | None = None


@pytest.mark.parametrize(
    ("in_memory", "counts", "is_static", "length"),
    [
        (8000, (5000, 3000), False, None),  # all rows together, no more than may be
        (8000, (5000, 3001), False, 1000),
        (8000, (5000, 3001), True, None),
        (1600, (1000, 1000), False, 256),  # the shortest piece
        (8000, (None, 8000), False, None),  # what is only read whole counts as nothing
    ],
)
def test_logs_of_more_rows_than_memory_may_hold_are_cut_into_eighths(
    hand, monkeypatch, in_memory, counts, is_static, length
):
    job = replace(hand, rows_in_memory=in_memory)
    rows = dict(zip((Path("a.csv"), Path("b.csv")), counts, strict=True))

    def opened(job, model, path, needs):
        count = rows[path]
        table = SimpleNamespace(
            rows=None if count is None else SimpleNamespace(count=lambda: count)
        )
        return path, table

    cut = []

    def surveyed(layout, table, model, signals, window, *, length):
        cut.append((layout.name, window, length))
        return _Surveyed(layout.name)

    monkeypatch.setattr(module, "_open", opened)
    monkeypatch.setattr(module, "survey_log", surveyed)
    model = SimpleNamespace(is_static=is_static)
    fitted = [LogEntry(Path("a.csv"), 1.0, 2.0, "arm-1"), LogEntry(Path("b.csv"), unit="arm-2")]
    groups = fitted, [LogEntry(Path("a.csv"))]
    found = survey_logs(job, model, *groups)
    assert [[log.name for log in group] for group in found] == [["a.csv", "b.csv"], ["a.csv"]]
    assert [[log.unit for log in group] for group in found] == [["arm-1", "arm-2"], [""]]
    assert cut == [
        ("a.csv", (1.0, 2.0), length), ("b.csv", (None, None), length),
        ("a.csv", (None, None), length),
    ]  # fmt: skip


def test_a_log_that_cannot_be_used_is_refused_alone_where_that_is_wanted(hand, monkeypatch):
    def opened(job, model, path, needs):
        return (
            DataError("no", "gap") if path.name == "b.csv" else (path, SimpleNamespace(rows=None))
        )

    monkeypatch.setattr(module, "_open", opened)
    monkeypatch.setattr(module, "survey_log", lambda layout, *_, **__: _Surveyed(layout.name))
    entries = [LogEntry(Path(f"{name}.csv")) for name in "abc"]
    refused = []
    found = survey_logs(
        hand, hand.model(), entries, refuse=lambda entry, error: refused.append((entry, str(error)))
    )
    assert [[log.name for log in group] for group in found] == [["a.csv", "c.csv"]]
    assert refused == [(entries[1], "no")]
    with pytest.raises(DataError, match="no"):
        survey_logs(hand, hand.model(), entries)


def test_a_file_of_which_two_windows_are_used_is_read_once(hand, tmp_path, monkeypatch):
    lay_out, reads, path = Job.lay_out, [], tmp_path / "a.csv"

    def counted(*words, **settings):
        layout, table = lay_out(*words, **settings)
        read = table.read
        return layout, replace(table, read=lambda wanted: reads.append(wanted) or read(wanted))

    monkeypatch.setattr(Job, "lay_out", counted)
    t = 2.0 + 0.01 * np.arange(100)
    q = np.column_stack([np.sin(3 * t), 0.2 * np.cos(2 * t)])
    names = "time,q_ja,q_slide,tau_ja,tau_slide"
    np.savetxt(path, np.column_stack([t, q, q]), delimiter=",", header=names, comments="")
    entries = LogEntry(path, 2.1, 2.3), LogEntry(path, 2.5)
    (first,), (second,) = survey_logs(hand, hand.model(), *([entry] for entry in entries))
    np.testing.assert_allclose(first.head.q, q[10:31])
    np.testing.assert_allclose(second.head.q, q[50:])
    assert len(reads) == 1


@dataclass(frozen=True)
class Held:
    """A surveyed log, as far as its locked joints go."""

    locked: dict
    model: object = None


def test_a_joint_is_locked_at_the_median_of_all_logs_if_it_stands_there_in_each(hand):
    model = hand.model()
    first = Held({"jc": np.array([0.3, 0.3001]), "jd": np.array([0.1, 0.1])})
    second = Held({"jc": np.array([0.3004, 0.3002, 0.3001])})
    far = Held({"jd": np.array([0.4, 0.4])})
    found = locked_as_logged(hand, model, [first], [second])
    assert found.job.locked == {"jc": pytest.approx(0.3001), "jd": pytest.approx(0.1)}
    assert found.model.locked["jc"] == pytest.approx(0.3001)
    (note,) = found.notes
    assert (note.code, note.severity) == ("locked_as_logged", "note")
    assert "jc = 0.3001, jd = 0.1." in note.message
    assert {log.model for log in (*found.fitted, *found.validation)} == {found.model}
    found = locked_as_logged(hand, model, [first, far], [second])
    assert found.job.locked == {"jc": pytest.approx(0.3001)}
    stated = replace(hand, locked={"jc": 0.0, "jd": 0.2})
    assert locked_as_logged(stated, stated.model(), [first], [second]).notes == ()


def test_notes_of_a_long_log_are_told_once_and_its_looks_are_all_examined(hand, monkeypatch):
    told = []
    monkeypatch.setattr(module, "diagnose", lambda model, *logs: told.append(logs) or ("d",))
    monkeypatch.setattr(
        module, "check_locked", lambda model, held, name, placed, units: [(name, held, placed)]
    )

    def log(name, *looks):
        return SimpleNamespace(
            path=f"runs/{name}", locked=f"held of {name}", windows=looks, looks=list(looks),
            head=SimpleNamespace(notes=[f"a note of {name}"], assumed=(), path=name),
        )  # fmt: skip

    long, short, kept = log("a.csv", "a1", "a2"), log("b.csv", "b1"), log("c.csv", "c1", "c2")
    found = examine_logs(hand, hand.model(), [long, short], [kept])
    assert told == [(["a1", "a2", "b1"], ["c1", "c2"], hand.signals)]
    notes = [f.message for f in found if not isinstance(f, (str, tuple))]
    assert notes == ["a.csv: a note of a.csv", "c.csv: a note of c.csv"]
    assert [f for f in found if isinstance(f, tuple)] == [
        (name, f"held of {name}", ()) for name in ("a.csv", "b.csv", "c.csv")
    ]
    assert found[-1] == "d"


@pytest.mark.parametrize(
    ("loop", "wanted"),
    [
        (LoopSettings(kp=20.0, kd=1.0), "log of commands"),
        (LoopSettings(kp=20.0, kd=1.0, gravity_compensation=True),
         "log of commands with gravity of ('ja', 'slide')"),
        (LoopSettings(kind="torque"), "log of torque driven by the result's"),
    ],
)  # fmt: skip
def test_a_robot_hears_commands_the_gravity_of_its_urdf_or_torques(hand, monkeypatch, loop, wanted):
    monkeypatch.setattr(
        Job, "read", lambda self, entry, model, needs: f"log of {needs}" * (model == "the result's")
    )
    monkeypatch.setattr(
        "robotid.identification.closed_loop.from_commands.driven_log",
        lambda robot, log, _: f"{log} driven by {robot}",
    )
    monkeypatch.setattr(
        "robotid.identification.closed_loop.from_commands.with_gravity",
        lambda model, log: f"{log} with gravity of {model.joints}",
    )
    job = replace(hand, controller=loop, estimator=SimulationSettings())
    result = SimpleNamespace(robot="the result's")
    assert log_of_commands(job, LogEntry(Path("a.csv")), result) == wanted


@pytest.mark.parametrize("at", [0, 1, 2])
def test_a_log_that_alone_has_no_unit_is_named(at):
    entries = [LogEntry(Path(f"{name}.csv"), unit="left") for name in "abc"]
    assert units_of_logs(entries) == ["left"] * 3
    entries[at] = replace(entries[at], unit="")
    other = "b.csv" if at == 0 else "a.csv"
    wanted = f"^{'abc'[at]}.csv has no unit, but {other} has unit = 'left'; "
    with pytest.raises(SettingsError, match=wanted):
        units_of_logs(entries)
