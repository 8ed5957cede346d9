"""`bench sensor_fit`: how near `bodyseg sensor fit` comes to the known artifacts of simulated recordings."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

from benches.measuring import counter, evenly_spaced
from benches.model.sensor_fit.recordings import Scene, Scenes, in_steps
from bodyseg_data.artifacts import SensorModel, artifact_class
from bodyseg_data.bodies import open_source
from bodyseg_data.core import ProgressCallback, silent
from bodyseg_data.rigs import Rig, load_rig
from bodyseg_model.recordings import FrameCamera
from bodyseg_model.sensor_fit import fit_sensor
from bodyseg_model.sensor_fit.finding import NEEDED, Finding

RIG: Final = "kinect_v1"
STEP_MM: Final = 0.1
"""Step of the recordings' ranges: finer than the rig's own, so that only cases about rounding have much of it."""

WITHIN: Final = 0.1
"""Greatest relative error of a strength that counts as found."""


@dataclass(frozen=True)
class Case:
    """A sensor with known strengths. given: artifact -> its strengths. wanted: (artifact, figure) -> true value, of a
    finding's estimates. baseline_m: of the rig; None for the rig's own. wall: whether a wall stands behind the body.
    step_mm: to whose multiples stored ranges are rounded; None for `STEP_MM`.
    """

    name: str
    given: Mapping[str, Mapping[str, Any]]
    wanted: Mapping[tuple[str, str], float]
    wall: bool = False
    baseline_m: float | None = None
    step_mm: float | None = None

    def sensor(self) -> SensorModel:
        """The sensor model that makes the recording."""
        return SensorModel("known", tuple(artifact_class(name)(**values) for name, values in self.given.items()))


def all_cases() -> list[Case]:
    """Every artifact at two strengths or more, and all of them together."""
    cases = [Case(f"noise {each:g} mm", _noise(each), {("noise", "sigma_mm"): each}) for each in (1.0, 3.0, 15.0)]
    for sigma, step in ((3.0, 8.0), (1.0, 8.0)):
        wanted = {("noise", "sigma_mm"): math.hypot(sigma, step / math.sqrt(12))}
        cases.append(Case(f"noise {sigma:g} mm, steps of {step:g} mm", _noise(sigma), wanted, step_mm=step))
    for share in (0.3, 0.8):
        given: dict[str, dict[str, Any]] = {"mixed_pixels": {"share": share, "background_m": None}}
        cases.append(Case(f"mixed {share:.0%}", given, {("mixed_pixels", "share"): share}, wall=True))
    for share in (0.05, 0.4):
        given = {"missing_data": {"rates": (share,)}}
        cases.append(Case(f"random {share:.0%}", given, {("missing_data", "share"): share}))
    for share in (0.05, 0.2):
        both = {"low": share, "high": share}
        cases.append(Case(f"patches {share:.0%}", {"patch_loss": both}, {("patch_loss", "share"): share}))
    for along in ("rows", "columns"):
        given = {"stripe_loss": {"low": 0.1, "high": 0.1, "along": along}}
        cases.append(Case(f"stripes in {along} 10%", given, {("stripe_loss", "share"): 0.1}))
    for baseline in (0.075, 0.2):
        wanted = {("occlusion", "baseline_m"): baseline}
        cases.append(Case(f"shadow {baseline:g} m", {"occlusion": {}}, wanted, wall=True, baseline_m=baseline))
    return [Case("nothing", {}, {}), *cases]


def _noise(sigma_mm: float) -> dict[str, dict[str, Any]]:
    return {"noise": {"low_mm": sigma_mm, "high_mm": sigma_mm}}


SCENES: Final = (Scene(1), Scene(4), Scene(12), Scene(8, moving=True))


def bench_sensor_fit(views: int = 1, progress: ProgressCallback = silent) -> dict[str, Any]:
    """Fit every case in every scene.

    views: bodies of the open set. Returns, a case and scene, each wanted figure's true and found values, its relative
    error (None where the artifact was not found), and which other artifacts were said to be needed. Raises
    MissingLibrary without Anny.
    """
    rig = replace(load_rig(RIG), range_step_mm=STEP_MM)
    cases = all_cases()
    source = open_source("open")
    bodies = evenly_spaced([body for body in source.bodies() if body.split == "test"], views)
    rows: list[dict[str, Any]] = []
    advance = counter(progress, len(bodies) * len(cases) * len(SCENES))
    for body in bodies:
        scenes = Scenes(source.build(body), rig)
        for case, scene in itertools.product(cases, SCENES):
            rows.append({"body": body.mesh, **measure(case, scene, scenes, rig)})
            advance()
        scenes.close()
    return {"rig": RIG, "range_step_mm": STEP_MM, "within": WITHIN, "rows": rows, "summary": summarise(rows)}


def measure(case: Case, scene: Scene, scenes: Scenes, rig: Rig) -> dict[str, Any]:
    """One recording of a case, fitted: its figures."""
    used = rig if case.baseline_m is None else _with_baseline(rig, case.baseline_m)
    scene = replace(scene, wall=case.wall)
    recording = scenes.record(scene, case.sensor(), None if case.baseline_m is None else used)
    recording = recording if case.step_mm is None else in_steps(recording, case.step_mm)
    fit = fit_sensor(recording, FrameCamera(used.camera, "known", rig=used))
    found = {finding.artifact: finding for finding in fit.findings}
    figures = [_figure(found[artifact], name, true) for (artifact, name), true in case.wanted.items()]
    others = [each.artifact for each in fit.findings if each.verdict == NEEDED and each.artifact not in case.given]
    return {
        "case": case.name,
        "scene": str(scene),
        "figures": figures,
        "verdicts": {artifact: found[artifact].verdict for artifact in case.given},
        "others_needed": others,
    }


def _figure(finding: Finding, name: str, true: float) -> dict[str, Any]:
    estimate = finding.estimates.get(name)
    value = None if estimate is None or finding.verdict != NEEDED else round(float(estimate.value), 6)
    error = None if value is None else round(value / true - 1, 4)
    return {"artifact": finding.artifact, "figure": name, "true": round(true, 6), "found": value, "error": error}


def summarise(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """By scene: the share of figures within `WITHIN`, those found beyond it, those not found, and false alarms."""
    summary = {}
    for scene in dict.fromkeys(row["scene"] for row in rows):
        chosen = [row for row in rows if row["scene"] == scene]
        errors = [figure["error"] for row in chosen for figure in row["figures"]]
        known = [abs(error) for error in errors if error is not None]
        summary[scene] = {
            "figures": len(errors),
            "within": sum(error <= WITHIN for error in known),
            "beyond": sum(error > WITHIN for error in known),
            "not_found": len(errors) - len(known),
            "others_needed": sum(len(row["others_needed"]) for row in chosen),
        }
    return summary


def _with_baseline(rig: Rig, baseline_m: float) -> Rig:
    projector = replace(
        rig.projector, position_m=(baseline_m, 0.0, 0.0), aims_at_m=(baseline_m, 0.0, rig.projector.aims_at_m[2])
    )
    return replace(rig, projector=projector)
