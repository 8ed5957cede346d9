"""The page that sets and recordings share: its server, points in space, a picture of panels, facts and a legend.

Every web page that a user has open may connect to a server on this machine, so the page is served to those who know its
token, under its own host's names, and to no script of another page. Who knows the token is trusted.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import errno
import hmac
import http
import io
import logging
import math
import re
import secrets
import socket
import threading
import time
from collections.abc import Callable, Collection, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import urlsplit

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadConfig, BodysegError, check_int
from bodyseg_data.files import write_result
from bodyseg_data.machine import required
from bodyseg_model.viewing.pictures import (
    VIEWPOINTS,
    Drawing,
    facts_html,
    legend_html,
    name_heights,
    sheet_of,
    viewpoint,
)

_PORTS: Final = {"http": ":80", "https": ":443"}
_NUMBER: Final = re.compile(r"[0-9]+(\.[0-9]+){3}|[0-9a-f]*:[0-9a-f:.]*")


class Guard:
    """The token of a page, and the rule of who is served.

    host: the address that is served. allowed: further names of hosts, such as a proxy's.
    """

    def __init__(self, host: str, allowed: Collection[str] = ()) -> None:
        self.token = secrets.token_urlsafe(16)
        self._allowed = {name.lower() for name in allowed}
        self._own = {"localhost", host.lower(), socket.gethostname().lower()}

    def refusal(self, path: str, hosts: list[str], origins: list[str]) -> str | None:
        """Say why a request with a path and headers Host and Origin is refused; None if it is served.

        A foreign name that leads here may be another page's, whose scripts would pass for this one's; a number cannot.
        """
        if not hmac.compare_digest(path.lstrip("/").split("/")[0].split("?")[0].encode(), self.token.encode()):
            return "open the address that bodyseg view printed: the token in it is missing or of another page"
        if len(hosts) != 1 or len(origins) > 1:
            return "a request must name one host"
        name = _name(hosts[0])
        if name not in self._own | self._allowed and not _NUMBER.fullmatch(name):
            return f"{name} is not a host of this page: name it by --allow-host"
        for origin in origins:
            scheme, _, place = origin.lower().partition("://")
            same = place.removesuffix(_PORTS.get(scheme, "")) == hosts[0].lower().removesuffix(_PORTS.get(scheme, ""))
            if not place or not (same or _name(place) in self._allowed):
                return f"a page of {origin} may not use this one: name its host by --allow-host"
        return None


def _name(host: str) -> str:
    """The name in a header "name:port", in small letters; "" if there is none."""
    with contextlib.suppress(ValueError):
        return urlsplit(f"//{host}").hostname or ""
    return ""


@contextlib.contextmanager
def guarded(guard: Guard) -> Iterator[None]:
    """While the context lasts, servers of WebSockets that are begun serve whom `guard` lets in, and print nothing of
    what goes wrong on a connection. viser has no place for these rules.
    """
    from websockets.asyncio import server
    from websockets.datastructures import Headers
    from websockets.http11 import Request, Response

    log = logging.getLogger("bodyseg.view")
    log.disabled = True
    plain = server.serve

    def serve(*given: Any, process_request: Callable[..., Response | None], **options: Any) -> Any:
        def answer(connection: server.ServerConnection, request: Request) -> Response | None:
            headers = request.headers
            why = guard.refusal(request.path, headers.get_all("Host"), headers.get_all("Origin"))
            if why is None:
                path = request.path.lstrip("/").removeprefix(guard.token) or "/"
                return process_request(connection, dataclasses.replace(request, path=path))
            body = f"{why}\n".encode()
            head = Headers({"Content-Type": "text/plain; charset=utf-8", "Content-Length": str(len(body))})
            return Response(http.HTTPStatus.FORBIDDEN.value, "Forbidden", head, body)

        asyncio.get_running_loop().set_exception_handler(lambda loop, context: None)
        return plain(*given, process_request=answer, logger=log, **options)

    vars(server)["serve"] = serve
    try:
        yield
    finally:
        vars(server)["serve"] = plain


if TYPE_CHECKING:
    import viser


LOOPBACK: Final = "127.0.0.1"
"""The address that only this machine can reach."""

_PORTS_TRIED: Final = 20


def free_port(host: str, port: int) -> int:
    """The given port, or the next free one; 0: any. Raises BadConfig for another machine's host, or if none is free."""
    check_int("a port", port, 0, 65535)
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    for number in range(port, min(port + _PORTS_TRIED, 65536)):
        try:
            with socket.create_server((host, number), family=family) as tried:
                return int(tried.getsockname()[1])
        except PermissionError as error:
            raise BadConfig(f"port {number} needs more rights: give a --port of at least 1024") from error
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise BadConfig(
                    f"--host must be an address of this machine, found {host!r}: {error.strerror}"
                ) from error
    raise BadConfig(f"ports {port} to {min(port + _PORTS_TRIED, 65536) - 1} of {host} are taken: give another --port")


def open_server(host: str, port: int, title: str, guard: Guard) -> viser.ViserServer:
    """Start a server. title: of the page. guard: decides who is served. Raises BadConfig, MissingLibrary."""
    required("viser", "bodyseg view", "view")
    import viser

    class Server(viser.ViserServer):
        def request_share_url(self, verbose: bool = True) -> str | None:
            """Refuse what would connect this page to a server outside."""
            return None

    chosen = free_port(host, port)
    with contextlib.redirect_stdout(io.StringIO()), guarded(guard):
        return Server(host=host, port=chosen, label=title, verbose=False)


class Redrawing:
    """Calls `draw` after requests, in one thread. Requests that arrive while it draws are answered by one more call.

    least_s: time from one call to the next at least, so that a slider that is dragged does not fill a connection.
    """

    def __init__(self, draw: Callable[[], None], least_s: float = 0.1) -> None:
        self._draw, self._least_s = draw, least_s
        self._thread, self._closed = ThreadPoolExecutor(1, "redrawing"), threading.Event()
        self._requested, self._due = False, 0.0
        self._last: Future[bool] | None = None

    def request(self) -> None:
        """Ask for a drawing; returns at once."""
        if not self._requested:
            self._requested = True
            with contextlib.suppress(RuntimeError):  # closed
                self._last = self._thread.submit(self._once)

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait until all that was requested before is drawn; False if that took longer, or this was closed before."""
        with contextlib.suppress(TimeoutError):
            return self._last is not None and self._last.result(timeout_s)
        return False

    def close(self) -> None:
        """End the thread after what it is drawing."""
        self._closed.set()
        self._thread.shutdown()

    def _once(self) -> bool:
        if self._closed.wait(max(0.0, self._due - time.monotonic())):
            return False
        self._requested, self._due = False, time.monotonic() + self._least_s  # later requests are of the next drawing
        self._draw()
        return True


_FOV_RAD: Final = 0.7
_ASPECT: Final = 0.6  # width over height of the space between the panels of a usual window
_PICTURE_PX: Final = 440
_CONTROLS_PX: Final = 300
_PHONE_PX: Final = 640
_FREE: Final = 0.4  # share of a narrower window's height, from the top, that the controls leave free
_SAME: Final = 0.02
_DEVICE_M: Final = 0.22
_DEVICE_COLOURS: Final = ((32, 34, 40), (196, 110, 20), (150, 60, 140))
_VIEW_PX: Final = (1000, 800)
_VIEW_TIMEOUT_S: Final = 20.0


class Page:
    """A page with nothing on it yet: controls are added to `server.gui`, and `start` begins to draw.

    host, port: as for `open_server`, and raises as it does. title: of the page. save: folder for pictures; None: the
    browser downloads them. allowed: names of hosts beside this one's under which it is served, such as a proxy's.
    """

    def __init__(
        self, host: str, port: int, title: str, save: Path | None = None, allowed: Collection[str] = ()
    ) -> None:
        self.guard = Guard(host, allowed)
        self.server = open_server(host, port, title, self.guard)
        self.host, self.port = host, self.server.get_port()
        self._save_in, self._warning = save, ""
        self._drawing: Drawing | None = None
        self._lock = threading.Lock()
        self._redrawing: Redrawing | None = None
        self._build()

    @property
    def address(self) -> str:
        """Address of the page with its token, for a browser on this machine if it is served on all of its addresses."""
        host = {"0.0.0.0": "127.0.0.1", "::": "[::1]"}.get(self.host, self.host)
        return f"http://{f'[{host}]' if ':' in host and '[' not in host else host}:{self.port}/{self.guard.token}/"

    def _build(self) -> None:
        gui, scene = self.server.gui, self.server.scene
        gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)
        scene.set_up_direction("+y")
        scene.configure_default_lights(cast_shadow=False)
        gui.main_panel.dock_right()
        gui.main_panel.set_width(_CONTROLS_PX)
        self.facts = gui.add_html("")
        panel = gui.add_panel()
        with panel.add_tab("Images"):
            blank = np.full((8, 8, 3), 250, np.uint8)
            self._picture = gui.add_image(blank, format="jpeg", jpeg_quality=88)
            self._legend = gui.add_html("")
        panel.dock_left()
        panel.set_width(_PICTURE_PX)
        none = np.zeros((0, 3), np.float32)
        self._points = scene.add_point_cloud(
            "/points", none, none.astype(np.uint8), precision="float32", point_shape="circle", point_shading="flat"
        )
        self.point_scale = 1.3
        self._devices: dict[str, viser.CameraFrustumHandle] = {}
        self._names: dict[str, viser.LabelHandle] = {}
        self._devices_shown = False  # seen from the front, the sensor is in the way
        self.server.on_client_connect(self._follow)

    def add_view_controls(self) -> None:
        """Add the controls of the viewpoint and of what is drawn, and the button that saves a picture."""
        gui = self.server.gui
        with gui.add_folder("View"):
            look = gui.add_button_group("look at", VIEWPOINTS)
            size = gui.add_slider("point size", 0.4, 4.0, 0.1, self.point_scale)
            devices = gui.add_checkbox("camera, projector", self._devices_shown)
            save = gui.add_button("Save picture")

        @size.on_update
        def _(_: object) -> None:
            self.point_scale = size.value
            self.request()

        @devices.on_update
        def _(_: object) -> None:
            self._devices_shown = devices.value
            self.request()

        @look.on_click
        def _(event: viser.GuiEvent[viser.GuiButtonGroupHandle]) -> None:
            if event.client is not None:
                box: Any = devices
                box.value = box.value or look.value == "sensor"
                self._look(event.client, look.value, event.client.camera.aspect, 1.0, [])

        @save.on_click
        def _(event: viser.GuiEvent[viser.GuiButtonHandle]) -> None:
            if event.client is not None:
                self._save(event.client)

    def start(self, draw: Callable[[], Drawing]) -> None:
        """Draw once, then after every `request`, in a thread. Raises what the first drawing raises."""
        first, camera = draw(), self.server.initial_camera
        place, at = viewpoint(aimed_at(first), [*first.devices.values()], "points", _FOV_RAD, _ASPECT)
        camera.fov, camera.look_at, camera.position = _FOV_RAD, at, place
        self._show(first)

        def redraw() -> None:
            try:
                drawing = draw()
                self._warning = ""
                self._show(drawing)
            except BodysegError as error:
                self.warn(str(error))
            except Exception as error:  # of a user's artifact: the page goes on
                self.warn(BodysegError.words_of(error))

        self._redrawing = Redrawing(redraw)

    def request(self) -> None:
        """Ask for a new drawing; returns at once."""
        if self._redrawing is not None:
            self._redrawing.request()

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait until what was requested is drawn; False if that took longer."""
        return self._redrawing is not None and self._redrawing.wait(timeout_s)

    def warn(self, line: str) -> None:
        """Show a line in red above the facts until the next drawing; what is drawn stays."""
        with self._lock:
            self._warning = line
            self.facts.content = facts_html(() if self._drawing is None else self._drawing.facts, line)

    def close(self) -> None:
        """Stop drawing and serving."""
        if self._redrawing is not None:
            self._redrawing.close()
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()

    def _follow(self, client: viser.ClientHandle) -> None:
        """Keep the whole body in one client's window, whatever its shape, until somebody moves the view."""
        places, fitted = [np.asarray(self.server.initial_camera.position)], [0.0]
        free = _FREE if client.camera.image_width < _PHONE_PX else 1.0  # image_width is the whole window's at first
        turn = threading.Lock()  # reports are answered in several threads

        def fit(camera: viser.CameraHandle) -> None:
            with turn:
                aspect = camera.aspect
                unmoved = any(np.allclose(camera.position, place, atol=1e-3) for place in places)
                if unmoved and abs(aspect - fitted[0]) > _SAME * fitted[0]:
                    fitted[0] = aspect
                    self._look(client, "points", aspect, free, places)

        client.camera.on_update(fit)
        fit(client.camera)

    def _look(
        self, client: viser.ClientHandle, kind: str, aspect: float, free: float, places: list[NDArray[np.float64]]
    ) -> None:
        """Move one client's view to one of `VIEWPOINTS`.

        aspect: width by height of its window. free: share of the window's height, from its top, in which the points are
        to be seen. places: receives where the view goes, before it goes there: the client may report it at once.
        """
        drawing, chosen = self._drawing, next(each for each in VIEWPOINTS if each == kind)
        if drawing is None:
            return
        camera, half = client.camera, math.tan(client.camera.fov / 2)
        fov_rad = 2 * math.atan(free * half)
        place, at = viewpoint(aimed_at(drawing), [*drawing.devices.values()], chosen, fov_rad, aspect / free)
        # A little less than to the edge: what is nearer than the middle moves farther.
        down = np.array([0.0, 0.92 * (1 - free) * half * float(np.linalg.norm(place - at)), 0.0])
        places.append(place - down)
        with client.atomic():
            camera.up_direction, camera.position, camera.look_at = (0.0, 1.0, 0.0), place - down, at - down

    def _show(self, drawing: Drawing) -> None:
        with self._lock, self.server.atomic():
            self._drawing = drawing
            self._points.points = drawing.points.xyz
            self._points.colors = drawing.points.colours
            self._points.point_size = self.point_scale * drawing.gap_m
            self._show_devices(drawing)
            self._picture.image = drawing.picture
            legend = legend_html(drawing.legend, 3)
            if self._legend.content != legend:
                self._legend.content = legend
            self.facts.content = facts_html(drawing.facts, self._warning)

    def _show_devices(self, drawing: Drawing) -> None:
        from viser.transforms import SO3  # there since `open_server`

        heights = name_heights([*drawing.devices.values()])
        for number, ((device, placed), height) in enumerate(zip(drawing.devices.items(), heights, strict=True)):
            handle = self._devices.get(device)
            if handle is None:
                camera, colour = placed.camera, _DEVICE_COLOURS[min(number, len(_DEVICE_COLOURS) - 1)]
                fov_rad, aspect = 2 * math.atan(camera.rows / 2 / camera.focal_px), camera.columns / camera.rows
                name = f"/{device.replace(' ', '_')}"
                handle = self._devices[device] = self.server.scene.add_camera_frustum(
                    name, fov_rad, aspect, scale=_DEVICE_M, thickness=0.002, color=colour
                )
                self._names[device] = self.server.scene.add_label(f"{name}_name", device)
            handle.wxyz, handle.position = SO3.from_matrix(placed.axes.T).wxyz, placed.position
            self._names[device].position = placed.position + np.array([0.0, height, 0.0])
            handle.visible = self._names[device].visible = self._devices_shown

    def _save(self, client: viser.ClientHandle) -> None:
        """Write the panels and the points as one client sees them as a PNG."""
        drawing = self._drawing
        if drawing is None:
            return
        try:
            view = client.get_render(*_VIEW_PX, timeout=_VIEW_TIMEOUT_S)
            name, data = picture_file(drawing, np.asarray(view[..., :3], np.uint8))
            if self._save_in is None:
                client.send_file_download(name, data, save_immediately=True)
                return
            path = unused(self._save_in / name)
            write_result(path, data)
            client.add_notification("Saved", str(path), auto_close_seconds=6)
        except Exception as error:  # also of a picture that a browser made up
            self.warn(f"no picture was saved: {error}")


class Controls:
    """State of a page's controls. shown: a frozen dataclass, which `view.draw` takes."""

    def __init__(self, page: Page, view: Any, shown: Any) -> None:
        self.page, self.view, self.shown = page, view, shown
        self._lock = threading.RLock()

    def draw(self) -> Drawing:
        """Draw what the controls say. Raises as the view's `draw`."""
        with self._lock:
            view, shown = self.view, self.shown
        drawing: Drawing = view.draw(shown)
        return drawing

    def change(self, **changes: Any) -> None:
        """Change what is shown, by the fields of `shown`, and draw it."""
        with self._lock:
            self.shown = dataclasses.replace(self.shown, **changes)
        self.page.request()


def aimed_at(drawing: Drawing) -> NDArray[np.float32]:
    """Points that a window is turned to, float32 [N, 3]: those of bodies, or all if there is no body."""
    return drawing.points.xyz[: drawing.bodies or None]


def picture_file(drawing: Drawing, view: NDArray[np.uint8]) -> tuple[str, bytes]:
    """Name and bytes of a PNG of a drawing. view: its points as a browser drew them, sRGB uint8 [H, W, 3]."""
    buffer = io.BytesIO()
    sheet_of(drawing.picture, view, drawing.facts).save(buffer, "PNG")
    word = "".join(letter if letter.isalnum() or letter in "-_" else "_" for letter in drawing.facts[0])
    return f"{word[:80] or 'picture'}.png", buffer.getvalue()


def unused(path: Path) -> Path:
    """The path, or with the first number from 2 on at the end of its name for which there is no file."""
    number, found = 1, path
    while found.exists():
        number += 1
        found = path.with_name(f"{path.stem}-{number}{path.suffix}")
    return found
