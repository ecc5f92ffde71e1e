"""Threads, memory and signals of a process. Numpy is not imported here."""

from __future__ import annotations

import ctypes
import os
import resource
import signal
import sys
from multiprocessing import resource_tracker
from multiprocessing.process import BaseProcess

LIMITS = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "NUMEXPR_NUM_THREADS": "1",
    "OPENCV_FOR_THREADS_NUM": "1",
}
MB = 2**20
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD, M_ARENA_MAX = -1, -3, -8
"""As in glibc's `malloc.h`."""
KEPT_BYTES = 256 * MB
"""So much at most lies idle; SIFT's scale space of a KITTI image takes 110 MB."""
LARGEST_BYTES = 32 * MB
"""Larger arrays are given back all the same: glibc allows no more."""


def limit_threads() -> bool:
    """Tell the numerical libraries, which read the environment when they are loaded, to use one thread each.

    Our parallelism is processes, and BLAS threads on busy cores only wait. Variables that the user has set stay. Call
    it before numpy is imported, in a program of your own as in ours; importing dualslam does not call it.

    Returns bool: false where numpy was loaded already, so that the limits came too late for it.
    """
    for name, value in LIMITS.items():
        os.environ.setdefault(name, value)
    return "numpy" not in sys.modules


def spare_cores(n_busy: int) -> int:
    """Return how many of the cores that this process may use are left beside so many busy ones."""
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(0, usable - n_busy)


def keep_freed_memory() -> bool:
    """Tell the C library to keep freed memory for what is allocated next, as fresh pages cost up to a fifth of the
    time.

    Call it in a program of your own as in ours; importing dualslam does not call it.

    Returns bool: false where the C library has no such setting: elsewhere than on Linux with glibc nothing is changed.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, TypeError):
        return False
    # One arena: what the thread that reads images frees is used by the others, too.
    settings = ((M_MMAP_THRESHOLD, LARGEST_BYTES), (M_TRIM_THRESHOLD, KEPT_BYTES), (M_ARENA_MAX, 1))
    return all(mallopt(*setting) for setting in settings)


def peak_rss_mb(with_children: bool = False) -> float:
    """Return the highest resident memory of this process, and of its largest child that has ended, mebibytes."""
    whose = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN) if with_children else (resource.RUSAGE_SELF,)
    peak = sum(resource.getrusage(who).ru_maxrss for who in whose)
    return peak / MB if sys.platform == "darwin" else peak / 2**10


def start_undisturbed(process: BaseProcess) -> None:
    """Start a spawned process in which SIGINT is held back from its first instruction on.

    An interrupt at the terminal reaches all processes of a run, and the first one's decides. A process that only
    ignored it in its own code would die with a stack trace while it still imports.
    """
    resource_tracker.ensure_running()  # starting a process would do that, and lets signals through again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        process.start()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def hear_interrupts() -> None:
    """Let SIGINT through, in a process of `start_undisturbed`; one that came before comes now."""
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
