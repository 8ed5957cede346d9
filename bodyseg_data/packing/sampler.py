"""A stored sample from two cameras' views of a labelled body; the same code for every renderer."""

from collections.abc import Callable
from dataclasses import asdict
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.artifacts import ShadowTest, shadow_tests
from bodyseg_data.bodies import BodyRef, load_template, shortened
from bodyseg_data.labels import BACKGROUND, NOWHERE, PART_COUNT, TEMPLATE, UNLABELLED
from bodyseg_data.meshes import Mesh, Partition, SceneMesh
from bodyseg_data.packing.occluders import occluder_range
from bodyseg_data.packing.things import Things, ThingsPlace, draw_things, nearest
from bodyseg_data.rendering import Renderer
from bodyseg_data.rigs import PlacedCamera, Rig
from bodyseg_data.samples import HELD, Sample, SampleInfo, Value, View, steps

_LONGEST_KEY: Final = 80  # by `check_key`
_SHARED: Final = 254  # stands for a triangle that parts share; no part has this number
_SURE_M: Final = 1e-4  # from a triangle's plane: a light farther away is on one side of it despite rounding

Floats = NDArray[np.float64]
PointsAt = Callable[[NDArray[np.intp]], Floats]
"""Numbers [N] of pixels that see the body -> the points [N, 3] that they see."""


def body_key(source: str, body: BodyRef) -> str:
    """The beginning of the keys of a body's samples."""
    return f"{source}-{body.subject}-{body.mesh}"


def sample_key(source: str, body: BodyRef, view: View) -> str:
    """The identity of a sample: it names the body and the view, nothing that depends on how shards are cut. The body's
    part is shortened where the view's, with pitch, roll and height, leaves no room for it.
    """
    return f"{shortened(body_key(source, body), _LONGEST_KEY - 1 - len(view.name))}-{view.name}"


class Sampler:
    """Takes samples of one body or scene with one rig; all that does not depend on the view is computed once.

    parts: its labels, below `classes`. things: where things stand that are drawn for each sample (`draw_things`).
    template: `Body.template`, for samples with the plane `TEMPLATE`: the nearest point of the template, uint16, or
    `NOWHERE`; of clothes that lie over the body, that of the skin below.
    """

    def __init__(
        self,
        renderer: Renderer,
        rig: Rig,
        mesh: Mesh,
        parts: Partition | SceneMesh,
        source: str,
        body: BodyRef,
        things: ThingsPlace = "none",
        classes: int = PART_COUNT,
        template: Floats | None = None,
    ) -> None:
        self._renderer, self._rig, self._mesh, self._parts = renderer, rig, mesh, parts
        self._source, self._body, self._place, self._classes = source, body, things, classes
        self._template, self._below = template, parts.below if isinstance(parts, Partition) else None
        self._tests = shadow_tests(rig)
        corners = parts.corners(mesh)
        whole = (corners == corners[:, :1]).all(axis=1)
        self._holding = isinstance(parts, Partition) and parts.holding
        self._part_of_face = np.where(whole, corners[:, 0], _SHARED)
        self._normals = mesh.normals
        self._offsets = np.einsum("ij,ij->i", mesh.normals, mesh.vertices[mesh.faces[:, 0]])
        self._sure = _SURE_M * np.linalg.norm(mesh.normals, axis=1)

    def take(self, view: View) -> Sample:
        """Render one view and label it. Raises BadSample."""
        body, key, step_m = self._body, sample_key(self._source, self._body, view), self._rig.range_step_m
        camera, _ = self._rig.placed(self._mesh.centre, view)
        seen, things = self._renderer.render(camera), None
        projectors = [test.rig.placed(self._mesh.centre, view)[1] for test in self._tests]
        if self._place != "none":
            lights = [(projector, self._renderer.render(projector)) for projector in projectors]
            things = draw_things(self._place, key, self._mesh, view, camera, seen, step_m, projectors=lights)
            seen = nearest(seen, things.render(camera), len(self._mesh.faces))
        measured = np.flatnonzero(seen.face >= 0)
        pixels, faces = measured, seen.face.take(measured)
        if things is not None:
            of_thing = faces - np.int32(len(self._mesh.faces))  # negative on the body
            on_thing = of_thing >= 0
            pixels, faces = measured[~on_thing], faces[~on_thing]

        def points(chosen: NDArray[np.intp]) -> Floats:
            return camera.points(seen.range, *np.divmod(pixels[chosen], camera.camera.columns))

        range_image = np.zeros(seen.face.shape, np.uint16)
        range_image.ravel()[measured] = steps(seen.range.take(measured), step_m, key)
        labels = np.full(seen.face.shape, BACKGROUND, np.uint8)
        labels.ravel()[measured] = UNLABELLED
        labels.ravel()[pixels] = self._labels(faces, points)
        facing, occluders = [], []
        for test, projector in zip(self._tests, projectors, strict=True):
            facing.append(np.zeros(seen.face.shape, np.bool_))
            facing[-1].ravel()[pixels] = self._facing(faces, points, projector.position, camera.position)
            if things is not None:
                facing[-1].ravel()[measured[on_thing]] = things.facing(of_thing[on_thing], projector.position)
            occluders.append(self._occluder(test, projector, range_image, facing[-1], key, things))
        if things is None:
            place, hidden_pct = HELD if self._holding else "", 0
        else:
            place, hidden_pct = self._place, round(100 * things.hidden)
        fields: dict[str, Value] = {"source": self._source}
        fields |= {name: getattr(body, name) for name in ("subset", "subject", "mesh", "pose")}
        fields |= asdict(view)
        info = SampleInfo(body.split, {**fields, "things": place, "hidden_pct": hidden_pct})
        second = facing[1] if len(facing) == 2 else None
        planes: dict[str, NDArray[np.uint16]] = {}
        if self._template is not None:
            planes[TEMPLATE] = np.full(seen.face.shape, NOWHERE, np.uint16)
            seen_at = points(np.arange(len(pixels)))
            planes[TEMPLATE].ravel()[pixels] = self._places(faces, seen_at, self._template)
        sample = Sample(key, range_image, np.concatenate(occluders), labels, facing[0], info, second, planes)
        sample.check(self._classes)
        return sample

    def _occluder(
        self,
        test: ShadowTest,
        projector: PlacedCamera,
        range_image: NDArray[np.uint16],
        facing: NDArray[np.bool_],
        key: str,
        things: Things | None,
    ) -> NDArray[np.uint16]:
        """The stored range of one projector. Raises BadSample."""
        of_things = None if things is None else things.render(projector).range

        def ranges(texels: NDArray[np.intp]) -> NDArray[np.uint16]:
            found = self._renderer.ranges(projector, texels)
            if of_things is not None:
                before = of_things.take(texels)
                found = np.where((before > 0) & ((found == 0) | (before < found)), before, found)
            return steps(found, self._rig.range_step_m, key)

        return occluder_range(test, range_image, facing, ranges)

    def _labels(self, faces: NDArray[np.int32], points: PointsAt) -> NDArray[np.uint8]:
        labels: NDArray[np.uint8] = self._part_of_face.take(faces)
        shared = np.flatnonzero(labels == _SHARED)
        labels[shared] = self._parts.labels_at(self._mesh, faces[shared], points(shared))
        labels[labels == BACKGROUND] = UNLABELLED  # a thing that is held or worn
        return labels

    def _places(self, faces: NDArray[np.int32], points: Floats, template: Floats) -> NDArray[np.uint16]:
        """Numbers, uint16 [N], of the template's points nearest to `points` [N, 3] of triangles [N], or `NOWHERE`."""
        corners, weights = self._mesh.faces[faces], self._mesh.barycentric(faces, points)
        if self._below is not None:
            over = self._below[corners[:, 0]] != corners[:, 0]
            nearest = corners[np.arange(len(corners)), weights.argmax(axis=1)]
            corners = np.where(over[:, None], self._below[nearest][:, None], corners)
        numbers = load_template().nearest(np.einsum("nc,nci->ni", weights, template[corners]))
        numbers[corners[:, 0] < 0] = NOWHERE
        return numbers

    def _facing(self, faces: NDArray[np.int32], points: PointsAt, source: Floats, eye: Floats) -> NDArray[np.bool_]:
        """As `faces_towards`, computed once a triangle wherever rounding of its points cannot change the answer.

        Triangles of a scene have no outside: there, True where the camera at `eye` [3] and the light see the same side.
        """
        towards = self._normals @ source - self._offsets
        if isinstance(self._mesh, SceneMesh):
            same: NDArray[np.bool_] = (towards * (self._normals @ eye - self._offsets) > 0).take(faces)
            return same
        answer: NDArray[np.bool_] = (towards > 0).take(faces)
        unsure = np.flatnonzero((np.abs(towards) <= self._sure).take(faces))
        answer[unsure] = faces_towards(self._mesh, faces[unsure], points(unsure), source)
        return answer


def faces_towards(mesh: Mesh, faces: NDArray[np.int32], points: Floats, source: Floats) -> NDArray[np.bool_]:
    """Mark the triangles seen at `points` [N, 3] that turn their outside to a light at `source` [3], bool [N]."""
    towards: NDArray[np.bool_] = np.einsum("ij,ij->i", mesh.normals[faces], source - points) > 0
    return towards
