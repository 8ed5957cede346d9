"""Time of a view by stage, and the gain of each optimisation, from casting every ray of both frames to packing.

All times are of the processor, so that other work on the machine disturbs them little.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from benches.data.codec.baselines import label_bytes, predicted
from bodyseg_data.artifacts import shadow_tests
from bodyseg_data.bodies import BodyRef, BodySource
from bodyseg_data.labels import BACKGROUND
from bodyseg_data.meshes import Mesh
from bodyseg_data.packing import Packing, Sampler
from bodyseg_data.packing.occluders import occluder_range
from bodyseg_data.packing.sampler import faces_towards
from bodyseg_data.rendering import RasterRenderer, Renderer, Surface, open_renderer
from bodyseg_data.rendering.embree import EmbreeRenderer
from bodyseg_data.rigs import PlacedCamera, Rig
from bodyseg_data.samples import View, steps
from bodyseg_data.shards import TarWriter, encode_sample
from bodyseg_data.shards.codecs.bodyseg_images import encode_images
from bodyseg_data.shards.earlier import split_label_bytes

_FORMER_LEVEL: Final = 9
_QUICK_LEVEL: Final = 1
ROUNDS: Final = 3

STAGES: Final = ("build", "partition", "camera", "projector", "labels", "encode", "write")
"""Stages of packing: making the mesh, dividing it, both images, the sample made of them, its bytes, the shard."""

Images = list[tuple[NDArray[Any], int]]
"""Images and their backgrounds."""


def whole_frame(camera: PlacedCamera) -> NDArray[np.bool_]:
    """Every pixel."""
    return np.ones((camera.camera.rows, camera.camera.columns), np.bool_)


def box_of(mesh: Mesh) -> Callable[[PlacedCamera], NDArray[np.bool_]]:
    """The pixels of the upright box around a mesh in front of the camera."""

    def covered(camera: PlacedCamera) -> NDArray[np.bool_]:
        pixels, _ = camera.project(mesh.surface_vertices)
        size = np.array([camera.camera.columns, camera.camera.rows])
        left, top = np.clip(np.floor(pixels.min(axis=0)).astype(int) - 1, 0, size)
        right, bottom = np.clip(np.ceil(pixels.max(axis=0)).astype(int) + 1, 0, size)
        inside = np.zeros((camera.camera.rows, camera.camera.columns), np.bool_)
        inside[top:bottom, left:right] = True
        return inside

    return covered


class _Scene:
    """One labelled body with all that any step needs."""

    def __init__(self, rig: Rig, source: BodySource, ref: BodyRef) -> None:
        body = source.build(ref)
        self.rig, self.mesh = rig, body.mesh
        self.parts = body.partition()
        self.every_ray, self.in_box, self.in_blocks = (EmbreeRenderer(body.mesh) for _ in range(3))
        self.every_ray._covered, self.in_box._covered = whole_frame, box_of(body.mesh)  # type: ignore[assignment]
        self.by_rays, self.by_filling = (
            Sampler(renderer, rig, body.mesh, self.parts, source.name, ref)
            for renderer in (self.in_blocks, RasterRenderer(body.mesh))
        )

    def by_pixel(self, view: View, renderer: EmbreeRenderer, whole_projector: bool = True) -> Images:
        """Each pixel's part and facing from its own point."""
        step_m = self.rig.range_step_m
        camera, projector = self.rig.placed(self.mesh.centre, view)
        seen = renderer.render(camera)
        rows, columns = np.nonzero(seen.face >= 0)
        faces, points = seen.face[rows, columns], camera.points(seen.range, rows, columns)
        labels = np.full(seen.face.shape, BACKGROUND, np.uint8)
        labels[rows, columns] = self.parts.labels_at(self.mesh, faces, points)
        facing = np.zeros(seen.face.shape, np.bool_)
        facing[rows, columns] = faces_towards(self.mesh, faces, points, projector.position)
        camera_range = steps(seen.range, step_m, view.name)
        if whole_projector:
            projector_range = steps(renderer.render(projector).range, step_m, view.name)
        else:
            test = shadow_tests(self.rig)[0]
            projector_range = occluder_range(
                test, camera_range, facing, lambda texels: steps(renderer.ranges(projector, texels), step_m, view.name)
            )
        return _images(camera_range, projector_range, labels, facing)


def _taken(sampler: Sampler, view: View) -> Images:
    """As packing has it."""
    sample = sampler.take(view)
    return _images(sample.range, sample.occluder_range(), sample.labels, sample.faces_projector)


def _images(camera: NDArray[Any], projector: NDArray[Any], labels: NDArray[Any], facing: NDArray[np.bool_]) -> Images:
    return [(camera, 0), (projector, 0), (label_bytes(labels, facing), BACKGROUND)]


@dataclass(frozen=True)
class _Step:
    name: str
    images: Callable[[_Scene, View], Images]
    store: Callable[[Images], int]


def _differences(level: int) -> Callable[[Images], int]:
    codec = predicted("two-way", level)
    return lambda images: sum(len(codec.encode(image, background)) for image, background in images)


def _as_packed(images: Images) -> int:
    (camera, _), (projector, _), (stored, _) = images
    return len(encode_images(camera, *split_label_bytes(stored), projector))


def _steps() -> list[_Step]:
    former, quick = _differences(_FORMER_LEVEL), _differences(_QUICK_LEVEL)
    return [
        _Step("every ray of both frames", lambda scene, view: scene.by_pixel(view, scene.every_ray), former),
        _Step("rays in the box around the body", lambda scene, view: scene.by_pixel(view, scene.in_box), former),
        _Step("rays in blocks that triangles touch", lambda scene, view: scene.by_pixel(view, scene.in_blocks), former),
        _Step(
            "projector only where it can shade",
            lambda scene, view: scene.by_pixel(view, scene.in_blocks, False),
            former,
        ),
        _Step("part and facing by triangle", lambda scene, view: _taken(scene.by_rays, view), former),
        _Step(
            f"zstd level {_QUICK_LEVEL} instead of {_FORMER_LEVEL}",
            lambda scene, view: _taken(scene.by_rays, view),
            quick,
        ),
        _Step("triangles filled instead of rays cast", lambda scene, view: _taken(scene.by_filling, view), quick),
        _Step("runs and slopes instead of differences", lambda scene, view: _taken(scene.by_filling, view), _as_packed),
    ]


def measure_steps(packing: Packing, refs: Sequence[BodyRef], views: Sequence[View]) -> list[dict[str, Any]]:
    """Rendering, labelling and encoding a view in each step's way: ms (the median of three, mean over views), bytes."""
    chain = _steps()
    spent, sizes, count = [0.0] * len(chain), [0] * len(chain), 0
    for ref in refs:
        scene = _Scene(packing.rig, packing.opened(), ref)
        for view in views:
            rounds: list[list[float]] = [[] for _ in chain]
            for turn in range(ROUNDS * len(chain)):
                number = turn % len(chain)
                start = time.process_time()
                size = chain[number].store(chain[number].images(scene, view))
                rounds[number].append(time.process_time() - start)
                if turn < len(chain):
                    sizes[number] += size
            spent = [total + one for total, one in zip(spent, map(statistics.median, rounds), strict=True)]
            count += 1
    return [
        {"name": step.name, "ms_per_view": round(1e3 * total / count, 2), "bytes_per_view": round(size / count)}
        for step, total, size in zip(chain, spent, sizes, strict=True)
    ]


class _Clock:
    """Adds up time under names."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def on(self, name: str) -> Iterator[None]:
        start = time.process_time()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.process_time() - start


@dataclass(frozen=True)
class _Timed:
    """A renderer under a clock."""

    renderer: Renderer
    clock: _Clock

    def render(self, camera: PlacedCamera) -> Surface:
        with self.clock.on("camera"):
            return self.renderer.render(camera)

    def ranges(self, camera: PlacedCamera, pixels: NDArray[np.intp]) -> NDArray[np.float32]:
        with self.clock.on("projector"):
            return self.renderer.ranges(camera, pixels)

    def close(self) -> None:
        self.renderer.close()


def measure_stages(packing: Packing, refs: Sequence[BodyRef], views: Sequence[View]) -> dict[str, float]:
    """Time of each stage of packing in one process, ms a view. views: all that one body is rendered from."""
    clock, source = _Clock(), packing.opened()
    with (
        TemporaryDirectory() as folder,
        TarWriter(Path(folder) / "train-00000.tar", Path(folder) / "part", "train") as writer,
    ):
        for ref in refs:
            source.build(ref)  # the first of a motion also makes its clothes, which hundreds of others then wear
            with clock.on("build"):
                body = source.build(ref)
            with clock.on("partition"):
                parts = body.partition()
            renderer = _Timed(open_renderer(packing.renderer, body.mesh), clock)
            with clock.on("labels"):
                sampler = Sampler(renderer, packing.rig, body.mesh, parts, source.name, ref)
            for view in views:
                with clock.on("labels"):
                    sample = sampler.take(view)
                with clock.on("encode"):
                    members = encode_sample(sample)
                with clock.on("write"):
                    writer.write(sample.key, members)
    clock.seconds["labels"] -= clock.seconds["camera"] + clock.seconds["projector"]  # they were under both
    return {name: round(1e3 * clock.seconds[name] / (len(refs) * len(views)), 2) for name in STAGES}
