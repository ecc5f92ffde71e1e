"""The exit statuses of the command. Nothing is imported here: an interrupt may come before anything is."""

from __future__ import annotations

DONE = 0
FAILED = 1
"""No map could be made, standard output could not be written, or it is a bug of ours."""
BAD_INPUT = 2
"""Or bad usage."""
INTERRUPTED = 130
