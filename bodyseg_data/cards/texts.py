"""Facts that a publisher adds to cards, and sentences that both cards of a set use."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import date
from typing import Final

from bodyseg_data.artifacts.variants import VARIANTS
from bodyseg_data.cards.origins import all_made, origin_of
from bodyseg_data.cards.set_facts import SetFacts
from bodyseg_data.core.errors import BadConfig, check_fields
from bodyseg_data.core.rig import Camera

UNKNOWN_LICENCE: Final = "unknown"
"""Licence of a set whose publisher states none."""

MEMBERS: Final = {
    "bsi": "one image file of the package bodyseg: range, labels and the projector's range, without loss",
    "range.png": "camera range, 16-bit, in steps of the rig along the optical axis; 0 is background",
    "labels.png": "label bytes, 8-bit: 255 is background; else bits 0 to 5 are the part (62: a thing), bit 6 is set "
    "where the surface faces the projector",
    "projector.png": "projector's range where it casts a shadow, 16-bit, rounded as far as no shadow changes",
    "json": "description of the sample: source, subset, subject, mesh, pose, split and view",
}
"""Member of a tar -> its content."""

LIMITS: Final = (
    "Images are rendered: one person each, without materials; artifacts are models of a sensor's, added when images "
    "are read.",
    "Labels are the nearest of 33 landmarks along the surface, so borders between parts are geometric, not anatomical.",
    "Splits hold apart postures, motions and people as the paper does; two splits may show one person in two postures.",
    "Nothing here is a measurement of health; not for medical use, and not for recognising people.",
)


@dataclass(frozen=True)
class Publication:
    """Facts of a publication that no manifest knows.

    title: of the set or network. published: date of the cards. licence: an SPDX identifier, an address or a sentence;
    "unknown" where none is stated. author: who publishes it, "" where nobody is named. url: address of the folder that
    holds it, "" for a set that is read where it lies. Raises BadConfig for text that is empty or not one line.
    """

    title: str
    published: date
    licence: str = UNKNOWN_LICENCE
    author: str = ""
    url: str = ""

    def __post_init__(self) -> None:
        check_fields(self)
        for name in ("title", "licence", "author", "url"):
            text = getattr(self, name)
            if not text.isprintable() or (not text.strip() and name in ("title", "licence")):
                raise BadConfig(f"a card's {name} must be one line of text, found {text!r}")
        if self.url and not self.url.startswith(("https://", "http://")):
            raise BadConfig(f"a card's url must begin with https:// or http://, found {self.url!r}")


def summary_text(facts: SetFacts) -> str:
    """Two sentences on a set."""
    counts = " and ".join(f"{counts.samples} for {_purpose(split)}" for split, counts in facts.splits.items())
    return (
        f"Range images of people with a body part, one of 33, at each pixel: {counts}. They are stored without "
        f"artifacts; the package bodyseg makes the variants {', '.join(VARIANTS)} of them while it reads them."
    )


def bodies_text(facts: SetFacts) -> list[str]:
    """One line a source: who its bodies are."""
    return [f"{source}: {origin_of(source).bodies}" for source in facts.sources]


def terms_text(facts: SetFacts) -> list[str]:
    """One line a source: licences of the data that its bodies come from."""
    return [f"{source}: {origin_of(source).terms}" for source in facts.sources]


def people_text(facts: SetFacts) -> str:
    """One sentence: whether real people are in the set."""
    if all_made(facts.sources):
        return "Every body is made; no person was measured."
    return "Some bodies are those of real people; their shape may identify them."


def camera(device: Camera) -> str:
    """Size and focal length of a camera or projector."""
    return f"{device.rows} x {device.columns} pixels (rows x columns), focal length {device.focal_px:.6g} pixels"


def _purpose(split: str) -> str:
    return {"train": "training", "test": "testing"}[split]
