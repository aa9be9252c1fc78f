"""`python -m approxjac` is the command `approxjac`."""

import sys

from approxjac.cli import main

sys.exit(main())
