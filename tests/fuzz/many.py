"""A campaign by command: many cases by seed. What is wrong is printed with the kind and seed that repeat it."""

from __future__ import annotations

import argparse
import shutil
import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

Trial = Callable[[str, int, Path], tuple[int, str | None]]
"""Makes one case of a kind and a seed in a new folder; returns its exit status, and what is wrong with it or None."""


def make_many(
    target: str, description: str, kinds: Sequence[str], n_cases: int, prepare: Callable[[Path], Trial]
) -> int:
    """Read the command line of a `make` target, make the cases, and return the exit status.

    - `n_cases`: by default.
    - `prepare`: makes what all cases share, in a folder of their own.
    """
    parser = argparse.ArgumentParser(prog=f"make {target} ARGS=...", description=description)
    parser.add_argument("--cases", type=int, default=n_cases)
    parser.add_argument("--seed", type=int, default=0, help="of the first case of each kind; the next has the next")
    parser.add_argument("--kind", choices=kinds, nargs="+", default=list(kinds))
    args = parser.parse_args()
    faults, statuses = Counter[str](), Counter[tuple[str, int]]()
    with tempfile.TemporaryDirectory() as folder:
        shared, work = Path(folder) / "shared", Path(folder) / "case"
        shared.mkdir()
        trial = prepare(shared)
        for i in range(args.cases):
            kind, seed = args.kind[i % len(args.kind)], args.seed + i // len(args.kind)
            status, fault = trial(kind, seed, work)
            statuses[kind, status] += 1
            shutil.rmtree(work, ignore_errors=True)  # a command that was refused has made none
            if fault is not None:
                faults[kind] += 1
                print(f"{kind} --seed {seed}: {fault}", flush=True)
    for kind in args.kind:
        n_each = ", ".join(f"{n} ended with {s}" for (k, s), n in sorted(statuses.items()) if k == kind)
        print(f"{kind}: {n_each}; {faults[kind]} faults")
    return int(faults.total() > 0)
