"""Folders that tests read."""

from pathlib import Path
from typing import Final

HELPERS: Final = Path(__file__).parent
TESTS: Final = HELPERS.parent
ROOT: Final = TESTS.parent
GOLDEN: Final = TESTS / "golden"
SHARED_DATA: Final = ROOT.parent / "shared" / "data"
"""Bodies and frames whose licences keep them out of the repository; tests that need them say when they are absent."""
