"""`make fuzz`: many cases of damaged input, by seed. A fault is printed with the kind and seed that repeat it."""

from __future__ import annotations

import argparse
import collections
import shutil
import sys
import tempfile
from pathlib import Path

from dualslam.cli.streams import without_libraries
from tests.fuzz.campaign import KINDS, Templates, tried


def main() -> int:
    parser = argparse.ArgumentParser(prog="make fuzz ARGS=...", description=__doc__)
    parser.add_argument("--cases", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0, help="of the first case of each kind; the next has the next")
    parser.add_argument("--kind", choices=KINDS, nargs="+", default=list(KINDS))
    args = parser.parse_args()
    faults, statuses = collections.Counter[str](), collections.Counter[tuple[str, int]]()
    with tempfile.TemporaryDirectory() as folder, without_libraries():
        templates = Path(folder) / "templates"
        templates.mkdir()
        Templates(templates).build()
        work = Path(folder) / "case"
        for i in range(args.cases):
            kind, seed = args.kind[i % len(args.kind)], args.seed + i // len(args.kind)
            status, fault = tried(kind, seed, templates, work)
            statuses[kind, status] += 1
            shutil.rmtree(work)
            if fault is not None:
                faults[kind] += 1
                print(f"{kind} --seed {seed}: {fault}", flush=True)
    for kind in args.kind:
        n_each = ", ".join(f"{n} ended with {s}" for (k, s), n in sorted(statuses.items()) if k == kind)
        print(f"{kind}: {n_each}; {faults[kind]} faults")
    return int(faults.total() > 0)


if __name__ == "__main__":
    sys.exit(main())
