"""`python -m bodyseg_model` is `bodyseg`."""

import sys

from bodyseg_model.commands import main

sys.exit(main())
