"""`make fuzz`: many cases of damaged input, by seed. A fault is printed with the kind and seed that repeat it."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path

from dualslam.cli.streams import without_libraries
from tests.fuzz.campaign import KINDS, Templates, tried
from tests.fuzz.many import Trial, make_many


def prepare(folder: Path) -> Trial:
    return partial(tried, templates=Templates(folder).build().folder)


if __name__ == "__main__":
    with without_libraries():
        sys.exit(make_many("fuzz", str(__doc__), list(KINDS), 2000, prepare))
