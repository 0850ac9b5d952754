"""The live page's server, spoken to as a browser does, and what a tracker tells it."""

import http.client
import json
import socket
import struct
import threading
import time

import numpy as np
import pytest
from helpers.synthetic import payload_log

from robotid.cli.job import job_from_settings
from robotid.cli.track import serve_track
from robotid.data.files.read import write_log
from robotid.output.viewer.scene import coordinates
from robotid.output.viewer.server import LivePage


@pytest.fixture
def live():
    with LivePage("<p>page") as page:
        yield page


def ask(url, path="/", host=None):
    where = url.removeprefix("http://").rstrip("/")
    connection = http.client.HTTPConnection(where, timeout=10)
    connection.request("GET", path, headers={} if host is None else {"Host": host})
    return connection, connection.getresponse()


def told(url):
    """Return every message of a stream, until its end."""
    connection, response = ask(url, "/events")
    assert response.headers["Content-Type"] == "text/event-stream"
    text = response.read().decode()
    connection.close()
    assert text.endswith("event: end\ndata:\n\n")
    lists = [line[6:] for line in text.splitlines() if line.startswith("data: ")]
    return [message for part in lists for message in json.loads(part)]


def test_the_page_is_served_on_this_machine_alone(live):
    assert live.url.startswith("http://127.0.0.1:")
    _, response = ask(live.url)
    assert (response.status, response.read()) == (200, b"<p>page")
    names = ("Content-Type", "Content-Length", "Cache-Control")
    said = [response.headers[name] for name in names]
    assert said == ["text/html; charset=utf-8", "7", "no-store"]
    assert ask(live.url, "/etc/passwd")[1].status == 404
    # a page of another site whose name was made to point here
    assert ask(live.url, host="evil.example:80")[1].status == 403
    assert ask(live.url, host="localhost:1")[1].status == 200


def test_a_page_opened_late_and_one_opened_early_hear_the_same(live):
    early = []
    listener = threading.Thread(target=lambda: early.extend(told(live.url)))
    listener.start()
    for k in range(50):
        live.send({"t": k})
        time.sleep(0.002)  # or all are heard at once
    live.finish()
    listener.join(10)
    late = told(live.url)
    assert early == late == [{"t": k} for k in range(50)]


@pytest.mark.parametrize("words", ["", "GET / HTTP/1.1\r\n", "GET /events HTTP/1.1\r\n"])
def test_a_client_that_breaks_off_leaves_no_trace(live, capfd, words):
    live.page = b"x" * 2**24  # more than any buffer on its way
    host, _, port = live.url.removeprefix("http://").rstrip("/").partition(":")
    for end in ("", "Host: localhost\r\n\r\n"):
        with socket.create_connection((host, int(port))) as client:
            client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            client.sendall((words + end).encode())
            time.sleep(0.05)
    live.send({"t": 0.0})
    live.send({"t": 1.0})
    assert ask(live.url, "/none")[1].status == 404
    time.sleep(0.1)
    assert capfd.readouterr().err == ""


@pytest.fixture(scope="module")
def words(panda, tmp_path_factory):
    log = payload_log(panda, np.random.default_rng(0), duration=12.0, at=10.0)
    path = tmp_path_factory.mktemp("live") / "log.csv"
    write_log(log, path)
    return log, [str(panda.tree.path), str(path), "--joints", ",".join(panda.joints)]


def test_a_tracker_tells_motion_torque_parameters_and_changes(panda, words, tmp_path):
    log, (urdf, path, *_) = words
    table = {
        "urdf": urdf, "joints": list(panda.joints), "identification": [{"log": path}],
    }  # fmt: skip
    job = job_from_settings(table, "test", tmp_path)
    heard = []

    def announce(url):
        listener = threading.Thread(target=lambda: heard.extend(told(url)))
        listener.start()
        announce.listener = listener

    content = serve_track(
        job, str(tmp_path / "out"), speed=0.0, announce=announce, finished=print, linger=False
    )
    announce.listener.join(120)
    assert json.loads((tmp_path / "out" / "track.json").read_text()) == content
    (mark,) = [m["mark"] for m in heard if "mark" in m]
    assert mark["t"] == pytest.approx(content["changes"][0]["onset"])
    shown = [m for m in heard if "t" in m]
    times = np.array([m["t"] for m in shown])
    assert np.diff(times)[:-1].min() > 0.039  # the last sample is told at once
    assert times[-1] == pytest.approx(log.t[-1])
    for message in shown[:: len(shown) // 7]:
        row = int(np.argmin(np.abs(log.t - message["t"])))
        np.testing.assert_allclose(message["q"], coordinates(panda, log.q[row : row + 1])[0])
    ready = [m for m in shown if "tau" in m]
    assert len(ready) > 0.8 * len(shown)
    delay = [m["t"] - m["at"] for m in ready]
    assert np.median(delay) == pytest.approx(content["delay"], abs=0.01)
    assert len(ready[-1]["theta"]) == len(content["base_parameters"])
    # what is predicted is what was measured, but for noise; nothing is where a joint is at rest
    late = [m for m in ready if 5.0 < m["t"] - log.t[0] < 9.5]
    tau, predicted = (np.array([m[key] for m in late], dtype=float) for key in ("tau", "predicted"))
    known = np.isfinite(predicted)
    assert np.linalg.norm((tau - predicted)[known]) < 0.1 * np.linalg.norm(tau[known])
    v = np.gradient(log.q, log.t, axis=0)
    speed = np.array([v[int(np.argmin(np.abs(log.t - m["at"])))] for m in late])
    assert known.mean() > 0.5
    assert known[np.abs(speed) > 0.05].all()
    assert not known[np.abs(speed) < 0.01].any()
    assert (np.abs(speed) < 0.01).any()
