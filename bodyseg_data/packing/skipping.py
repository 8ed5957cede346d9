"""Meshes that cannot be packed: all are named at once, or left out, up to a budget, each of them recorded.

`find_faults` checks all files of a source before the first view is rendered.
"""

import uuid
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final, Literal

from bodyseg_data.bodies import BodyRef, collapsed
from bodyseg_data.core import BadConfig, BadLandmarks, BadMesh, BadSample, ProgressCallback, check_fields, silent
from bodyseg_data.packing.jobs import ordered
from bodyseg_data.packing.options import Packing

OnError = Literal["stop", "skip"]

SKIPPABLE: Final = (BadMesh, BadLandmarks, BadSample)
"""Errors of one mesh; all others end a packing."""

_NAMED: Final = 3


@dataclass(frozen=True)
class OnFaults:
    """Treatment of meshes that cannot be packed; no byte of the other meshes' samples depends on it.

    on_error: "stop" names all that the check finds, and renders nothing; "skip" leaves them out.
    skip_budget: the most meshes that may be left out, a number or a share of the meshes asked for (a float below 1).
    progress: called with (meshes checked, meshes in all).
    Raises BadConfig for on_error="skip" without a budget, or for a budget without it.
    """

    on_error: OnError = "stop"
    skip_budget: float | None = None
    progress: ProgressCallback = silent

    def __post_init__(self) -> None:
        check_fields(self)
        if (self.on_error == "skip") != (self.skip_budget is not None):
            raise BadConfig(f"on_error='skip' needs a skip_budget, found {self.on_error!r} and {self.skip_budget!r}")
        if (budget := self.skip_budget) is not None and not (0 <= budget < 1 or (budget >= 1 and budget % 1 == 0)):
            raise BadConfig(f"skip_budget must be a number of meshes, or a share below 1, found {self.skip_budget!r}")

    def budget(self, meshes: int) -> int:
        """The most of `meshes` that may be left out."""
        budget = self.skip_budget or 0
        return int(budget if budget >= 1 else budget * meshes * (1 + 1e-12))  # 29 for 0.29 of 100: floats have less


STOP: Final = OnFaults()


class FaultyMeshes(BadMesh):
    """Meshes that cannot be packed, or more of them than a budget permits.

    problem: how many of how many. faults: name of a mesh -> reason.
    """

    def __init__(self, problem: str, faults: Mapping[str, str]) -> None:
        self.problem, self.faults = problem, dict(faults)
        reasons = list(dict.fromkeys(self.faults.values()))
        more = f"; and {len(reasons) - _NAMED} more" if len(reasons) > _NAMED else ""
        super().__init__(f"{problem}: {'; '.join(reasons[:_NAMED])}{more}")

    def __reduce__(self) -> tuple[Any, ...]:
        return FaultyMeshes, (self.problem, self.faults)  # else its words alone, from which no process could make it

    def lines(self) -> list[str]:
        """One line for each reason, with the meshes that it holds for."""
        meshes: dict[str, list[str]] = {}
        for mesh, reason in self.faults.items():
            meshes.setdefault(reason, []).append(mesh)
        return [f"{', '.join(collapsed(names))}: {reason}" for reason, names in meshes.items()]


class SkipList:
    """The meshes that one packing leaves out. total: meshes asked for. folder: left out of the reasons' paths."""

    def __init__(self, on_faults: OnFaults, total: int, folder: Path | None) -> None:
        self._on_faults, self._total, self._folder = on_faults, total, folder
        self.reasons: dict[str, str] = {}

    @property
    def strict(self) -> bool:
        """True if no mesh may be left out."""
        return self._on_faults.on_error == "stop"

    def add(self, faults: Mapping[str, str]) -> None:
        """Leave more meshes out. Raises FaultyMeshes if none may be, or beyond the budget."""
        if not faults:
            return
        if self.strict:
            raise FaultyMeshes(f"{len(faults)} of {self._total} meshes cannot be packed", faults)
        both, budget = self.reasons | dict(faults), self._on_faults.budget(self._total)
        if len(both) > budget:
            beyond = f"{len(both)} of {self._total} meshes cannot be packed, the skip budget allows {budget}"
            raise FaultyMeshes(beyond, both)
        if len(both) == self._total:
            raise FaultyMeshes(f"none of {self._total} meshes can be packed", both)
        self.reasons |= {mesh: self._shortened(why) for mesh, why in faults.items() if mesh not in self.reasons}

    def _shortened(self, reason: str) -> str:
        if self._folder is None:
            return reason
        return reason.replace(f"{self._folder}/", "").replace(str(self._folder), "the source's folder")


def check_run(packing: Packing, body: BodyRef, plan: str) -> str | None:
    """The reason why a body cannot be packed, in whichever process, as far as its source's check tells; else None."""
    try:
        with BadConfig.named(f"the source {packing.source!r}, body {body.mesh!r}"):
            packing.opened(plan).check(body)
    except SKIPPABLE as error:
        return str(error)
    return None


def find_faults(
    packing: Packing, bodies: Sequence[BodyRef], executor: Executor, workers: int, progress: ProgressCallback
) -> dict[str, str]:
    """Name of a mesh -> why it cannot be packed, of all with faulty files. Sources without files are not checked."""
    if packing.path is None:
        return {}
    token = uuid.uuid4().hex  # files may have changed since a worker read them
    jobs = (partial(executor.submit, check_run, packing, body, token) for body in bodies)
    found: dict[str, str] = {}
    for done, (body, reason) in enumerate(zip(bodies, ordered(jobs, workers), strict=True), 1):
        if reason is not None:
            found[body.mesh] = reason
        progress(done, len(bodies))
    return found
