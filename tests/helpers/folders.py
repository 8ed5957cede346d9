"""Folders that tests read."""

import os
from pathlib import Path
from typing import Final

HELPERS: Final = Path(__file__).parent
TESTS: Final = HELPERS.parent
ROOT: Final = TESTS.parent
GOLDEN: Final = TESTS / "golden"
SHARED_DATA: Final = Path(os.environ.get("BODYSEG_SHARED_DATA", ROOT.parent / "shared" / "data"))
"""Bodies and frames whose licences keep them out of the repository; see the fixture `shared_data`."""
