"""A body that holds a thing: what its samples say and store, and that reduction keeps the thing."""

from __future__ import annotations

import numpy as np
import pytest
from shapes import evenly_drawn, figure
from small_rig import SMALL
from spheres import icosphere

from bodyseg_data.bodies import Body, BodyRef
from bodyseg_data.labels import BACKGROUND, UNLABELLED
from bodyseg_data.meshes import Mesh, SurfacePiece
from bodyseg_data.packing import Sampler, ThingsPlace
from bodyseg_data.packing.mesh_reduction import reduced_body
from bodyseg_data.rendering import RasterRenderer
from bodyseg_data.samples import HELD, Sample, View
from bodyseg_data.shards import encode_sample
from bodyseg_data.shards.sample_codec import decode_sample

REF = BodyRef("everyday", "E1", "E1-0", "standing", "train")
BARE = figure()


def holding(subdivisions: int = 2) -> Body:
    """The figure with a ball of 6 cm before its trunk, within its bounding box."""
    points, faces = icosphere(subdivisions, 0.06)
    vertices = np.concatenate([BARE.vertices, points + np.array([-0.1, 1.2, 0.24])])
    mesh = Mesh("holding", vertices, np.concatenate([BARE.faces, faces + len(BARE.vertices)]))
    return Body(mesh, evenly_drawn(BARE), pieces=(SurfacePiece(len(BARE.vertices)),))


def taken(body: Body, things: ThingsPlace = "none") -> Sample:
    sampler = Sampler(RasterRenderer(body.mesh), SMALL, body.mesh, body.partition(), "everyday", REF, things)
    return sampler.take(View(215, 0))


def test_a_held_thing_has_a_range_and_no_label() -> None:
    body = holding()
    sample, bare = taken(body), taken(Body(BARE, body.landmarks))
    assert sample.info.things == HELD and bare.info.things == ""
    thing = sample.labels == UNLABELLED
    assert thing.sum() > 20 and (sample.faces_projector & thing).any()
    seen = sample.labels < UNLABELLED
    np.testing.assert_array_equal(sample.labels[seen], bare.labels[seen])
    assert taken(body, "behind").info.things == "behind"


@pytest.mark.parametrize("codec", ["bsi", "png"])
def test_it_is_stored(codec: str) -> None:
    sample = taken(holding())
    read = decode_sample(sample.key, encode_sample(sample, codec))
    for image in ("range", "labels", "faces_projector"):
        np.testing.assert_array_equal(getattr(read, image), getattr(sample, image))
    assert read.info == sample.info
    read.check()


@pytest.mark.usefixtures("pymeshlab")
def test_a_reduced_body_still_holds_it() -> None:
    pytest.importorskip("embreex")
    body = holding(subdivisions=5)
    reduced = reduced_body(body, 2.0, SMALL, 215)
    assert len(reduced.mesh.faces) < len(body.mesh.faces) and reduced.notes
    at = reduced.mesh.vertices[reduced.pieces[0].vertex]
    np.testing.assert_array_equal(at, body.mesh.vertices[body.pieces[0].vertex])
    assert (reduced.partition().labels == BACKGROUND).any()
