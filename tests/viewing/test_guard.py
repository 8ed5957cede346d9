"""Who may open a page, and messages that would harm it: a real server, and clients that forge what they send."""

from __future__ import annotations

import contextlib
import socket
import sys
import time
from collections.abc import Iterator
from typing import Any

import msgspec
import numpy as np
import pytest
import viser
from websockets.sync.client import connect
from websockets.sync.connection import Connection

from bodyseg_model.viewing import LOOPBACK, Page
from bodyseg_model.viewing.page import Guard
from bodyseg_model.viewing.pictures import Drawing, Points, viewpoint

WAIT_S = 20.0
FOREIGN = "http://evil.example"


@pytest.fixture
def page() -> Iterator[Page]:
    opened = Page(LOOPBACK, 0, "bodyseg view", allowed=["Lab.example.org"])
    yield opened
    opened.close()


def status(page: Page, path: str, host: str | None = None, origin: str | None = None, upgrade: bool = True) -> int:
    """Status of the answer to a raw request, 101 for an accepted WebSocket."""
    lines = [f"GET {path} HTTP/1.1", f"Host: {host or f'{LOOPBACK}:{page.port}'}", "Connection: Upgrade"]
    lines += [] if origin is None else [f"Origin: {origin}"]
    if upgrade:
        lines += ["Upgrade: websocket", "Sec-WebSocket-Version: 13", "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA=="]
        lines.append(f"Sec-WebSocket-Protocol: viser-v{viser.__version__}")
    with socket.create_connection((LOOPBACK, page.port), timeout=WAIT_S) as client:
        client.sendall("\r\n".join([*lines, "", ""]).encode())
        return int(client.recv(65536).split(b" ", 2)[1])


@pytest.mark.parametrize("upgrade", [True, False], ids=["socket", "page"])
def test_only_who_knows_the_token_is_served_and_no_other_site(page: Page, upgrade: bool) -> None:
    served = 101 if upgrade else 200
    token, own = f"/{page.guard.token}", f"{LOOPBACK}:{page.port}"
    for path, host, origin, expected in (
        (token, None, f"http://{own}", served),
        (f"{token}/", None, None, served),
        (token, f"localhost:{page.port}", f"http://localhost:{page.port}", served),
        (token, "lab.example.org", "https://lab.example.org", served),
        (token, "lab.example.org:443", "https://lab.example.org", served),
        (token, None, "https://lab.example.org", served),  # a proxy that gives the server's own host
        ("/", None, f"http://{own}", 403),
        ("/wrong/", None, f"http://{own}", 403),
        (f"{token}x", None, f"http://{own}", 403),
        (token, None, FOREIGN, 403),
        (token, None, "null", 403),
        (token, None, f"http://{LOOPBACK}:{page.port + 1}", 403),  # another server of this machine
        (token, None, f"http://{own}.evil.example", 403),
        (token, "evil.example", FOREIGN, 403),  # a name that another site has pointed here
        (token, f"evil.example:{page.port}", None, 403),
        (token, "[", None, 403),
    ):
        assert status(page, path, host, origin, upgrade) == expected, (path, host, origin)


def test_tokens_are_of_one_start_and_are_asked_of_text_of_any_kind() -> None:
    one, other = Guard(LOOPBACK), Guard(LOOPBACK)
    assert one.token != other.token and len(one.token) >= 20
    assert "token" in (one.refusal(f"/{other.token}/", [LOOPBACK], []) or "")
    assert "token" in (one.refusal("/\u00fc", [LOOPBACK], []) or "")
    assert one.refusal(f"/{one.token}/?a=1", ["192.0.2.1:80"], []) is None
    assert "one host" in (one.refusal(f"/{one.token}", [LOOPBACK, "b"], []) or "")
    assert "one host" in (one.refusal(f"/{one.token}", [], []) or "")


@contextlib.contextmanager
def client(page: Page) -> Iterator[Connection]:
    protocol: Any = f"viser-v{viser.__version__}"
    address = page.address.replace("http", "ws").rstrip("/")
    with connect(address, subprotocols=[protocol], compression=None, max_size=None) as connection:
        yield connection
        connection.close()


def camera(**changes: Any) -> dict[str, Any]:
    axis = [0.0, 1.0, 0.0]
    sizes = {"fov": 0.7, "near": 0.01, "far": 1000.0, "image_height": 700, "image_width": 1100}
    vectors = {"wxyz": [1.0, *axis], "position": axis, "look_at": axis, "up_direction": axis}
    return {"type": "ViewerCameraMessage", **sizes, **vectors, **changes}


def test_a_window_of_any_shape_shows_all_until_it_is_moved(page: Page) -> None:
    xyz = np.random.default_rng(0).uniform((-0.4, -0.9, -0.2), (0.4, 0.9, 0.2), (500, 3)).astype(np.float32)
    picture = np.zeros((4, 6, 3), np.uint8)
    page.start(lambda: Drawing(Points(xyz, np.zeros((500, 3), np.uint8)), {}, picture, ("one",), 0.01, 500, ()))

    def report(width: int, position: Any) -> None:
        message = camera(image_width=width, position=[float(each) for each in position], look_at=[0.0, 0.0, 0.0])
        browser.send(msgspec.msgpack.encode(message))

    def wait_for(width: int, expected: Any) -> Any:
        end = time.monotonic() + WAIT_S
        while time.monotonic() < end:
            for window in page.server.get_clients().values():
                seen = window.camera
                if seen.image_width == width and np.allclose(seen.position, expected, atol=1e-6):
                    return seen.position
            time.sleep(0.01)
        raise AssertionError([each.camera.position for each in page.server.get_clients().values()])

    start = page.server.initial_camera.position
    with client(page) as browser:
        report(1100, start)
        first = wait_for(1100, viewpoint(xyz, [], "points", 0.7, 1100 / 700)[0])
        report(150, first)  # the panels have come
        fitted = wait_for(150, viewpoint(xyz, [], "points", 0.7, 150 / 700)[0])
        assert np.linalg.norm(fitted) > np.linalg.norm(first)
        report(150, [1.0, 1.0, 1.0])  # somebody has moved it
        report(500, [1.0, 1.0, 1.0])
        wait_for(500, [1.0, 1.0, 1.0])
    with client(page) as browser:
        report(480, start)
        end = time.monotonic() + WAIT_S
        fitted = False
        while not fitted and time.monotonic() < end:  # the browser that has left may still be in the list
            phones = [each.camera for each in page.server.get_clients().values() if each.camera.image_width == 480]
            fitted = any(phone.look_at[1] < -1 and phone.position[2] > 5 for phone in phones)
            time.sleep(0.01)
        assert fitted, "the body is in the upper part of the window"


def test_what_is_no_request_prints_nothing(page: Page, capfd: pytest.CaptureFixture[str]) -> None:
    for data in (b"\x16\x03\x01\x02\x00nonsense\r\n\r\n", b"GET\r\n\r\n", b""):
        with socket.create_connection((LOOPBACK, page.port), timeout=WAIT_S) as stranger:
            stranger.sendall(data)
            stranger.shutdown(socket.SHUT_WR)
            while stranger.recv(65536):
                pass
    assert status(page, "/", upgrade=False) == 403
    assert capfd.readouterr() == ("", "")


def test_a_drawing_that_cannot_be_shown_does_not_end_the_page(page: Page) -> None:
    good = Drawing(Points(np.zeros((1, 3), np.float32), np.zeros((1, 3), np.uint8)), {}, np.zeros((4, 6, 3), np.uint8),
                   ("one",), 0.01, 0, ())  # fmt: skip
    answers = [good]
    page.start(lambda: answers[-1])
    answers.append(Drawing(good.points, {}, np.zeros((0, 0, 9), np.uint8), ("broken",), 0.01, 0, ()))
    page.request()
    assert page.wait(WAIT_S)
    answers.append(Drawing(good.points, {}, good.picture, ("three",), 0.01, 0, ()))
    page.request()
    assert page.wait(WAIT_S) and "three" in page.facts.content
    assert sys.exc_info()[0] is None
