"""One clean sample: what is stored, before any artifact; and its split by the paper's protocol.

That protocol (section 3.5) splits by mesh, so that no mesh has views in both: docs/how-to/splits.md has the table,
and the split "val", which is not stored: it is chosen out of train while reading.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final, Literal, cast

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadSample, check_choice, reported
from bodyseg_data.labels import BACKGROUND, PART_COUNT, UNLABELLED
from bodyseg_data.samples.views import View

Split = Literal["train", "test"]
SPLITS: Final[tuple[Split, ...]] = ("train", "test")

ReadSplit = Literal["train", "val", "test"]
READ_SPLITS: Final[tuple[ReadSplit, ...]] = ("train", "val", "test")
"""The splits that a set can be read by."""

OccluderName = Literal["stored", "camera"]
"""What the projector's range comes from: the set, or what the camera sees."""

_FIRST_FOR_TRAINING: Final = {"A": 57, "people": 467}
_MOTION_FOR_TESTING: Final = {"B": "jumping", "C": "squat"}

FARTHEST_STEPS: Final = np.float32(65535)
"""The largest range that a stored image can hold, in steps; the length of a step is the rig's (`Rig.range_step_m`)."""

_KEY = re.compile(r"[A-Za-z0-9_+-]{1,80}")  # no dots: readers of plain tars split names at the first one

HELD: Final = "held"
"""Value of the field `things` for a body that holds or wears a thing and has none around it."""


@dataclass(frozen=True)
class ShadowThresholds:
    """The thresholds of the shadow test that the stored projector range is made for.

    With these, and only with these, that range gives the same shadows as the exact one; so they belong to the format of
    shards (docs/reference/shard_format.md), and packing and the shadow test read them here.

    surface_gap_m: how far behind the surface that the projector sees a point may lie and still belong to it.
    edge_m: the difference in range from which on neighbouring texels show two surfaces and not one.
    """

    surface_gap_m: float = 0.006
    edge_m: float = 0.020

    def in_steps(self, step_m: float) -> tuple[np.float32, np.float32]:
        """Both in steps of a stored range, whole, at least 1; step_m: one step, metres."""
        gap, edge = (np.float32(max(1, round(each / step_m))) for each in (self.surface_gap_m, self.edge_m))
        return gap, edge


SHADOW_THRESHOLDS: Final = ShadowThresholds()
"""The thresholds of the format of shards."""


Value = str | int | float | bool | tuple[float, ...]
"""Value of a field of a description; a tuple of numbers for one such as a camera's pose."""

FIELD_KINDS: Final[dict[str, type]] = {"text": str, "int": int, "float": float, "flag": bool, "numbers": tuple}
"""Kinds of fields by the name that files give them."""

_KINDS: Final = {accepted: kind for kind, accepted in FIELD_KINDS.items()}

MOST_FIELDS: Final = 64
"""Largest number of fields of a description."""

_FIELD: Final = re.compile(r"[a-z][a-z0-9_]{0,63}")
_VIEW: Final = tuple(View.__dataclass_fields__)


@dataclass(frozen=True, eq=False)
class SampleInfo:
    """The description of a sample. split: "train" or "test". fields: name -> value, whatever the set says of it.

    A field is also an attribute: `info.subject`. Samples that are packed from bodies have source, subset (the paper's
    group), subject, mesh, pose; distance_cm, azimuth_deg, pitch_deg, roll_deg, height_cm, of their `View`; things:
    "before", "behind" or "both" where things stand around the body (docs/reference/things.md), `HELD` where it only
    holds one, else ""; and hidden_pct: percent of the body's pixels that things around it hide.

    Raises BadSample for another split, a name that is no lower-case word, or a value of no kind.
    """

    split: Split
    fields: Mapping[str, Value] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_choice("'split'", self.split, SPLITS, BadSample)
        if len(self.fields) > MOST_FIELDS:
            raise BadSample(f"a description has at most {MOST_FIELDS} fields, found {len(self.fields)}")
        for name, value in self.fields.items():
            check_field_name(name)
            kind_of(value, name)

    def __getattr__(self, name: str) -> Any:
        try:
            return vars(self)["fields"][name]
        except KeyError:
            raise AttributeError(f"the sample's description has no field {name!r}") from None

    def __eq__(self, other: object) -> bool:
        return isinstance(other, SampleInfo) and (self.split, dict(self.fields)) == (other.split, dict(other.fields))

    def get(self, name: str, default: Any = None) -> Any:
        """Return a field, or `default` where the description has none of that name."""
        return self.fields.get(name, default)

    def with_fields(self, **changed: Value) -> SampleInfo:
        """Return a description with other values of some fields, or further ones."""
        return SampleInfo(self.split, {**self.fields, **changed})

    @property
    def view(self) -> View | None:
        """The view that a sample of a body was rendered from; None for samples that say nothing of one."""
        found = {name: self.fields[name] for name in _VIEW if name in self.fields}
        if not {"distance_cm", "azimuth_deg"} <= found.keys() or set(map(type, found.values())) != {int}:
            return None
        return View(**cast(dict[str, int], found))

    def to_json(self) -> dict[str, Any]:
        """Convert to a JSON object."""
        return {
            "split": self.split,
            **{name: list(v) if isinstance(v, tuple) else v for name, v in self.fields.items()},
        }


def check_field_name(name: Any) -> str:
    """Return the name of a field. Raises BadSample unless it is a lower-case word like "robot_arm" and not "split"."""
    taken = ("split", "key", "fields", "view", "get")
    if not isinstance(name, str) or not _FIELD.fullmatch(name) or name in taken:
        raise BadSample(f"a field must have a lower-case name like 'subject', none of {taken}, found {name!r}")
    return name


def plain_value(value: Any) -> Any:
    """A field's value without NumPy or torch: their numbers as Python's, lists and arrays as tuples of floats."""
    if getattr(value, "ndim", None) == 0 and not np.ma.is_masked(value):
        return value.item()
    if isinstance(value, list | tuple) or hasattr(value, "tolist"):
        try:
            flat = np.asarray(value.tolist() if hasattr(value, "tolist") else value)
        except (TypeError, ValueError):
            return value
        return tuple(flat.astype(np.float64).tolist()) if flat.ndim == 1 and flat.dtype.kind in "biuf" else value
    return value


def kind_of(value: Any, name: str) -> str:
    """Return the kind of a field's value (`FIELD_KINDS`). Raises BadSample, naming the field, for one of no kind."""
    if (kind := _KINDS.get(type(value))) is None:
        kinds = "text, a whole number, a number, true or false, or a tuple of numbers"
        raise BadSample(f"field {name!r} must be {kinds}, found {value!r}")
    if kind == "int" and abs(value) >= 1 << 53:
        raise BadSample(f"field {name!r} must be below 2**53, which JSON readers can tell apart, found {value!r}")
    numbers = value if kind == "numbers" else (value,) if kind == "float" else ()
    if numbers and not (len(numbers) <= 64 and all(type(each) is float and math.isfinite(each) for each in numbers)):
        raise BadSample(f"field {name!r} must hold finite numbers, at most 64, found {value!r}")
    if kind == "text" and not value.isprintable():
        raise BadSample(f"field {name!r} must be text that can be printed, found {value!r}")
    return kind


@dataclass(frozen=True, eq=False, repr=False)
class Sample:
    """A clean scene before one camera.

    range: uint16 [H, W], the camera's range in the rig's steps along its optical axis; 0 is background.
    projector_range: uint16 [Hp, Wp], the same for the projector; None if it was not read. Of a rig with two projectors,
    the second's rows follow the first's.
    labels: uint8 [H, W], classes of the set, 0 to 253, `UNLABELLED` (254) on surfaces of none, 255 where range is 0. In
    samples that were read for batches, surfaces of no class are 255, too.
    faces_projector: bool [H, W], whether the surface seen is turned towards the projector (lit unless something stands
    between); False on background. faces_second: the same for a second projector; None if the rig has one.
    planes: name -> uint8 or uint16 [H, W], further images of integers that a set may have.
    edges, texels: flat indices of what holds anything, only of samples decoded into given arrays, None if decoding did
    not find them. edges: int32 [2 N], in reading order: where foreground begins, ends, begins ...; texels: int32 [N],
    ascending, where the projector's range is not 0. Compiled loops rely on both: a sample whose images are changed must
    drop them.
    """

    key: str
    range: NDArray[np.uint16]
    projector_range: NDArray[np.uint16] | None
    labels: NDArray[np.uint8]
    faces_projector: NDArray[np.bool_]
    info: SampleInfo
    faces_second: NDArray[np.bool_] | None = None
    planes: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    edges: NDArray[np.int32] | None = None
    texels: NDArray[np.int32] | None = None

    def __repr__(self) -> str:
        projector = "no" if self.projector_range is None else shape_of(self.projector_range)
        return f"Sample({self.key!r}, camera {shape_of(self.range)}, projector {projector}, {self.info})"

    def occluder_range(self) -> NDArray[np.uint16]:
        """The projector's range. Raises BadSample if it was not read."""
        if self.projector_range is None:
            raise BadSample(f"{self.key}: the projector's range is needed, the sample was read without it")
        return self.projector_range

    def check(self, classes: int = PART_COUNT) -> None:
        """Raise BadSample, naming the key, if the arrays break a rule of the format. classes: how many the set has."""
        check_key(self.key, self.planes)
        kinds = {
            "range": np.uint16,
            "projector_range": np.uint16,
            "labels": np.uint8,
            "faces_projector": np.bool_,
            "faces_second": np.bool_,
        }
        for name, kind in kinds.items():
            array = getattr(self, name)
            if array is None:  # of the projector, or of a second one
                continue
            if array.dtype != kind or array.ndim != 2 or not array.size:
                raise BadSample(f"{self.key}: {name} must be {kind.__name__} [H, W], found {array.dtype} {array.shape}")
        masks = [mask for mask in (self.faces_projector, self.faces_second) if mask is not None]
        shapes = [self.range.shape, self.labels.shape, *(mask.shape for mask in masks)]
        if len(set(shapes)) > 1:
            found = ", ".join(map(str, shapes))
            raise BadSample(f"{self.key}: range, labels and facing must have one shape, found {found}")
        if any(mask.view(np.uint8).max() > 1 for mask in masks):
            raise BadSample(f"{self.key}: the rig has fewer projectors than the facing bits tell of")
        background = self.range == 0
        if not np.array_equal(background, self.labels == BACKGROUND):
            raise BadSample(f"{self.key}: labels must be {BACKGROUND} exactly where range is 0")
        classed = self.labels[self.labels < UNLABELLED]
        if classed.size and int(classed.max()) >= classes:
            raise BadSample(f"{self.key}: labels must be 0 to {classes - 1}, found {classed.max()}")
        if any((mask & background).any() for mask in masks):
            raise BadSample(f"{self.key}: background cannot face the projector")
        for name, plane in self.planes.items():
            if plane.dtype not in (np.uint8, np.uint16) or plane.shape != self.range.shape:
                raise BadSample(f"{self.key}: the plane {name!r} must be uint8 or uint16, as large: {plane.dtype}")


def shape_of(image: NDArray[Any]) -> str:
    """The size of an image in words, "640 x 329"."""
    return " x ".join(map(str, image.shape))


Window = tuple[slice, slice]
"""Rows and columns of an image."""


def box_of(image: NDArray[Any], margin: int = 0) -> Window | None:
    """The rows and columns that all of an image of whole numbers or a mask [H, W] but 0 reaches over; None if all is 0.

    margin: pixels more on every side, where the image has them. By the bits of whole rows, which takes three fifths of
    the time that `any` takes for 16-bit ranges.
    """
    rows = np.flatnonzero(np.bitwise_or.reduce(image, axis=1))
    if not len(rows):
        return None
    columns = np.flatnonzero(np.bitwise_or.reduce(image[rows[0] : rows[-1] + 1], axis=0))
    top, left = max(int(rows[0]) - margin, 0), max(int(columns[0]) - margin, 0)
    return slice(top, int(rows[-1]) + 1 + margin), slice(left, int(columns[-1]) + 1 + margin)


def check_key(key: str, planes: Iterable[str] = ()) -> None:
    """Raise BadSample unless `key` can name a sample in a tar, letters, digits, _, + and -, at most 80, and with the
    name of each of its `planes` at most 89: tars have 100 bytes for KEY.plane.NAME.bsp.
    """
    if not _KEY.fullmatch(key):
        raise BadSample(f"a sample key must be 1 to 80 letters, digits, '_', '+' or '-', found {key!r}")
    for name in planes:
        if len(key) + len(name) > 89:
            found = f"{len(key)} and {len(name)} of the plane {name!r}"
            raise BadSample(f"{key}: a key and the name of a plane must have 89 characters at most, found {found}")


def as_array(given: Any, where: str) -> NDArray[Any]:
    """An array of NumPy, a tensor of torch or nested lists as an array of NumPy, which may share its memory.

    where: names it in messages. Raises BadSample.
    """
    if np.ma.is_masked(given):  # the mask would be lost
        raise BadSample(f"{where} must have no masked values, but a number for them: 0 as a range, 255 as a label")
    with reported(f"{where} must be an array", BadSample, TypeError, ValueError, RuntimeError):
        # A tensor of torch, without importing it.
        return np.asarray(given.detach().cpu().numpy() if hasattr(given, "detach") else given)


def steps(range_m: NDArray[np.floating[Any]], step_m: float, where: str) -> NDArray[np.uint16]:
    """Ranges in metres, 0 for background, as uint16 steps rounded to nearest; of foreground, none becomes 0.

    step_m: one step, metres (`Rig.range_step_m`). where: origin of the ranges, for the message. Raises BadSample for a
    range below 0 or beyond 65535 steps.
    """
    rounded = np.asarray(range_m, np.float64) / step_m
    np.rint(rounded, out=rounded)
    if rounded.size and not (rounded.min() >= 0 and rounded.max() <= 65535):  # False for NaN too
        reach = f"{65535 * step_m:.5g} m, 65535 steps of {1e3 * step_m:g} mm"
        found = np.asarray(range_m)[~((rounded >= 0) & (rounded <= 65535))][0]
        raise BadSample(f"{where}: a range must be 0 to {reach}, found {found:.5g} m")
    return np.maximum(rounded, np.asarray(range_m) > 0).astype(np.uint16)


def info_from_json(tree: Any, key: str) -> SampleInfo:
    """Check and read a sample's description. Raises BadSample."""
    if not isinstance(tree, dict) or "split" not in tree:
        raise BadSample(f"{key}: the description must be an object with a 'split'")
    fields: dict[str, Any] = {name: tuple(each) if isinstance(each, list) else each for name, each in tree.items()}
    with reported(key, BadSample):
        return SampleInfo(fields.pop("split"), fields)


def split_by_order(subset: Literal["A", "people"], index: int) -> Split:
    """Return the split of mesh number `index`, counted from 0 over the whole subset."""
    return "train" if index < _FIRST_FOR_TRAINING[subset] else "test"


def split_by_motion(subset: Literal["B", "C"], motion: str) -> Split:
    """Return the split of all frames of a motion sequence."""
    return "test" if motion == _MOTION_FOR_TESTING[subset] else "train"


def holds_motions(subset: str) -> bool:
    """Return whether the meshes of one of the paper's subsets are frames of motions, which are their poses."""
    return subset in _MOTION_FOR_TESTING


def holds_postures(subset: str) -> bool:
    """Return whether every mesh of one of the paper's subsets is a posture of its own, not a frame of a motion."""
    return subset in _FIRST_FOR_TRAINING


def metres(steps: NDArray[np.uint16], step_m: float, out: NDArray[np.float32] | None = None) -> NDArray[np.float32]:
    """Convert stored steps to metres: float32(steps) * float32(step_m).

    step_m: one step, metres (`RangeImages.step_m`). out: float32 array to write into, of the same shape.
    """
    return np.multiply(steps, np.float32(step_m), out=out)
