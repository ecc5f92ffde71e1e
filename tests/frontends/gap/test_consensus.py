"""Two frames beyond a gap: right ones confirm each other within their covariances, a wrong one is found out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dualslam.core.geometry import se3
from dualslam.core.geometry.projection import project_points
from dualslam.core.types import Features, FloatArray, Rival
from dualslam.frontends.gap.consensus import CONFIRMING_SHARE, BeyondGap, are_no_copies, confirmed_share
from dualslam.frontends.gap.relocalisation import GapPose

K = np.array([[400.0, 0.0, 320.0], [0.0, 400.0, 240.0], [0.0, 0.0, 1.0]])
N, N_TRACKED = 240, 60
SIGMA_PX = 0.5
T_FIRST, T_SECOND = (se3.exp(np.array([0.0, 0.01 * k, 0.0, 0.05 * k, 0.0, 0.4 * k])) for k in (1.0, 2.0))
SIGMAS = np.array([0.008, 0.008, 0.008, 0.05, 0.05, 0.1])
"""Of a pose: half a degree, and a hundredth of the way to what the camera sees."""


def scene(seed: int) -> FloatArray:
    return np.random.default_rng(seed).uniform([-4, -3, 6], [4, 3, 14], (N, 3))


def beyond(xyz: FloatArray, T_true: FloatArray, error: FloatArray, sigmas: FloatArray, seed: int) -> BeyondGap:
    """A frame that sees all points, with a pose that is off by `error`, and points through the gap of that pose."""
    uv, _ = project_points(K, T_true, xyz)
    uv = uv + SIGMA_PX * np.random.default_rng([seed, 1]).normal(size=uv.shape)
    ones = np.ones(N)
    features = Features(uv, uv, SIGMA_PX * ones, ones, np.zeros(N, np.int64), 0.0 * ones, np.zeros((N, 32), np.uint8))
    T = se3.exp(error) @ T_true
    # Seen at the same pixels by the pose that was found: so were they triangulated.
    tracked = se3.act(se3.inverse(T), se3.act(T_true, xyz[:N_TRACKED]))
    pose = GapPose(T, tracked, np.ones(N_TRACKED, bool), 1.0, np.diag(sigmas**2), 0.02)
    return BeyondGap(features, np.arange(N_TRACKED), pose)


def share(seed: int, errors: tuple[FloatArray, FloatArray], sigmas: FloatArray, wrong: float = 0.0) -> float:
    xyz, matches = scene(seed), np.column_stack([np.arange(N)] * 2)
    mixed = np.random.default_rng([seed, 2]).permutation(N)[: int(wrong * N)]
    matches[mixed, 1] = np.roll(mixed, 1)
    first, second = (
        beyond(xyz, T, error, sigmas, seed + n)
        for n, (T, error) in enumerate(zip((T_FIRST, T_SECOND), errors, strict=True))
    )
    return confirmed_share(first, second, matches, K)


def drawn(seed: int) -> tuple[FloatArray, FloatArray]:
    a, b = SIGMAS * np.random.default_rng([seed, 3]).normal(size=(2, 6))
    return a, b


EXACT = np.zeros(6), np.zeros(6)


def test_exact_poses_confirm_each_other_by_the_noise_of_their_pixels() -> None:
    assert share(0, EXACT, 1e-6 * SIGMAS) > 0.9
    assert share(0, EXACT, 1e-6 * SIGMAS, wrong=0.3) < 0.75


@pytest.mark.parametrize("seed", range(6))
def test_poses_as_wrong_as_they_say_confirm_each_other(seed: int) -> None:
    assert share(seed, drawn(seed), SIGMAS) > CONFIRMING_SHARE
    # What they say counts: for poses that claimed to be exact the same errors would be a contradiction.
    assert share(seed, drawn(seed), 0.02 * SIGMAS) < CONFIRMING_SHARE


@pytest.mark.parametrize("part", range(6))
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_pose_far_beyond_what_it_says_is_found_out(part: int, sign: float) -> None:
    wrong = 25.0 * sign * SIGMAS * np.eye(6)[part]
    a, b = drawn(0)
    assert share(0, (a + wrong, b), SIGMAS) < CONFIRMING_SHARE
    assert share(0, (a, b + wrong), SIGMAS) < CONFIRMING_SHARE


def test_frames_that_share_too_little_tell_nothing() -> None:
    xyz = scene(0)
    first, second = (beyond(xyz, T, np.zeros(6), SIGMAS, 0) for T in (T_FIRST, T_SECOND))
    few = np.column_stack([np.arange(N_TRACKED - 8, N)] * 2)
    assert confirmed_share(first, second, few, K) == 0.0


def along_the_view(way: float) -> FloatArray:
    return se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, -way]))


@pytest.mark.parametrize("ways", [[1.5], [-1.5], [1.5, -1.5], [-1.5, 1.5], [12.0], [12.0, -1.5]])
def test_rivals_along_the_view_let_right_matches_pass(ways: list[float]) -> None:
    """Rivals ahead (positive) and behind, in any order, also where some or all points lie behind their cameras."""
    xyz = np.random.default_rng(0).uniform([-2, -1, 1], [2, 1, 8], (N, 3))
    T_first, T_second = np.eye(4), along_the_view(0.1)
    first, second = (beyond(xyz, T, np.zeros(6), SIGMAS, n) for n, T in enumerate((T_first, T_second)))
    rivals = [Rival(0, along_the_view(way) @ T_first, T_first) for way in ways]
    same = np.column_stack([np.arange(N)] * 2)
    assert are_no_copies(first, second, same, rivals, K).mean() > 0.85


@pytest.mark.parametrize(("way", "seen_from", "passes"), [(2.0, 1.2, True), (2.0, 1.6, False), (-2.0, 1.2, False)])
def test_copies_lie_where_the_rival_shows_them(way: float, seen_from: float, passes: bool) -> None:
    """From 2 ahead a ring at depth 4 is shown a whole radius off, from 2 behind a third of one.

    It is seen 0.43 or 0.67 off. A third of what is known is so near that it lies behind the rival ahead.
    """
    angle, near = np.linspace(0.0, 2 * np.pi, N), np.arange(N) < N_TRACKED // 3
    ring = np.column_stack([np.cos(angle), np.sin(angle), np.where(near, 1.0, 4.0)])
    first, second = (beyond(ring, along_the_view(ahead), np.zeros(6), SIGMAS, 0) for ahead in (0.0, seen_from))
    second = replace(second, pose=first.pose)
    rival = Rival(0, along_the_view(way), np.eye(4))
    matches = np.column_stack([np.flatnonzero(~near)] * 2)
    assert (are_no_copies(first, second, matches, [rival], K) == passes).all()
