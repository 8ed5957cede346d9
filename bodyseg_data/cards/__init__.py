"""Cards of sets: a Croissant file and a dataset card, written from the manifest."""

from typing import TYPE_CHECKING

from bodyseg_data.core import lazy_door

if TYPE_CHECKING:
    from bodyseg_data.cards.croissant import CROISSANT_NAME, croissant_bytes
    from bodyseg_data.cards.dataset_cards import (
        CARD_NAME,
        CARD_NAMES,
        bullets,
        dataset_card,
        licence_lines,
        stale_cards,
        table,
    )
    from bodyseg_data.cards.facts import UNKNOWN_LICENCE, Publication, set_facts
else:
    __getattr__, __dir__, __all__ = lazy_door(__name__)
