"""`robotid track`: what of a job reaches the tracker, and what of its history is told."""

from pathlib import Path

import numpy as np
import pytest
from helpers.synthetic import exact_log, truth

from robotid.commands.job import Job, LogEntry
from robotid.commands.track import run_track
from robotid.logs.formats import open_table
from robotid.logs.read import write_log
from robotid.logs.settings import LogSource, SignalSettings
from robotid.online.settings import OnlineSettings


def tracked(arm, log, folder=None, **signals):
    """Track a log; return what is told, and the identifier that was used."""
    used = []
    job = Job(
        Path(arm.tree.path), identification=(LogEntry(log),), signals=SignalSettings(**signals)
    )
    content = run_track(job, folder, observer=lambda k, identifier: used.append((k, identifier)))
    assert [k for k, _ in used] == list(range(content["samples"]))
    return content, used[-1][1]


def test_the_settings_of_the_signals_reach_the_tracker(arm, arm_logs):
    stated = {"rate": 50.0, "cutoff": 5.0, "min_velocity": 0.1}
    _, identifier = tracked(arm, arm_logs / "fit.csv", **stated)
    assert identifier.settings == OnlineSettings(**stated)
    _, identifier = tracked(arm, arm_logs / "fit.csv")
    usual = SignalSettings()
    assert identifier.settings.rate == pytest.approx(100.0)  # the log's own
    assert identifier.settings.cutoff == usual.cutoff
    assert identifier.settings.min_velocity == usual.min_velocity


def test_what_is_told_is_what_the_history_ends_with(arm, rng, tmp_path):
    write_log(
        exact_log(arm, truth(arm), rng, samples=1300, rate=100.0, noise=0.1), tmp_path / "log.csv"
    )
    content, identifier = tracked(arm, tmp_path / "log.csv", tmp_path)
    table = open_table(tmp_path / content["history"], LogSource())
    columns = table.read(table.names)
    assert content["samples"] == 1300
    assert content["first_estimate"] == columns["time"][0]
    reached = np.flatnonzero(columns["converged"])
    assert len(reached) > 1
    assert content["converged_at"] == columns["time"][reached[0]]
    assert content["excitation"] == columns["excitation"][-1]
    assert content["delay"] == identifier.delay
    for entry in content["base_parameters"]:
        assert entry["value"] == columns[entry["name"]][-1]
        assert entry["std_error"] == columns[f"{entry['name']}.std_error"][-1]
    assert list(content["sigma"]) == list(arm.joints)
    assert list(content["sigma"].values()) == identifier.reading.sigma.tolist()
