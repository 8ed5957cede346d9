"""`python -m bodyseg_data` is `bodyseg` without the commands on networks."""

import sys

from bodyseg_data.commands.cli import main

sys.exit(main())
