"""A live page: a server on this machine alone, which tells it what is sent."""

import json
import sys
import threading
from collections import deque
from collections.abc import Mapping
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Self

__all__ = ["LivePage"]

_KEPT = 20_000  # messages that a page opened late still gets
_ALIVE = 10.0  # [s] between signs of life when there is nothing to tell


class LivePage:
    """Serves a page and a stream of messages (server-sent events) on 127.0.0.1.

    Args:
        html: The page.
        port: Port to listen at; any free one if 0.

    Attributes:
        url: Address of the page.
        page: The page, as it is sent.

    Raises:
        OSError: If the port is taken.
    """

    def __init__(self, html: str, port: int = 0) -> None:
        self.page = html.encode()
        self._messages: deque[str] = deque(maxlen=_KEPT)
        self._sent, self._over = 0, False
        self._news = threading.Condition()
        handler = type("Handler", (_Handler,), {"live": self})
        try:
            self._server = _Server(("127.0.0.1", port), handler)
        except OSError as error:
            message = f"port {port} of 127.0.0.1: {error.strerror}; name another one, or none"
            raise OSError(message) from error
        self.url = f"http://127.0.0.1:{self._server.server_address[1]}/"
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

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


class _Server(ThreadingHTTPServer):
    daemon_threads = True

    def handle_error(self, request: Any, client_address: Any) -> None:  # noqa: ANN401
        """Say nothing of a page that was closed in the middle of a request or of an answer."""
        if not isinstance(sys.exception(), ConnectionError):
            super().handle_error(request, client_address)


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
            self._tell()
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
