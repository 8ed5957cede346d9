"""Views of a body: the distances, azimuths, pitches, rolls and heights from which each mesh is rendered."""

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

from bodyseg_data.core import BadConfig, Checked, Draws, check_fields

_DISTANCES_CM: Final = (50, 600)
_LIMITS: Final = {"pitch_deg": (-90, 90), "roll_deg": (-179, 180), "height_cm": (-300, 300)}
_KEY: Final = re.compile(r"(.+)-(d[0-9]{3}-a[0-9]{3}(?:-p-?[0-9]+)?(?:-r-?[0-9]+)?(?:-h-?[0-9]+)?)")
_WHOLE: Final = re.compile(r"[+-]?[0-9]{1,4}")
_RANGE: Final = re.compile(rf"({_WHOLE.pattern})\.\.({_WHOLE.pattern})")


@dataclass(frozen=True, order=True)
class View:
    """Pose of the camera in relation to the body.

    The camera aims at a point `height_cm` above the centre of the body's bounding box.

    distance_cm: from the camera's centre to that point, along the optical axis.
    azimuth_deg: rotation of the camera about the body's vertical axis; 0 shows the front, 90 the subject's left side,
    180 the back.
    pitch_deg: angle of the optical axis above the horizontal; negative looks down, from above, -90 straight down. The
    distance stays: the camera goes round the point that it aims at.
    roll_deg: rotation of the camera about its optical axis, clockwise as seen from behind it; a body in the image turns
    the other way.
    height_cm: the camera, without turning, raised by that much; a body in the image moves down.

    Raises BadConfig for anything but whole numbers.
    """

    distance_cm: int
    azimuth_deg: int
    pitch_deg: int = 0
    roll_deg: int = 0
    height_cm: int = 0

    def __post_init__(self) -> None:
        if {*map(type, vars(self).values())} != {int}:  # a packing makes hundreds of thousands; the check takes longer
            check_fields(self)

    @property
    def name(self) -> str:
        """Part of a sample's key, like d255-a090; with pitch, roll and height where not 0, like d255-a090-p-10-h040."""
        marks = (("p", self.pitch_deg), ("r", self.roll_deg), ("h", self.height_cm))
        more = "".join(f"-{mark}{value:03d}" for mark, value in marks if value)
        return f"d{self.distance_cm:03d}-a{self.azimuth_deg:03d}{more}"

    @property
    def words(self) -> str:
        """Description for captions, like "2.55 m, 90°", with pitch, roll and height where not 0."""
        marks = ((self.pitch_deg, "pitch", "°"), (self.roll_deg, "roll", "°"), (self.height_cm, "height", " cm"))
        more = "".join(f", {what} {value}{unit}" for value, what, unit in marks if value)
        return f"{self.distance_cm / 100:.2f} m, {self.azimuth_deg}°{more}"


def split_key(key: str) -> tuple[str, str]:
    """Body and `View.name` of a sample's key; the whole key and "" if it does not end in a view's name."""
    match = _KEY.fullmatch(key)
    return (match[1], match[2]) if match else (key, "")


@dataclass(frozen=True)
class Drawn(Checked):
    """A range of whole numbers, both ends included, from which each view of each body draws its own, uniformly.

    Raises BadConfig for anything but whole numbers.
    """

    low: int
    high: int


Choice = tuple[int, ...] | Drawn
"""Values that a grid combines with all others, or a range that each view draws from."""


@dataclass(frozen=True)
class ViewGrid:
    """Views of a body from all combinations of distances, pitches, rolls and heights, at all azimuths.

    The defaults are the paper's 3 × 18 = 54 views, 10° apart, level and upright. The paper turns by 10° eighteen times,
    half a turn, while its results show full turns; so the span is a parameter. Pitches, rolls and heights (see `View`)
    are values of the grid, or ranges to draw from. `count` thins the grid evenly over azimuths, with the other values
    in turn. Raises BadConfig for a value out of range.
    """

    distances_cm: tuple[int, ...] = (215, 255, 295)
    azimuths: int = 18
    span_deg: int = 180
    count: int | None = None
    pitch_deg: Choice = (0,)
    roll_deg: Choice = (0,)
    height_cm: Choice = (0,)

    def __post_init__(self) -> None:
        check_fields(self)
        _check("distance_cm", self.distances_cm, _DISTANCES_CM)
        if self.azimuths < 1 or not 1 <= self.span_deg <= 360 or self.span_deg % self.azimuths:
            raise BadConfig(f"azimuths must divide 1 to 360 degrees evenly, found {self.azimuths} in {self.span_deg}")
        for name, limits in _LIMITS.items():
            _check(name, getattr(self, name), limits)
        if self.count is not None and not 1 <= self.count <= self.full:
            raise BadConfig(f"views a mesh must be between 1 and {self.full}, found {self.count}")

    @property
    def full(self) -> int:
        """Number of views in the whole grid, before thinning."""
        return len(self._rows()) * self.azimuths

    @property
    def drawn(self) -> dict[str, Drawn]:
        """The ranges that views draw from, by the field of `View`."""
        choices = ((name, getattr(self, name)) for name in _LIMITS)
        return {name: choice for name, choice in choices if isinstance(choice, Drawn)}

    @property
    def pitches_deg(self) -> tuple[int, ...]:
        """The pitches of the grid; of a range, its least, middle and greatest one."""
        if isinstance(self.pitch_deg, Drawn):
            low, high = self.pitch_deg.low, self.pitch_deg.high
            return tuple(sorted({low, (low + high) // 2, high}))
        return self.pitch_deg

    def described(self) -> list[str]:
        """All that makes these views, as text: their names, without what is drawn, and the ranges."""
        names = [view.name for view in self._fixed()]
        return names + [f"{name} {drawn.low}..{drawn.high}" for name, drawn in self.drawn.items()]

    def __len__(self) -> int:
        return self.full if self.count is None else self.count

    def __iter__(self) -> Iterator[View]:
        """The views of a body without a name; if nothing is drawn, those of every body."""
        return self.of("")

    def of(self, body: str) -> Iterator[View]:
        """The views of one body. body: its name, unique in a set.

        A draw depends on the body's name and on the values that are not drawn, not on the number of views.
        """
        for fixed in self._fixed():
            key = f"{body}-{fixed.name}"
            yield replace(fixed, **{name: _draw(drawn, key, f"view {name}") for name, drawn in self.drawn.items()})

    def _fixed(self) -> Iterator[View]:
        """The views, with 0 for what is drawn."""
        step = self.span_deg // self.azimuths
        rows = self._rows()
        for index in range(len(self)):
            distance, pitch, roll, height = rows[index % len(rows)]
            yield View(distance, index * self.azimuths // len(self) * step, pitch, roll, height)

    def _rows(self) -> list[tuple[int, int, int, int]]:
        """All combinations, in an order whose every beginning has each value about equally often; 0: what is drawn."""
        rows: list[tuple[int, ...]] = [(distance,) for distance in self.distances_cm]
        for name in _LIMITS:
            choice = getattr(self, name)
            values = (0,) if isinstance(choice, Drawn) else choice
            # Rows and values advance together; where they would repeat, values skip one.
            period, count = math.lcm(len(rows), len(values)), len(rows) * len(values)
            rows = [(*rows[n % len(rows)], values[(n + n // period) % len(values)]) for n in range(count)]
        return [(distance, pitch, roll, height) for distance, pitch, roll, height in rows]


def _draw(drawn: Drawn, key: str, purpose: str) -> int:
    return drawn.low + int(Draws(0, 0, key).chance(purpose) * (drawn.high - drawn.low + 1))


def _check(name: str, choice: Choice, limits: tuple[int, int]) -> None:
    """Raise BadConfig for values of a view that are out of range, or for an empty range."""
    (what, _, unit), (low, high) = name.partition("_"), limits
    unit = unit.replace("deg", "degrees")
    values = (choice.low, choice.high) if isinstance(choice, Drawn) else choice
    if not values or any(not low <= value <= high for value in values):
        raise BadConfig(f"a view's {what} must be between {low} and {high} {unit}, found {list(values)}")
    if isinstance(choice, Drawn):
        if choice.low >= choice.high:
            raise BadConfig(f"a range of {what} must go up, found {choice.low}..{choice.high}")
    elif len(set(choice)) != len(choice):
        raise BadConfig(f"each {what} of views must be given once, found {list(choice)}")


def parse_choice(words: Sequence[str], flag: str) -> Choice:
    """Parse whole numbers like "0", "-15" as values of a grid, or one word like "-30..10" as a range to draw from.

    flag: its name in messages. Raises BadConfig for other words.
    """
    if len(words) == 1 and (ends := _RANGE.fullmatch(words[0])):
        return Drawn(int(ends[1]), int(ends[2]))
    if not all(_WHOLE.fullmatch(word) for word in words):
        found = " ".join(words)[:60]
        raise BadConfig(f"{flag} takes whole numbers, or one range like -30..10, found {found!r}")
    return tuple(int(word) for word in words)
