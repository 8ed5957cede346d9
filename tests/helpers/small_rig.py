"""The paper's rig with a quarter of the pixels a side, for tests that take many pictures."""

from __future__ import annotations

from typing import Final

from folders import HELPERS

from bodyseg_data.rigs import load_rig

SMALL_FILE: Final = HELPERS / "small_rig.toml"
SMALL: Final = load_rig(SMALL_FILE)
