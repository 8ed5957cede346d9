"""Views of a body: the distances and azimuths at which each mesh is rendered."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from bodyseg_data.core.errors import BadConfig


@dataclass(frozen=True, order=True)
class View:
    """Distance and azimuth of the camera.

    distance_cm: from the camera's centre to the centre of the body's bounding box, along the optical axis.
    azimuth_deg: rotation of the camera about the body's vertical axis; 0 shows the front, 90 the subject's left side,
    180 the back.
    """

    distance_cm: int
    azimuth_deg: int

    @property
    def name(self) -> str:
        """Part of a sample's key, like d255-a090."""
        return f"d{self.distance_cm:03d}-a{self.azimuth_deg:03d}"


@dataclass(frozen=True)
class ViewGrid:
    """Views at all distances from all azimuths. The defaults are the paper's 3 × 18 = 54 views, 10° apart.

    The paper turns by 10° eighteen times, which covers half a turn, while its results show full turns; the span
    is therefore a parameter. `count` thins the grid evenly over azimuths, with the distances in turn. Raises BadConfig
    for a value out of range.
    """

    distances_cm: tuple[int, ...] = (215, 255, 295)
    azimuths: int = 18
    span_deg: int = 180
    count: int | None = None

    def __post_init__(self) -> None:
        if not self.distances_cm or any(not 50 <= d <= 600 for d in self.distances_cm):
            raise BadConfig(f"view distances must be between 50 and 600 cm, found {list(self.distances_cm)}")
        if len(set(self.distances_cm)) != len(self.distances_cm):
            raise BadConfig(f"view distances must differ, found {list(self.distances_cm)}")
        if not 1 <= self.azimuths <= 360 or not 1 <= self.span_deg <= 360 or self.span_deg % self.azimuths:
            raise BadConfig(
                "the azimuth span must be 1 to 360 whole degrees and divide evenly by the number of azimuths, "
                f"found span {self.span_deg} and {self.azimuths} azimuths"
            )
        if self.count is not None and not 1 <= self.count <= self.full:
            raise BadConfig(f"views a mesh must be between 1 and {self.full}, found {self.count}")

    @property
    def full(self) -> int:
        """Views in the whole grid, before thinning."""
        return len(self.distances_cm) * self.azimuths

    def __len__(self) -> int:
        return self.full if self.count is None else self.count

    def __iter__(self) -> Iterator[View]:
        step = self.span_deg // self.azimuths
        rows = len(self.distances_cm)
        for index in range(len(self)):
            azimuth = index * self.azimuths // len(self)
            yield View(self.distances_cm[index % rows], azimuth * step)
