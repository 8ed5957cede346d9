"""`bench shuffles`: what a network loses where its training reads samples by blocks."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

from benches.measuring import counter
from bodyseg_data.commands import provenance
from bodyseg_data.core import ProgressCallback, silent
from bodyseg_data.files import last_name
from bodyseg_data.loading import BodyCrop, RangeImages
from bodyseg_model.evaluation import evaluate, over_seeds
from bodyseg_model.networks import build
from bodyseg_model.training import GeometricAugmentation, Recipe, RunOptions, recipe_for, train

ORDERS: Final = ("global", "blocks")
STEPS: Final = 240
SETTINGS: Final[dict[str, Any]] = {"patch": 4, "widths": [48, 64, 96], "blocks": [1, 1, 1]}
WINDOW: Final = BodyCrop(96, 64)
"""Images of bodies are small, and so is the network, so that many trainings take minutes of one processor."""


def bench_shuffles(
    data: str, seeds: int = 3, steps: int = STEPS, images: int = 500, progress: ProgressCallback = silent
) -> dict[str, Any]:
    """Train a small `compact` of each order and seed on `all`, and evaluate it on test images of `all`.

    data: folder or address of a set; blocks mix 1024 samples, so that its train split should have several times as
    many. seeds, steps: trainings of each order, and steps of each, alike in all but the order. images: test images.
    accuracy, pixel_accuracy: per class and of pixels, over the seeds. over_global: the accuracy less that of the
    training of the same seed in the global order. Raises BadConfig, and as training does.
    """
    found: dict[str, list[tuple[float, float]]] = {order: [] for order in ORDERS}
    tick = counter(progress, len(ORDERS) * seeds)
    for seed in range(seeds):
        test_images = RangeImages(data, "all", "test", transform=WINDOW)
        for order in ORDERS:
            with TemporaryDirectory(prefix="bodyseg-shuffles-") as folder:
                found[order].append(_trained(data, order, seed, steps, Path(folder), test_images, images))
            tick()
    manifest = test_images.manifest
    return {
        "data": last_name(data),
        "train_images": manifest.samples("train"),
        "test_images": min(images, len(test_images)),
        "seeds": seeds,
        "image": [WINDOW.rows, WINDOW.columns],
        "network": {"name": "compact", "settings": SETTINGS},
        "recipe": _recipe(steps, "global").to_json(),
        "orders": {
            order: {
                "accuracy": over_seeds([per_class for per_class, _ in scores]),
                "pixel_accuracy": over_seeds([of_pixels for _, of_pixels in scores]),
                "over_global": over_seeds(
                    [one[0] - base[0] for one, base in zip(scores, found["global"], strict=True)]
                ),
            }
            for order, scores in found.items()
        },
    }


def _recipe(steps: int, shuffle: str) -> Recipe:
    plain: dict[str, Any] = {"bf16": False, "mirror": False, "geometric_augmentation": GeometricAugmentation()}
    return recipe_for("compact", steps=steps, learning_rate=4e-3, shuffle=shuffle, **plain)


def _trained(
    data: str, order: str, seed: int, steps: int, folder: Path, test_images: RangeImages, count: int
) -> tuple[float, float]:
    options = RunOptions(log_every=100, checkpoint_every=steps, num_workers=1)
    facts = provenance("tools/bench shuffles")
    images = RangeImages(data, "all", "train", seed, transform=WINDOW)
    network = build("compact", SETTINGS, seed)
    recipe = _recipe(steps, order)
    trained = train(images, folder / "run", network, recipe, seed=seed, run_options=options, facts=facts)
    confusion = evaluate(trained.network, test_images, count, confidences=False).total().confusion
    return confusion.average_per_class_accuracy(), confusion.pixel_accuracy()
