"""The commands that a checkout has and an installed package has not: `tools/bench`, `tools/chart` and others."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Final

from bodyseg_data.commands import cli

COMMANDS: Final[cli.Commands] = {
    "bench": ("benches.bench", "measure speed and accuracy side by side"),
    "chart": ("benches.results.chart", "chart speed against accuracy, one chart a choice"),
    "card": ("benches.cards.command", "write the cards of a set or a network beside it"),
    "demo": ("benches.demo", "pack a small open set and stream all five variants"),
    "landmarks": ("benches.landmarks.command", "draw the 33 parts of a body, or propose its landmarks"),
    "licences": ("benches.licences", "list the licences of the packages that each extra installs"),
}

ALL: Final[cli.Commands] = {
    "bench all": ("benches.results.command", "make all results on accuracy anew, as far as they are stale"),
}
"""Apart from `COMMANDS`, where a name of two words would make a group of `bench`."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one of `COMMANDS`, or `tools/bench all`; see `bodyseg_data.commands.main`."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    return cli.main(words, ALL if " ".join(words[:2]) in ALL else COMMANDS, "tools/")


if __name__ == "__main__":
    sys.exit(main())
