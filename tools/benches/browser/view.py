"""`make test-browser`: the page of a set in a real browser, over a proxy's path, without a network.

Opens the page, moves a slider with the mouse, and compares what the window shows; screenshots are kept.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final
from urllib.parse import urlsplit

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from benches.browser.chromium import Tab, chromium, open_tab
from bodyseg_data.artifacts import VARIANTS
from bodyseg_model.commands import cli
from bodyseg_model.viewing import LOOPBACK, SetView
from bodyseg_model.viewing.pictures import WIDTH, Layout

WINDOW: Final = (1400, 900)
PREFIX: Final = "/lab/view"
_WAIT_S: Final = 120.0
_SETTLED_S: Final = 1.5
_COLOURED: Final = 20
_CHANGED: Final = 0.02


class Proxy:
    """A proxy on loopback that serves one server's pages below a path, as lab machines do: it takes the path off."""

    def __init__(self, prefix: str, port: int) -> None:
        self._prefix, self._server = prefix.encode(), port
        self._socket = socket.create_server((LOOPBACK, 0))
        self.port: int = self._socket.getsockname()[1]
        self._threads: list[threading.Thread] = []
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Accept no more connections, and wait for the end of those that there are."""
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._thread.join()
        for thread in self._threads:
            thread.join()

    def _run(self) -> None:
        with self._socket, contextlib.suppress(OSError):  # it is closed
            while True:
                client, _ = self._socket.accept()
                self._threads.append(threading.Thread(target=self._forward, args=(client,), daemon=True))
                self._threads[-1].start()

    def _forward(self, client: socket.socket) -> None:
        with client:
            head = b""
            while b"\r\n" not in head:
                data = client.recv(65536)
                if not data:
                    return
                head += data
            method, path, rest = head.split(b" ", 2)
            if not path.startswith(self._prefix):
                client.sendall(b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\nConnection: close\r\n\r\n")
                return
            with socket.create_connection((LOOPBACK, self._server)) as server:
                server.sendall(b" ".join([method, path[len(self._prefix) :] or b"/", rest]))
                back = threading.Thread(target=_pump, args=(server, client), daemon=True)
                back.start()
                _pump(client, server)
                back.join()


def _pump(source: socket.socket, sink: socket.socket) -> None:
    with contextlib.suppress(OSError):  # one side went away
        while data := source.recv(65536):
            sink.sendall(data)
    for each in (source, sink):
        with contextlib.suppress(OSError):
            each.shutdown(socket.SHUT_RDWR)


def settled(tab: Tab, until: Callable[[NDArray[np.uint8]], bool] = lambda image: True) -> NDArray[np.uint8]:
    """A screenshot of a window that no longer changes. until: what must hold for it, else the last one is returned.

    A machine that is busy may need long before a change is seen.
    """
    end, before = time.monotonic() + _WAIT_S, tab.screenshot()
    while time.monotonic() < end:
        time.sleep(_SETTLED_S)
        now = tab.screenshot()
        if np.array_equal(before, now) and until(now):
            break
        before = now
    return before


def slider(tab: Tab, label: str) -> tuple[tuple[float, float], tuple[float, float]]:
    """Scroll to the slider with a label; returns the middle of its thumb and the end of its track, pixels."""
    script = """(() => {
        const named = [...document.querySelectorAll('*')].filter(
            (each) => !each.children.length && each.textContent.trim() === %s);
        let row = named[0];
        while (!row.querySelector('[role=slider]')) row = row.parentElement;
        row.scrollIntoView({block: 'center'});
        const thumb = row.querySelector('[role=slider]');
        const [a, b] = [thumb.getBoundingClientRect(), thumb.parentElement.getBoundingClientRect()];
        return [a.x + a.width / 2, a.y + a.height / 2, b.x + b.width];
    })()"""
    x, y, end = tab.evaluate(script % json.dumps(label))
    return (x, y), (end, y)


def press(tab: Tab, label: str) -> None:
    """Press the button with a label."""
    named = (
        f"[...document.querySelectorAll('button')].filter((each) => each.textContent.trim() === {json.dumps(label)})"
    )
    tab.evaluate(f"{named}[0].click()")


def picture_box(tab: Tab) -> tuple[float, float, float]:
    """Left and top of the panels' picture in the window, and its scale."""
    script = """(() => {
        const images = [...document.querySelectorAll('img')].filter((each) => each.naturalWidth === %d);
        const box = images[0].getBoundingClientRect();
        return [box.x, box.y, box.width / images[0].naturalWidth];
    })()"""
    left, top, scale = tab.evaluate(script % WIDTH)
    return left, top, scale


def changed_panels(tab: Tab, before: NDArray[np.uint8], after: NDArray[np.uint8], layout: Layout) -> dict[str, float]:
    """Share of the pixels of each variant's panel that differ by more than a 32nd of the scale.

    82 mm of noise change the colour of a body that reaches 1 m towards the camera by so little.
    """
    left, top, scale = picture_box(tab)
    different: NDArray[np.bool_] = np.any(np.abs(before.astype(int) - after) > 8, axis=-1)
    found: dict[str, float] = {}
    for name, (column, row, width, height) in zip(VARIANTS, layout.boxes(1), strict=False):
        inside = 4
        rows = slice(round(top + scale * row) + inside, round(top + scale * (row + height)) - inside)
        columns = slice(round(left + scale * column) + inside, round(left + scale * (column + width)) - inside)
        found[name] = float(different[rows, columns].mean())
    return found


def points_shown(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The part of a window between its panels, sRGB uint8 [H, W, 3]."""
    return image[200:, 560:1040]


def differs(one: NDArray[np.uint8], other: NDArray[np.uint8]) -> float:
    """Share of the pixels between the panels of two windows that differ by more than an eighth of the scale."""
    return float(np.any(np.abs(points_shown(one).astype(int) - points_shown(other)) > 32, axis=-1).mean())


def colours_of(image: NDArray[np.uint8]) -> int:
    """Number of the colours of an image, sRGB uint8 [H, W, 3]."""
    return len(np.unique(image.reshape(-1, 3), axis=0))


def check(condition: bool, what: str) -> None:
    """Print what holds. Raises SystemExit for what does not."""
    sys.stdout.write(f"{'holds' if condition else 'DOES NOT HOLD'}: {what}\n")
    sys.stdout.flush()
    if not condition:
        raise SystemExit(1)


def run(folder: Path, out: Path) -> None:
    """All checks on the page of a set, with screenshots in a folder."""
    out.mkdir(parents=True, exist_ok=True)
    saves = Path(tempfile.mkdtemp(dir=out))
    command = [sys.executable, "-m", "bodyseg_model", "view", str(folder), "--port", "0", "--variant", "noise"]
    command += ["--save", str(saves)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, preexec_fn=_interruptible) as program:
        try:
            if program.stderr is None:
                raise RuntimeError("the program has no standard error")
            address = program.stderr.readline().split()[1]
            _look(address, folder, out, saves)
            program.send_signal(signal.SIGINT)
            said = program.stderr.read()
            status = program.wait(_WAIT_S)
            check((status, said) == (130, "bodyseg view: interrupted\n"), "Ctrl-C ends it in one line, status 130")
        finally:
            program.kill()


def _interruptible() -> None:
    signal.signal(signal.SIGINT, signal.default_int_handler)


def _look(address: str, folder: Path, out: Path, saves: Path) -> None:
    view = SetView(folder)
    layout, _ = view.layout_of(view.images.clean(0))
    with contextlib.closing(Proxy(PREFIX, urlsplit(address).port or 0)) as proxy, open_tab(*WINDOW) as tab:
        page = f"http://{LOOPBACK}:{proxy.port}{PREFIX}{urlsplit(address).path}"
        tab.open(page)
        tab.wait_for(f"[...document.querySelectorAll('img')].some((each) => each.naturalWidth === {WIDTH})", _WAIT_S)
        close = "document.querySelector('.mantine-Notification-closeButton')"
        tab.evaluate(f"{close} === null || {close}.click()")  # the browser draws without a graphics card
        before = settled(tab, lambda image: colours_of(points_shown(image)) > _COLOURED)
        Image.fromarray(before).save(out / "before.png")
        check(colours_of(points_shown(before)) > _COLOURED, "the page comes over a proxy's path")
        strange = [each for each in tab.requested if not each.startswith((page, "data:", "blob:"))]
        check(not strange, f"the page asks nothing of other servers {strange or ''}")
        tab.drag(*slider(tab, "high, mm"))
        noisy, others = {"noise", "all"}, {"none", "occ", "md"}

        def redrawn(image: NDArray[np.uint8]) -> bool:
            return changed_panels(tab, before, image, layout)["noise"] > _CHANGED and differs(before, image) > _CHANGED

        after = settled(tab, redrawn)
        Image.fromarray(after).save(out / "after.png")
        shares = changed_panels(tab, before, after, layout)
        listed = ", ".join(f"{name} {share:.1%}" for name, share in shares.items())
        check(
            min(shares[name] for name in noisy) > _CHANGED and not any(shares[name] for name in others),
            f"the slider of the noise changes the variants that have noise, and no other: {listed}",
        )
        moved = differs(before, after)
        check(moved > _CHANGED, f"the slider moves points: {moved:.1%} of their part of the window")
        press(tab, "sensor")
        beside = settled(tab, lambda image: differs(after, image) > _CHANGED)
        Image.fromarray(beside).save(out / "sensor.png")
        check(differs(after, beside) > _CHANGED, "a button looks at the sensor from beside")
        press(tab, "Save picture")
        end = time.monotonic() + _WAIT_S
        while not (saved := [*saves.iterdir()]) and time.monotonic() < end:
            time.sleep(_SETTLED_S)
        colours = [colours_of(np.asarray(Image.open(each))[:, WIDTH:]) for each in saved]
        check(len(saved) == 1 and colours[0] > _COLOURED, f"a button saves panels and points as PNG: {len(saved)} file")
        check(not tab.errors, f"no script fails {tab.errors or ''}")


def main() -> int:
    """Run the checks; 0 if all hold, and where there is no browser."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--set", type=Path, help="folder of a set (default: a small one is packed)")
    parser.add_argument("--out", type=Path, default=Path("browser"), help="folder for screenshots")
    given = parser.parse_args()
    if chromium() is None:
        sys.stdout.write("not checked: the page in a browser, which needs apt-get install chromium\n")
        return 0
    with tempfile.TemporaryDirectory() as folder:
        chosen = given.set
        if chosen is None:
            chosen = Path(folder) / "shards"
            words = ["shard", "--source", "open", "--meshes", "1", "--views", "2", "--out", str(chosen)]
            if status := cli.main(words):
                return status
        run(chosen, given.out)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
