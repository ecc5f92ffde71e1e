"""Starts of a map: right where the views allow one, refused where they do not."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from dualslam.backend.local_ba import bundle_adjust_arrays
from dualslam.core.config.settings import InitialiserConfig
from dualslam.core.types import Failure, FailureReason, FloatArray, Start, View
from dualslam.frontends.features.orb import OrbFrontend
from dualslam.frontends.tracking.initialiser import MAX_DIRECTION_SIGMA_DEG, MIN_PARALLAX_DEG, Initialiser
from dualslam.testing.point_world import CAMERA, SIZE_PX, PointWorld, cloud, path, pose_errors, random_features
from tests.seeds import first_of

ROTATION_RAD = 0.01
TRANSLATION = 3 * np.radians(MAX_DIRECTION_SIGMA_DEG)
"""Of the baseline: three of the standard deviations that the direction may have."""


def initialiser() -> Initialiser:
    return Initialiser(OrbFrontend(), bundle_adjust_arrays, InitialiserConfig(), CAMERA.K, SIZE_PX, 0)


def bound_direction(monkeypatch: pytest.MonkeyPatch, max_sigma_deg: float) -> None:
    monkeypatch.setattr("dualslam.frontends.tracking.initialiser.MAX_DIRECTION_SIGMA_DEG", max_sigma_deg)


def feed(views: list[View]) -> tuple[Start | None, list[Failure]]:
    starter, refusals = initialiser(), []
    for view in views:
        start = starter.add(view)
        if start:
            return start, refusals
        refusals.append(start)
    return None, refusals


@pytest.mark.parametrize(
    ("step_m", "turn_rad"),
    [
        ([0.1, 0, 0], [0, 0, 0]),
        ([0.1, 0, 0], [0, -0.01, 0]),
        ([0.0, 0.03, 0.25], [0, 0.005, 0]),
        ([0.0, 0.0, 0.25], [0, 0, 0]),
        ([0.05, 0.05, 0.05], [0.005, 0.005, 0.02]),
    ],
    ids=["sideways", "around", "drive and turn", "ahead", "screw"],
)
@pytest.mark.parametrize("seed", first_of([0, 1]))
def test_start_is_right(step_m: FloatArray, turn_rad: FloatArray, seed: int) -> None:
    world = PointWorld(cloud(seed=seed), path(30, step_m, turn_rad), seed=seed)
    start, _ = feed(world.views())
    assert start is not None
    T_true = world.T_world_cam[[view.index for view in start.views]]
    translation, rotation = pose_errors(start.T_first_cam, T_true)
    baseline_m = np.linalg.norm(T_true[-1, :3, 3] - T_true[0, :3, 3])
    assert rotation.max() < ROTATION_RAD
    assert translation.max() < TRANSLATION * baseline_m
    assert np.median(start.xyz[:, 2]) == pytest.approx(1.0)
    assert (start.feature[[0, -1]] >= 0).all()


def test_near_points_start_a_map_however_many_are_far() -> None:
    """As on a road: most of what is seen has no parallax, and the rest fixes the motion."""
    xyz = np.concatenate([15 * cloud(900, 1), cloud(300)])
    world = PointWorld(xyz, path(8, np.array([0, 0.03, 0.25]), np.array([0, 0.005, 0])))
    start, refusals = feed(world.views())
    assert start is not None
    assert len(refusals) <= 4
    assert start.numbers["parallax_deg"] < 0.5 * MIN_PARALLAX_DEG
    T_true = world.T_world_cam[[view.index for view in start.views]]
    translation, rotation = pose_errors(start.T_first_cam, T_true)
    assert rotation.max() < ROTATION_RAD
    assert translation.max() < TRANSLATION * np.linalg.norm(T_true[-1, :3, 3] - T_true[0, :3, 3])


@pytest.mark.parametrize("seed", first_of(range(4)))
def test_what_is_far_has_its_say_beside_a_near_plane(seed: int) -> None:
    """As where a drone takes off from a bench: a pose that takes the turn for parallax has more points."""
    rng = np.random.default_rng(seed)
    bench = np.column_stack([rng.uniform(-1.2, 1.2, 500), rng.uniform(0.1, 0.9, 500), np.zeros(500)])
    bench[:, 2] = 2.0 - 0.9 * bench[:, 1]
    hall = np.column_stack([rng.uniform(-60, 60, 300), rng.uniform(-45, 0, 300), rng.uniform(60, 90, 300)])
    world = PointWorld(np.vstack([bench, hall]), path(24, [0.002, -0.006, 0.004], [0.003, 0.001, 0.0]), seed=seed)
    start, _ = feed(world.views())
    if start is None:
        return
    T_true = world.T_world_cam[[view.index for view in start.views]]
    translation, rotation = pose_errors(start.T_first_cam, T_true)
    assert rotation.max() < ROTATION_RAD
    assert translation.max() < TRANSLATION * np.linalg.norm(T_true[-1, :3, 3] - T_true[0, :3, 3])


@pytest.mark.parametrize("turn_rad", [[0, 0, 0], [0, 0.02, 0], [0.01, 0.01, 0.01]], ids=["still", "pan", "all axes"])
@pytest.mark.parametrize("seed", first_of([0, 1]))
def test_no_start_without_a_baseline(turn_rad: FloatArray, seed: int) -> None:
    world = PointWorld(cloud(1200, seed), path(20, np.zeros(3), turn_rad), seed=seed)
    start, refusals = feed(world.views())
    assert start is None
    assert {refusal.reason for refusal in refusals[1:]} <= {
        FailureReason.LOW_PARALLAX,
        FailureReason.TOO_FEW_INLIERS,
        FailureReason.TOO_FEW_MATCHES,
        FailureReason.AMBIGUOUS_MODEL,
        FailureReason.DOUBTFUL_INITIALISATION,
        FailureReason.CHI_SQUARE,
    }


@pytest.mark.parametrize("step_m", [0.005, 0.01, 0.02])
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_pairs_that_are_refused_early_start_no_map_otherwise(
    step_m: float, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    world = PointWorld(cloud(seed=seed), path(30, [step_m, 0, 0], [0, 0.02, 0]), seed=seed)
    is_hopeless, found = Initialiser._hopeless, []

    def count(*args: Any) -> Failure | None:
        found.append(is_hopeless(*args))
        return found[-1]

    monkeypatch.setattr(Initialiser, "_hopeless", count)
    early, refused_early = feed(world.views())
    assert any(failure is not None for failure in found)
    monkeypatch.setattr(Initialiser, "_hopeless", lambda *args: None)
    late, refused_late = feed(world.views())
    assert len(refused_early) == len(refused_late)
    assert (early is None) == (late is None)
    if early is not None and late is not None:
        assert np.array_equal(early.T_first_cam, late.T_first_cam)
        assert np.array_equal(early.xyz, late.xyz)


def test_a_plane_gives_the_right_start_or_none() -> None:
    xyz = cloud(1200)
    xyz[:, 2] = 6 + 0.2 * xyz[:, 0]
    world = PointWorld(xyz, path(30, np.array([0.1, 0.02, 0.03]), np.array([0, -0.005, 0])))
    start, _ = feed(world.views())
    if start is not None:
        translation, rotation = pose_errors(start.T_first_cam, world.T_world_cam[[v.index for v in start.views]])
        assert rotation.max() < 2 * ROTATION_RAD
        assert translation.max() < 0.1


def test_no_start_from_noise() -> None:
    orb, rng = OrbFrontend(), np.random.default_rng(0)
    dark = [np.clip(rng.normal(0, 1.8, (240, 320)), 0, 255).astype(np.uint8) for _ in range(10)]
    bright = [np.clip(rng.normal(128, 30, (240, 320)), 0, 255).astype(np.uint8) for _ in range(10)]
    start, _ = feed([View(i, i / 10, orb.extract(image)) for i, image in enumerate(dark + bright)])
    assert start is None
    start, refusals = feed([View(i, i / 10, random_features(rng, 1000)) for i in range(10)])
    assert start is None
    assert refusals[-1].reason is FailureReason.TOO_FEW_MATCHES


def test_too_little_to_see_is_said() -> None:
    _, refusals = feed([View(i, i / 10, random_features(np.random.default_rng(i), 30)) for i in range(3)])
    assert [r.reason for r in refusals] == [FailureReason.NO_TEXTURE] * 3


def test_witnesses_that_disagree_refuse_the_start() -> None:
    """The frames between the two views show something else: the pair alone must not start a map."""
    world = PointWorld(cloud(), path(4, np.array([0.3, 0, 0]), np.zeros(3)))
    other = PointWorld(cloud(seed=9), path(4, np.array([0.3, 0, 0]), np.zeros(3)), seed=9)
    starter = initialiser()
    for view in (world.view(0), other.view(1), world.view(2)):
        starter.collect(view)
    refusal = starter.try_pair(0, 2)
    assert isinstance(refusal, Failure)
    assert refusal.reason is FailureReason.DOUBTFUL_INITIALISATION
    assert refusal.numbers["support"] == 0


@pytest.mark.parametrize(("n_seen", "starts"), [(26, False), (34, True)])
def test_a_map_starts_with_a_third_of_its_points_proven(n_seen: int, starts: bool) -> None:
    """These fix the poses; by them the start grows to the landmarks that the next frame needs."""
    world = PointWorld(cloud(), path(4, np.array([0.3, 0, 0]), np.zeros(3)))
    starter = initialiser()
    first, between, last = (world.view(i) for i in range(3))
    orb = OrbFrontend()
    in_first, in_last = orb.match_wide(first.features, last.features).index[:75].T
    ends = [replace(v, features=v.features.take(seen)) for v, seen in ((first, in_first), (last, in_last))]
    seen = orb.match_wide(ends[0].features, between.features).index[:, 1]
    others = np.setdiff1d(np.arange(len(between.features)), seen)[:50]
    witness = replace(between, features=between.features.take(np.concatenate([seen[:n_seen], others])))
    for view in (ends[0], witness, ends[1]):
        starter.collect(view)
    start = starter.try_pair(0, 2)
    if starts:
        assert isinstance(start, Start)
        assert n_seen * 0.7 < len(start.xyz) <= n_seen
    else:
        assert isinstance(start, Failure)
        assert "prove" in start.detail


def test_direction_is_known_as_well_as_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    errors, sigmas = [], []
    for seed in range(8):
        world = PointWorld(cloud(seed=seed), path(9, np.array([0.06, 0, 0.02]), np.zeros(3)), noise_px=1.0, seed=seed)
        starter = initialiser()
        for view in world.views():
            starter.collect(view)
        start = starter.try_pair(0, 8)
        assert isinstance(start, Start)
        t, t_true = start.T_first_cam[-1, :3, 3], world.T_world_cam[8, :3, 3]
        cosine = t @ t_true / np.linalg.norm(t) / np.linalg.norm(t_true)
        errors.append(np.degrees(np.arccos(min(cosine, 1.0))))
        sigmas.append(start.numbers["direction_sigma_deg"])
    # The sigma is that of the worse of two axes.
    assert 0.3 < np.sqrt(np.mean(np.square(errors))) / np.mean(sigmas) < 1.6
    bound_direction(monkeypatch, 0.5 * min(sigmas))
    strict = initialiser()
    for view in world.views():
        strict.collect(view)
    refusal = strict.try_pair(0, 8)
    assert isinstance(refusal, Failure)
    assert "direction of translation" in refusal.detail


@pytest.mark.parametrize(("worse", "starts"), [(1.2, True), (1.5, False)])
def test_after_a_long_wait_a_direction_may_be_known_a_third_less_well(
    worse: float, starts: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    world = PointWorld(cloud(), path(9, np.array([0.06, 0, 0.02]), np.zeros(3)), noise_px=1.0)
    *earlier, newest = world.views()
    usual = _fed(initialiser(), earlier).add(newest)
    assert isinstance(usual, Start)
    bound_direction(monkeypatch, usual.numbers["direction_sigma_deg"] / worse)
    for waited_s, expected in ((0.0, False), (9.0, False), (15.0, starts), (100.0, starts)):
        found = _fed(initialiser(), earlier).add(newest, waited_s)
        assert bool(found) is expected
        assert found or "direction of translation" in found.detail


def _fed(starter: Initialiser, views: list[View]) -> Initialiser:
    for view in views:
        starter.collect(view)
    return starter


@pytest.mark.parametrize(("noise_of_sigma", "worth"), [(1.0, 1.0), (0.6, 1.0), (0.02, 2 / 3)])
def test_direction_is_known_better_where_pixels_are_calmer_than_usual(noise_of_sigma: float, worth: float) -> None:
    """The bound is for residuals of 0.3 sigmas; what is calmer is taken as it is, down to what drawn pictures have."""
    at_usual, at_this = [
        _direction_sigma_deg(PointWorld(cloud(), path(9, [0.06, 0, 0.02], [0, 0, 0]), noise_px=noise), 1.0 / noise)
        for noise in (1.0, noise_of_sigma)
    ]
    assert at_this == pytest.approx(worth * at_usual, rel=0.15)


def _direction_sigma_deg(world: PointWorld, claim: float) -> float:
    """Return how well the first and the last view say to know their direction, of sigmas `claim` times the noise."""
    starter = initialiser()
    for view in world.views():
        features = replace(view.features, sigma_px=claim * view.features.sigma_px)
        starter.collect(replace(view, features=features))
    start = starter.try_pair(0, 8)
    assert isinstance(start, Start)
    return start.numbers["direction_sigma_deg"]


def test_collected_views_can_be_first_views() -> None:
    """What a lost track collected starts the next map as soon as one more frame comes."""
    world = PointWorld(cloud(), path(12, np.array([0.12, 0, 0]), np.zeros(3)))
    starter = initialiser()
    for view in world.views()[:-1]:
        starter.collect(view)
    start = starter.add(world.view(11))
    assert isinstance(start, Start)
    assert start.views[-1].index == 11


ROUND = 128
"""Frames in which the camera turns round."""


def turned_round(step_m: float, n_points: int = 4000) -> PointWorld:
    """A camera that turns round while it moves by a little: it sees the same again from somewhere else."""
    xyz = 3 * cloud(3 * n_points)[:n_points] - [0, 0, 22.5]
    T_world_cam = path(ROUND + 8, [step_m, 0, 0], [0, 2 * np.pi / ROUND, 0])
    return PointWorld(xyz[np.linalg.norm(xyz, axis=1) > 4], T_world_cam)


def test_what_is_seen_again_after_a_turn_starts_a_map() -> None:
    world = turned_round(0.01)
    starter = _fed(initialiser(), world.views()[:ROUND])
    start = starter.add(world.view(ROUND))
    assert isinstance(start, Start)
    assert start.views[0].index == 0
    T_true = world.T_world_cam[[view.index for view in start.views]]
    translation, rotation = pose_errors(start.T_first_cam, T_true)
    assert rotation.max() < ROTATION_RAD
    assert translation.max() < TRANSLATION * np.linalg.norm(T_true[-1, :3, 3] - T_true[0, :3, 3])


@pytest.mark.parametrize(("step_m", "n_points"), [(0.0, 4000), (0.01, 700)], ids=["no step", "few points"])
def test_a_turn_alone_starts_no_map_and_neither_do_few_points(step_m: float, n_points: int) -> None:
    world = turned_round(step_m, n_points)
    starter = _fed(initialiser(), world.views()[:ROUND])
    assert not any(starter.add(world.view(i)) for i in range(ROUND, ROUND + 8))


def test_the_same_views_give_the_same_start() -> None:
    world = PointWorld(cloud(), path(20, np.array([0.1, 0, 0.02]), np.array([0, 0.004, 0])))
    (a, _), (b, _) = feed(world.views()), feed(world.views())
    assert a is not None
    assert b is not None
    assert np.array_equal(a.T_first_cam, b.T_first_cam)
    assert np.array_equal(a.xyz, b.xyz)


def test_in_a_hurry_one_pair_is_tried_at_a_time_and_the_map_that_starts_is_right() -> None:
    world = PointWorld(cloud(), path(30, np.array([0.02, 0, 0]), np.array([0, 0.001, 0])))
    starter, lags = initialiser(), []
    try_pair = starter.try_pair

    def noted(first: int, last: int, lenience: float) -> Start | Failure:
        lags.append(last - first)
        return try_pair(first, last, lenience)

    starter.try_pair = noted  # type: ignore[method-assign]
    starts = []
    for view in world.views():
        n_tried = len(lags)
        start = starter.add(view, briefly=True)
        assert len(lags) <= n_tried + 1
        if start:
            starts.append(start)
            break
    (start,) = starts
    assert max(lags) >= 4  # not the nearest alone
    T_true = world.T_world_cam[[view.index for view in start.views]]
    translation, rotation = pose_errors(start.T_first_cam, T_true)
    assert rotation.max() < ROTATION_RAD
    assert translation.max() < TRANSLATION * np.linalg.norm(T_true[-1, :3, 3] - T_true[0, :3, 3])


@pytest.mark.parametrize("briefly", [False, True])
def test_pairs_far_enough_apart_are_tried_and_no_nearer_ones_in_vain(
    briefly: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Too little in common 30 frames back and more, too little parallax up to 5 frames back: 8 and 16 are tried."""
    starter, tried = initialiser(), []

    def judge(first: int, last: int, lenience: float) -> Failure:
        lag = last - first
        tried.append(lag)
        if lag > 30:
            return Failure(FailureReason.TOO_FEW_MATCHES, "")
        return Failure(FailureReason.LOW_PARALLAX if lag < 6 else FailureReason.AMBIGUOUS_MODEL, "")

    monkeypatch.setattr(starter, "try_pair", judge)
    for view in PointWorld(cloud(), path(110, np.array([0.01, 0, 0]), np.zeros(3))).views():
        starter.add(view, briefly=briefly)
    late = tried[len(tried) // 2 :]
    assert late.count(8) + late.count(16) > 0.45 * len(late)
    assert {8, 16, 32} <= set(late), "farther ones are asked again: the camera may stand still meanwhile"
    assert 2 not in late


def test_while_nothing_moves_no_pair_is_tried_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    starter, tried = initialiser(), []

    def judge(first: int, last: int, lenience: float) -> Failure:
        tried.append((first, last))
        return Failure(FailureReason.LOW_PARALLAX, "")

    monkeypatch.setattr(starter, "try_pair", judge)
    for view in PointWorld(cloud(), path(60, np.zeros(3), np.zeros(3))).views():
        starter.add(view)
    assert len(tried) == len(set(tried)) > 50


def test_too_little_parallax_says_how_far_the_image_has_moved() -> None:
    """A turn of 0.02 rad moves the image by about that much of the focal length."""
    world = PointWorld(cloud(), path(3, np.zeros(3), np.array([0, 0.01, 0])))
    starter = initialiser()
    for view in world.views():
        starter.collect(view)
    refusal = starter.try_pair(0, 2)
    assert isinstance(refusal, Failure)
    assert refusal.reason is FailureReason.LOW_PARALLAX
    assert refusal.numbers["shift_px"] == pytest.approx(0.02 * CAMERA.K[0, 0], rel=0.2)
