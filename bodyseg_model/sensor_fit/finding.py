"""Results of the measurements: a verdict for each artifact, with the figures behind it."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final, Literal

Verdict = Literal["needed", "not seen", "cannot be told"]

NEEDED: Final[Verdict] = "needed"
NOT_SEEN: Final[Verdict] = "not seen"
UNKNOWN: Final[Verdict] = "cannot be told"


@dataclass(frozen=True)
class Estimate:
    """A figure and its standard error, in the figure's own unit; NaN where no error is known."""

    value: float
    error: float = math.nan

    def __str__(self) -> str:
        return f"{self.value:.3g}" + (f" ± {self.error:.2g}" if math.isfinite(self.error) else "")

    def to_json(self) -> dict[str, float | None]:
        """Value and error as plain JSON, null where the error is not known."""
        return {"value": self.value, "error": self.error if math.isfinite(self.error) else None}


@dataclass(frozen=True)
class Finding:
    """The measurement of one artifact.

    artifact: its name in the registry. reason: the figures behind the verdict, one line. estimates: figures by name,
    with their units in the names. strengths: of the artifact where it is needed, else none.
    """

    artifact: str
    verdict: Verdict
    reason: str
    estimates: Mapping[str, Estimate] = field(default_factory=dict)
    strengths: Mapping[str, Any] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """Everything measured as plain JSON."""
        estimates = {name: estimate.to_json() for name, estimate in self.estimates.items()}
        return {**vars(self), "estimates": estimates, "strengths": dict(self.strengths)}


def rounded(value: float) -> float:
    """A figure to three significant digits, for strengths in files."""
    return float(f"{value:.3g}")
