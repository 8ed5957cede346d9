"""`tools/bench` and `tools/chart`, which a checkout has and an installed package has not."""

from __future__ import annotations

import sys
from typing import Final

from bodyseg_data.commands.cli import main

COMMANDS: Final = {
    "bench": ("benches.bench", "measure speed and accuracy side by side"),
    "chart": ("benches.chart", "chart speed against accuracy, one chart a choice"),
}

if __name__ == "__main__":
    sys.exit(main(commands=COMMANDS, program="tools/"))
