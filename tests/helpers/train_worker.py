"""`bodyseg train` without dropout, which each process draws for itself; run by torchrun."""

from __future__ import annotations

import sys

from torch import nn

from bodyseg_model.commands.cli import main

if __name__ == "__main__":
    nn.Dropout.forward = lambda self, x: x  # type: ignore[method-assign]
    sys.exit(main())
