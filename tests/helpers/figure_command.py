"""The command `bodyseg` with figures for the open bodies: spawned workers load this file, too, and register them."""

from __future__ import annotations

import figure_worker  # noqa: F401  # registers the figures, with the trouble that BODYSEG_TROUBLE names

from bodyseg_data.commands import main

if __name__ == "__main__":
    raise SystemExit(main())
