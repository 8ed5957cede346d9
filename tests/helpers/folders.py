"""Folders that tests read."""

import os
from pathlib import Path
from typing import Final

HELPERS: Final = Path(__file__).parent
TESTS: Final = HELPERS.parent
ROOT: Final = TESTS.parent
DOCS: Final = ROOT / "docs"
GOLDEN: Final = TESTS / "golden"
SHARED_DATA: Final = Path(os.environ.get("BODYSEG_SHARED_DATA", ROOT.parent / "shared" / "data"))
"""Bodies and frames whose licences keep them out of the repository; see the fixture `shared_data`."""

MADE_PAGES: Final = (DOCS / "results" / "index.md", DOCS / "results" / "tables.md")
"""Pages that `make page` writes."""

PAGES: Final = sorted(
    page
    for folder in (".", "tutorials", "how-to", "reference", "explanation", "results")
    for page in (DOCS / folder).glob("*.md")
    if page not in MADE_PAGES
)
"""Pages of the documentation that people write, without decisions."""
