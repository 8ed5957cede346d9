"""The line of scores that `bodyseg evaluate` prints."""

from __future__ import annotations

from bodyseg_model.commands.evaluate import headline


def line(above: dict[str, float | None], gross_errors: dict[str, float] | None = None) -> str:
    scores = {"images": 2, "average_per_class_accuracy": 0.436, "gross_errors": gross_errors}
    return headline({**scores, "confidence": {"above_70_percent": above}})


def test_confident_pixels_are_scored_apart() -> None:
    found = line({"average_per_class_accuracy": 0.9, "share_of_pixels": 0.25})
    assert found == (
        "2 images: average per-class accuracy 43.6 %, 90.0 % where confidence is above 70 % (25.0 % of pixels)"
    )


def test_an_unsure_network_has_no_confident_pixels() -> None:
    found = line({"average_per_class_accuracy": None, "share_of_pixels": 0.0})
    assert found == "2 images: average per-class accuracy 43.6 %, no pixel with a confidence above 70 %"


def test_gross_errors_are_said_where_they_are_measured() -> None:
    found = line({"average_per_class_accuracy": None, "share_of_pixels": 0.0}, {"beyond_30_mm": 0.0512, "mean_mm": 7.0})
    assert ", 5.1 % of pixels farther than 30 mm from the part predicted for them, no pixel" in found
