"""A server of files on loopback that is far away: a pause before each answer, and a rate for each connection.

It is a process of its own, so that its work is neither the loader's processor time nor done under its lock.
"""

from __future__ import annotations

import os
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Final

_STEP_S: Final = 0.02


class ThrottledServer:
    """Serves `folder` from `__enter__` to `__exit__`. latency_s: before each answer. rate: bytes a second of each
    connection.

    Counted since `forget`: requests and sent bytes of shards.
    """

    def __init__(self, folder: Path, latency_s: float, rate: float) -> None:
        context = get_context("fork")  # the address is bound before, so that nothing is sent back
        server = _Server(folder, latency_s, rate, context.Array("q", 2))
        self._counts, self.url = server.counts, f"http://127.0.0.1:{server.server_port}/"
        self._process = context.Process(target=server.serve_forever, args=(0.02,), daemon=True)
        self._process.start()
        server.socket.close()

    def __enter__(self) -> ThrottledServer:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.terminate()
        self._process.join()

    def forget(self) -> None:
        """Count from 0 again."""
        with self._counts:
            self._counts[:] = [0, 0]

    @property
    def requests(self) -> int:
        return int(self._counts[0])

    @property
    def sent(self) -> int:
        return int(self._counts[1])


class _Server(ThreadingHTTPServer):
    """counts: shared, requests and bytes as `ThrottledServer` names them."""

    daemon_threads = True
    request_queue_size = 64

    def __init__(self, folder: Path, latency_s: float, rate: float, counts: Any) -> None:
        self.folder, self.latency_s, self.rate, self.counts = folder, latency_s, rate, counts
        super().__init__(("127.0.0.1", 0), _Handler)

    def count(self, *amounts: int) -> None:
        """Add to requests and bytes."""
        with self.counts:
            self.counts[:] = [before + more for before, more in zip(self.counts, amounts, strict=True)]

    def handle_error(self, request: object, client_address: object) -> None:
        """Clients may go away."""


class _Handler(BaseHTTPRequestHandler):
    server: _Server
    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True

    def do_GET(self) -> None:
        path = self.server.folder / Path(self.path).name
        if not path.is_file():
            self.send_error(404)
            return
        is_shard = path.suffix == ".tar"
        if is_shard:
            self.server.count(1, 0)
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
            self._send(file.fileno(), first, last + 1, is_shard)

    def _send(self, file: int, first: int, stop: int, is_counted: bool) -> None:
        start, at = time.monotonic(), first
        while at < stop:
            # What is due by now, so that a thread that wakes up late keeps the rate.
            due = min(stop, first + int((time.monotonic() - start + _STEP_S) * self.server.rate))
            while at < due:
                sent = os.sendfile(self.connection.fileno(), file, at, due - at)
                at += sent
                if is_counted:
                    self.server.count(0, sent)
            if at < stop:
                time.sleep(_STEP_S)

    def log_message(self, *_: object) -> None:
        """Print nothing."""
