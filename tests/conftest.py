"""Tests compute as the command line does: with one thread for each numerical library, or sums round otherwise."""

from dualslam.core.threads import limit_threads

limit_threads()
