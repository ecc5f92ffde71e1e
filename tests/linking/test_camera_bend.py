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
from dualslam.core.config.settings import CalibrationConfig, LinkingConfig
from dualslam.core.estimates import PreferredCamera
from dualslam.core.geometry import se3, sim3, so3
from dualslam.core.types import FailureReason, IntArray
from dualslam.linking import LinkEstimate, LinkRefusal, add_camera
from dualslam.linking.live_end import Bend, measure_bend
from dualslam.map.submap import Submap
from tests.backend.test_self_calibration import TRUE, make_submap, wrong_camera
from tests.linking.test_scale_observability import linked

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
    return PreferredCamera(0.05, 0.01, 40.0, beyond_chance, ids, T, np.array(moved), np.empty((0, *T.shape)))


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
    carried = add_camera(link, submap, LIVE_SINCE, asking(TRUE), CONFIG)
    assert isinstance(carried, LinkEstimate)
    assert carried.numbers["sigma_scale_camera"] < 0.005


def test_a_map_that_says_nothing_of_its_camera_has_no_bend(link: LinkEstimate) -> None:
    camera = wrong_camera(1.06)
    submap = make_submap(camera, turning=False, n=N)
    assert add_camera(link, submap, LIVE_SINCE, asking(camera), CONFIG) is link


def bent_and_true(camera: PinholeCamera) -> tuple[Submap, Bend]:
    """Return a map that a wrong camera has bent, and by how much."""
    true = make_submap(camera, turning=True, n=N)
    submap = true.copy()
    adjust_submap(submap, 1.345)
    ids = np.arange(N)
    poses = [m.keyframe_poses(ids) for m in (submap, true)]
    return submap, measure_bend(*poses, OVERLAP, np.arange(LIVE_SINCE, N))


def test_a_camera_that_bends_the_map_is_a_reason_for_no_link(link: LinkEstimate) -> None:
    camera = wrong_camera(1.12)
    submap, truth = bent_and_true(camera)
    assert abs(truth.log_scale) > CONFIG.max_live_scale_sigma, "else the scene shows nothing"
    refused = add_camera(link, submap, LIVE_SINCE, asking(camera), CONFIG)
    assert isinstance(refused, LinkRefusal)
    assert refused.unsure is None, "the scale would do for a doubt, but not the turn"
    assert refused.reason is FailureReason.CAMERA
    assert refused.numbers["sigma_scale_camera"] == pytest.approx(abs(truth.log_scale), rel=0.2)
    assert "focal length -1" in refused.detail


@pytest.mark.parametrize("log_focal", [0.01, 0.03])
def test_a_camera_that_is_known_to_a_covariance_bends_the_map_as_one_that_is_so_far_off(
    link: LinkEstimate, log_focal: float
) -> None:
    _, truth = bent_and_true(wrong_camera(math.exp(log_focal)))
    submap, known = make_submap(TRUE, turning=True, n=N), np.diag([log_focal, 1e-6, 1e-6, 1e-9, 1e-9]) ** 2
    find = partial(find_preferred_camera, camera=TRUE, config=CALIBRATION, present_covariance=known)
    carried = add_camera(replace(link, sigma_scale=0.0), submap, LIVE_SINCE, find, CONFIG)
    carried = carried.unsure if isinstance(carried, LinkRefusal) else carried
    assert isinstance(carried, LinkEstimate)
    assert carried.sigma_scale == pytest.approx(abs(truth.log_scale), rel=0.25, abs=0.002)
    turned = math.sqrt((carried.covariance - link.covariance)[0, 0])
    assert turned == pytest.approx(truth.rotation_rad, rel=0.25, abs=0.002)


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
        verdict = add_camera(link, submap, LIVE_SINCE, find, CONFIG)
        is_sure = abs(log_scale) < CONFIG.max_live_scale_sigma and turn_deg < 1.0
        assert isinstance(verdict, LinkEstimate) is is_sure
        if isinstance(verdict, LinkRefusal):
            assert (verdict.unsure is not None) is passes
            assert verdict.reason is reason


def test_it_counts_beside_what_else_is_unknown(link: LinkEstimate) -> None:
    submap = make_submap(TRUE, turning=True, n=N)
    find = partial(found, log_scale=0.02, turn_deg=0.0)
    unsure = replace(link, sigma_scale=0.02)
    verdicts = [add_camera(each, submap, LIVE_SINCE, find, CONFIG) for each in (link, unsure)]
    assert [isinstance(verdict, LinkEstimate) for verdict in verdicts] == [True, False]


def test_of_a_large_map_a_window_is_asked_that_reaches_both_ends(
    link: LinkEstimate, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dualslam.linking.live_end.MAX_KEYFRAMES", 12)
    asked: list[IntArray] = []

    def find(submap: Submap, ids: IntArray) -> PreferredCamera | None:
        asked.append(ids)
        return None

    submap = make_submap(TRUE, turning=True, n=N)
    add_camera(link, submap, LIVE_SINCE, find, CONFIG)
    assert len(asked[0]) == 12
    assert (asked[0][0], asked[0][-1]) == (0, N - 1)
    # Next to a live end of one keyframe those before it tell its scale.
    assert add_camera(link, submap, N - 1, find, CONFIG) is link


def test_a_link_carries_it_in_its_covariance(link: LinkEstimate) -> None:
    submap = make_submap(TRUE, turning=True, n=N)
    bent = add_camera(link, submap, LIVE_SINCE, partial(found, log_scale=0.015, turn_deg=0.5), CONFIG)
    assert isinstance(bent, LinkEstimate)
    share = math.sqrt(1.0 - 1.0 / 40.0)
    assert bent.numbers["sigma_scale"] == pytest.approx(math.hypot(link.sigma_scale, share * 0.015))
    more = bent.covariance - link.covariance
    sigmas = share * np.array([math.radians(0.5)] * 3 + [0.015])
    np.testing.assert_allclose(np.diag(more)[[0, 1, 2, 6]], sigmas**2, rtol=1e-6)


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

        verdict = add_camera(link, submap, LIVE_SINCE, find, CONFIG)
        assert isinstance(verdict, LinkEstimate) is passes
