"""Does a front end keep what `dualslam.core.interfaces.Frontend` promises? For ours, and for other packages'.

In a test of another package::

    from dualslam.frontends.conformance import CHECKS, Subject

    @pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
    def test_front_end_conforms(check):
        check(Subject(MyFrontend))

or all at once, with a report of everything that is wrong: ``check_frontend(MyFrontend)``. What is checked is what the
entry point names, built by its `from_options`. The scenes are drawn: their truth is exact, and no file is needed. A
quick front end takes some seconds on a CPU.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from dualslam.core.conformance import NotConforming, run_checks
from dualslam.frontends.conformance import features, matching
from dualslam.frontends.conformance.scene import Subject
from dualslam.frontends.registry import FrontendFactory

__all__ = ["CHECKS", "NotConforming", "Subject", "check_frontend"]

CHECKS: tuple[Callable[[Subject], None], ...] = (*features.CHECKS, *matching.CHECKS)
"""Each takes a `Subject` and raises `NotConforming` where it does not keep the protocol."""


def check_frontend(factory: FrontendFactory, options: Mapping[str, Any] | None = None) -> None:
    """Run all checks on what an entry point names, built with `options` (`frontend.options`).

    Raises `NotConforming`: one line for each check that fails, or in which the front end raises anything.
    """
    run_checks(CHECKS, Subject(factory, options or {}))
