"""Traps that the publishers of real recordings warn of: the doctor finds each that a log shows."""

from pathlib import Path

import pytest

from robotid.cli.job import LogEntry, read_job
from robotid.diagnosis.logs.check_logs import diagnose
from robotid.diagnosis.urdf.inspection import inspect_urdf

JOBS = Path(__file__).parents[2] / "jobs"
# what the notes of each set say, and the finding with the figure that tells it
TRAPS = {
    "kinova_gen3/gen3_1.parquet": [
        ("gap", "longest", 0.9, 1.0),  # slow samples were removed
        ("jitter", "relative_spread", 0.16, 0.17),
    ],
    "kinova_gen3/gen3_2.parquet": [("gap", "gaps", 2, 4)],
    "tx40/joint_side.parquet": [
        ("rate", "rate", 4999, 5001),
        ("standstill", "after", 1.2, 1.6),  # motion 0-7.45 s of 9, cut and trimmed by the settings
    ],
    "ur10e/ident_20200212_50s12h.parquet": [
        ("standstill", "before", 2.0, 4.0),  # every file starts and ends at rest
        ("standstill", "after", 3.0, 6.0),
    ],
    "tiago/tiago_dyn.parquet": [
        ("velocity_delay", "delay", 0.13, 0.2),  # 140-190 ms, smoothed by the driver
        ("quantised", "steps_arm_5_joint", 20, 60),  # wrist currents of a few quanta
        ("quantised", "steps_arm_7_joint", 20, 60),
        ("standstill", "before", 6.0, 10.0),  # about 9 s at rest, then slow
        ("standstill", "after", 11.0, 13.0),
        ("unexplained_torque", "share", 0.7, 0.8),  # of the last joint
    ],
    "panda/panda_inria.parquet": [
        ("jitter", "longest", 0.0019, 0.009),  # 0.7-8.8 ms around 1 ms
        ("stale_rows", "rows", 1000, 1300),  # 1255 repeated rows, those at rest among them
        ("velocity_delay", "delay", 0.004, 0.008),  # about 6 ms
        ("gap", "longest", 0.0085, 0.009),
    ],
}
FOLDERS = {"panda": "panda_inria"}


@pytest.mark.parametrize("file", TRAPS)
def test_the_doctor_finds_the_traps_of_a_real_recording(recordings, monkeypatch, file):
    monkeypatch.setenv("ROBOTID_DATA", str(recordings))
    folder = file.split("/", maxsplit=1)[0]
    job = read_job(JOBS / f"{FOLDERS.get(folder, folder)}.toml")
    model = job.model()
    findings = diagnose(model, [job.read(LogEntry(recordings / file), model)], [], job.signals)
    assert not [f.code for f in findings if f.severity == "error"]
    for code, figure, low, high in TRAPS[file]:
        values = [f.evidence[figure] for f in findings if f.code == code and figure in f.evidence]
        assert any(low <= value <= high for value in values), (code, figure, values)


def test_joints_that_turn_freely_but_are_stated_without_limits_are_named(recordings):
    found = inspect_urdf(recordings / "kinova_gen3" / "robot.urdf").findings
    joints = {f.where for f in found if f.code == "no_limits"}
    assert joints == {f"joint joint_{k}" for k in (1, 3, 5, 7)}
