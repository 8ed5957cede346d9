"""Protocol of a transform: one sample in, one sample out, in a worker, after the artifacts and before the label map.

A transform is a frozen dataclass:

    @dataclass(frozen=True)
    class Nearer(Transform):
        name = "nearer"
        least: int = 500

        def __call__(self, image: RangeImage, random: np.random.Generator) -> RangeImage: ...
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import Field, asdict
from typing import Any, ClassVar, Protocol

import numpy as np

from bodyseg_data.artifacts.artifact import RangeImage
from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.randomness import Draws


class Transform(Protocol):
    """An alteration of samples. Implementations are frozen dataclasses, whose fields are parameters.

    name: in `RangeImages.identity()` and in cards. version: of the code; goes up when the same parameters and draws
    give other samples.
    """

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]
    name: ClassVar[str]
    version: ClassVar[int] = 1

    def shape(self, rows: int, columns: int) -> tuple[int, int]:
        """Rows and columns of the images that come out, for those that go in."""
        return rows, columns

    def __call__(self, image: RangeImage, random: np.random.Generator) -> RangeImage:
        """Return the altered sample; `image` may be altered in place and returned.

        image: uint16 [H, W] in the rig's steps and labels uint8 [H, W]. random: a generator that belongs to (seed,
        epoch, key of the sample, name of the transform), so that the draws depend on nothing else.
        """
        ...


def check_transforms(given: Transform | Sequence[Transform]) -> tuple[Transform, ...]:
    """Return one transform or several as a tuple. Raises BadConfig for anything else, or a name given twice."""
    found = tuple(given) if isinstance(given, Sequence) else (given,)
    for each in found:
        if not callable(each) or not isinstance(getattr(each, "name", None), str):
            raise BadConfig(f"a transform must be a Transform with a name, found {each!r}")
    names = [each.name for each in found]
    for name in names:
        if names.count(name) > 1:
            raise BadConfig(f"a transform is given once, as its draws are its own; found {name!r} twice")
    return found


def transform_image(image: RangeImage, transforms: Sequence[Transform], draws: Draws) -> RangeImage:
    """Apply transforms in their order."""
    for each in transforms:
        image = each(image, draws.generator(f"transform {each.name}"))
    return image


def transforms_to_json(transforms: Sequence[Transform]) -> list[dict[str, Any]]:
    """Name, version and parameters of each transform, as plain JSON."""
    return [{"name": each.name, "version": each.version, **asdict(each)} for each in transforms]
