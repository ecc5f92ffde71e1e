"""`python -m dualslam` is the command `dualslam`, which begins here: an interrupt may come before it is imported."""

from __future__ import annotations

import sys

from dualslam.core import exit_status


def main() -> int:
    """Run the command and return its exit status."""
    try:
        from dualslam.cli import main as command

        return command()
    except KeyboardInterrupt:
        sys.stderr.write("dualslam: interrupted\n")
        return exit_status.INTERRUPTED


if __name__ == "__main__":
    sys.exit(main())
