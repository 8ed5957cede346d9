"""`python -m bodyseg_data` is `bodyseg`."""

import sys

from bodyseg_data.cli import main

sys.exit(main())
