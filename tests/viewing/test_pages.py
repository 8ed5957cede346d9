"""Pages on a real server, without a browser: what is served, and what the controls change."""

from __future__ import annotations

import socket
import threading
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from label_networks import Places
from small_rig import SMALL

from bodyseg_data.artifacts import Noise, load_sensor_model
from bodyseg_data.core import BadConfig, MissingLibrary
from bodyseg_data.loading import RangeImages
from bodyseg_model.networks import Trained
from bodyseg_model.viewing import LOOPBACK, Page, SetPage, SetView, Shown
from bodyseg_model.viewing.page import Guard, aimed_at, free_port, open_server, unused
from bodyseg_model.viewing.pictures import Drawing, Points
from bodyseg_model.viewing.set_page import SensorState
from bodyseg_model.viewing.strengths import sliders_of

WAIT_S = 60.0


@pytest.fixture
def page(tmp_path: Path) -> Iterator[Page]:
    opened = Page(LOOPBACK, 0, "bodyseg view", tmp_path)
    yield opened
    opened.close()


def drawing(count: int, *facts: str) -> Drawing:
    points = Points(np.full((count, 3), 0.5, np.float32), np.full((count, 3), 9, np.uint8))
    return Drawing(points, {}, np.full((4, 6, 3), count, np.uint8), facts or ("one",), 0.01, 0, (("a", (1, 2, 3)),))


def test_the_page_is_one_file_of_the_server(page: Page) -> None:
    assert page.port and page.address == f"http://{LOOPBACK}:{page.port}/{page.guard.token}/"
    with urllib.request.urlopen(page.address, timeout=WAIT_S) as reply:
        text = reply.read().decode()
    assert "<title>Viser</title>" in text
    assert "src=" not in text.replace("src=''", "") and 'href="http' not in text


def test_new_drawings_replace_the_points_and_errors_leave_them(page: Page) -> None:
    answers: list[Callable[[], Drawing]] = []

    def raising(error: Exception) -> Callable[[], Drawing]:
        def draw() -> Drawing:
            raise error

        return draw

    page.start(lambda: answers[-1]() if answers else drawing(3))
    points: Any = page._points
    assert len(points.points) == 3 and points.point_size == pytest.approx(0.013)
    for answer, count, said in (
        (lambda: drawing(5, "two"), 5, "<b>two</b>"),
        (raising(BadConfig("no such thing")), 5, "no such thing"),
        (raising(ZeroDivisionError("somebody's artifact")), 5, "ZeroDivisionError: somebody&#x27;s artifact"),
        (lambda: drawing(2, "three"), 2, "<b>three</b>"),
    ):
        answers.append(answer)
        page.request()
        assert page.wait(WAIT_S)
        assert len(points.points) == len(points.colors) == count
        assert said in page.facts.content
    assert "somebody" not in page.facts.content


@pytest.fixture
def set_page(page: Page, small_set: Path) -> SetPage:
    view = SetView(small_set, Trained(Places(0, 5), {"rig": SMALL.to_json()}))
    return SetPage(page, view, Shown(variant="noise"))


def test_sliders_of_a_set_change_what_is_drawn(set_page: SetPage) -> None:
    page, view = set_page.page, set_page.view
    before = page.facts.content
    set_page._index.value = 3
    assert page.wait(WAIT_S) and page.facts.content != before
    assert view.images.keys[3] in page.facts.content and set_page._key.value == view.images.keys[3]
    set_page._key.value = view.images.keys[1]
    assert page.wait(WAIT_S) and set_page.shown.index == 1 == set_page._index.value
    set_page._key.value = "nobody"
    assert "no sample of those chosen has the key" in page.facts.content
    set_page.choose("test", "azimuth_deg=0", "")
    assert page.wait(WAIT_S) and set_page.view.images.keys[0] in page.facts.content
    assert set_page._index.max == len(set_page.view) - 1 or len(set_page.view) == 1
    kept = set_page.view
    for where, said in (("azimuth=0", "a condition is on one of"), ("'azimuth", "cannot divide")):
        set_page.choose("train", where, "")
        assert said in page.facts.content and set_page.view is kept


def test_a_slider_asks_for_no_key_but_the_shown_one(set_page: SetPage, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a set with an index, all keys take seconds to read."""
    key = set_page.view.images.keys[3]
    monkeypatch.setattr(RangeImages, "keys", property(lambda images: pytest.fail("all keys are read")))
    set_page._index.value = 3
    assert set_page.page.wait(WAIT_S) and key in set_page.page.facts.content and set_page._key.value == key


def test_a_strength_that_is_moved_is_drawn(set_page: SetPage) -> None:
    page = set_page.page
    controls: Any = set_page._sensor
    noise = controls._handles["noise"]
    low, high = (handle for _, handle in noise)
    high.value = 60.0
    assert page.wait(WAIT_S)
    assert Noise(0.0, 60.0) in set_page.shown.sensor.artifacts
    low.value = 80.0
    assert page.wait(WAIT_S) and high.value == 80.0
    assert Noise(80.0, 80.0) in set_page.shown.sensor.artifacts and "noise 80 mm" in page.facts.content
    low.value = -5.0
    assert "low_mm must be from 0 to 1000" in page.facts.content
    controls.put(load_sensor_model("paper_phase_shift"))
    assert set(controls._handles) == {artifact.name for artifact in load_sensor_model("paper_phase_shift")}
    (control, _), _ = noise
    controls._mover("noise", control, low)(None)  # a message that was on its way
    assert "noise" not in {artifact.name for artifact in controls.state.model}


def test_artifacts_that_are_left_out_keep_their_strengths() -> None:
    state = SensorState(load_sensor_model())
    _, high = sliders_of(state.artifact("noise"))
    assert state.move("noise", high, 30.0) and not state.move("noise", high, 30.0)
    state.left_out.add("noise")
    assert [artifact.name for artifact in state.model] == ["occlusion", "missing_data"]
    state.left_out.remove("noise")
    assert state.model == load_sensor_model().with_artifacts(Noise(0.0, 30.0))


def test_a_port_that_is_taken_gives_way_to_the_next() -> None:
    with socket.socket() as one:
        one.bind((LOOPBACK, 0))
        one.listen()
        taken = one.getsockname()[1]
        assert free_port(LOOPBACK, taken) > taken


@pytest.mark.parametrize(
    ("host", "port", "message"),
    [
        (LOOPBACK, 70000, "a port must be a whole number from 0 to 65535, found 70000"),
        ("no.such.host.invalid", 8080, "--host must be an address of this machine, found 'no.such.host.invalid'"),
        ("192.0.2.1", 8080, "--host must be an address of this machine, found '192.0.2.1'"),
    ],
)
def test_places_that_cannot_be_served_are_refused(host: str, port: int, message: str) -> None:
    with pytest.raises(BadConfig, match=message):
        free_port(host, port)


def test_ports_that_are_all_taken_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket() as one:
        one.bind((LOOPBACK, 65535))
        one.listen()
        with pytest.raises(BadConfig, match="ports 65535 to 65535 of 127.0.0.1 are taken: give another --port"):
            free_port(LOOPBACK, 65535)


def test_a_port_of_the_system_needs_rights(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(self: Any, address: Any) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(socket.socket, "bind", refuse)
    with pytest.raises(BadConfig, match="port 80 needs more rights: give a --port of at least 1024"):
        free_port(LOOPBACK, 80)


def test_without_viser_the_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "viser", None)
    with pytest.raises(MissingLibrary, match=r"needs the package 'viser': pip install 'bodyseg\[view\]'"):
        open_server(LOOPBACK, 0, "page", Guard(LOOPBACK))


def test_nothing_is_shared_outside_and_nothing_is_printed(capfd: pytest.CaptureFixture[str]) -> None:
    page = Page(LOOPBACK, 0, "page")
    assert page.server.request_share_url() is None
    page.close()
    assert capfd.readouterr() == ("", "")
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("redrawing")]


def test_saved_pictures_replace_none(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    assert unused(path) == path
    path.touch()
    assert unused(path).name == "a-2.png"
    (tmp_path / "a-2.png").touch()
    assert unused(path).name == "a-3.png"


def test_windows_are_turned_to_bodies_or_to_all() -> None:
    some = drawing(6)
    assert len(aimed_at(some)) == 6
    assert len(aimed_at(Drawing(some.points, {}, some.picture, (), 0.01, 2, ()))) == 2
