"""A live page: a server on the local host, which forwards messages to the page."""

import json
import sys
import threading
from collections import deque
from collections.abc import Mapping
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Self

_HISTORY = 20_000  # last messages, which pages opened later receive
_ALIVE = 10.0  # [s] between keep-alive comments


class LivePage:
    """Serves a page and a stream of messages (server-sent events) on 127.0.0.1.

    Attributes:
        url: Address of the page.
        page: The page, encoded.
    """

    def __init__(self, html: str, port: int = 0) -> None:
        self.page = html.encode()
        self._messages: deque[str] = deque(maxlen=_HISTORY)
        self._sent, self._over = 0, False
        self._news = threading.Condition()
        handler = type("Handler", (_Handler,), {"live": self})
        try:
            self._server = _Server(("127.0.0.1", port), handler)
        except OSError as error:
            message = f"port {port} of 127.0.0.1: {error.strerror}; choose another port, or none"
            raise OSError(message) from error
        self.url = f"http://127.0.0.1:{self._server.server_address[1]}/"
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def send(self, message: Mapping[str, Any]) -> None:
        """Send a message to all pages, including pages opened later."""
        text = json.dumps(message, allow_nan=False)
        with self._news:
            self._messages.append(text)
            self._sent += 1
            self._news.notify_all()

    def finish(self) -> None:
        """Send the end of the stream to all pages; the server continues."""
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
        """Wait for messages."""
        with self._news:
            self._news.wait_for(lambda: self._sent > count or self._over, _ALIVE)
            new = min(self._sent - count, len(self._messages))
            messages = list(self._messages)
            return messages[len(messages) - new :], self._sent, self._over


class _Server(ThreadingHTTPServer):
    daemon_threads = True

    def handle_error(self, request: Any, client_address: Any) -> None:  # noqa: ANN401
        """Ignore pages that were closed during a request or a response."""
        if not isinstance(sys.exception(), ConnectionError):
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    live: LivePage

    def do_GET(self) -> None:
        host = self.headers.get("Host", "").rsplit(":", 1)[0]
        if host not in ("127.0.0.1", "localhost"):  # a foreign host name that resolves to this host
            self.send_error(HTTPStatus.FORBIDDEN)
        elif self.path == "/":
            self._start("text/html; charset=utf-8", len(self.live.page))
            self.wfile.write(self.live.page)
        elif self.path == "/events":
            self._start("text/event-stream", None)
            self._stream()
        else:
            self.send_error(HTTPStatus.NOT_FOUND)

    def _start(self, kind: str, length: int | None) -> None:
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", kind)
        self.send_header("Cache-Control", "no-store")
        if length is not None:
            self.send_header("Content-Length", str(length))
        self.end_headers()

    def _stream(self) -> None:
        count, over = 0, False
        while not over:
            new, count, over = self.live.after(count)
            text = f"data: [{','.join(new)}]\n\n" if new else ": nothing new\n\n"
            self.wfile.write(text.encode())
        self.wfile.write(b"event: end\ndata:\n\n")

    def log_message(self, format: str, *_: object) -> None:
        """Do not log requests."""
