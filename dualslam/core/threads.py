"""One thread for each numerical library: our parallelism is processes, and BLAS threads on busy cores only wait."""

from __future__ import annotations

import os
import sys

LIMITS = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "NUMEXPR_NUM_THREADS": "1",
    "OPENCV_FOR_THREADS_NUM": "1",
}


def limit_threads() -> bool:
    """Tell the numerical libraries, which read the environment when they are loaded, to use one thread each.

    Variables that the user has set are left as they are. Call it before numpy is imported, in a program of your own as
    in ours; importing dualslam does not call it.

    Returns bool: false where numpy was loaded already, so that the limits came too late for it.
    """
    for name, value in LIMITS.items():
        os.environ.setdefault(name, value)
    return "numpy" not in sys.modules


def spare_cores(n_busy: int) -> int:
    """Return how many of the cores that this process may use are left beside so many busy ones."""
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(0, usable - n_busy)
