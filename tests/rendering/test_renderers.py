"""What both renderers see, against exact geometry and against each other.

`BODYSEG_FULL=1 pytest tests/rendering/test_renderers.py -k agree -rP` prints the table of
docs/explanation/renderers.md.
"""

from __future__ import annotations

import os
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from benches.data.occlusion.shadow_rays import lit as lit_by_rays
from numpy.typing import NDArray
from seen import FRONT, RIG, body_rays, see, skip_without_opengl
from shapes import ball, figure

from bodyseg_data.bodies import open_source
from bodyseg_data.core import BadConfig
from bodyseg_data.meshes import Mesh
from bodyseg_data.rendering import Renderer, Surface, open_renderer
from bodyseg_data.rendering.embree import EmbreeRenderer
from bodyseg_data.rigs import PlacedCamera
from bodyseg_data.samples import View


@pytest.fixture(params=["raster", "embree", "opengl"])
def renderer(request: pytest.FixtureRequest) -> str:
    if request.param == "opengl":
        skip_without_opengl()
    return str(request.param)


@pytest.fixture
def opengl() -> None:
    skip_without_opengl()


def sphere_range(camera: PlacedCamera, centre: NDArray[np.float64], radius: float) -> NDArray[np.float64]:
    """Range of the first meeting of each pixel's ray with a sphere, NaN where they miss."""
    rays = body_rays(camera)
    offset = camera.position - centre
    a, b, c = (rays**2).sum(axis=-1), rays @ offset, offset @ offset - radius**2
    with np.errstate(invalid="ignore"):
        return (-b - np.sqrt(b**2 - a * c)) / a


@pytest.mark.parametrize(("azimuth", "device"), [(0, 0), (130, 1)], ids=["camera", "projector"])
def test_a_ball_lies_between_the_spheres_outside_and_inside_its_triangles(renderer, azimuth: int, device: int) -> None:
    mesh = ball(subdivisions=5)
    camera = RIG.placed(mesh.centre, View(215, azimuth))[device]
    (surface,) = see(renderer, mesh, camera)
    normals = mesh.normals / np.linalg.norm(mesh.normals, axis=1)[:, None]
    inner = np.einsum("ij,ij->i", normals, mesh.vertices[mesh.faces[:, 0]] - mesh.centre).min()
    first, last = sphere_range(camera, mesh.centre, 0.5), sphere_range(camera, mesh.centre, inner)
    assert 0.5 - inner < 2e-4, "the bound is tight enough to mean something"
    surely = ~np.isnan(last)
    assert surely.sum() > 50_000
    rounding_m = 2e-6
    assert (surface.range[surely] >= first[surely] - rounding_m).all()
    assert (surface.range[surely] <= last[surely] + rounding_m).all()
    assert (surface.face[np.isnan(first)] == -1).all() and (surface.range[np.isnan(first)] == 0).all()
    assert (surface.face[surely] >= 0).all()


def tilted_slab(camera: PlacedCamera, outline: NDArray[np.float64], normal: NDArray[np.float64], depth: float) -> Mesh:
    """A pyramid whose base faces the camera: corners at image points `outline`, in a plane of the camera's frame."""
    focal, centre = camera.camera.focal_px, camera.camera.centre_px
    rays = np.concatenate([(outline - centre) / focal, np.ones((4, 1))], axis=1)
    base = rays * (depth * normal[2] / (rays @ normal))[:, None]
    tip = base.mean(axis=0) * 1.3
    vertices = camera.to_body(np.concatenate([base, [tip]]))
    faces = np.array([[0, 2, 1], [0, 3, 2], [0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
    return Mesh("slab", vertices, faces)


@pytest.mark.parametrize("device", [0, 1], ids=["camera", "projector"])
@pytest.mark.parametrize("normal", [(0.0, 0.0, -1.0), (0.5, -0.3, -1.0)], ids=["level", "tilted"])
def test_a_pixel_is_sampled_at_its_centre(renderer, device: int, normal: tuple[float, float, float]) -> None:
    camera = RIG.placed(np.array([0.0, 0.9, 0.0]), View(255, 40))[device]
    left, right, top, bottom = 80.3, 230.7, 100.6, 540.2
    outline = np.array([[left, top], [right, top], [right, bottom], [left, bottom]])
    mesh = tilted_slab(camera, outline, np.array(normal), 2.4)
    (surface,) = see(renderer, mesh, camera)
    expected = np.zeros(surface.face.shape, np.bool_)
    expected[101:540, 80:231] = True  # 80.5 > 80.3, 230.5 < 230.7; 100.5 < 100.6 < 101.5, 539.5 < 540.2 < 540.5
    np.testing.assert_array_equal(surface.face >= 0, expected)
    plane = 2.4 * normal[2] / (camera.camera.pixel_rays() @ np.array(normal))
    assert np.abs(surface.range - plane)[expected].max() < 2e-6
    assert set(np.unique(surface.face[expected])) == {0, 1}, "the two triangles of the base"


def with_a_thing_at(place: tuple[float, float, float]) -> Mesh:
    trunk = trimesh.creation.icosphere(subdivisions=3, radius=0.3)
    thing = trimesh.creation.icosphere(subdivisions=2, radius=0.05)
    vertices = np.concatenate([trunk.vertices, thing.vertices + place]) + np.array([0.0, 1.0, 0.0])
    return Mesh("trunk and thing", vertices, np.concatenate([trunk.faces, thing.faces + len(trunk.vertices)]))


def test_image_axes(renderer) -> None:
    """Seen from the front the subject's left is at the right; the head is on top; 90 degrees see the left side."""
    mesh = with_a_thing_at((0.45, 0.3, 0.0))
    first_of_thing = 1280
    views = [RIG.placed(mesh.centre, View(255, azimuth))[0] for azimuth in (0, 90, 180)]
    front, side, back = see(renderer, mesh, *views)
    middle = RIG.camera.columns / 2
    rows, columns = np.nonzero(front.face >= first_of_thing)
    assert columns.min() > middle and rows.max() < RIG.camera.rows / 2
    assert np.nonzero(back.face >= first_of_thing)[1].max() < middle
    trunk = (side.face >= 0) & (side.face < first_of_thing)
    assert side.range[side.face >= first_of_thing].max() < side.range[trunk].min()


def test_the_inside_of_an_open_shell_is_seen(renderer) -> None:
    """Both sides of a triangle count. The shell's near half is taken away, so every ray meets the far half's inside."""
    whole = ball(subdivisions=5)
    far_half = whole.faces[(whole.vertices[whole.faces][..., 2] < 0.05).all(axis=1)]
    mesh = Mesh("shell", whole.vertices, far_half)
    camera = RIG.placed(whole.centre, FRONT)[0]
    (surface,) = see(renderer, mesh, camera)
    offset, rays = camera.position - whole.centre, body_rays(camera)
    a, b = (rays**2).sum(axis=-1), rays @ offset
    with np.errstate(invalid="ignore"):
        second = (-b + np.sqrt(b**2 - a * (offset @ offset - 0.5**2))) / a
    inside = second > 2.55 + 0.1  # well behind the rim
    assert inside.sum() > 30_000
    assert np.abs(surface.range - second)[inside].max() < 1e-3
    toward = np.einsum("ij,ij->i", mesh.normals[surface.face[inside]], -rays[inside])
    assert (toward < 0).all(), "all of it is seen from behind"


def moved_aside(camera: PlacedCamera, right_px: float, down_px: float) -> PlacedCamera:
    x, y = camera.camera.centre_px
    return replace(camera, camera=replace(camera.camera, centre_px=(x + right_px, y + down_px)))


def test_a_body_partly_outside_the_frame_is_cut_there(renderer) -> None:
    mesh = figure()
    camera = RIG.placed(mesh.centre, View(215, 20))[0]
    whole, cut = see(renderer, mesh, camera, moved_aside(camera, 120, -250))
    assert (whole.face[250:, : 329 - 120] >= 0).sum() > 1000
    same = cut.face[: 640 - 250, 120:] == whole.face[250:, : 329 - 120]
    assert (~same).sum() <= (30 if renderer == "opengl" else 0), "OpenGL rounds corners to 1/256 pixel"
    apart = np.abs(cut.range[: 640 - 250, 120:] - whole.range[250:, : 329 - 120])[same]
    assert apart.max() < (1e-3 if renderer == "opengl" else 1e-9) and np.median(apart) < 1e-6


@pytest.mark.parametrize("aside", [(500, 0), (-500, 0), (0, 900), (0, -900)])
def test_a_body_outside_the_frame_gives_an_empty_view(renderer, aside: tuple[int, int]) -> None:
    mesh = figure()
    (surface,) = see(renderer, mesh, moved_aside(RIG.placed(mesh.centre, FRONT)[0], *aside))
    assert not surface.range.any() and (surface.face == -1).all()
    assert surface.range.dtype == np.float32 and surface.face.dtype == np.int32


def test_a_body_behind_the_camera_is_not_seen(renderer) -> None:
    mesh = figure()
    camera = RIG.placed(mesh.centre, FRONT)[0]
    turned = replace(camera, axes=camera.axes * [[-1.0], [1.0], [-1.0]])
    (surface,) = see(renderer, mesh, turned)
    assert not surface.range.any() and (surface.face == -1).all()


@pytest.mark.usefixtures("opengl")
def test_a_body_beside_the_camera_is_seen_alike_by_both() -> None:
    """Cameras that look along the arm from just above it, and past the whole body: both have it on both sides."""
    mesh = figure()
    across = np.array([[0.0, 0.0, -1.0], [0.0, -1.0, 0.0], [-1.0, 0.0, 0.0]])
    above_arm, past = (PlacedCamera(RIG.camera, across, np.array(place)) for place in ((0.1, 1.3, 0.28), (0, 1.3, 0.6)))
    seen = {}
    for name, camera in (("arm", above_arm), ("past", past)):
        depth = camera.to_local(mesh.vertices)[:, 2]
        assert depth.min() < 0 < depth.max()
        by_rays, by_raster = (see(renderer, mesh, camera)[0] for renderer in ("embree", "opengl"))
        assert ((by_raster.face >= 0) != (by_rays.face >= 0)).sum() <= 5
        both = (by_rays.face >= 0) & (by_raster.face >= 0)
        assert np.abs(by_rays.range - by_raster.range)[both].max(initial=0) < 1e-3
        assert not both.any() or np.median(np.abs(by_rays.range - by_raster.range)[both]) < 1e-5
        seen[name] = both.sum()
    assert seen["arm"] > 1000 and seen["past"] == 0


@pytest.mark.usefixtures("opengl")
class TestAgreement:
    """Camera and projector views, three distances, some from above and turned; BODYSEG_FULL: at nine azimuths each."""

    def check(self, mesh: Mesh) -> None:
        rays, raster = EmbreeRenderer(mesh), open_renderer("opengl", mesh)
        for renderer in (rays, raster):
            renderer.render(RIG.placed(mesh.centre, FRONT)[0])  # what is done once only is not part of the speed
        figures, seconds = [], {"embree": 0.0, "opengl": 0.0}
        for distance, some in ((215, (40,)), (255, (240,)), (295, (280,))):
            for azimuth in range(0, 360, 40) if os.environ.get("BODYSEG_FULL") else some:
                stance = (-35, 25, 10) if azimuth % 120 == 40 else (0, 0, 0)
                for camera in RIG.placed(mesh.centre, View(distance, azimuth, *stance)):
                    exact = timed(rays, camera, seconds, "embree")
                    drawn = timed(raster, camera, seconds, "opengl")
                    np.testing.assert_array_equal(drawn.face >= 0, drawn.range > 0)
                    both = (exact.face >= 0) & (drawn.face >= 0)
                    apart_mm = np.abs(exact.range - drawn.range)[both] * 1000.0
                    outline = ((exact.face >= 0) != (drawn.face >= 0)).sum() / (exact.face >= 0).sum()
                    other = (exact.face != drawn.face)[both].mean()
                    figures.append((np.median(apart_mm), np.quantile(apart_mm, 0.999), outline, other))
        raster.close()
        typical, worst = np.median(figures, axis=0), np.max(figures, axis=0)
        milliseconds = [1000 * total / len(figures) for total in seconds.values()]
        sys.stdout.write(
            f"{mesh.name}, {len(mesh.faces)} faces: range median {typical[0]:.5f} (worst view {worst[0]:.5f}) mm, "
            f"99.9 % within {worst[1]:.4f} mm; silhouette {typical[2]:.4%} ({worst[2]:.4%}); "
            f"other face {typical[3]:.3%} ({worst[3]:.3%}); "
            f"{milliseconds[0]:.1f} ms a view by Embree, {milliseconds[1]:.1f} ms by OpenGL\n"
        )
        assert worst[0] <= 0.01 and worst[1] <= 0.1
        assert worst[2] <= 5e-4
        assert worst[3] <= 5e-3

    @pytest.mark.parametrize("shape", [ball, figure])
    def test_shapes_agree(self, shape) -> None:
        self.check(shape())

    @pytest.mark.parametrize("frame", [0, 45, 90] if os.environ.get("BODYSEG_FULL") else [45])
    def test_real_frames_agree(self, mit_folder: Path, frame: int) -> None:
        shape = trimesh.load(mit_folder / "I_crane" / "meshes" / f"mesh_{frame:04d}.obj", process=False)
        self.check(Mesh(f"crane {frame}", np.asarray(shape.vertices), np.asarray(shape.faces)))

    @pytest.mark.parametrize("index", [0, 100])
    def test_open_bodies_agree(self, index: int) -> None:
        source = open_source("open")
        self.check(source.build(source.bodies()[index]).mesh)


def timed(renderer: Renderer, camera: PlacedCamera, seconds: dict[str, float], name: str) -> Surface:
    start = time.perf_counter()
    surface = renderer.render(camera)
    seconds[name] += time.perf_counter() - start
    return surface


def test_shadow_rays_of_two_balls_against_the_analytic_shadow() -> None:
    radius, small = 0.4, 0.15
    centre, blocker = np.array([0.0, 0.9, 0.0]), np.array([0.35, 1.1, 0.7])
    shaded, shading = ball(radius, (0.0, 0.9, 0.0), 5), trimesh.creation.icosphere(subdivisions=5, radius=small)
    mesh = Mesh(
        "two balls",
        np.concatenate([shaded.vertices, shading.vertices + blocker]),
        np.concatenate([shaded.faces, shading.faces + len(shaded.vertices)]),
    )
    source = np.array([0.8, 1.4, 1.6])
    points = shaded.vertices[shaded.faces].mean(axis=1)
    lit = lit_by_rays(EmbreeRenderer(mesh), points, source)

    ways = points - source
    ways /= np.linalg.norm(ways, axis=1)[:, None]
    facing = -np.einsum("ij,ij->i", ways, points - centre) / radius
    to_blocker = blocker - source
    miss = np.linalg.norm(to_blocker - (ways @ to_blocker)[:, None] * ways, axis=1) - small
    sure = (np.abs(facing) > 0.05) & (np.abs(miss) > 0.001)
    assert sure.mean() > 0.9
    expected = (facing > 0) & (miss > 0)
    np.testing.assert_array_equal(lit[sure], expected[sure])
    in_blocker_shadow = (facing > 0.05) & (miss < -0.001)
    assert in_blocker_shadow.sum() > 300 and expected[sure].sum() > 3000


def test_shadow_rays_of_no_points() -> None:
    assert lit_by_rays(EmbreeRenderer(ball()), np.zeros((0, 3)), np.zeros(3)).shape == (0,)


def test_an_unknown_renderer_is_refused() -> None:
    with pytest.raises(BadConfig, match="must be one of raster, embree, opengl, found 'cycles'"):
        open_renderer("cycles", ball())
