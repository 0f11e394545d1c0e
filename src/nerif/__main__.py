"""`python -m nerif` is `nerif`."""

import sys

from nerif.cli import main

sys.exit(main())
