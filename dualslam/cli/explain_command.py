"""`dualslam explain`: prints the decisions about a frame of a run."""

from __future__ import annotations

import argparse

from dualslam.report.explanation import explain


def execute(args: argparse.Namespace) -> int:
    """Print the frame's outcome, and each decision about it."""
    print("\n".join(explain(args.run, args.frame)), flush=True)
    return 0
