"""A server of files on loopback that is far away: a pause before each answer, and a rate for each connection."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Final

_STEP_S: Final = 0.01


class ThrottledServer(ThreadingHTTPServer):
    """Serves `folder`. latency_s: before each answer. rate: bytes a second of each connection.

    requests, sent: of shards, since `forget`; most_at_once: answers at the same time.
    """

    daemon_threads = True
    request_queue_size = 64

    def __init__(self, folder: Path, latency_s: float, rate: float) -> None:
        self.latency_s, self.rate = latency_s, rate
        self._changing = threading.Lock()
        self.forget()
        super().__init__(("127.0.0.1", 0), partial(_Handler, folder))

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_port}/"

    def forget(self) -> None:
        """Count from 0 again."""
        self.requests = self.sent = self.most_at_once = self._answering = 0

    @contextlib.contextmanager
    def answering(self) -> Iterator[None]:
        with self._changing:
            self.requests += 1
            self._answering += 1
            self.most_at_once = max(self.most_at_once, self._answering)
        try:
            yield
        finally:
            with self._changing:
                self._answering -= 1

    def count(self, size: int) -> None:
        with self._changing:
            self.sent += size

    def handle_error(self, request: object, client_address: object) -> None:
        """Clients may go away."""


class _Handler(BaseHTTPRequestHandler):
    server: ThrottledServer
    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True

    def __init__(self, folder: Path, *arguments: object) -> None:
        self._folder = folder
        super().__init__(*arguments)  # type: ignore[arg-type]  # what socketserver gives

    def do_GET(self) -> None:
        path = self._folder / Path(self.path).name
        if not path.is_file():
            self.send_error(404)
            return
        with self.server.answering() if path.suffix == ".tar" else contextlib.nullcontext():
            size = path.stat().st_size
            first, last = 0, size - 1
            if asked := self.headers.get("Range", ""):
                first, last = map(int, asked.removeprefix("bytes=").split("-"))
            time.sleep(self.server.latency_s)
            self.send_response(206 if asked else 200)
            self.send_header("Content-Length", str(last + 1 - first))
            if asked:
                self.send_header("Content-Range", f"bytes {first}-{last}/{size}")
            self.end_headers()
            with path.open("rb") as file:
                file.seek(first)
                self._send(file.read(last + 1 - first), path.suffix == ".tar")

    def _send(self, data: bytes, is_counted: bool) -> None:
        start, sent = time.monotonic(), 0
        while sent < len(data):
            # What is due by now, so that a thread that wakes up late keeps the rate.
            due = min(len(data), int((time.monotonic() - start + _STEP_S) * self.server.rate))
            self.wfile.write(data[sent:due])
            if is_counted:
                self.server.count(due - sent)
            sent = due
            if sent < len(data):
                time.sleep(_STEP_S)

    def log_message(self, *_: object) -> None:
        """Print nothing."""


@contextlib.contextmanager
def throttled_server(folder: Path, latency_s: float, rate: float) -> Iterator[ThrottledServer]:
    """A running server; it ends with the context."""
    server = ThrottledServer(folder, latency_s, rate)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
    thread.start()
    try:
        yield server
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
