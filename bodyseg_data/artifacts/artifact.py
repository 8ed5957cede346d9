"""The protocol of an artifact: strengths that are set, draws for one image, and an alteration in NumPy.

A new artifact is one file in this folder and one entry of the registry (`bodyseg_data/artifacts/registry.py`), or a
class in a package of yours with an entry point `bodyseg.artifacts`, or an object in a `SensorModel`:

    @dataclass(frozen=True)
    class Rounding(Artifact):
        name, kind = "rounding", "noise"
        step_mm: float = 1.0

        def apply(self, image: RangeImage, scene: Scene, draws: Draws) -> None: ...
"""

from collections.abc import Mapping
from dataclasses import Field, dataclass, field
from functools import cached_property
from typing import Any, ClassVar, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadSample, Draws, check_fields
from bodyseg_data.labels import PART_CLASSES, Classes
from bodyseg_data.rigs import Rig
from bodyseg_data.samples import Sample, shape_of

Kind = Literal["occlusion", "noise", "missing_data"]
"""The three kinds of artifacts of the paper's Table 1: what the projector does not light, ranges that are wrong, pixels
that are lost. Every artifact is of one kind, and variants name kinds."""


@dataclass(frozen=True, eq=False, repr=False)
class RangeImage:
    """A sample as a sensor would deliver it.

    range: uint16 [H, W], in the rig's steps, 0 where nothing was measured. labels: uint8 [H, W], 255 where range is 0.
    drawn: the quantities drawn for this image, by their names (`Artifact.drawn`), such as "sigma_mm" or "missing_rate".
    planes: name -> uint8 or uint16 [H, W], further images that were asked for; as stored, also where pixels are lost.
    """

    key: str
    range: NDArray[np.uint16]
    labels: NDArray[np.uint8]
    drawn: Mapping[str, float]
    planes: Mapping[str, NDArray[Any]] = field(default_factory=dict, kw_only=True)

    def __repr__(self) -> str:
        measured = int(np.count_nonzero(self.range))
        drawn = "".join(f", {name} {value:g}" for name, value in self.drawn.items())
        return f"RangeImage({self.key!r}, {shape_of(self.range)}, {measured} pixels measured{drawn})"


@dataclass(frozen=True)
class Scene:
    """Input of every artifact, which none alters: a clean sample, the rig that sees it, and the classes of its set."""

    sample: Sample
    rig: Rig
    classes: Classes = PART_CLASSES

    @property
    def step_m(self) -> float:
        """Metres in one step of a range."""
        return self.rig.range_step_m

    @cached_property
    def pixels(self) -> NDArray[np.intp]:
        """Flat indices of the clean foreground in reading order, [N].

        An artifact that draws a number for each pixel draws for all of these, also for pixels that are lost already:
        the draws of a pixel are then the same in every variant.
        """
        return np.flatnonzero(self.sample.range != 0)


def check_image(what: str, array: Any, kind: type[np.generic], shape: tuple[int, int]) -> None:
    """Raise BadSample, naming `what`, for anything but an array of this kind and shape: compiled loops check none."""
    if not isinstance(array, np.ndarray) or array.dtype != kind or array.shape != shape:
        found = f"{array.dtype} {array.shape}" if isinstance(array, np.ndarray) else type(array).__name__
        raise BadSample(f"{what} must be {kind.__name__} {shape} as in the rig, found {found}")


class Artifact(Protocol):
    """A fault of a sensor, made in a clean range image. Implementations are frozen dataclasses; fields are strengths.

    name: in the registry, and of the strengths in JSON. kind: the artifact of Table 1 whose variants have this one.
    version: of the code; goes up when the same strengths and draws give other images.
    purposes: of its random numbers (`Draws`); no other artifact of a sensor may have them.
    either: strengths that exclude each other. needs_projector: whether `apply` reads the projector's range.
    drawn: quantities drawn once an image: name -> caption, which is formatted with the value.
    Raises BadConfig, when it is made, for strengths out of range.
    """

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]
    name: ClassVar[str]
    kind: ClassVar[Kind]
    version: ClassVar[int] = 1
    purposes: ClassVar[tuple[str, ...]] = ()
    either: ClassVar[tuple[str, ...]] = ()
    drawn: ClassVar[Mapping[str, str]] = {}
    needs_projector: ClassVar[bool] = False

    def __post_init__(self) -> None:
        """Raise BadConfig for a strength of another type than its field's, or out of bounds (`bounded`)."""
        check_fields(self)

    def draw(self, draws: Draws) -> dict[str, float]:
        """Draw the quantities of one image: name in `drawn` -> value."""
        return {}

    def apply(self, image: RangeImage, scene: Scene, draws: Draws) -> None:
        """Alter an image in place, in NumPy: the reference of any faster form.

        image: as the artifacts before this one left it, contiguous. Its range is 0 where pixels are lost; these stay
        lost, and their labels become background afterwards. `image.drawn` holds the quantities of all artifacts.
        draws: gives the same numbers whichever other artifacts there are.
        Raises BadSample for a scene that lacks what is needed; any other error ends the run as a BadConfig.
        """
