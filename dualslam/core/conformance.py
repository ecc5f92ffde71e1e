"""Checks of plug-ins, ours and others': one error, one runner."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np

SubjectT = TypeVar("SubjectT")


class NotConforming(AssertionError):  # noqa: N818 (it reads as what is raised: a test's failure, no error of ours)
    """A plug-in does not keep its protocol; the message says in what."""


def expect(condition: bool | np.bool_, complaint: str) -> None:
    """Complain unless a condition holds."""
    if not condition:
        raise NotConforming(complaint)


def run_checks(checks: Sequence[Callable[[SubjectT], None]], subject: SubjectT) -> None:
    """Run all checks, then raise `NotConforming` with a line for each that failed or raised anything else."""
    problems = []
    for check in checks:
        try:
            check(subject)
        except NotConforming as problem:
            problems.append(f"{check.__name__}: {problem}")
        except Exception as error:  # theirs, whatever it is: the other checks have more to tell
            problems.append(f"{check.__name__}: {_kind(error)}: {' '.join(str(error).split())}")
    if problems:
        raise NotConforming(f"{len(problems)} of {len(checks)} checks failed\n" + "\n".join(problems))


def _kind(error: Exception) -> str:
    kind = type(error)
    return kind.__name__ if kind.__module__ == "builtins" else f"{kind.__module__}.{kind.__name__}"
