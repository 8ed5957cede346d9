"""Sources of finished renders: what the readers of all layouts share, which is partners, sizes, units and checks."""

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadConfig, BadSample, check_choice, reported
from bodyseg_data.files import natural_key
from bodyseg_data.labels import UNLABELLED, Classes
from bodyseg_data.renders.images import as_metres, ray_lengths
from bodyseg_data.renders.set_file import LabelTable, SampleRows, SetFile
from bodyseg_data.rigs import Camera, Rig
from bodyseg_data.samples import Split, Value, check_key

RANGE, LABELS, PROJECTOR, FACING, NORMALS = "range", "labels", "projector", "facing", "normals"
"""Kinds of images; any other is a plane."""

_NAMED: Final = 3
_FEW: Final = 0.02
"""Share of labelled pixels that may have no range: borders that two renderers draw half a pixel apart."""
_MUCH: Final = 0.05  # share of pixels with one largest range that is no chance, but a background
_SLACK: Final = 1e-4  # of distances along the ray: share that conversion to the axis and back may change


ProjectorRanges = Callable[[NDArray[np.intp], NDArray[np.intp]], Any]
"""Rows and columns [N] of texels of the projector's image -> ranges in metres [N], 0 for nothing."""


@dataclass(frozen=True)
class Render:
    """A finished scene: the arguments of `ShardWriter.write`, which describes them. rig: its number in the source's."""

    key: str
    range_m: NDArray[np.floating[Any]]
    labels: NDArray[np.uint8]
    projector_range_m: NDArray[np.floating[Any]] | None = None
    facing: NDArray[np.bool_] | None = None
    normals: NDArray[np.floating[Any]] | None = None
    split: Split = "train"
    fields: Mapping[str, Value] = field(default_factory=dict)
    planes: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    rig: int = 0
    projector: ProjectorRanges | None = None


@dataclass(frozen=True)
class Stored:
    """An image as its file holds it. where: the file, for messages. ray: ranges are measured along the ray."""

    array: NDArray[Any]
    where: str
    ray: bool = False


class RenderSource(ABC):
    """A set of finished renders in a fixed order, found in files of several kinds, each with one file a key.

    files: kind -> key -> file; those of `RANGE` lead. classes, rigs: of set and samples, as the files tell them, else
    as `content` says. Raises BadConfig for a file without partner, rows of other keys, and without classes or rigs.

    The attributes: classes: what labels mean. rigs: of all samples. planes: name -> "uint8" or "uint16" of further
    images. fields: name -> kind of the fields of descriptions, as `ShardWriter` takes them.
    """

    def __init__(
        self,
        content: SetFile,
        rows: SampleRows,
        files: Mapping[str, Mapping[str, Path]],
        classes: Classes | None = None,
        rigs: Mapping[str, Rig] | None = None,
    ) -> None:
        self._content, self._rows, self._files = content, rows, files
        self._said = repr(replace(content, path=Path(), rigs={}))
        for found in files.values():
            _check_partners(files[RANGE], found)
        self._keys = self._in_order()
        if content.classes is None and classes is None:
            raise BadConfig(f"{content.path}: 'classes' is missing, names in the order of their labels")
        self.classes: Classes = content.classes or classes  # type: ignore[assignment]
        each = {key: self._named_rig(key) if rigs is None else rigs[key] for key in self._keys}
        numbers = {rig: number for number, rig in enumerate(dict.fromkeys(each.values()))}
        self.rigs = tuple(numbers)
        self._rig_numbers = {key: numbers[rig] for key, rig in each.items()}
        self.planes: Mapping[str, str] = {}
        self.fields: Mapping[str, str] = rows.kinds()

    def _in_order(self) -> list[str]:
        """Keys in the order of the table of samples, else of their names."""
        keys, rows = sorted(self._files[RANGE], key=natural_key), self._rows
        if rows.path is None:
            return keys
        lacking = [key for key in keys if key not in rows.infos]
        extra = [key for key in rows.infos if key not in self._files[RANGE]]
        if lacking or extra:
            which = f"no row for {named(lacking)}" if lacking else f"no images for {named(extra)}"
            raise BadConfig(f"{rows.path}: every sample has a row and images, found {which}")
        return list(rows.infos)

    def _named_rig(self, key: str) -> Rig:
        path, rigs, name = self._content.path, self._content.rigs, self._rows.rigs.get(key, "")
        if not rigs:
            raise BadConfig(f"{path}: 'rig' is missing: a rig file in this folder, or the name of a rig")
        return rigs[check_choice(f"{path}: the rig of sample {key!r}", name, rigs)]

    def keys(self) -> Sequence[str]:
        """Return the keys of all renders, in their order."""
        return self._keys

    def without_projector(self) -> Self:
        """These renders without the projector's images, which are not read."""
        others = copy(self)
        others._files = {kind: files for kind, files in self._files.items() if kind != PROJECTOR}
        return others

    def split(self, key: str) -> Split:
        """Return the split of one of `keys()`, without reading its images."""
        return self._rows.info(key).split

    def files(self, key: str) -> list[Path]:
        """The files of a sample's images."""
        return [files[key] for files in self._files.values()]

    def fingerprint(self, key: str) -> str:
        """Digest of what set.toml and the table say of a sample, and of names, sizes and times of its files."""
        said = self._said, self._rows.info(key), self._rig_numbers[key]
        files = [(path.name, (found := path.stat()).st_size, found.st_mtime_ns) for path in self.files(key)]
        return hashlib.sha256(repr((said, files)).encode()).hexdigest()[:16]

    @abstractmethod
    def read(self, key: str) -> Mapping[str, Stored]:
        """Read the images of a sample by their kinds. Raises BadSample, naming the file."""

    def table(self, key: str) -> LabelTable:
        """Meaning of the numbers and colours of a sample's label image."""
        return self._content.table

    def further(self, key: str) -> Mapping[str, Value]:
        """Fields of a sample that its files hold, besides those of the table of samples."""
        return {}

    def load(self, key: str) -> Render:
        """Read one of `keys()`. Raises BadSample, naming file and rule, for images that cannot be what they should."""
        images, info, number = dict(self.read(key)), self._rows.info(key), self._rig_numbers[key]
        rig = self.rigs[number]
        camera = (rig.camera.rows, rig.camera.columns), "camera"
        for kind, image in images.items():
            _check_size(image, *((rig.projector_shape, PROJECTOR) if kind == PROJECTOR else camera))
        seen, labels = images.pop(RANGE), images.pop(LABELS)
        range_m, found = self._metres(seen, rig, rig.camera), self.table(key).labels(labels.array, labels.where)
        stored = seen.array if self._content.no_range is None else None
        check_labels(range_m, found, labels.where, ray_lengths(rig.camera), stored)
        lit, facing, normals = (images.pop(kind, None) for kind in (PROJECTOR, FACING, NORMALS))
        return Render(
            key,
            range_m,
            found,
            None if lit is None else self._metres(lit, rig, *rig.projectors),
            None if facing is None else facing.array != 0,
            None if normals is None else normals.array,
            info.split,
            {**self.further(key), **info.fields},
            {name: image.array for name, image in images.items()},
            number,
        )

    def _metres(self, image: Stored, rig: Rig, *devices: Camera) -> NDArray[np.floating[Any]]:
        """Ranges along the axes of devices whose images stand one below the other."""
        content = self._content
        lengths = np.concatenate([ray_lengths(device) for device in devices]) if image.ray else None
        return as_metres(image.array, content.unit_m, rig.range_step_m, image.where, lengths, content.no_range)


def named(names: Sequence[str]) -> str:
    """The first few names, and how many more there are."""
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return ", ".join(map(repr, names[:_NAMED])) + more


def by_key(paths: Iterable[tuple[str, Path]]) -> dict[str, Path]:
    """Files by their keys. Raises BadConfig, naming the file, for a name that is no key, or two files of one."""
    found: dict[str, Path] = {}
    for key, path in paths:
        with reported(f"{path}: its name gives the key", BadConfig, BadSample):
            check_key(key)
        if key in found:
            raise BadConfig(f"{path.parent}: a sample has one file of a kind, found {found[key].name} and {path.name}")
        found[key] = path
    return found


def _check_partners(leading: Mapping[str, Path], found: Mapping[str, Path]) -> None:
    """Raise BadConfig unless two kinds of images have the same keys."""
    ours, theirs = leading.keys() - found.keys(), found.keys() - leading.keys()
    missing, extra = sorted(ours, key=natural_key), sorted(theirs, key=natural_key)
    homes = " and ".join(str(next(iter(files.values())).parent) for files in (leading, found))
    if missing:
        raise BadConfig(f"{homes}: the second lacks {len(missing)} of {len(leading)} samples: {named(missing)}")
    if extra:
        raise BadConfig(f"{homes}: the first lacks the range of {len(extra)} samples of the second: {named(extra)}")


def _check_size(image: Stored, size: tuple[int, int], device: str) -> None:
    """Raise BadSample unless an image has the rows and columns of the rig's camera, or its projectors."""
    found = image.array.shape[:2]
    if found != size:
        turned = ": rows and columns are exchanged" if found == size[::-1] else ""
        raise BadSample(
            f"{image.where}: an image must have {size[0]} rows and {size[1]} columns as the rig's {device}, found "
            f"{found[0]} and {found[1]}{turned}"
        )


def check_labels(
    range_m: NDArray[Any], labels: NDArray[np.uint8], where: str, lengths: NDArray[Any], stored: NDArray[Any] | None
) -> None:
    """Raise BadSample if labels and ranges cannot be of one scene; where: the label image.

    range_m: 0 where nothing was measured. lengths: of the rays. stored: the file's numbers, None if the set knows them.
    """
    nothing, classed = range_m == 0, labels < UNLABELLED
    lost, total = np.count_nonzero(classed & nothing), np.count_nonzero(classed)
    if lost > _FEW * max(int(total), labels.size // 20):
        turned = {"left to right": labels[:, ::-1], "upside down": labels[::-1]}
        for way, image in turned.items():
            if np.count_nonzero((image < UNLABELLED) & nothing) < lost / 4:
                raise BadSample(f"{where}: labels look mirrored {way}: turned, they fit the range image's surfaces")
        raise BadSample(
            f"{where}: a class needs a surface, {lost} of {total} pixels with a class have no range: is the image of "
            "another scene, or does a class like the sky belong into 'background' of set.toml?"
        )
    for far_m, slack, along in ((range_m, 0.0, ""), (range_m * lengths, _SLACK, " along the ray")):
        farthest = (far_m >= (1 - slack) * far_m.max()) & ~nothing
        far = np.count_nonzero(farthest)
        if stored is not None and far > _MUCH * labels.size and np.count_nonzero(classed & farthest) <= _FEW * far:
            low, high = stored[farthest].min(), stored[farthest].max()
            told = f"no_range = [{high:.9g}] in set.toml" if high - low <= 1e-5 * high else "0 in its file"
            raise BadSample(
                f"{where}: {far} pixels without a class share the largest range, {far_m.max():.6g} m{along}: {told} "
                "says that nothing is there, no_range = [] that something is"
            )
