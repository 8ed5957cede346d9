"""Shadow of rigs with two projectors: where neither lights, against exact rays and whole projector images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from benches.data.occlusion.views import exact_view, postures
from shapes import figure

from bodyseg_data.artifacts import Augmentation, ShadowTest, lit_pixels
from bodyseg_data.bodies import Body, BodyRef, open_source
from bodyseg_data.core import BadSample
from bodyseg_data.meshes import Mesh, Partition
from bodyseg_data.meshes.partitioning import find_borders
from bodyseg_data.packing import Sampler
from bodyseg_data.rendering.embree import EmbreeRenderer
from bodyseg_data.rigs import Rig, load_rig
from bodyseg_data.samples import Sample, View

REF = BodyRef("A", "A", "figure", "standing", "train")


def two_projectors() -> Rig:
    """The paper's rig with another projector nearer the camera, higher, and with fewer rows."""
    rig = load_rig()
    second = replace(rig.projector, rows=560, centre_px=(164.5, 280.0), position_m=(-0.5, -0.3, 0.0))
    return replace(rig, second_projector=second)


RIG = two_projectors()


def sample_of(mesh: Mesh, renderer: EmbreeRenderer, view: View, rig: Rig = RIG) -> Sample:
    nowhere, labels = np.full(len(mesh.vertices), np.inf), np.zeros(len(mesh.vertices), np.uint8)
    parts = Partition(labels, nowhere, find_borders(mesh, labels, nowhere))
    return Sampler(renderer, rig, mesh, parts, "open", REF).take(view)


def test_a_pixel_is_in_shadow_where_neither_projector_lights_it() -> None:
    mesh = figure()
    renderer, body = EmbreeRenderer(mesh), Body(mesh, np.zeros(0, np.int64))
    wrong = pixels = dark = rescued = 0
    for azimuth in (40, 130, 290):
        sample = sample_of(mesh, renderer, View(255, azimuth))
        lit = lit_pixels(RIG, sample)
        exact = [exact_view(each, renderer, body, REF, View(255, azimuth), scales=(1,)) for each in RIG.by_projector()]
        whole = [ShadowTest(rig).lit(*view.images(1)) for rig, view in zip(RIG.by_projector(), exact, strict=True)]
        assert np.array_equal(lit, whole[0] | whole[1]), "the stored images give the answers of the whole ones"
        inside = exact[0].inside | exact[1].inside
        truth = exact[0].lit | exact[1].lit
        wrong += int(((lit != truth) & inside).sum())
        pixels += int(inside.sum())
        dark += int((~truth & inside).sum())
        rescued += int((truth & ~exact[0].lit & inside).sum())
    assert pixels > 60_000 and dark > 150 and rescued > 600
    assert wrong / pixels < 0.005


def test_three_real_postures_are_within_half_a_percent_of_exact_shadow_rays() -> None:
    source, wrong, pixels, dark = open_source("open"), 0, 0, 0
    for number, ref in enumerate(postures()[::4]):
        body, view = source.build(ref), View((215, 255, 295)[number % 3], 72 * number)
        renderer = EmbreeRenderer(body.mesh)
        exact = [exact_view(each, renderer, body, ref, view, scales=(1,)) for each in RIG.by_projector()]
        inside, truth = exact[0].inside | exact[1].inside, exact[0].lit | exact[1].lit
        lit = lit_pixels(RIG, sample_of(body.mesh, renderer, view))
        wrong += int(((lit != truth) & inside).sum())
        pixels += int(inside.sum())
        dark += int((~truth & inside).sum())
    assert pixels > 90_000 and dark > 0.01 * pixels
    assert wrong / pixels < 0.005


def test_each_projectors_share_is_that_of_a_rig_with_it_alone() -> None:
    mesh = figure()
    renderer = EmbreeRenderer(mesh)
    for number, single in enumerate(RIG.by_projector()):
        both, alone = (sample_of(mesh, renderer, View(215, 20), rig) for rig in (RIG, single))
        assert np.array_equal(both.range, alone.range) and np.array_equal(both.labels, alone.labels)
        rows = slice(0, 640) if number == 0 else slice(640, 1200)
        assert np.array_equal(both.occluder_range()[rows], alone.occluder_range())
        assert np.array_equal((both.faces_projector, both.faces_second)[number], alone.faces_projector)
        assert alone.faces_second is None and both.occluder_range().shape == RIG.projector_shape == (1200, 329)


def test_a_sample_that_lacks_what_the_second_projector_sees_is_refused() -> None:
    mesh = figure()
    both = sample_of(mesh, EmbreeRenderer(mesh), View(215, 20))
    augmentation = Augmentation(RIG, "occ")
    message = r"a rig of two projectors needs a projector range \(1200, 329\) and a second facing bit, found "
    with pytest.raises(BadSample, match=message + r"\(1200, 329\) without that bit"):
        augmentation(replace(both, faces_second=None))
    for rows in (slice(640), slice(1199)):
        short = replace(both, projector_range=both.occluder_range()[rows])
        with pytest.raises(BadSample, match=message + rf"\({rows.stop}, 329\) with that bit"):
            augmentation(short)
    with pytest.raises(BadSample, match="the projector's range is needed"):
        augmentation(replace(both, projector_range=None))
    with pytest.raises(BadSample, match=r"the projector range must be uint16 \(640, 329\) as in the rig"):
        Augmentation(load_rig(), "occ")(both)
    second = both.faces_second
    assert second is not None
    with pytest.raises(BadSample, match=r"the facing bit must be bool \(640, 329\)"):
        augmentation(replace(both, faces_second=second[1:]))
