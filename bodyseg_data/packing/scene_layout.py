"""Samples from the arrays of a scene: what all samples of a set have in common, and the checks that each must pass.

Checks and copies of the arrays (`SceneLayout.taken`) are quick and run where the scene is handed over, so that a
mistake is reported there and buffers may be used again; the rest (`SceneLayout.sample`) may run anywhere.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.artifacts import shadow_tests
from bodyseg_data.core import BadConfig, BadSample, BadShard, reported
from bodyseg_data.labels import BACKGROUND, UNLABELLED, Classes
from bodyseg_data.packing.occluders import exact_range, occluder_range
from bodyseg_data.packing.range_facing import facing_from_normals, facing_from_range
from bodyseg_data.renders import ProjectorRanges, Render
from bodyseg_data.rigs import Rig
from bodyseg_data.samples import Sample, SampleInfo, Value, as_array, check_key, kind_of, plain_value, steps
from bodyseg_data.shards import EXTERNAL, FACING_FROM_RANGE, RIG_FIELD, Fields, ProjectorKind, check_plane

Images = NDArray[Any]


@dataclass(frozen=True)
class SceneLayout:
    """Common properties of all samples of a set. Arguments as in `Manifest`; facing: its `renderer`."""

    rigs: tuple[Rig, ...]
    classes: Classes
    fields: Fields
    projector: ProjectorKind
    planes: Mapping[str, str]
    facing: str
    codec: str

    def taken(self, scene: Render) -> Render:
        """The scene with copies of its arrays, checked; facing: bool [projectors, H, W], None to be found from its
        ranges; of the projector, its ranges. Raises BadSample, naming the key and the rule.
        """
        check_key(scene.key, self.planes)
        if isinstance(scene.rig, bool) or scene.rig not in range(len(self.rigs)):
            raise BadSample(f"{scene.key}: rig must number one of the set's {len(self.rigs)} rigs, found {scene.rig!r}")
        rig = self.rigs[scene.rig]
        size = rig.camera.rows, rig.camera.columns
        range_m = _ranges(scene.range_m, "range_m", size, rig, scene.key)
        labels = self._labels(scene, size)
        fields = self._fields_of(scene)
        planes = self._planes(scene, size)
        facing = self._facing(scene, rig, range_m)
        self._check_projector(scene)
        if scene.projector is not None:
            facing = np.array(facing_from_range(rig, range_m)) if facing is None else facing
            projector = self._asked(scene.projector, rig, range_m, facing, scene.key)
        elif scene.projector_range_m is not None:
            projector = _ranges(scene.projector_range_m, "projector_range_m", rig.projector_shape, rig, scene.key)
        else:
            projector = None
        return Render(scene.key, range_m, labels, projector, facing, None, scene.split, fields, planes, int(scene.rig))

    def sample(self, taken: Render) -> Sample:
        """The sample of a scene that was `taken`: ranges as the set stores them, fitting labels. Raises BadSample."""
        rig, key = self.rigs[taken.rig], taken.key
        range_image = steps(taken.range_m, rig.range_step_m, f"{key}: range_m")
        measured = range_image > 0
        labels = taken.labels.copy()
        labels[measured & (labels == BACKGROUND)] = UNLABELLED
        labels[~measured] = BACKGROUND
        found = facing_from_range(rig, taken.range_m) if taken.facing is None else taken.facing
        facing = [np.ascontiguousarray(mask & measured) for mask in found]
        occluder = None
        if taken.projector_range_m is not None:
            occluder = steps(taken.projector_range_m, rig.range_step_m, f"{key}: the projector's range")
            if self.projector == "shadow":
                occluder = _coarse(rig, range_image, facing, occluder)
        second = facing[1] if len(facing) == 2 else None
        info = SampleInfo(taken.split, taken.fields)
        return Sample(key, range_image, occluder, labels, facing[0], info, second, taken.planes)

    def _labels(self, scene: Render, size: tuple[int, int]) -> NDArray[np.uint8]:
        labels = _integers(scene.labels, "labels", size, scene.key)
        allowed = (labels >= 0) & ((labels < len(self.classes)) | (labels == UNLABELLED) | (labels == BACKGROUND))
        if not allowed.all():
            top, found = len(self.classes) - 1, _first(labels, ~allowed)
            raise BadSample(f"{scene.key}: labels must be 0 to {top}, {UNLABELLED} or {BACKGROUND}, found {found}")
        return labels.astype(np.uint8)

    def _fields_of(self, scene: Render) -> Mapping[str, Value]:
        fields = {name: plain_value(value) for name, value in scene.fields.items()}
        if len(self.rigs) > 1 and (found := fields.setdefault(RIG_FIELD, int(scene.rig))) != scene.rig:
            rule = f"of several rigs, the field {RIG_FIELD!r} holds the number of the scene's, {scene.rig}"
            raise BadSample(f"{scene.key}: {rule}: name your own otherwise, found {found!r}")
        for name, value in fields.items():
            kind = self.fields.kinds.get(name)
            if kind is None:
                known = ", ".join(sorted(self.fields.kinds)) or "none"
                raise BadSample(f"{scene.key}: the set has the fields {known}, found {name!r}: name it in 'fields'")
            if kind == "float" and type(value) is int:
                fields[name] = value = float(value)
            if (found := _kind(value, name, scene.key)) != kind:
                raise BadSample(f"{scene.key}: field {name!r} must be of the kind {kind}, found {value!r}, {found}")
        with reported(scene.key, BadSample):
            return SampleInfo(scene.split, fields).fields

    def _planes(self, scene: Render, size: tuple[int, int]) -> dict[str, Images]:
        given = scene.planes
        if set(given) != set(self.planes):
            wanted, found = (", ".join(sorted(names)) or "none" for names in (self.planes, given))
            raise BadSample(f"{scene.key}: the samples of the set have the planes {wanted}, found {found}")
        planes = {}
        for name, kind in sorted(self.planes.items()):
            plane = _integers(given[name], f"the plane {name!r}", size, scene.key)
            wrong = (plane < 0) | (plane > np.iinfo(kind).max)
            if wrong.any():
                raise BadSample(f"{scene.key}: the plane {name!r} must hold {kind}, found {_first(plane, wrong)}")
            planes[name] = plane.astype(kind)
        return planes

    def _facing(self, scene: Render, rig: Rig, range_m: Images) -> NDArray[np.bool_] | None:
        if scene.facing is not None and scene.normals is not None:
            raise BadSample(f"{scene.key}: facing and normals are alternatives, found both")
        origin = facing_of(scene)
        if origin != self.facing:
            words = {EXTERNAL: "facing or normals", FACING_FROM_RANGE: "neither facing nor normals"}
            raise BadSample(f"{scene.key}: samples of the set come with {words[self.facing]}, found {words[origin]}")
        size, count = range_m.shape, len(rig.projectors)
        if scene.normals is not None:
            normals = as_array(scene.normals, f"{scene.key}: normals")
            if normals.shape != (*size, 3) or normals.dtype.kind != "f":
                wanted = f"floats [{size[0]}, {size[1]}, 3]"
                raise BadSample(f"{scene.key}: normals must be {wanted}, found {normals.dtype} {normals.shape}")
            return _from_normals(rig, range_m, normals, scene.key)
        if scene.facing is None:
            return None
        facing = as_array(scene.facing, f"{scene.key}: facing")
        if facing.dtype != np.bool_ or facing.shape not in ((count, *size), *((size,) if count == 1 else ())):
            wanted = f"bool [{size[0]}, {size[1]}]" if count == 1 else f"bool [{count}, {size[0]}, {size[1]}]"
            raise BadSample(f"{scene.key}: facing must be {wanted}, found {facing.dtype} {facing.shape}")
        return facing.reshape(count, *size).copy()

    def _check_projector(self, scene: Render) -> None:
        ways = (scene.projector_range_m is not None) + (scene.projector is not None)
        if ways != (self.projector != "none"):
            wanted = "no projector's range" if self.projector == "none" else "projector_range_m or projector"
            found = ("neither", "one", "both")[ways]
            raise BadSample(f"{scene.key}: the samples of the set come with {wanted}, found {found} of the two")
        if scene.projector is not None and not callable(scene.projector):
            raise BadSample(f"{scene.key}: projector must be a function of rows and columns, found {scene.projector!r}")

    def _asked(
        self, projector: ProjectorRanges, rig: Rig, range_m: Images, facing: NDArray[np.bool_], key: str
    ) -> Images:
        """The projector's range by the user's function, for the texels that the shadow test reads, or for all."""
        shape = rig.projector_shape
        image = np.zeros(shape)

        def ask(texels: NDArray[np.intp]) -> None:
            found = as_array(projector(*np.divmod(texels, shape[1])), f"{key}: what projector returns")
            image.ravel()[texels] = _ranges(found, "what projector returns", (len(texels),), rig, key)

        if self.projector == "exact":
            ask(np.arange(image.size))
            return image
        range_image, first = steps(range_m, rig.range_step_m, f"{key}: range_m"), 0
        for test, mask in zip(shadow_tests(rig), facing, strict=True):

            def ranges(texels: NDArray[np.intp], first: int = first) -> NDArray[np.uint16]:
                ask(texels + first)
                return steps(image.ravel()[texels + first], rig.range_step_m, key)

            exact_range(test, range_image, mask & (range_image > 0), ranges)
            first += test.rig.projector.rows * shape[1]
        return image


def facing_of(scene: Render) -> str:
    """Origin of a scene's facing bits, as manifests say it."""
    return FACING_FROM_RANGE if scene.facing is None and scene.normals is None else EXTERNAL


def learned_fields(fields: Mapping[str, Any], rigs: int, key: str) -> Fields:
    """The fields of a set as its first scene has them. Raises BadSample."""
    kinds = {name: _kind(plain_value(value), name, key) for name, value in fields.items()}
    with reported(key, BadSample, BadShard):
        return fields_of(kinds, rigs)


def learned_planes(planes: Mapping[str, Any], key: str) -> dict[str, str]:
    """Name -> type of the planes that a first scene has; uint16 where they are no uint8. Raises BadSample."""
    kinds = {}
    for name, plane in planes.items():
        kinds[name] = "uint8" if as_array(plane, f"{key}: the plane {name!r}").dtype == np.uint8 else "uint16"
        with reported("", BadSample, BadShard):
            check_plane(name, kinds[name], key)
    return kinds


def fields_of(kinds: Mapping[str, str], rigs: int) -> Fields:
    """Fields, each in a table of its own, by name; for several rigs `RIG_FIELD`, too. Raises BadConfig or BadShard."""
    kinds = {**kinds, RIG_FIELD: "int"} if rigs > 1 else kinds
    if not all(isinstance(kind, str) for kind in kinds.values()):
        raise BadConfig(f"'fields' must give a kind for each name, found {dict(kinds)!r:.200}")
    return Fields(tuple(((name, kind),) for name, kind in sorted(kinds.items())))


def _kind(value: Value, name: str, key: str) -> str:
    with reported(key, BadSample):
        return kind_of(value, name)


def _ranges(given: Any, name: str, shape: tuple[int, ...], rig: Rig, key: str) -> Images:
    """Ranges in metres, checked and copied."""
    image = as_array(given, f"{key}: {name}")
    if image.dtype.kind != "f" or image.dtype.itemsize == 2:  # whose steps are 2 mm beyond 2 m
        raise BadSample(f"{key}: {name} must be floats of 32 or 64 bits, in metres, found {image.dtype}")
    _check_shape(image, name, shape, key)
    reach = 65535 * rig.range_step_m
    if image.size and not (image.min() >= 0 and image.max() <= reach):  # false for NaN too
        wrong = ~((image >= 0) & (image <= reach))
        raise BadSample(f"{key}: {name} must be metres, 0 to {reach:.5g}, found {_first(image, wrong)}")
    return image.copy()


def _integers(given: Any, name: str, size: tuple[int, int], key: str) -> Images:
    image = as_array(given, f"{key}: {name}")
    if image.dtype.kind not in "iu":
        raise BadSample(f"{key}: {name} must be whole numbers, found {image.dtype}")
    _check_shape(image, name, size, key)
    return image


def _check_shape(image: Images, name: str, shape: tuple[int, ...], key: str) -> None:
    if image.shape != shape:
        wanted, found = (" x ".join(map(str, sizes)) for sizes in (shape, image.shape))
        raise BadSample(f"{key}: {name} must be {wanted}, as the rig says, found {found or 'one number'}")


def _first(image: Images, wrong: NDArray[np.bool_]) -> str:
    place = tuple(np.argwhere(wrong)[0].tolist())
    where = f"row {place[0]}, column {place[1]}" if len(place) == 2 else f"place {place[0]}"
    return f"{image[place]:.7g} at {where}"


def _from_normals(rig: Rig, range_m: Images, normals: Images, key: str) -> NDArray[np.bool_]:
    measured = range_m > 0
    if not np.isfinite(normals[measured]).all():
        raise BadSample(f"{key}: normals must be finite where range_m is above 0")
    towards = np.einsum("ijk,ijk->ij", normals, rig.camera.pixel_rays())[measured] < 0
    if towards.size and np.count_nonzero(towards) < towards.size / 2:
        rule = "normals must point out of the surfaces, in the camera's frame (x right, y down, z forward)"
        away = f"{np.count_nonzero(~towards)} of {towards.size} point away"
        raise BadSample(f"{key}: {rule}, so towards the camera: {away}")
    return np.array(facing_from_normals(rig, range_m, normals))


def _coarse(
    rig: Rig, range_image: NDArray[np.uint16], facing: list[NDArray[np.bool_]], occluder: NDArray[np.uint16]
) -> NDArray[np.uint16]:
    """The projectors' exact ranges, as coarse as the shadows permit."""
    images = np.split(occluder, [rig.projector.rows])
    return np.concatenate(
        [
            occluder_range(test, range_image, mask, np.ascontiguousarray(image).ravel().take)
            for test, mask, image in zip(shadow_tests(rig), facing, images, strict=False)
        ]
    )
