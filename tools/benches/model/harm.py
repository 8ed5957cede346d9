"""`bench harm`: what each artifact costs networks that were not trained with it, on test images that have it alone.

An artifact that costs such networks nothing cannot be learned to anybody's gain on rendered images: no training is
needed to tell that it is more than a scene needs.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from benches.measuring import counter
from benches.model.ablation.conditions import AblationCondition
from benches.model.ablation.costs import loading_ms
from benches.model.chosen import chosen_network
from benches.model.variants.verdicts import paired
from bodyseg_data.artifacts import (
    Artifact,
    MissingData,
    MixedPixels,
    Noise,
    PatchLoss,
    SensorModel,
    StripeLoss,
    load_sensor_model,
)
from bodyseg_data.core import ProgressCallback, silent
from bodyseg_data.loading import RangeImages
from bodyseg_model.evaluation import evaluate
from bodyseg_model.networks import find_device

ARTIFACTS: Final[dict[str, Artifact]] = {
    "noise of one sigma": Noise(0.0, 20.0),
    "mixed pixels": MixedPixels(0.5, 4.0),
    "pixels lost by themselves": MissingData((0.0, 0.05, 0.5)),
    "patches lost": PatchLoss(0.0, 0.4),
    "stripes lost": StripeLoss(0.0, 0.4),
    "phase shifting": next(each for each in load_sensor_model("paper_phase_shift") if each.name == "phase_shift"),
}
"""In words -> the artifact, as strong as on sensors that have it."""
SENSORS: Final = ("kinect_v1", "realsense_d435", "azure_kinect", "paper_phase_shift")
_NONE: Final = "none"


def bench_harm(
    data: str, runs: Sequence[Path] = (), images: int = 100, progress: ProgressCallback = silent
) -> dict[str, Any]:
    """Evaluate networks on the first test images of a set without artifacts, then with each of `ARTIFACTS` alone, then
    with all artifacts of each of `SENSORS`.

    data: folder or address of a set. runs: trainings NAME-SEED, one row for each NAME, beside the shipped network.
    lost: points of average per-class accuracy less than without artifacts, over the seeds. ms: processor
    time of a sample in the loader. Raises BadConfig, and as `load_network`.
    """
    device = find_device()
    rows: dict[str, dict[int, Any]] = {}
    for name, trained in [chosen_network(), *(chosen_network([run]) for run in runs)]:
        row, _, number = name.rpartition("-")
        rows.setdefault(row or name, {})[int(number) if row else 0] = trained.network.to(device)
    shown = {_NONE: SensorModel(_NONE, ())}
    shown |= {title: SensorModel(artifact.name, (artifact,)) for title, artifact in ARTIFACTS.items()}
    shown |= {f"all of {name}": load_sensor_model(name) for name in SENSORS}
    tick = counter(progress, len(shown) * sum(map(len, rows.values())))
    found: dict[str, dict[str, dict[int, float]]] = {}
    for title, sensor in shown.items():  # the outer loop, so that every set of test images is opened once
        tested = AblationCondition("all", label=title, sensor=sensor).open(data)
        for name, networks in rows.items():
            for seed, network in networks.items():
                judged = evaluate(network, tested, images, confidences=False, batch_size=1).total().confusion
                found.setdefault(title, {}).setdefault(name, {})[seed] = judged.average_per_class_accuracy()
                tick()
    clean = found.pop(_NONE)
    lost = {what: {row: paired(clean[row], scores[row]) for row in rows} for what, scores in found.items()}
    cost = loading_ms({title: RangeImages(data, "all", "train", sensor=sensor) for title, sensor in shown.items()})
    return {
        "test_images": min(images, len(tested)),
        "artifacts": [
            {"what": title, "lost": points, "ms": round(cost[title]["ms"] - cost[_NONE]["ms"], 3)}
            for title, points in lost.items()
        ],
    }
