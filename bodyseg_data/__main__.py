"""`python -m bodyseg_data` is `bodyseg`."""

import sys

from bodyseg_data.commands.cli import main

sys.exit(main())
