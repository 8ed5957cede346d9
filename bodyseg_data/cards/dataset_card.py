"""The dataset card of a set, README.md: a YAML header as Hugging Face's hub reads it, and a page for people."""

from __future__ import annotations

import json
from typing import Final

from bodyseg_data.cards import texts
from bodyseg_data.cards.markdown import bullets, licence_lines, table
from bodyseg_data.cards.set_facts import SetFacts
from bodyseg_data.cards.texts import UNKNOWN_LICENCE, Publication, camera
from bodyseg_data.core.parts import PARTS
from bodyseg_data.shards.codecs import CODECS

CARD_NAME: Final = "README.md"

DIGEST_FIELD: Final = "bodyseg_manifest"
"""Entry of the header: the digest of the manifest that the card describes."""

_SIZE_CLASSES: Final = (
    (10**3, "n<1K"),
    (10**4, "1K<n<10K"),
    (10**5, "10K<n<100K"),
    (10**6, "100K<n<1M"),
    (10**7, "1M<n<10M"),
    (10**8, "10M<n<100M"),
)


def dataset_card(facts: SetFacts, publication: Publication) -> str:
    """Return the text of a set's README.md."""
    parts = [_header(facts, publication), f"# {publication.title}", texts.summary(facts)]
    parts += ["## Who the bodies are", bullets(texts.bodies(facts))]
    parts += [_made(facts), _splits(facts), _reading(facts), _labels()]
    limits = [texts.people(facts), *texts.LIMITS]
    parts += ["## Limits", bullets(limits), "## Licences", _licences(facts, publication)]
    if facts.notes:
        parts += ["## Notes on meshes", f"{len(facts.notes)} notes, listed by `bodyseg verify`."]
    return "\n\n".join(parts) + "\n"


def size_class(samples: int) -> str:
    """Return the hub's name of a number of samples."""
    return next((name for limit, name in _SIZE_CLASSES if samples < limit), "n>100M")


def _header(facts: SetFacts, publication: Publication) -> str:
    lines = [
        "---",
        f"pretty_name: {json.dumps(publication.title)}",
        *licence_lines(publication.licence),
        "task_categories:",
        "- image-segmentation",
        "tags:",
        *(f"- {tag}" for tag in ("webdataset", "depth", "range-image", "body-part-segmentation")),
        "size_categories:",
        f"- {size_class(facts.samples)}",
        "configs:",
        "- config_name: default",
        "  data_files:",
    ]
    for split in facts.splits:
        lines += [f"  - split: {split}", f"    path: {split}-*.tar"]
    return "\n".join([*lines, f"{DIGEST_FIELD}: {facts.digest}", "---"])


def _made(facts: SetFacts) -> str:
    rig = facts.rig
    view = [f"{name.replace('_', ' ')}: {low} to {high}" for name, (low, high) in facts.views.items() if low or high]
    rows = [
        ("rendered by", f"`{facts.renderer}`"),
        ("rig", f"`{rig.name}`, made for a distance of {rig.stand_off_m:g} m, baseline {rig.baseline_m:g} m"),
        ("camera", camera(rig.camera)),
        *(("projector", camera(projector)) for projector in rig.projectors),
        ("step of stored range", f"{rig.range_step_mm:g} mm"),
        ("views", "; ".join(view)),
        ("format", f"{facts.format}, codec `{facts.codec}`"),
        ("digest of the manifest", f"`{facts.digest}`"),
    ]
    return "## How it was made\n\n" + table(("", ""), rows)


def _splits(facts: SetFacts) -> str:
    rows = [
        (
            split,
            str(counts.samples),
            str(counts.bodies),
            str(counts.subjects),
            ", ".join(f"{subset} {samples}" for subset, samples in counts.samples_by_subset.items()),
            f"{counts.shards}, {counts.size / 1e6:.1f} MB",
        )
        for split, counts in facts.splits.items()
    ]
    return "## Splits\n\n" + table(("split", "samples", "bodies", "people", "samples by subset", "shards"), rows)


def _reading(facts: SetFacts) -> str:
    members = [(f"`NAME.{member}`", texts.MEMBERS[member]) for member in (*CODECS[facts.codec].members, "json")]
    files = ", ".join(f'"{split}": "{split}-*.tar"' for split in facts.splits)
    return "\n".join(
        [
            "## Reading",
            "",
            table(("member of a shard", "content"), members),
            "",
            "By the package that made it, with artifacts, every byte checked (`pip install bodyseg`):",
            "",
            "```python",
            "from bodyseg_data import RangeImages",
            "",
            'images = RangeImages("FOLDER OR ADDRESS", variant="all", split="train")',
            "```",
            "",
            "By Hugging Face's `datasets`, as stored, from the folder of the shards:",
            "",
            "```python",
            "from datasets import load_dataset",
            "",
            f'samples = load_dataset("webdataset", data_files={{{files}}}, streaming=True)',
            "```",
            "",
            "`croissant.json` describes the same files to readers of Croissant.",
        ]
    )


def _labels() -> str:
    rows = [(str(part.label), part.landmark, part.location, part.side) for part in PARTS]
    return (
        "## Labels\n\nA part is the surface nearest to one landmark; sides are the subject's own. 255 is background."
        "\n\n" + table(("label", "landmark", "place", "side"), rows)
    )


def _licences(facts: SetFacts, publication: Publication) -> str:
    stated = "not stated" if publication.licence == UNKNOWN_LICENCE else publication.licence
    by = f", published by {publication.author}" if publication.author else ""
    lines = [f"this set: {stated}{by}, {publication.published.isoformat()}", *texts.terms(facts)]
    return bullets(lines)
