"""Pixel matchers: found by name, checked by their suite, and asked where guided search finds too few landmarks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from dualslam.build import build_system
from dualslam.build.checks import check_config
from dualslam.core.camera.base import Camera
from dualslam.core.config.corruption import Corruption, CorruptionKind
from dualslam.core.config.settings import Config, PixelsConfig, RecoveryConfig
from dualslam.core.errors import ConfigError, FrontendError
from dualslam.core.matchers import PixelMatches, PosedImage
from dualslam.core.types import FloatArray, Frame, FrameMethod
from dualslam.frontends.tracking.pixel_search import checked_matches
from dualslam.lab.disturbances.images import corrupt_image
from dualslam.lab.synthetic.sequence import SyntheticSequence, make_sequence
from dualslam.map.frame_records import FrameResult
from dualslam.testing.pixel_matching import CHECKS, NotConforming, check_matcher
from tests.frontends.klt_example import KltMatcher

KLT = PixelsConfig(name="tests.frontends.klt_example:KltMatcher")
BLURRED = range(14, 19)


class StatedExact(KltMatcher):
    """States a noise that it does not keep."""

    def find(
        self, references: tuple[PosedImage, ...], image: NDArray[np.uint8], camera: Camera, T_cam_submap: FloatArray
    ) -> PixelMatches:
        found = super().find(references, image, camera, T_cam_submap)
        return replace(found, uv_px=found.uv_px + 0.5, sigma_px=np.full(len(found), 0.01))


class Twice(KltMatcher):
    """Returns each landmark twice."""

    def find(self, *given: Any, **named: Any) -> PixelMatches:
        found = super().find(*given, **named)
        return PixelMatches(*(np.concatenate([a, a]) for a in (found.landmark_ids, found.uv_px, found.sigma_px)))


class Silent:
    """Finds nothing."""

    name = "silent"

    @classmethod
    def from_options(cls, options: Mapping[str, Any]) -> Silent:
        return cls()

    def find(self, *given: object) -> PixelMatches:
        return PixelMatches.none()


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
def test_klt_conforms(check: Any) -> None:
    check(KltMatcher)


@pytest.mark.parametrize(
    ("matcher", "said"),
    [
        (StatedExact, "check_small_step: .*of their sigmas"),
        (Twice, "check_shapes: each landmark is found at most once"),
        (Silent, "check_small_step: 0% of the landmarks are found"),
    ],
)
def test_the_suite_says_what_is_wrong(matcher: Any, said: str) -> None:
    with pytest.raises(NotConforming, match=said):
        check_matcher(matcher)


@pytest.mark.parametrize(
    ("pixels", "said"),
    [
        (PixelsConfig(name="kltt"), r"pixels\.name: no pixel matcher is called 'kltt'"),
        (PixelsConfig(name="os:path"), r"pixels\.name: 'os:path' is no pixel matcher: it has no from_options"),
        (PixelsConfig(name="nomod:X"), r"pixels\.name: 'nomod:X' cannot be imported"),
        (KLT.model_copy(update={"options": {"window": 3}}), r"pixels\.options\.window: there is no such option"),
    ],
)
def test_a_mistake_in_the_config_is_named(pixels: PixelsConfig, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        check_config(Config(pixels=pixels))


@pytest.fixture(scope="module")
def street() -> tuple[SyntheticSequence, list[Frame]]:
    """A drive along a street; the images of `BLURRED` are far out of focus."""
    drive = make_sequence("street", n_frames=40, seed=3, width=320, height=240)
    blur = Corruption(kind=CorruptionKind.BLUR, start=BLURRED.start, length=len(BLURRED), strength=12.0)
    frames = []
    for i in range(24):
        frame = drive.frame(i)
        assert frame.image is not None
        frames.append(replace(frame, image=corrupt_image(frame.image, blur, i)) if i in BLURRED else frame)
    return drive, frames


def followed(street: tuple[SyntheticSequence, list[Frame]], pixels: PixelsConfig) -> list[FrameResult]:
    config = Config(pixels=pixels, recovery=RecoveryConfig(enabled=False))
    system = build_system(config, street[0].camera)
    return [system.step(frame) for frame in street[1]]


@pytest.mark.slow
def test_klt_holds_the_track_through_blur_that_orb_loses(street: tuple[SyntheticSequence, list[Frame]]) -> None:
    lost = [r.index for r in followed(street, PixelsConfig()) if r.index in BLURRED and r.lost]
    assert len(lost) >= 4
    held = followed(street, KLT)
    blurred = [r for r in held if r.index in BLURRED]
    assert all(r.method is FrameMethod.DIRECT for r in blurred)
    assert not any(r.lost for r in held[BLURRED.start :])
    assert all(r.method is FrameMethod.GUIDED for r in held[BLURRED.stop + 2 :])
    # Beside the truth, in the truth's scale by the way before the blur.
    T_true, T = (
        street[0].ground_truth_T_world_cam,
        {r.index: r.T_submap_cam for r in held if r.T_submap_cam is not None},
    )
    first, last = 6, BLURRED.start - 1

    def moved(poses: Any, i: int, j: int) -> FloatArray:
        return np.asarray((np.linalg.inv(poses[i]) @ poses[j])[:3, 3])

    scale = np.linalg.norm(moved(T_true, first, last)) / np.linalg.norm(moved(T, first, last))
    for i in BLURRED:
        true, found = moved(T_true, last, i), scale * moved(T, last, i)
        assert np.linalg.norm(found - true) < 0.1 * np.linalg.norm(moved(T_true, first, i))


@pytest.mark.parametrize(
    ("found", "said"),
    [
        (None, "find returned a NoneType, not"),
        (PixelMatches(np.array([1, 1]), np.ones((2, 2)), np.ones(2)), "find returned a landmark twice"),
        (PixelMatches(np.array([1]), np.array([[1.0, np.nan]]), np.ones(1)), "not finite"),
        (PixelMatches(np.array([1]), np.ones((2, 2)), np.ones(1)), r"uv_px \(2, 2\) .* for 1 landmarks"),
    ],
)
def test_a_matcher_that_returns_nonsense_is_named(found: PixelMatches, said: str) -> None:
    with pytest.raises(FrontendError, match=f"klt_example:KltMatcher': .*{said}"):
        checked_matches(KltMatcher(), found)
