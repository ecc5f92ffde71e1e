"""`python -m dualslam.cli` is the command `dualslam`."""

import sys

from dualslam.cli import main

sys.exit(main())
