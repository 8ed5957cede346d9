"""Driving a browser where there is none, and the proxy that a page is tested through."""

from __future__ import annotations

import http.server
import sys
import threading
import urllib.error
import urllib.request
from pathlib import Path

import pytest
from benches.browser import view
from benches.browser.chromium import chromium, open_tab
from benches.browser.view import Proxy

from bodyseg_data.core import MissingLibrary


def test_without_a_browser_one_line_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(sys, "argv", ["view"])
    assert chromium() is None
    with pytest.raises(MissingLibrary, match="a browser is needed: apt-get install chromium"), open_tab(800, 600):
        pass
    assert view.main() == 0
    assert capsys.readouterr().out == "not checked: the page in a browser, which needs apt-get install chromium\n"


def test_a_browser_that_does_not_start_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = tmp_path / "chromium"
    program.write_text("#!/bin/sh\nexit 3\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(RuntimeError, match="did not start: status 3"), open_tab(800, 600):
        pass


class Paths(http.server.BaseHTTPRequestHandler):
    """Answers with the path that it was asked for."""

    def do_GET(self) -> None:
        self.send_response(200)
        self.end_headers()
        self.wfile.write(self.path.encode())

    def log_message(self, *_: object) -> None:
        """Print nothing."""


def test_the_proxy_takes_its_path_off() -> None:
    with http.server.HTTPServer(("127.0.0.1", 0), Paths) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        proxy = Proxy("/lab/view", server.server_port)
        address = f"http://127.0.0.1:{proxy.port}"
        for asked, found in (("/lab/view/", b"/"), ("/lab/view/a?b", b"/a?b"), ("/lab/view", b"/")):
            with urllib.request.urlopen(address + asked, timeout=60) as reply:
                assert reply.read() == found
        with pytest.raises(urllib.error.HTTPError, match="404") as refused:
            urllib.request.urlopen(f"{address}/other", timeout=60)
        refused.value.close()
        proxy.close()
        server.shutdown()
