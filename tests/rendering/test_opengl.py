"""What only the OpenGL renderer can get wrong: shared contexts, image sizes, face numbers as colours, memory."""

from __future__ import annotations

import contextlib
import multiprocessing
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from benches.data.occlusion.scaled_rig import with_projector_scale
from seen import FRONT, RIG, body_rays, see, skip_without_opengl
from shapes import ball, figure

from bodyseg_data.core import BadConfig, BadMesh
from bodyseg_data.rendering import Surface, open_renderer
from bodyseg_data.samples import View


@pytest.fixture(autouse=True)
def _opengl_is_here() -> None:
    skip_without_opengl()


def test_images_of_different_sizes_take_turns() -> None:
    mesh = figure()
    camera, projector = with_projector_scale(RIG, 2).placed(mesh.centre, FRONT)
    assert projector.camera.rows == 2 * camera.camera.rows
    (alone,) = see("opengl", mesh, camera)
    small, large, again = see("opengl", mesh, camera, projector, camera)
    assert large.face.shape == (1280, 658)
    for surface in (small, again):
        np.testing.assert_array_equal(surface.face, alone.face)
        np.testing.assert_array_equal(surface.range, alone.range)


def test_every_face_number_is_exact() -> None:
    """More than 65536 faces, so that all three bytes count; each pixel's ray meets the face it names."""
    mesh = ball(subdivisions=6)
    assert len(mesh.faces) > 65_536
    camera = RIG.placed(mesh.centre, FRONT)[0]
    (surface,) = see("opengl", mesh, camera)
    seen = surface.face >= 0
    assert surface.face.max() > 65_536
    points = camera.position + body_rays(camera)[seen] * surface.range[seen][:, None]
    middles = mesh.vertices[mesh.faces[surface.face[seen]]].mean(axis=1)
    assert np.linalg.norm(points - middles, axis=1).max() < 0.01


def test_a_renderer_may_be_closed_as_python_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    """By a generator, or an object's end, when threads take no more work."""
    renderer = open_renderer("opengl", ball())
    ended = ThreadPoolExecutor(1)
    ended.shutdown()
    monkeypatch.setattr(renderer._context, "_thread", ended)
    renderer.close()


def test_two_meshes_may_be_open_and_closing_one_leaves_the_other() -> None:
    one, two = ball(), figure()
    camera = RIG.placed(one.centre, FRONT)[0]
    first, second = open_renderer("opengl", one), open_renderer("opengl", two)
    before, other = first.render(camera), second.render(camera)
    assert not np.array_equal(before.face, other.face)
    second.close()
    second.close()
    np.testing.assert_array_equal(first.render(camera).range, before.range)
    first.close()


def test_a_program_that_draws_with_pyrender_itself_may_close_its_renderers() -> None:
    import pyrender

    camera = RIG.placed(ball().centre, FRONT)[0]
    with contextlib.closing(open_renderer("opengl", ball())) as renderer:
        before = renderer.render(camera)
        for _ in range(2):  # the second takes the memory that the driver has freed with the first
            its = pyrender.OffscreenRenderer(8, 8)
            its.delete()  # closes EGL's display for all of the process
            np.testing.assert_array_equal(renderer.render(camera).range, before.range)
    (after,) = see("opengl", ball(), camera)
    np.testing.assert_array_equal(after.range, before.range)


def test_threads_may_draw() -> None:
    mesh = figure()
    cameras = [RIG.placed(mesh.centre, View(255, azimuth))[0] for azimuth in range(0, 120, 20)]
    expected = see("opengl", mesh, *cameras)
    found: dict[int, list[Surface]] = {}
    threads = [
        threading.Thread(target=lambda i=i: found.update({i: see("opengl", figure(), *cameras)})) for i in range(3)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(found) == [0, 1, 2]
    for surfaces in found.values():
        for surface, right in zip(surfaces, expected, strict=True):
            np.testing.assert_array_equal(surface.range, right.range)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_twenty_meshes_leave_nothing_behind() -> None:
    mesh = ball(subdivisions=5)
    cameras = RIG.placed(mesh.centre, FRONT)
    see("opengl", mesh, *cameras)
    sizes = []
    for _ in range(20):
        see("opengl", mesh, *cameras)
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
        sizes.append(pages * 4096 / 2**20)
    assert sizes[-1] - sizes[9] < 10, "MiB; the mesh alone takes 1.7 MiB in the driver"


def test_too_many_faces_for_three_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bodyseg_data.rendering.opengl.MOST_FACES", 1000)
    with pytest.raises(BadMesh, match="mesh ball: OpenGL draws at most 1000 faces, found 5120"):
        open_renderer("opengl", ball())


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="forks")
def test_a_fork_is_told_so_instead_of_hanging() -> None:
    parent, camera = open_renderer("opengl", ball()), RIG.placed(ball().centre, FRONT)[0]
    here, there = multiprocessing.Pipe()

    def forked() -> None:
        parent.close()
        try:
            open_renderer("opengl", ball()).render(camera)
        except BadConfig as error:
            there.send(str(error))

    child = multiprocessing.get_context("fork").Process(target=forked)
    child.start()
    child.join(60)
    assert child.exitcode == 0
    assert here.poll() and "start workers by 'spawn'" in here.recv()
    parent.close()
