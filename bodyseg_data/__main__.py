"""`python -m bodyseg_data` is `bodyseg` without the commands on networks."""

import sys

from bodyseg_data.commands import main

sys.exit(main())
