"""Cards that lie beside a set and describe another one."""

from __future__ import annotations

import json
import re
from typing import Final

from bodyseg_data.cards.croissant import CROISSANT_NAME, DIGEST_PREFIX
from bodyseg_data.cards.dataset_card import CARD_NAME, DIGEST_FIELD
from bodyseg_data.shards.stores.store import Store

CARD_NAMES: Final = (CROISSANT_NAME, CARD_NAME)

_LARGEST_CARD: Final = 1 << 28
_DIGEST_LINE: Final = re.compile(rf"^{DIGEST_FIELD}: ([0-9a-f]{{64}})$", re.MULTILINE)


def stale_cards(store: Store, digest: str) -> list[str]:
    """Return one line for each card of a set that names another digest of a manifest.

    digest: of the set's manifest. A README.md that names none is somebody's own page, and no fault. Raises OSError or
    Unreachable if a card cannot be read.
    """
    lines = []
    for name in CARD_NAMES:
        text = store.read_file(name, _LARGEST_CARD)
        found = None if text is None else _digest_in(name, text.decode("utf-8", "replace"))
        if found is not None and found != digest:
            lines.append(
                f"{name}: card of another set: manifest {found or 'not named'}, that of this set is {digest} "
                f"(`bodyseg card` writes it anew)"
            )
    return lines


def _digest_in(name: str, text: str) -> str | None:
    """The manifest's digest that a card names; without one None for a README.md, "" for a Croissant file."""
    if name == CARD_NAME:
        match = _DIGEST_LINE.search(text)
        return match[1] if match else None
    try:
        tree = json.loads(text)
        identifier = tree.get("identifier") if isinstance(tree, dict) else None
    except (ValueError, RecursionError):
        identifier = None
    return str(identifier or "").removeprefix(DIGEST_PREFIX)
