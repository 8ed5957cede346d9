"""Servers on loopback: one of HTTP that fails in every way that networks do, and one of S3."""

from __future__ import annotations

import base64
import contextlib
import json
import random
import re
import select
import socket
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from http.client import HTTPConnection
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, Final
from urllib.parse import parse_qs, unquote, urlsplit
from urllib.request import Request as UrlRequest
from urllib.request import urlopen

import pytest
from replies import Faults, Reply, Request, refusal

FATES: Final = "x..xx...x..xxxx....."
"""Requests of `failing/` and `bucket/` in turn: 40 % fail (x), up to four in a row, the same ones in every run."""

LIMIT_S: Final = 0.05
"""`limited/` refuses requests that come sooner after the last one it answered."""

USER: Final = "Basic " + base64.b64encode(b"someone:pass-word").decode()
TOKEN: Final = "hush-hush"


class WebServer(ThreadingHTTPServer):
    """Serves the files of `root` under `good/` and under other locations, each with a fault of its own.

    s3: port of a server whose `bucket` is seen through this one, with failures.
    """

    daemon_threads = False  # closing waits for them: none is left to a later test
    request_queue_size = 64

    def __init__(self, root: Path, s3: int | None = None) -> None:
        self.root, self.s3 = root, s3
        self.shard_bytes = (root / "train-00000.tar").stat().st_size
        self.faults = Faults()
        self.commits = {"main": "a" * 40, "v1.0": "b" * 40}
        self.errors: list[BaseException] = []
        self._log: list[Request] = []
        self._answering = 0
        self._idle = threading.Condition()
        self._turn = 0
        self._last_s = -LIMIT_S
        self._connections: set[socket.socket] = set()
        super().__init__(("127.0.0.1", 0), _Handler)

    def url(self, location: str) -> str:
        return f"http://127.0.0.1:{self.server_port}/{location}"

    def log(self, part: str = "") -> list[Request]:
        """Requests whose path has `part` in it, in the order in which they ended, once none is being answered."""
        with self._idle:
            assert self._idle.wait_for(lambda: not self._answering, 10), "a request does not end"
            return [request for request in self._log if part in request.path]

    def forget(self) -> None:
        """Begin a new log and new counts, without faults."""
        self.log()
        self._log.clear()
        self._turn, self._last_s = 0, -LIMIT_S
        self.faults.act = None
        self.faults.asked.clear()

    @contextlib.contextmanager
    def answering(self) -> Iterator[list[Request]]:
        """Surrounds an answer; the request put into the list is logged as it ends."""
        with self._idle:
            self._answering += 1
        ended: list[Request] = []
        try:
            yield ended
        finally:
            with self._idle:
                self._log += ended
                self._answering -= 1
                self._idle.notify_all()

    def fails(self) -> bool:
        """Count a request; True for the 40 % that are to fail."""
        with self._idle:
            self._turn += 1
            return FATES[(self._turn - 1) % len(FATES)] == "x"

    def comes_too_soon(self) -> bool:
        """Count a request; True for those to be refused by `limited/`."""
        with self._idle:
            now = time.monotonic()
            soon = now - self._last_s < LIMIT_S
            self._last_s = self._last_s if soon else now
            return soon

    def spoiled(self, name: str, reply: Reply) -> Reply:
        """The reply as the test's fault makes it; the manifest is always right."""
        with self._idle:
            before = self.faults.asked[name]
            self.faults.asked[name] += 1
        act = self.faults.act
        return reply if act is None or name == "manifest.json" else act(reply, before)

    def process_request(self, request: Any, client_address: Any) -> None:
        self._connections.add(request)
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        super().shutdown_request(request)
        self._connections.discard(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Keep what was raised, for the end of the tests; clients may go away."""
        error = sys.exception()
        if error is not None and not isinstance(error, BrokenPipeError | ConnectionResetError):
            self.errors.append(error)

    def stop(self) -> None:
        """End all connections and their threads."""
        self.shutdown()
        for connection in list(self._connections):
            with contextlib.suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)
        self.server_close()


class _Handler(BaseHTTPRequestHandler):
    """Answers the requests of one connection."""

    server: WebServer
    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True  # else a body waits 40 ms for the acknowledgement of its headers

    def do_GET(self) -> None:
        path = unquote(urlsplit(self.path).path)
        location, _, name = path[1:].partition("/")
        status, self._sent = 444, 0
        with self.server.answering() as ended:
            try:
                reply = self._reply(location, name)
                if reply is None:
                    self.close_connection = True
                else:
                    status = reply.status
                    self._send(reply)
            finally:
                ended.append(Request(path, status, self._sent, self.headers.get("Range", "")))

    def do_HEAD(self) -> None:
        self.do_GET()

    def log_message(self, *_: object) -> None:
        """Print nothing."""

    def _reply(self, location: str, name: str) -> Reply | None:
        """The reply of a location; None closes the connection without one."""
        server = self.server
        match location:
            case "good":
                return self._file(name)
            case "slow":
                return replace(self._file(name), step=server.shard_bytes * 3 // 4)
            case "crawling":
                return replace(self._file(name), step=server.shard_bytes // 4)
            case "rangeless":
                return self._file(name, ranges=False)
            case "failing":
                return refusal(500) if server.fails() else self._file(name)
            case "limited":
                return refusal(429) if server.comes_too_soon() else self._file(name)
            case "silent":
                return None
            case "moved":
                return refusal(302, Location=server.url(f"good/{name}"))
            case "circle":
                return refusal(302, Location=server.url(f"circle/{name}"))
            case "private":
                known = self.headers.get("Authorization") == USER
                return self._file(name) if known else refusal(401, WWW_Authenticate='Basic realm="x"')
            case "signed":
                known = parse_qs(urlsplit(self.path).query).get("token") == [TOKEN]
                return self._file(name) if known else refusal(403)
            case "api" | "datasets":
                return self._hub(name)
            case "content":  # another origin, which gets no token
                return refusal(400) if self.headers.get("Authorization") else self._file(name)
            case "forbidden":
                return refusal(403)
            case "unlisted":  # as a bucket that may be read, but not listed
                return self._file(name) if (server.root / name).exists() else refusal(403)
            case "packed":
                return replace(self._file(name), headers={"Content-Encoding": "gzip"})
            case "bucket" if server.s3 is not None:
                return refusal(503) if server.fails() else self._passed_on(server.s3)
            case "faulty":
                return server.spoiled(name, self._file(name))
        return refusal(404)

    def _hub(self, name: str) -> Reply:
        """The hub's API for one private set: its commits by revision, and its files, shards at another address."""
        server = self.server
        if self.headers.get("Authorization") != f"Bearer {TOKEN}":
            return refusal(401, X_Error_Code="RepoNotFound")
        if name.startswith("datasets/"):
            revision = name.removeprefix("datasets/owner/name/revision/")
            if revision not in server.commits:
                return refusal(404, X_Error_Code="RevisionNotFound")
            body = json.dumps({"id": "owner/name", "sha": server.commits[revision]}).encode()
            return Reply(body, len(body), status=200, headers={"Content-Type": "application/json"})
        known, _, file = name.partition("/resolve/")
        commit, _, file = file.partition("/")
        if known != "owner/name" or commit not in server.commits.values():
            return refusal(404)
        if not file.endswith(".tar"):
            return self._file(file)
        return refusal(302, Location=f"http://localhost:{server.server_port}/content/{file}")

    def _file(self, name: str, ranges: bool = True) -> Reply:
        try:
            data = (self.server.root / name).read_bytes()
        except (FileNotFoundError, IsADirectoryError):
            return refusal(404)
        match = re.fullmatch(r"bytes=(\d+)-(\d*)", self.headers.get("Range", "")) if ranges else None
        if match is None:
            return Reply(data, len(data), status=200)
        start = int(match[1])
        if start >= len(data):
            return refusal(416, Content_Range=f"bytes */{len(data)}")
        body = data[start : int(match[2]) + 1 if match[2] else None]
        return Reply(body, len(body), f"bytes {start}-{start + len(body) - 1}/{len(data)}")

    def _passed_on(self, port: int) -> Reply:
        """The reply of the S3 server, asked the same."""
        behind = HTTPConnection("127.0.0.1", port, timeout=30)
        with contextlib.closing(behind):
            behind.request(self.command, self.path, headers=dict(self.headers))
            answer = behind.getresponse()
            body = answer.read()
        headers = {name.title(): value for name, value in answer.getheaders()}
        for name in ("Connection", "Transfer-Encoding", "Date", "Server"):
            headers.pop(name, None)
        length = int(headers.pop("Content-Length", len(body)))  # of a HEAD request: what GET would send
        return Reply(body, length, headers.pop("Content-Range", ""), answer.status, headers=headers)

    def _send(self, reply: Reply) -> None:
        """Send a reply as far as the client takes it."""
        self.send_response(reply.status)
        self.send_header("Content-Length", str(reply.length))
        if reply.status == 206:
            self.send_header("Content-Range", reply.content_range)
        for name, value in reply.headers.items():
            self.send_header(name, value)
        try:
            self.end_headers()
            if self.command != "HEAD":
                self._send_body(reply)
        except OSError:
            self.close_connection = True

    def _send_body(self, reply: Reply) -> None:
        step = reply.step or len(reply.body) or 1
        for start in range(0, len(reply.body), step):
            if start and self._client_leaves_within(reply.step_s):
                self.close_connection = True
                return
            rest = memoryview(reply.body)[start : start + step]
            while rest:
                taken = self.connection.send(rest)
                self._sent += taken
                rest = rest[taken:]
        if len(reply.body) != reply.length:
            self._client_leaves_within(reply.pause_s)
            self.close_connection = True

    def _client_leaves_within(self, seconds: float) -> bool:
        """Wait; True as soon as the connection is closed at its other end."""
        return bool(select.select([self.connection], [], [], seconds)[0])


@contextlib.contextmanager
def web_server(root: Path, s3: int | None = None) -> Iterator[WebServer]:
    """A running server; it ends with the context. Raises what went wrong in it."""
    server = WebServer(root, s3)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
    thread.start()
    try:
        yield server
    finally:
        server.stop()
        thread.join()
    if server.errors:
        raise server.errors[0]


@contextlib.contextmanager
def s3_server(root: Path, bucket: str, folder: str) -> Iterator[int]:
    """The port of an S3-compatible server on loopback whose `bucket` holds the files of `root` under `folder`."""
    server = pytest.importorskip("moto.server").ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    try:
        port = int(server.get_host_and_port()[1])
        put(f"http://127.0.0.1:{port}/{bucket}", b"")
        for file in root.iterdir():
            put(f"http://127.0.0.1:{port}/{bucket}/{folder}/{file.name}", file.read_bytes())
        yield port
    finally:
        server.stop()


def put(url: str, data: bytes) -> None:
    kind = {"Content-Type": "application/octet-stream"}
    with urlopen(UrlRequest(url, data, kind, method="PUT")):
        pass


def free_port() -> int:
    """A port where nobody listens, below those that systems give to connections: no connection takes it meanwhile."""
    while True:
        port = random.SystemRandom().randrange(20_000, 32_000)
        with contextlib.suppress(OSError), socket.create_server(("127.0.0.1", port)):
            return port
