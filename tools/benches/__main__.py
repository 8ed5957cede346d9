"""`tools/bench` and `tools/chart`, which a checkout has and an installed package has not."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Final

from bodyseg_data.commands import cli

COMMANDS: Final[cli.Commands] = {
    "bench": ("benches.bench", "measure speed and accuracy side by side"),
    "chart": ("benches.chart", "chart speed against accuracy, one chart a choice"),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one of `COMMANDS`; see `bodyseg_data.commands.cli.main`."""
    return cli.main(arguments, COMMANDS, "tools/")


if __name__ == "__main__":
    sys.exit(main())
