"""Does a pixel matcher keep what `dualslam.core.interfaces.PixelMatcher` promises? For ours, and for other packages'.

In a test of another package::

    from dualslam.testing.pixel_matching import CHECKS

    @pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
    def test_matcher_conforms(check):
        check(MyMatcher)

or all at once: ``check_matcher(MyMatcher)``. The scene is a printed plane: its truth is exact, and no file is needed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dualslam.core.camera.models import PinholeCamera
from dualslam.core.conformance import NotConforming, expect, run_checks
from dualslam.core.geometry import se3
from dualslam.core.interfaces import PixelMatcher
from dualslam.core.matchers import PixelMatches, PosedImage
from dualslam.core.types import FloatArray
from dualslam.frontends.conformance.scene import PrintedPlane, transfer
from dualslam.frontends.features.orb import OrbFrontend
from dualslam.frontends.registry import PixelMatcherFactory

__all__ = ["CHECKS", "NotConforming", "check_matcher"]

SIZE_PX = (480, 360)
CAMERA = PinholeCamera(*SIZE_PX, 400.0, 400.0, 239.5, 179.5)
STEP = np.array([0.004, -0.006, 0.008, 0.006, -0.004, 0.01])
"""Motion (rotation, translation; the plane is at depth 1) between the two views: about 5 px."""
NEAR_PX = 3.0
"""Error of a match that counts as right."""
MIN_FOUND, MIN_RIGHT, MAX_BY_CHANCE = 0.5, 0.8, 0.25
"""Shares: landmarks found across `STEP`; right ones among these; landmarks found in an image of something else. A pose
with outliers bears the rest."""
WITHIN_95 = 0.85
"""Share of the right matches that must lie within 2.45 sigmas, where 95 % do under the exact noise model."""


@dataclass(frozen=True, slots=True, eq=False)
class TwoViews:
    """A reference, a new image, and where it shows each landmark."""

    reference: PosedImage
    image: NDArray[np.uint8]
    T_cam_submap: FloatArray
    uv_true_px: FloatArray


@lru_cache(maxsize=1)
def plane_views() -> TwoViews:
    """Photograph the plane straight on and from a little to the side; the landmarks are corners."""
    scene = PrintedPlane.printed(3, SIZE_PX)
    first = scene.photograph(seed=1)
    uv = OrbFrontend(300).extract(first).uv_px
    uv = uv[((uv > 25) & (uv < np.array(SIZE_PX) - 26)).all(axis=1)]
    T = np.asarray(se3.exp(STEP))
    H = CAMERA.K @ (T[:3, :3] + np.outer(T[:3, 3], [0.0, 0.0, 1.0])) @ np.linalg.inv(CAMERA.K)
    ids = 7 + 3 * np.arange(len(uv), dtype=np.int64)
    reference = PosedImage(0, first, np.eye(4), ids, uv, np.ones(len(uv)))
    return TwoViews(reference, scene.photograph(H, seed=2), T, transfer(H, uv))


def _make(factory: PixelMatcherFactory, options: Mapping[str, Any] | None) -> PixelMatcher:
    return factory.from_options(options or {})


def _find(matcher: PixelMatcher, image: NDArray[np.uint8], T_cam_submap: FloatArray) -> PixelMatches:
    found = matcher.find((plane_views().reference,), image, CAMERA, T_cam_submap)
    expect(isinstance(found, PixelMatches), f"find returned a {type(found).__name__}, not PixelMatches")
    return found


def check_shapes(factory: PixelMatcherFactory, options: Mapping[str, Any] | None = None) -> None:
    """Check types and shapes, that ids are the reference's, each at most once, and that pixels are in the image."""
    views = plane_views()
    matcher = _make(factory, options)
    expect(isinstance(matcher.name, str) and matcher.name != "", "name is a word")
    found = _find(matcher, views.image, views.T_cam_submap)
    n = len(found.landmark_ids)
    expect(found.landmark_ids.dtype == np.int64, f"landmark_ids is {found.landmark_ids.dtype}, not int64")
    expect(found.uv_px.shape == (n, 2) and found.uv_px.dtype == np.float64, "uv_px is (M, 2) float64")
    expect(found.sigma_px.shape == (n,) and found.sigma_px.dtype == np.float64, "sigma_px is (M,) float64")
    expect(bool((found.sigma_px > 0).all()), "sigma_px is above 0")
    expect(bool(np.isin(found.landmark_ids, views.reference.landmark_ids).all()), "ids are of the references")
    expect(len(np.unique(found.landmark_ids)) == n, "each landmark is found at most once")
    expect(bool(((found.uv_px >= -0.5) & (found.uv_px < np.array(SIZE_PX) - 0.5)).all()), "pixels are in the image")


def check_small_step(factory: PixelMatcherFactory, options: Mapping[str, Any] | None = None) -> None:
    """Check that landmarks are found across a small step, with the prediction at rest, and to within their sigmas."""
    views, matcher = plane_views(), _make(factory, options)
    found = _find(matcher, views.image, np.eye(4))
    share = len(found) / len(views.reference.landmark_ids)
    expect(share >= MIN_FOUND, f"{share:.0%} of the landmarks are found across a step of 5 px")
    row = np.searchsorted(views.reference.landmark_ids, found.landmark_ids)
    error_px = np.linalg.norm(found.uv_px - views.uv_true_px[row], axis=1)
    right = error_px < NEAR_PX
    expect(right.mean() >= MIN_RIGHT, f"{right.mean():.0%} of the matches are within {NEAR_PX:g} px")
    within = (error_px[right] < 2.45 * found.sigma_px[right]).mean()
    expect(within >= WITHIN_95, f"{within:.0%} of the right matches are within 2.45 of their sigmas; 95 % should be")


def check_nothing_to_find(factory: PixelMatcherFactory, options: Mapping[str, Any] | None = None) -> None:
    """Check that a flat image shows nothing, and another scene hardly anything."""
    matcher = _make(factory, options)
    flat = np.full(SIZE_PX[::-1], 90, np.uint8)
    n = len(plane_views().reference.landmark_ids)
    expect(len(_find(matcher, flat, np.eye(4))) == 0, "landmarks are found in a flat image")
    share = len(_find(matcher, PrintedPlane.printed(8, SIZE_PX).photograph(seed=5), np.eye(4))) / n
    expect(share <= MAX_BY_CHANCE, f"{share:.0%} of the landmarks are found in an image of something else")


def check_no_state(factory: PixelMatcherFactory, options: Mapping[str, Any] | None = None) -> None:
    """Check that the same arguments give the same matches whatever came before, and are left as they were."""
    views, matcher = plane_views(), _make(factory, options)
    given: list[NDArray[Any]] = [views.image, views.reference.image, views.reference.uv_px]
    kept = [each.copy() for each in given]
    first = _find(matcher, views.image, views.T_cam_submap)
    _find(matcher, views.image[::-1].copy(), np.eye(4))
    for other in (matcher, _make(factory, options)):
        again = _find(other, views.image, views.T_cam_submap)
        same = np.array_equal(first.landmark_ids, again.landmark_ids) and np.array_equal(first.uv_px, again.uv_px)
        expect(same, "the same arguments give other matches")
    expect(all(np.array_equal(a, b) for a, b in zip(kept, given, strict=True)), "an argument is changed")


CHECKS: tuple[Callable[[PixelMatcherFactory], None], ...] = (
    check_shapes,
    check_small_step,
    check_nothing_to_find,
    check_no_state,
)
"""Each takes what the entry point names, and raises `NotConforming`."""


def check_matcher(factory: PixelMatcherFactory) -> None:
    """Run all checks.

    Raises
    ------
    NotConforming
        Says everything that is wrong, one line for each check.
    """
    run_checks(CHECKS, factory)
