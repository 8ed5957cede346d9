"""Protocol of a transform: one sample in, one sample out, in a worker, after the artifacts and before the label map.

A transform is a frozen dataclass:

    @dataclass(frozen=True)
    class Nearer(Transform):
        name = "nearer"
        most_m: float = 2.5

        def __call__(self, image: CameraImage, random: np.random.Generator) -> CameraImage:
            image.range[image.metres > self.most_m] = 0
            return image

or a function with these two arguments, which has no parameters and leaves images as large as they are.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import Field, asdict, dataclass, replace
from types import CellType, FunctionType
from typing import Any, ClassVar, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.artifacts import RangeImage
from bodyseg_data.core import BadConfig, BadSample, BodysegError, Draws, reported
from bodyseg_data.labels import BACKGROUND, PART_CLASSES, UNLABELLED, Classes
from bodyseg_data.samples import Sample, SampleInfo, box_of, metres


class BadTransform(BodysegError):
    """A transform has failed on a sample, or returned something that is no sample."""


Box = tuple[int, int, int, int]
"""First row, end of the rows, first column, end of the columns."""


@dataclass(frozen=True, eq=False, repr=False)
class CameraImage(RangeImage):
    """A range image with artifacts, and the pinhole camera that took it. Make altered ones by `dataclasses.replace`.

    range: uint16 [H, W], steps of `step_m` along the optical axis, 0 where nothing was measured.
    labels: uint8 [H, W], classes of the set, 255 where there is none.
    step_m: one step, metres. focal_px: focal length in pixels. classes: of the set.
    centre_px: (x, y) of the optical axis in image coordinates: pixel (row, column) covers x from column to column + 1.
    sample: the stored one, for `info`; its arrays may have been used for this image.
    planes: name -> uint8 or uint16 [H, W], moved along with the pixels, 0 outside of the image as it was (`NOWHERE` in
    the map of the body). has_map: whether the plane `TEMPLATE` is that map, and not one of the user's.
    """

    step_m: float
    focal_px: float
    centre_px: tuple[float, float]
    sample: Sample
    classes: Classes = PART_CLASSES
    has_map: bool = False

    @property
    def info(self) -> SampleInfo:
        """Origin of the sample, and the view it was rendered from: as stored, whatever transforms do."""
        return self.sample.info

    @property
    def metres(self) -> NDArray[np.float32]:
        """Ranges in metres, float32 [H, W], 0 where nothing was measured; see `samples.metres`."""
        return metres(self.range, self.step_m)

    @property
    def body_box(self) -> Box | None:
        """The smallest box that holds all labelled pixels; None if there are none."""
        return ends_of(self.labels < UNLABELLED)


def ends_of(mask: NDArray[Any]) -> Box | None:
    """The smallest box that holds all of an image [H, W] that is not 0; None if nothing is."""
    box = box_of(mask)
    return None if box is None else (box[0].start, box[0].stop, box[1].start, box[1].stop)


class Transform(Protocol):
    """An alteration of samples. Implementations are frozen dataclasses, whose fields are parameters.

    name: of the transform in `RangeImages.identity()` and in cards.
    version: of the code; goes up when the same parameters and draws give other samples.
    """

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]
    name: ClassVar[str]
    version: ClassVar[int] = 1

    def shape(self, rows: int, columns: int) -> tuple[int, int]:
        """Return rows and columns of the images that come out, given those of the images that go in."""
        return rows, columns

    def __call__(self, image: CameraImage, random: np.random.Generator) -> CameraImage:
        """Return the altered sample; arrays of `image` may be altered in place and returned.

        image: ranges in steps, labels of the set, and the camera, which a transform that moves pixels keeps up to date.
        random: a generator for (seed, epoch, key of the sample, name of the transform); draws depend on nothing else.
        Where the returned range is 0, the label becomes background; elsewhere background becomes 254 where surfaces
        without a class have that. Raises BadSample for a sample that should be left out (`on_error="skip"`); any other
        error ends the run as BadTransform.
        """


Function = Callable[[CameraImage, np.random.Generator], CameraImage]
"""A function that does what `Transform.__call__` does."""

Transforms = Transform | Function | Sequence[Transform | Function]
"""Transforms as users give them: one or several."""


@dataclass(frozen=True)
class FunctionTransform(Transform):
    """A plain function as a transform, named after its module and its qualified name."""

    function: Function

    @property
    def name(self) -> str:  # type: ignore[override]  # a class has one name, and functions have one each
        """Module and qualified name of the function, the same in spawned processes, where a program is __mp_main__."""
        return _name_of(self.function)

    def __call__(self, image: CameraImage, random: np.random.Generator) -> CameraImage:
        return self.function(image, random)


def _name_of(function: Function) -> str:
    return f"{function.__module__}.{function.__qualname__}".replace("__mp_main__.", "__main__.")


def check_transforms(given: Transforms) -> tuple[Transform, ...]:
    """Return one transform or several as a tuple, functions as `FunctionTransform`.

    Raises BadConfig for anything else, a lambda, or a parameter that is no plain JSON.
    """
    found = tuple(given) if isinstance(given, Sequence) else (given,)
    checked = tuple(_checked(each) for each in found)
    transforms_to_json(checked)
    return checked


def _checked(given: Any) -> Transform:
    if isinstance(given, FunctionType):
        if given.__name__ == "<lambda>":
            raise BadConfig(f"a transform must have a name: use a function of a module, found {_name_of(given)}")
        around = [cell.cell_contents for cell in given.__closure__ or () if cell != CellType()]  # some may be empty yet
        if any(isinstance(each, int | float | str) for each in around):
            raise BadConfig(f"a transform with parameters must be a class, found the function {_name_of(given)}")
        return FunctionTransform(given)
    if isinstance(given, type) or not callable(given) or not isinstance(getattr(given, "name", None), str):
        raise BadConfig(f"a transform must be a function, or a dataclass derived from Transform, found {given!r}")
    if not getattr(getattr(given, "__dataclass_params__", None), "frozen", False):
        raise BadConfig(f"a transform must be a frozen dataclass, found {type(given).__name__}")
    return cast(Transform, given)


def transforms_to_json(transforms: Sequence[Transform]) -> list[dict[str, Any]]:
    """Name, version and parameters of each transform, as plain JSON. Raises BadConfig for other parameters."""
    return [{"name": each.name, "version": each.version, **_parameters(each)} for each in transforms]


def _parameters(transform: Transform) -> dict[str, Any]:
    if isinstance(transform, FunctionTransform):
        return {}
    with reported(f"transform {transform.name!r}: a parameter must be plain JSON", BadConfig, TypeError, ValueError):
        return dict(json.loads(json.dumps(asdict(transform), allow_nan=False)))


def transformed_shape(transforms: Sequence[Transform], rows: int, columns: int) -> tuple[int, int]:
    """Rows and columns that transforms make of an image in their order. Raises BadConfig for no whole numbers."""
    for each in transforms:
        found = each.shape(rows, columns)
        if not isinstance(found, tuple) or [type(side) for side in found] != [int, int] or min(found) < 1:
            raise BadConfig(f"transform {each.name!r}: 'shape' must give two whole numbers above 0, found {found!r}")
        rows, columns = found
    return rows, columns


def transform_image(
    image: CameraImage, transforms: Sequence[Transform], draws: Draws, unlabelled: int = BACKGROUND
) -> CameraImage:
    """Apply transforms in their order; the draws of the n-th of one name are its own.

    unlabelled: the label of surfaces without a class, 254 or 255.

    Raises BadSample if a transform does; BadTransform, with the traceback as a note, for any other error in one, and
    for a result that is no sample of the declared shape. Messages begin with the key.
    """
    counts: dict[str, int] = {}
    for each in transforms:
        count = counts[each.name] = counts.get(each.name, 0) + 1
        purpose = f"transform {each.name}" if count == 1 else f"transform {each.name} {count}"
        shape = each.shape(*image.range.shape)
        where = f"{image.key}: transform {each.name!r}"
        with BadTransform.named(where, passes=BadSample), reported(where, BadSample):
            found = each(image, draws.generator(purpose))
        image = _checked_image(found, image, where, shape, unlabelled)
    return image


def _checked_image(found: Any, image: CameraImage, where: str, shape: tuple[int, int], unlabelled: int) -> CameraImage:
    if not isinstance(found, CameraImage):
        raise BadTransform(f"{where} must return a CameraImage, found {type(found).__name__}")
    for fixed in ("key", "step_m"):
        if getattr(found, fixed) != getattr(image, fixed):
            raise BadTransform(f"{where} must keep the {fixed}, found {getattr(found, fixed)!r}")
    if found.planes.keys() != image.planes.keys():
        raise BadTransform(f"{where} must return the planes {', '.join(image.planes)}, found {', '.join(found.planes)}")
    arrays: list[tuple[str, Any, NDArray[Any]]] = [("range", found.range, image.range)]
    arrays.append(("labels", found.labels, image.labels))
    arrays += [(f"the plane {each!r}", plane, image.planes[each]) for each, plane in found.planes.items()]
    for what, array, before in arrays:
        plain = isinstance(array, np.ndarray) and not isinstance(array, np.ma.MaskedArray)
        if not plain or array.dtype != before.dtype or array.shape != shape:
            shown = f"{array.dtype} {array.shape}" if plain else type(array).__name__
            raise BadTransform(f"{where} must return {what} as {before.dtype} {shape}, found {shown}")
    ranges, labels, count = np.ascontiguousarray(found.range), found.labels, len(found.classes)
    strange = labels[(labels >= count) & (labels < unlabelled)]
    if strange.size:
        raise BadTransform(f"{where} must return labels 0 to {count - 1} or {BACKGROUND}, found {strange.min()}")
    labels = np.where(ranges == 0, np.uint8(BACKGROUND), np.minimum(labels, np.uint8(unlabelled)))
    planes = {what: np.ascontiguousarray(array) for what, array in found.planes.items()}
    return replace(found, range=ranges, labels=labels, planes=planes, has_map=image.has_map)
