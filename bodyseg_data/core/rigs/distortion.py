"""Lens distortion by the Brown-Conrady model, with OpenCV's coefficients in OpenCV's order.

D. C. Brown, "Decentering distortion of lenses", Photogrammetric Engineering 32(3), 1966; the form is that of OpenCV's
`calibrateCamera` with five coefficients (https://docs.opencv.org/4.x/d9/d0c/group__calib3d.html). For a point (x, y, 1)
of the camera's frame and r^2 = x^2 + y^2, the lens draws it at

    x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)
    y' = y (1 + k1 r^2 + k2 r^4 + k3 r^6) + p1 (r^2 + 2 y^2) + 2 p2 x y
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadConfig, check_fields
from bodyseg_data.core.tables import Table

MODEL: Final = "brown_conrady"

_LARGEST: Final = 1e6

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Distortion:
    """Coefficients of the model, without unit: radial k1, k2, k3, tangential p1, p2. Raises BadConfig beyond 1e6."""

    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0

    def __post_init__(self) -> None:
        check_fields(self)
        for name, value in asdict(self).items():
            if not abs(value) <= _LARGEST:
                raise BadConfig(f"a coefficient of distortion must be at most {_LARGEST:g}, found {name} = {value:g}")

    def apply(self, x: Floats, y: Floats) -> tuple[Floats, Floats]:
        """Return where the lens draws directions (x, y, 1), at z = 1; all float64 of one shape."""
        squared = x * x + y * y
        radial = 1 + squared * (self.k1 + squared * (self.k2 + squared * self.k3))
        return (
            x * radial + 2 * self.p1 * x * y + self.p2 * (squared + 2 * x * x),
            y * radial + self.p1 * (squared + 2 * y * y) + 2 * self.p2 * x * y,
        )

    def is_one_to_one(self, x: Floats, y: Floats) -> bool:
        """True if the lens keeps the order of neighbouring directions (x, y, 1) everywhere in a lattice.

        That is where the derivative of `apply`, a matrix of two by two, has a positive determinant and trace.
        """
        with np.errstate(over="ignore", invalid="ignore"):
            squared = x * x + y * y
            radial = 1 + squared * (self.k1 + squared * (self.k2 + squared * self.k3))
            growth = 2 * (self.k1 + squared * (2 * self.k2 + squared * 3 * self.k3))  # of radial, along x by x
            mixed = x * y * growth + 2 * (self.p1 * x + self.p2 * y)
            along_x = radial + x * x * growth + 2 * self.p1 * y + 6 * self.p2 * x
            along_y = radial + y * y * growth + 6 * self.p1 * y + 2 * self.p2 * x
            determinant, trace = along_x * along_y - mixed * mixed, along_x + along_y
        return bool(((determinant > 0) & (trace > 0)).all())

    def to_json(self) -> dict[str, Any]:
        """Model and coefficients as plain JSON, as in a rig file."""
        return {"model": MODEL, **asdict(self)}


def distortion_from_table(table: Table) -> Distortion:
    """Read what `Distortion.to_json` gives; a coefficient that is left out is 0. Raises BadConfig."""
    model = table.text("model")
    if model != MODEL:
        raise BadConfig(f"{table.where}: 'model' must be {MODEL!r}, found {model!r}")
    names = Distortion.__dataclass_fields__
    coefficients = {name: table.number(name) for name in names if table.has(name)}
    table.finish()
    try:
        return Distortion(**coefficients)
    except BadConfig as error:
        raise BadConfig(f"{table.where}: {error}") from None
