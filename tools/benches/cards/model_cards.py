"""The page of a network for people, from its card: purpose, data, training, scores, limits."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from benches.cards.dataset_cards import bullets, licence_lines, table
from benches.cards.facts import UNKNOWN_LICENCE, Publication
from bodyseg_model.networks import CardWords, confusion_file
from bodyseg_model.networks.checkpoints import read_card

_SCORES: Final = {
    "average_per_class_accuracy": "average per-class accuracy",
    "pixel_accuracy": "pixels right",
    "mean_iou": "mean IoU",
    "ece": "calibration error",
}
_LIMITS: Final = (
    "It labels one person a view, at distances like those it was trained on; `bodyseg segment` cuts such views from "
    "frames.",
    "It gives every pixel of a body a label, also pixels of clothes, hair and things that it has never seen.",
    "Measure it on your own sensor before anything depends on it; not for medical use, safety, or recognising people.",
)


def model_card(weights: Path, publication: Publication) -> str:
    """Return the page of the network in `weights` (.safetensors), read from the card beside it. Raises BadConfig."""
    card = read_card(weights)
    scores = card.get("scores")
    labels = card.get("labels")
    of_parts = not (isinstance(labels, dict) and "of" in labels)
    what = "of a person in a range image with body parts" if of_parts else f"of a range image as {_named(labels)}"
    parts = [
        _header(publication, of_parts),
        f"# {publication.title}",
        f"Labels the pixels {what}. The package `bodyseg` made it and runs it: `bodyseg segment --run {weights.name}`.",
        "## Network\n\n" + table(("", ""), _network(card, weights)),
        "## Training\n\n" + table(("", ""), _training(card)),
        "## Scores\n\n" + _scores(scores if isinstance(scores, dict) else {}, weights),
        "## Limits\n\n" + bullets(_LIMITS if of_parts else _LIMITS[2:]),
        "## Licence\n\n" + _licence(publication),
    ]
    return "\n\n".join(parts) + "\n"


def _header(publication: Publication, of_parts: bool) -> str:
    lines = ["---", *licence_lines(publication.licence), "library_name: bodyseg", "pipeline_tag: image-segmentation"]
    tags = [f"- {tag}" for tag in ("depth", "range-image", *(["body-part-segmentation"] if of_parts else []))]
    return "\n".join([*lines, "tags:", *tags, "---"])


def _network(card: Mapping[str, Any], weights: Path) -> list[tuple[str, str]]:
    labels, rig = card.get("labels"), card.get("rig")
    return [
        ("architecture", f"`{card.get('network')}`, {_plain(card.get('settings'))}"),
        ("file", f"`{weights.name}`, {weights.stat().st_size / 1e6:.2f} MB"),
        ("SHA-256", f"`{card.get(CardWords.WEIGHTS_SHA256, 'not stated')}`"),
        ("classes", _named(labels) if labels else "the 33 parts"),
        ("rig of its images", _named(rig) if rig else "paper"),
    ]


def _training(card: Mapping[str, Any]) -> list[tuple[str, str]]:
    sensor = card.get("sensor")
    rows = {
        "variant": card.get("variant"),
        "sensor": _named(sensor) if sensor else "paper",
        "seed": card.get("seed"),
        "step": card.get("step"),
        "recipe": card.get("recipe"),
        **_data(card.get("data")),
        "started from": card.get(CardWords.PRETRAINED),
        "command": card.get("command"),
        "commit": card.get("commit"),
        "machine": card.get("hardware"),
    }
    return [(name, _plain(value)) for name, value in rows.items() if value is not None]


def _data(data: Any) -> dict[str, Any]:
    """One row for each set that the network was trained on."""
    tree = data if isinstance(data, dict) else {}
    sets = [each for turn in tree.get("turns", [tree] if tree else []) for each in turn.get("mixture", [turn])]
    return {f"set {number}" if len(sets) > 1 else "set": entry for number, entry in enumerate(sets, 1)}


def _scores(scores: Mapping[str, Any], weights: Path) -> str:
    rows = [(text, _percent(scores[name])) for name, text in _SCORES.items() if name in scores]
    if not rows:
        return "The card has none: `bodyseg evaluate --json FILE` measures, `bodyseg export --scores FILE` adds them."
    subsets = scores.get("subsets")
    if isinstance(subsets, dict):
        rows += [(f"subset {name}", _percent(_accuracy(value))) for name, value in subsets.items()]
    lines = [table((f"{scores.get('images', 'unknown number of')} images", ""), rows)]
    if "command" in scores:
        lines.append(f"Measured by `{scores['command']}`.")
    if confusion_file(weights).exists():
        lines.append(f"Confusion matrix, rows truth, columns answer, pixels: `{confusion_file(weights).name}`.")
    return "\n\n".join(lines)


def _accuracy(subset: Any) -> Any:
    return subset.get("average_per_class_accuracy") if isinstance(subset, dict) else subset


def _licence(publication: Publication) -> str:
    stated = "Not stated" if publication.licence == UNKNOWN_LICENCE else publication.licence
    by = f", published by {publication.author}" if publication.author else ""
    return f"{stated}{by}, {publication.published.isoformat()}."


def _named(entry: Any) -> str:
    return str(entry.get("name", "without a name")) if isinstance(entry, dict) else str(entry)


def _percent(value: Any) -> str:
    return f"{100 * value:.1f} %" if isinstance(value, int | float) else "undefined"


def _plain(value: Any) -> str:
    """A value of a card in words: "steps 3000, crop yes, zoom (least 0.9, most 1.1)"."""
    if isinstance(value, dict):
        entries = ((name.replace("_", " "), entry) for name, entry in value.items() if entry is not None)
        return ", ".join(
            f"{name} ({_plain(e)})" if isinstance(e, dict) else f"{name} {_plain(e)}" for name, e in entries
        )
    if isinstance(value, list):
        nested = any(isinstance(entry, dict) for entry in value)
        return f"({'; '.join(map(_plain, value))})" if nested else f"[{', '.join(map(_plain, value))}]"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return str(value)
