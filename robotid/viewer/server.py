"""A live page: a server on this machine alone, and a tracker that tells it what it sees."""

import json
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Self

import numpy as np

from robotid.commands.job import Job
from robotid.exceptions import SettingsError
from robotid.identification.pipeline import structural_mapping
from robotid.logs.data import Log
from robotid.online.identifier import OnlineIdentifier
from robotid.online.tracking import run_track
from robotid.robot.model import RobotModel
from robotid.viewer.replays import live_page
from robotid.viewer.scene import coordinates

__all__ = ["LivePage", "serve_track"]

_RATE = 25.0  # [Hz] messages per second of the log
_KEPT = 20_000  # messages that a page opened late still gets
_ALIVE = 10.0  # [s] between signs of life when there is nothing to tell


class LivePage:
    """Serves a page and a stream of messages (server-sent events) on 127.0.0.1.

    Args:
        html: The page.
        port: Port to listen at; any free one if 0.

    Attributes:
        url: Address of the page.

    Raises:
        OSError: If the port is taken.
    """

    def __init__(self, html: str, port: int = 0) -> None:
        self._html = html.encode()
        self._messages: deque[str] = deque(maxlen=_KEPT)
        self._sent, self._over = 0, False
        self._news = threading.Condition()
        handler = type("Handler", (_Handler,), {"live": self})
        try:
            self._server = ThreadingHTTPServer(("127.0.0.1", port), handler)
        except OSError as error:
            message = f"port {port} of 127.0.0.1: {error.strerror}; name another one, or none"
            raise OSError(message) from error
        self._server.daemon_threads = True
        self.url = f"http://127.0.0.1:{self._server.server_address[1]}/"
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def page(self) -> bytes:
        """The page, as it is sent."""
        return self._html

    def send(self, message: Mapping[str, Any]) -> None:
        """Tell every page, those opened later too.

        Args:
            message: Plain finite values; replay.js says which.
        """
        text = json.dumps(message, allow_nan=False)
        with self._news:
            self._messages.append(text)
            self._sent += 1
            self._news.notify_all()

    def finish(self) -> None:
        """Tell every page that no more will come; the server goes on."""
        with self._news:
            self._over = True
            self._news.notify_all()

    def close(self) -> None:
        """End the server."""
        self.finish()
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def after(self, count: int) -> tuple[list[str], int, bool]:
        """Wait for messages.

        Args:
            count: How many have been taken.

        Returns:
            Those after them, none if nothing came for a while; how many there have been; and
            whether these are the last.
        """
        with self._news:
            self._news.wait_for(lambda: self._sent > count or self._over, _ALIVE)
            new = min(self._sent - count, len(self._messages))
            kept = list(self._messages)
            return kept[len(kept) - new :], self._sent, self._over


class _Handler(BaseHTTPRequestHandler):
    live: LivePage

    def do_GET(self) -> None:
        host = self.headers.get("Host", "").rsplit(":", 1)[0]
        if host not in ("127.0.0.1", "localhost"):  # a name of another site that points here
            self.send_error(HTTPStatus.FORBIDDEN)
        elif self.path == "/":
            self._start("text/html; charset=utf-8", len(self.live.page))
            self.wfile.write(self.live.page)
        elif self.path == "/events":
            self._start("text/event-stream", None)
            try:
                self._tell()
            except (BrokenPipeError, ConnectionResetError):
                return  # the page was closed
        else:
            self.send_error(HTTPStatus.NOT_FOUND)

    def _start(self, kind: str, length: int | None) -> None:
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", kind)
        self.send_header("Cache-Control", "no-store")
        if length is not None:
            self.send_header("Content-Length", str(length))
        self.end_headers()

    def _tell(self) -> None:
        count, over = 0, False
        while not over:
            new, count, over = self.live.after(count)
            text = f"data: [{','.join(new)}]\n\n" if new else ": nothing new\n\n"
            self.wfile.write(text.encode())
        self.wfile.write(b"event: end\ndata:\n\n")

    def log_message(self, format: str, *_: object) -> None:
        """Say nothing of each request."""


def serve_track(
    job: Job,
    folder: str | None,
    *,
    port: int = 0,
    speed: float = 1.0,
    announce: Callable[[str], None],
    finished: Callable[[dict[str, Any]], None] | None = None,
    linger: bool = True,
) -> dict[str, Any]:
    """Track the one log of a job and show it in a live page as it goes.

    Args:
        job: The robot, the log and the signals' settings.
        folder: Where the history is written; nowhere if None.
        port: Port of the page on 127.0.0.1; any free one if 0.
        speed: How fast the log passes, 1 is true time; 0 is as fast as the tracker can.
        announce: Called with the address of the page.
        finished: Called with the content of track.json when the log has ended.
        linger: Whether the page is served on after the end, until KeyboardInterrupt.

    Returns:
        The content of track.json.

    Raises:
        DataError: If the log cannot be used.
        KeyboardInterrupt: If the user ends it.
        ModelError: If the URDF cannot be used.
        OSError: If the port is taken.
        SettingsError: If a setting does not fit.
    """
    if not speed >= 0:
        raise SettingsError(f"speed is {speed}, wanted 0 or more")
    model = job.model()
    log = job.read(job.identification[0], model)
    mapping = structural_mapping(model)
    units = [model.layout.units[i] for i in mapping.independent]
    html = live_page(model, mapping.base_names, units, log.q, model.standard_parameters())
    with LivePage(html, port) as live:
        announce(live.url)
        content = run_track(job, folder, observer=_Teller(live, model, log, speed))
        live.finish()
        if finished is not None:
            finished(content)
        while linger:
            time.sleep(3600.0)
    return content


class _Teller:
    """Tells a live page what a tracker sees, no faster than the log's time passes."""

    def __init__(self, live: LivePage, model: RobotModel, log: Log, speed: float) -> None:
        self._live, self._model, self._log, self._speed = live, model, log, speed
        self._due, self._marks = -np.inf, 0
        self._began = time.monotonic()

    def __call__(self, k: int, identifier: OnlineIdentifier) -> None:
        t, start = float(self._log.t[k]), float(self._log.t[0])
        if t < self._due:
            return
        self._due = t + 1.0 / _RATE
        if self._speed > 0:
            ahead = (t - start) / self._speed - (time.monotonic() - self._began)
            time.sleep(max(ahead, 0.0))
        message = {
            "t": t - start,
            "q": coordinates(self._model, self._log.q[k : k + 1])[0].tolist(),
        }
        if identifier.is_ready:
            reading, (tau, predicted) = identifier.reading, identifier.compared
            message |= {
                "at": reading.t - start,
                "tau": tau.tolist(),
                "predicted": predicted.tolist(),
                "theta": reading.theta.tolist(),
                "std_error": reading.std_error.tolist(),
            }
        self._live.send(message)
        for change in identifier.changes[self._marks :]:
            label = f"step change, flagged at {change.flagged - start:.2f} s"
            mark = {"t": change.onset - start, "label": label, "kind": "payload"}
            self._live.send({"mark": mark})
        self._marks = len(identifier.changes)
