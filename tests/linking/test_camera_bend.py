"""A wrong camera that bends the new map on the way to its live end, and matches that only look like one."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from dualslam.backend.self_calibration import find_preferred_camera
from dualslam.build import adjust_submap
from dualslam.core.camera.models import PinholeCamera
from dualslam.core.config.calibration_config import CalibrationConfig
from dualslam.core.config.settings import LinkingConfig
from dualslam.core.estimates import PreferredCamera
from dualslam.core.geometry import se3, sim3, so3
from dualslam.core.types import Failure, FailureReason, IntArray
from dualslam.linking import NO_BEND, Bend, LinkEstimate, check_camera, propagate_to_live_end
from dualslam.linking.live_end import measure_bend
from dualslam.map.submap import Submap
from tests.backend.test_self_calibration import TRUE, make_submap, wrong_camera
from tests.linking.test_scale_observability import THERE, linked

CONFIG, CALIBRATION = LinkingConfig(), CalibrationConfig()
N = 30
OVERLAP, LIVE_SINCE = np.arange(8), 22


@pytest.fixture(scope="module")
def link() -> LinkEstimate:
    return replace(linked()[1], agreeing_keyframes=OVERLAP)


def asking(camera: PinholeCamera) -> Callable[[Submap, IntArray], PreferredCamera | None]:
    return lambda submap, ids: find_preferred_camera(submap, ids, camera, CALIBRATION)


def found(
    submap: Submap, ids: IntArray, log_scale: float, turn_deg: float, beyond_chance: bool = True
) -> PreferredCamera:
    """Return a camera under which the map's second half would be another by so much, seen from elsewhere."""
    T = submap.keyframe_poses(ids)
    joint = T[len(T) // 2]
    bend = sim3.from_parts(math.exp(log_scale), so3.exp([0.0, math.radians(turn_deg), 0.0]), np.zeros(3))
    bend = joint @ bend @ se3.inverse(joint)
    elsewhere = sim3.from_parts(1.7, so3.exp([0.4, -1.0, 0.2]), np.array([3.0, 1.0, -2.0]))
    moved = [sim3.act_on_pose(elsewhere @ bend if i > len(T) // 2 else elsewhere, T_k) for i, T_k in enumerate(T)]
    return PreferredCamera(0.05, 0.01, 40.0, beyond_chance, ids, T, np.array(moved))


@pytest.mark.parametrize(("log_scale", "turn_deg"), [(0.0, 0.0), (0.03, 0.0), (-0.08, 2.0)])
def test_a_bend_is_by_what_one_end_turns_and_grows(log_scale: float, turn_deg: float) -> None:
    submap = make_submap(TRUE, turning=True, n=N)
    ids = np.arange(N)
    bent = found(submap, ids, log_scale, turn_deg)
    bend = measure_bend(submap.keyframe_poses(ids), bent.T_preferred, OVERLAP, np.arange(LIVE_SINCE, N))
    assert bend.log_scale == pytest.approx(log_scale, abs=1e-9)
    assert math.degrees(bend.rotation_rad) == pytest.approx(turn_deg, abs=1e-6)


def test_the_right_camera_bends_nothing(link: LinkEstimate) -> None:
    submap = make_submap(TRUE, turning=True, n=N)
    bend = check_camera(submap, link, LIVE_SINCE, asking(TRUE), CONFIG)
    assert isinstance(bend, Bend)
    assert abs(bend.log_scale) < 0.005


def test_a_map_that_says_nothing_of_its_camera_has_no_bend(link: LinkEstimate) -> None:
    camera = wrong_camera(1.06)
    submap = make_submap(camera, turning=False, n=N)
    assert check_camera(submap, link, LIVE_SINCE, asking(camera), CONFIG) == NO_BEND


def test_a_camera_that_bends_the_map_is_a_reason_for_no_link(link: LinkEstimate) -> None:
    camera = wrong_camera(1.12)
    true = make_submap(camera, turning=True, n=N)
    submap = true.copy()
    adjust_submap(submap, 1.345)
    ids = np.arange(N)
    poses = [m.keyframe_poses(ids) for m in (submap, true)]
    truth = measure_bend(*poses, OVERLAP, np.arange(LIVE_SINCE, N))
    assert abs(truth.log_scale) > CONFIG.max_live_scale_sigma, "else the scene shows nothing"
    refused = check_camera(submap, link, LIVE_SINCE, asking(camera), CONFIG)
    assert isinstance(refused, Failure)
    assert refused.reason is FailureReason.CAMERA
    assert refused.numbers["bend_scale"] == pytest.approx(truth.log_scale, rel=0.2)
    assert "focal length -1" in refused.detail


@pytest.mark.parametrize(
    ("log_scale", "turn_deg", "passes"),
    [(0.01, 0.5, True), (-0.01, 0.5, True), (0.04, 0.5, True), (0.06, 0.5, False), (0.01, 2.0, False)],
)
def test_what_counts_is_the_bend_and_not_the_contradiction(
    link: LinkEstimate, log_scale: float, turn_deg: float, passes: bool
) -> None:
    submap = make_submap(TRUE, turning=True, n=N)
    for beyond_chance, reason in ((True, FailureReason.CAMERA), (False, FailureReason.SCALE)):
        find = partial(found, log_scale=log_scale, turn_deg=turn_deg, beyond_chance=beyond_chance)
        verdict = check_camera(submap, link, LIVE_SINCE, find, CONFIG)
        assert isinstance(verdict, Bend) is passes
        doubt = verdict.doubt if isinstance(verdict, Bend) else verdict
        assert (doubt is None) is (abs(log_scale) < CONFIG.max_live_scale_sigma and turn_deg < 1.0)
        assert doubt is None or doubt.reason is reason


def test_it_counts_beside_what_else_is_unknown(link: LinkEstimate) -> None:
    submap = make_submap(TRUE, turning=True, n=N)
    find = partial(found, log_scale=0.02, turn_deg=0.0)
    unsure = replace(link, sigma_scale=0.02)
    bends = [check_camera(submap, each, LIVE_SINCE, find, CONFIG) for each in (link, unsure)]
    assert [isinstance(bend, Bend) and bend.doubt is not None for bend in bends] == [False, True]


def test_of_a_large_map_a_window_is_asked_that_reaches_both_ends(
    link: LinkEstimate, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dualslam.linking.live_end.MAX_KEYFRAMES", 12)
    asked: list[IntArray] = []

    def find(submap: Submap, ids: IntArray) -> PreferredCamera | None:
        asked.append(ids)
        return None

    submap = make_submap(TRUE, turning=True, n=N)
    check_camera(submap, link, LIVE_SINCE, find, CONFIG)
    assert len(asked[0]) == 12
    assert (asked[0][0], asked[0][-1]) == (0, N - 1)
    # Next to a live end of one keyframe those before it tell its scale.
    assert isinstance(check_camera(submap, link, N - 1, find, CONFIG), Bend)


def test_a_link_carries_it_in_its_covariance() -> None:
    case, link = linked()
    plain = propagate_to_live_end(link, case.new, int(THERE[0]), CONFIG)
    bent = propagate_to_live_end(link, case.new, int(THERE[0]), CONFIG, Bend(0.015, math.radians(0.5)))
    assert isinstance(plain, LinkEstimate)
    assert isinstance(bent, LinkEstimate)
    assert "sigma_scale_camera" not in plain.numbers
    assert bent.numbers["sigma_scale"] == pytest.approx(math.hypot(plain.numbers["sigma_scale"], 0.015))
    more = bent.covariance - plain.covariance
    np.testing.assert_allclose(np.diag(more)[[0, 1, 2, 6]], [math.radians(0.5) ** 2] * 3 + [0.015**2], rtol=1e-6)
    refused = propagate_to_live_end(link, case.new, int(THERE[0]), CONFIG, Bend(0.03))
    assert isinstance(refused, Failure)


@pytest.mark.parametrize("seed", range(8))
def test_what_counts_is_never_less_than_the_bend_without_its_variance(seed: int) -> None:
    """In whatever direction of the camera's parameters the map bends: the bound must hold without knowing it."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(5, 5))
    covariance = A @ A.T
    for size in (0.3, 1.0, 2.0, 5.0):
        correction = size * A @ rng.normal(size=5) / math.sqrt(5.0)
        distance2 = float(correction @ np.linalg.solve(covariance, correction))
        # The worst direction first, in which all of the distance is this bend's.
        for g in (np.linalg.solve(covariance, correction), *rng.normal(size=(20, 5))):
            bend, variance = float(g @ correction), float(g @ covariance @ g)
            counted = Bend(bend, abs(bend)).beyond_chance(distance2)
            assert bend**2 - variance <= counted.log_scale**2 + 1e-9
            assert abs(counted.log_scale) <= abs(bend)
            assert counted.rotation_rad == pytest.approx(abs(counted.log_scale))


def test_a_camera_within_one_sigma_bends_nothing(link: LinkEstimate) -> None:
    submap = make_submap(TRUE, turning=True, n=N)
    for distance2, passes in ((0.9, True), (1.3, True), (4.0, False)):

        def find(submap: Submap, ids: IntArray, distance2: float = distance2) -> PreferredCamera:
            return replace(found(submap, ids, 0.04, 0.0, beyond_chance=False), distance2=distance2)

        bend = check_camera(submap, link, LIVE_SINCE, find, CONFIG)
        assert isinstance(bend, Bend)
        assert (bend.doubt is None) is passes
