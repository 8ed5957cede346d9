"""`bodyseg <command>`, and `tools/<command>` in a checkout: the commands of both packages."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from bodyseg_data.commands import cli

COMMANDS: Final[cli.Commands] = {
    **cli.COMMANDS,
    "train": ("bodyseg_model.commands.train", "train a network on one variant of a set"),
    "evaluate": ("bodyseg_model.commands.evaluate", "score a network on a set"),
    "export": ("bodyseg_model.commands.export", "write a trained network as two small files"),
    "segment": ("bodyseg_model.commands.segment", "find the parts of people in frames of a sensor"),
    "stability": ("bodyseg_model.commands.stability", "measure robustness to sensor artifacts, motion, arithmetic"),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one of `COMMANDS`; see `bodyseg_data.commands.cli.main`."""
    return cli.main(arguments, COMMANDS)
