"""The dataset card of a set, README.md: a YAML header as Hugging Face's hub reads it, and a page for people."""

import json
from collections.abc import Iterable, Sequence
from typing import Final

from benches.cards.facts import (
    MEMBERS,
    UNKNOWN_LICENCE,
    Publication,
    SetFacts,
    bodies_text,
    camera,
    limits_text,
    summary_text,
    terms_text,
)
from bodyseg_data.labels import PARTS, Classes
from bodyseg_data.shards import CODECS, FACING_FROM_RANGE

_HUB_LICENCES: Final = frozenset(
    {"apache-2.0", "mit", "cc0-1.0", "cc-by-4.0", "cc-by-sa-4.0", "cc-by-nc-4.0", "cc-by-nc-sa-4.0", "cc-by-nd-4.0"}
)
"""Licences that the hub knows by these names; others are given as `other` with a name."""

DIGEST_FIELD: Final = "bodyseg_manifest"
"""Entry of the header: the digest of the manifest that the card describes."""

_SIZE_CLASSES: Final = (
    (10**3, "n<1K"), (10**4, "1K<n<10K"), (10**5, "10K<n<100K"), (10**6, "100K<n<1M"), (10**7, "1M<n<10M"),
    (10**8, "10M<n<100M"),
)  # fmt: skip

_FACING: Final = (
    "found from the range images: on bodies, 0.9 % of these bits differ from those of exact rays, and 0.6 % of the "
    "pixels are lit or dark by mistake"
)


def dataset_card(facts: SetFacts, publication: Publication) -> str:
    """Return the text of a set's README.md."""
    parts = [_header(facts, publication), f"# {publication.title}", summary_text(facts)]
    if facts.of_bodies:
        parts += ["## Who the bodies are", bullets(bodies_text(facts))]
    parts += [_made(facts), _splits(facts)]
    if facts.fields:
        parts.append("## Fields\n\n" + table(("field", "values"), [*facts.fields.items()]))
    parts += [_reading(facts), _part_labels() if facts.of_bodies else _labels(facts.manifest.classes)]
    parts += ["## Limits", bullets(limits_text(facts)), "## Licences", _licences(facts, publication)]
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
        *(f"- {tag}" for tag in ("webdataset", "depth", "range-image")),
        *(["- body-part-segmentation"] if facts.of_bodies else []),
        "size_categories:",
        f"- {size_class(facts.samples)}",
        "configs:",
        "- config_name: default",
        "  data_files:",
    ]
    for split in facts.splits:
        lines += [f"  - split: {split}", f"    path: {split}-?????.tar"]
    return "\n".join([*lines, f"{DIGEST_FIELD}: {facts.manifest.digest}", "---"])


def _made(facts: SetFacts) -> str:
    rig = facts.manifest.rig
    view = [f"{name.replace('_', ' ')}: {low} to {high}" for name, (low, high) in facts.views.items() if low or high]
    rows = [
        ("rendered by", f"`{facts.manifest.renderer}`"),
        *([("facing", _FACING)] if facts.manifest.renderer == FACING_FROM_RANGE else []),
        ("rig", f"`{rig.name}`, made for a distance of {rig.stand_off_m:g} m, baseline {rig.baseline_m:g} m"),
        ("camera", camera(rig.camera)),
        *(("projector", camera(projector)) for projector in rig.projectors),
        *(
            [("further rigs", f"{len(facts.manifest.rigs) - 1}, like this one but for their lenses and places")]
            if len(facts.manifest.rigs) > 1
            else []
        ),
        ("step of stored range", f"{rig.range_step_mm:g} mm"),
        *([("views", "; ".join(view))] if view else []),
        ("format", f"{facts.manifest.read_as}, codec `{facts.manifest.codec}`"),
        ("digest of the manifest", f"`{facts.manifest.digest}`"),
    ]
    return "## How it was made\n\n" + table(("", ""), rows)


def _splits(facts: SetFacts) -> str:
    rows = []
    for split, counts in facts.splits.items():
        subsets = ", ".join(f"{subset} {samples}" for subset, samples in counts.samples_by_subset.items())
        of_bodies = (str(counts.bodies), str(counts.subjects), subsets) if facts.of_bodies else ()
        rows.append((split, str(counts.samples), *of_bodies, f"{counts.shards}, {counts.size / 1e6:.1f} MB"))
    heads = ("bodies", "people", "samples by subset") if facts.of_bodies else ()
    return "## Splits\n\n" + table(("split", "samples", *heads, "shards"), rows)


def _reading(facts: SetFacts) -> str:
    members = [(f"`NAME.{member}`", MEMBERS[member]) for member in (*CODECS[facts.manifest.codec].members, "json")]
    members += [(f"`NAME.plane.{name}.*`", f"the plane `{name}`, whole numbers") for name in facts.manifest.planes]
    files = ", ".join(f'"{split}": "{split}-?????.tar"' for split in facts.splits)
    options = f'variant="{facts.variants[-1]}", split="{next(iter(facts.splits))}"'
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
            f'images = RangeImages("FOLDER OR ADDRESS", {options})',
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


def _labels(classes: Classes) -> str:
    rows = [
        (str(label), each.name, each.within or "", each.mirror or "itself")
        for label, each in enumerate(classes.entries)
    ]
    return (
        f"## Labels\n\nThe classes `{classes.name}`. 254 is a surface without a class; 255 means that nothing was "
        "measured.\n\n" + table(("label", "class", "part of", "mirror image"), rows)
    )


def _part_labels() -> str:
    rows = [(str(part.label), part.landmark, part.location, part.side) for part in PARTS]
    return (
        "## Labels\n\nA part is the surface nearest to one landmark; sides are the subject's own. 255 is background."
        "\n\n" + table(("label", "landmark", "place", "side"), rows)
    )


def _licences(facts: SetFacts, publication: Publication) -> str:
    stated = "not stated" if publication.licence == UNKNOWN_LICENCE else publication.licence
    by = f", published by {publication.author}" if publication.author else ""
    lines = [f"this set: {stated}{by}, {publication.published.isoformat()}", *terms_text(facts)]
    return bullets(lines)


def licence_lines(licence: str) -> list[str]:
    """Return the lines of a YAML header that state a licence."""
    if licence == UNKNOWN_LICENCE or licence.lower() in _HUB_LICENCES:
        return [f"license: {licence.lower()}"]
    return ["license: other", f"license_name: {json.dumps(licence)}"]


def bullets(lines: Iterable[str]) -> str:
    """Return a list, one line each."""
    return "\n".join(f"- {line}" for line in lines)


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table; a bar within a cell becomes a slash, and <none> is no tag, which would not be shown."""
    cells = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(map(_cell, row))} |" for row in cells)


def _cell(text: str) -> str:
    shown = text.replace("|", "/")
    return shown if "`" in text else shown.replace("<", "&lt;").replace("*", "\\*")
