"""Servers on loopback that behave as badly as networks do: a real nginx, and behind it an upstream that breaks."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.request import Request as UrlRequest
from urllib.request import urlopen

import pytest

_CONFIG = """
daemon off;
{user}
pid {work}/nginx.pid;
worker_processes 1;
error_log {work}/error.log;
events {{ worker_connections 256; }}
http {{
    log_format lines '$uri $status $body_bytes_sent "$http_range"';
    access_log {work}/access.log lines;
    client_body_temp_path {work}/a; proxy_temp_path {work}/b; fastcgi_temp_path {work}/c;
    uwsgi_temp_path {work}/d; scgi_temp_path {work}/e;
    keepalive_requests 10000;
    limit_req_zone $binary_remote_addr zone=few:64k rate=20r/s;
    split_clients $request_id $fate {{ 40% bad; * good; }}
    server {{
        listen 127.0.0.1:{port};
        location /good/ {{ alias {root}/; }}
        location /slow/ {{ alias {root}/; limit_rate {slow}; }}
        location /crawling/ {{ alias {root}/; limit_rate {crawling}; }}
        location /rangeless/ {{ alias {root}/; max_ranges 0; }}
        location /failing/ {{ if ($fate = bad) {{ return 500; }} alias {root}/; }}
        location /limited/ {{ limit_req zone=few; limit_req_status 429; alias {root}/; }}
        location /silent/ {{ return 444; }}
        location /moved/ {{ rewrite ^/moved/(.*)$ /good/$1 redirect; }}
        location /forbidden/ {{ deny all; }}
        location /private/ {{ auth_basic "x"; auth_basic_user_file {work}/users; alias {root}/; }}
        location /signed/ {{ if ($arg_token != "hush-hush") {{ return 403; }} alias {root}/; }}
        location /packed/ {{ alias {root}/; add_header Content-Encoding gzip; }}
        location /bucket/ {{
            if ($fate = bad) {{ return 503; }}
            proxy_pass http://127.0.0.1:{s3};
            proxy_set_header Host $http_host;
        }}
        location /faulty/ {{ proxy_pass http://127.0.0.1:{upstream}/; proxy_http_version 1.1; proxy_buffering off; }}
    }}
}}
"""


@dataclass
class Request:
    """A line of nginx's log."""

    path: str
    status: int
    sent: int
    range: str

    @property
    def start(self) -> int:
        """First byte asked for."""
        match = re.match(r"bytes=(\d+)-", self.range)
        return int(match[1]) if match else 0


@dataclass
class Reply:
    """Headers that promise `length` bytes, then `body`, a pause, and the connection is closed."""

    body: bytes
    length: int
    content_range: str
    status: int = 206
    pause_s: float = 0.0


@dataclass
class Faults:
    """`act` spoils replies; it gets the reply that would be right, and how often the file was asked for before."""

    act: Callable[[Reply, int], Reply] | None = None
    asked: dict[str, int] = field(default_factory=dict)


@dataclass
class Nginx:
    """A running nginx; `log` is read anew each time."""

    port: int
    work: Path
    faults: Faults

    def url(self, location: str) -> str:
        return f"http://127.0.0.1:{self.port}/{location}"

    def log(self, part: str = "") -> list[Request]:
        """Requests so far whose path has `part` in it, once nginx has written those that have ended."""
        time.sleep(0.02)
        lines = (
            re.match(r'(\S+) (\d+) (\d+) "(.*)"', line) for line in (self.work / "access.log").read_text().splitlines()
        )
        requests = [Request(line[1], int(line[2]), int(line[3]), line[4]) for line in lines if line]
        return [request for request in requests if part in request.path]

    def forget(self) -> None:
        """Begin a new log and a new count."""
        self.log()
        os.truncate(self.work / "access.log", 0)
        self.faults.act = None
        self.faults.asked.clear()


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextlib.contextmanager
def nginx(root: Path, work: Path, s3: int = 9) -> Iterator[Nginx]:
    """Serve `root` from a fresh nginx that needs no rights and leaves nothing outside `work`.

    A slow location sends three quarters of the first shard in a second, a crawling one a quarter; both send what a
    second allows at once. s3: port of a server whose `bucket` is seen through it, with failures.
    """
    program = shutil.which("nginx") or shutil.which("nginx", path="/usr/sbin")
    if program is None:
        pytest.skip("nginx is not installed (Debian's package `nginx-light` will do)")
    faults = Faults()
    with _upstream(root, faults) as upstream:
        port = free_port()
        user = "user root;" if os.geteuid() == 0 else ""
        work.mkdir()
        (work / "users").write_text("someone:{PLAIN}pass-word\n")
        values = {"user": user, "work": work, "root": root, "port": port, "upstream": upstream, "s3": s3}
        size = (root / "train-00000.tar").stat().st_size
        (work / "nginx.conf").write_text(_CONFIG.format(**values, slow=size * 3 // 4, crawling=size // 4))
        command = [program, "-p", str(work), "-e", str(work / "error.log"), "-c", str(work / "nginx.conf")]
        server = subprocess.Popen(command, stdin=subprocess.DEVNULL)
        try:
            _await_port(port, server, work)
            yield Nginx(port, work, faults)
        finally:
            server.terminate()
            server.wait(10)


def _await_port(port: int, server: subprocess.Popen[bytes], work: Path) -> None:
    for _ in range(200):
        if server.poll() is not None:
            raise RuntimeError(f"nginx ended: {(work / 'error.log').read_text()}")
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 1):
            return
        time.sleep(0.02)
    raise RuntimeError("nginx does not answer")


@contextlib.contextmanager
def _upstream(root: Path, faults: Faults) -> Iterator[int]:
    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_GET(self) -> None:
            name = self.path.lstrip("/")
            before = faults.asked.get(name, 0)
            faults.asked[name] = before + 1
            data = (root / name).read_bytes()
            match = re.match(r"bytes=(\d+)-(\d+)", self.headers.get("Range", ""))
            start, stop = (int(match[1]), int(match[2]) + 1) if match else (0, len(data))
            body = data[start:stop]
            reply = Reply(body, len(body), f"bytes {start}-{start + len(body) - 1}/{len(data)}", 206 if match else 200)
            if faults.act is not None and name != "manifest.json":
                reply = faults.act(reply, before)
            self.send_response(reply.status)
            self.send_header("Content-Length", str(reply.length))
            if reply.status == 206:
                self.send_header("Content-Range", reply.content_range)
            self.end_headers()
            with contextlib.suppress(OSError):
                self.wfile.write(reply.body)
                self.wfile.flush()
                time.sleep(reply.pause_s)
            self.close_connection = True

        def log_message(self, *_: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
    thread.start()
    try:
        yield server.server_address[1]
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


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
