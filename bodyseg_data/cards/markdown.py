"""Pieces of the pages that cards are: lists, tables, and the lines of a header that name a licence."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from typing import Final

from bodyseg_data.cards.texts import UNKNOWN_LICENCE

_HUB_LICENCES: Final = frozenset(
    {"apache-2.0", "mit", "cc0-1.0", "cc-by-4.0", "cc-by-sa-4.0", "cc-by-nc-4.0", "cc-by-nc-sa-4.0", "cc-by-nd-4.0"}
)
"""Licences that the hub knows by these names; others are given as `other` with a name."""


def licence_lines(licence: str) -> list[str]:
    """Return the lines of a YAML header that state a licence."""
    if licence == UNKNOWN_LICENCE or licence.lower() in _HUB_LICENCES:
        return [f"license: {licence.lower()}"]
    return ["license: other", f"license_name: {json.dumps(licence)}"]


def bullets(lines: Iterable[str]) -> str:
    """Return a list, one line each."""
    return "\n".join(f"- {line}" for line in lines)


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table; a bar within a cell becomes a slash."""
    cells = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(cell.replace('|', '/') for cell in row)} |" for row in cells)
