"""Consecutive frames of a motion, rendered with a fixed camera: clean samples, and the meshes they are made of."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from bodyseg_data.bodies.source import Body, BodyRef, BodySource
from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.rig import PlacedCamera, Rig
from bodyseg_data.core.sample import Sample, SampleInfo, steps
from bodyseg_data.core.views import View
from bodyseg_data.packing.sampler import faces_towards, sample_key
from bodyseg_data.rendering import open_renderer
from bodyseg_model.stability.correspondence import RenderedBody

DISTANCE_CM: Final = 255
AZIMUTHS_DEG: Final = (0, 50, 90, 140)
"""Camera azimuths that shots take in turn, degrees: front, both three-quarter views, side."""


@dataclass(frozen=True)
class Shot:
    """Consecutive bodies of one motion, and the view that the camera has of them."""

    bodies: tuple[BodyRef, ...]
    view: View


@dataclass(frozen=True)
class Frame:
    """One frame of a shot: a sample as it would be stored, and the rendered body in it."""

    sample: Sample = field(repr=False)
    body: RenderedBody


def choose_shots(source: BodySource, count: int, frames: int) -> list[Shot]:
    """Choose `count` shots of `frames` bodies each from the motions of a source's test split, taken in turn.

    A motion is all bodies of one subject and pose, in the source's order; its shots start at even intervals along it.
    Raises BadConfig if no motion has that many bodies.
    """
    motions: dict[tuple[str, str], list[BodyRef]] = {}
    for body in source.bodies():
        if body.split == "test":
            motions.setdefault((body.subject, body.pose), []).append(body)
    long = [motion for motion in motions.values() if len(motion) >= frames]
    if not long:
        longest = max(map(len, motions.values()), default=0)
        raise BadConfig(
            f"the source {source.name!r} needs a motion of {frames} frames to test on, found at most {longest}"
        )
    shots = []
    for number in range(count):
        motion, turn = long[number % len(long)], number // len(long)
        shares = len(range(number % len(long), count, len(long)))
        start = (2 * turn + 1) * (len(motion) - frames + 1) // (2 * shares)
        view = View(DISTANCE_CM, AZIMUTHS_DEG[number % len(AZIMUTHS_DEG)])
        shots.append(Shot(tuple(motion[start : start + frames]), view))
    return shots


def render_shot(source: BodySource, shot: Shot, rig: Rig) -> Iterator[Frame]:
    """Render the frames of a shot. The camera looks at the mean of the bodies' centres throughout.

    Raises as `BodySource.build`, `partition` and `steps`.
    """
    built = [source.build(body) for body in shot.bodies]
    centre = np.mean([body.mesh.centre for body in built], axis=0)
    camera, _ = rig.placed(centre, shot.view)
    projectors = [single.placed(centre, shot.view)[1] for single in rig.by_projector()]
    for ref, body in zip(shot.bodies, built, strict=True):
        key = sample_key(source.name, ref, shot.view)
        yield _frame(ref, body, shot.view, key, camera, projectors, source.name, rig.range_step_m)


def _frame(
    ref: BodyRef,
    body: Body,
    view: View,
    key: str,
    camera: PlacedCamera,
    projectors: Sequence[PlacedCamera],
    source: str,
    step_m: float,
) -> Frame:
    """Make a sample as `Sampler.take` does, but with camera and projectors given and all that the projector sees."""
    renderer = open_renderer("raster", body.mesh)
    rendered = RenderedBody(body.mesh, camera, renderer.render(camera))
    lit = [renderer.render(projector).range for projector in projectors]
    renderer.close()
    labels = rendered.labels(body.partition())
    facing = []
    for projector in projectors:
        facing.append(np.zeros(labels.shape, np.bool_))
        towards = faces_towards(body.mesh, rendered.faces, rendered.points, projector.position)
        facing[-1].ravel()[rendered.pixels] = towards
    info = SampleInfo(
        source=source,
        subset=ref.subset,
        subject=ref.subject,
        mesh=ref.mesh,
        pose=ref.pose,
        split=ref.split,
        distance_cm=view.distance_cm,
        azimuth_deg=view.azimuth_deg,
    )
    camera_range, projector_range = (steps(seen, step_m, key) for seen in (rendered.surface.range, np.concatenate(lit)))
    second = facing[1] if len(facing) == 2 else None
    sample = Sample(key, camera_range, projector_range, labels, facing[0], info, faces_second=second)
    return Frame(sample, rendered)
