"""Subject of the conformance checks, and their complaints."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from dualslam.core.interfaces import Frontend
from dualslam.core.types import Features, FloatArray
from dualslam.frontends.conformance.scene import PrintedPlane
from dualslam.frontends.registry import FrontendFactory

N_FEATURES = 800
FEATURES_ARRAYS = ("uv_px", "uv_rect_px", "sigma_px", "scale", "octave", "angle_rad", "descriptors")

SubjectT = TypeVar("SubjectT")


class NotConforming(AssertionError):  # noqa: N818 (it reads as what is raised: a test's failure, no error of ours)
    """A front end does not keep the protocol; the message says in what."""


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


@dataclass(frozen=True, slots=True)
class Subject:
    """The front end under examination, and the scene that it is shown."""

    factory: FrontendFactory  # what the entry point names
    options: Mapping[str, Any] = field(default_factory=dict)  # `frontend.options` to build it with

    def make(self, n_features: int = N_FEATURES) -> Frontend:
        """Build it anew."""
        return self.factory.from_options(n_features, self.options)

    def scene(self, seed: int = 1) -> PrintedPlane:
        """Return a flat scene full of blobs, bars and corners."""
        return _printed(seed)

    def image(self, H_view_scene: FloatArray | None = None, seed: int = 0) -> NDArray[np.uint8]:
        """Photograph that scene (`PrintedPlane.photograph`)."""
        return self.scene().photograph(H_view_scene, seed=seed)


@lru_cache(maxsize=2)
def _printed(seed: int) -> PrintedPlane:
    """The scene of a seed: drawing one takes longer than most checks."""
    return PrintedPlane.printed(seed)


def same_features(a: Features, b: Features) -> bool:
    """Whether two sets of features are equal bit for bit."""
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in FEATURES_ARRAYS)
