"""`robotid track`: what of a job reaches the tracker, and what of its history is told."""

from pathlib import Path

import numpy as np
from helpers.synthetic import exact_log, truth

from robotid.cli import track as module
from robotid.cli.job import Job, LogEntry
from robotid.cli.track import run_track, serve_track
from robotid.data.files.formats import open_table
from robotid.data.files.read import read_log, write_log
from robotid.data.signal_settings import LogSource, SignalSettings
from robotid.output.viewer.scene import coordinates


def tracked(arm, log, folder=None, **signals):
    """Track a log; return what is told, and the identifier that was used."""
    used = []
    job = Job(
        Path(arm.tree.path), identification=(LogEntry(log),), signals=SignalSettings(**signals)
    )
    content = run_track(job, folder, observer=lambda k, identifier: used.append((k, identifier)))
    assert [k for k, _ in used] == list(range(content["samples"]))
    return content, used[-1][1]


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


class Clock:
    """A clock that only waiting moves on."""

    now = 50.0

    @classmethod
    def monotonic(cls):
        return cls.now

    @classmethod
    def sleep(cls, seconds):
        assert seconds >= 0.0
        cls.now += seconds


def test_a_live_page_is_told_what_is_known_at_each_moment_in_the_time_of_the_log(
    arm, arm_logs, monkeypatch
):
    heard = []

    class Page:
        url = "here"

        def __init__(self, html, port):
            assert port == 7

        __enter__ = lambda self: self  # noqa: E731
        __exit__ = lambda self, *_: None  # noqa: E731
        finish = lambda self: None  # noqa: E731

        def send(self, message):
            heard.append((Clock.now - 50.0, message))

    known = {}
    monkeypatch.setattr(module, "time", Clock)
    monkeypatch.setattr(module, "LivePage", Page)
    told = module._LiveFeed.__call__

    def noted(self, k, identifier):
        if identifier.is_ready:
            known[k] = identifier.reading, *identifier.compared
        told(self, k, identifier)

    monkeypatch.setattr(module._LiveFeed, "__call__", noted)
    job = Job(Path(arm.tree.path), identification=(LogEntry(arm_logs / "fit.csv"),))
    stated = {"port": 7, "speed": 4.0, "linger": False}
    content = serve_track(job, None, announce=heard.append, **stated)
    address, *messages = heard
    assert address == "here"
    log = read_log(arm_logs / "fit.csv", arm.joints)
    times = np.array([message["t"] for _, message in messages])
    assert set(times) <= set(log.t)
    assert (times[0], times[-1]) == (log.t[0], log.t[-1])
    steps = np.diff(times)[:-1]  # 25 in a second, of samples that are 10 ms apart
    assert steps.min() > 0.04 - 1e-9
    assert steps.max() < 0.05 + 1e-9
    np.testing.assert_allclose([at for at, _ in messages], (times - log.t[0]) / 4.0, atol=1e-9)
    ready = 0
    for _, message in messages:
        k = int(np.argmin(np.abs(log.t - message["t"])))
        assert message["q"] == coordinates(arm, log.q[k : k + 1])[0].tolist()
        if k in known:
            reading, tau, predicted = known[k]
            assert message["theta"] == reading.theta.tolist()
            assert message["std_error"] == reading.std_error.tolist()
            assert (message["at"], message["tau"]) == (reading.t, tau.tolist())
            np.testing.assert_array_equal(np.array(message["predicted"], float), predicted)
            ready += 1
    assert ready > 100
    assert message["theta"] == [entry["value"] for entry in content["base_parameters"]]
    monkeypatch.setattr(module, "run_track", lambda job, folder, observer: vars(observer))
    real = serve_track(job, None, port=7, announce=heard.append, linger=False)
    assert real["_speed"] == 1.0  # in real time
