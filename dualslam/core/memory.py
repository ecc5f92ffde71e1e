"""Freed memory stays with the process: what one image took, the next one takes again."""

from __future__ import annotations

import ctypes
import resource
import sys

MB = 2**20
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD, M_ARENA_MAX = -1, -3, -8
"""As in glibc's `malloc.h`."""
KEPT_BYTES = 256 * MB
"""So much at most lies idle; SIFT's scale space of a KITTI image takes 110 MB."""
LARGEST_BYTES = 32 * MB
"""Larger arrays are given back all the same: glibc allows no more."""


def keep_freed_memory() -> bool:
    """Tell the C library to keep freed memory for what is allocated next.

    glibc gives arrays of some size back to the system at once, which hands out fresh pages, zeroed, for the next ones:
    a fifth of the CPU time of reverse tracking with SIFT on KITTI. Results are the same.

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
    """Return the highest resident memory of this process since it started, mebibytes.

    `with_children`: and that of the largest of its children that have ended.
    """
    whose = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN) if with_children else (resource.RUSAGE_SELF,)
    peak = sum(resource.getrusage(who).ru_maxrss for who in whose)
    return peak / MB if sys.platform == "darwin" else peak / 2**10
