"""Pairs of maps that must not be linked (or only where they are true), made from healthy ones."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from dualslam.core.geometry import se3, sim3, so3
from dualslam.core.types import FloatArray, Keyframe
from dualslam.map.submap import Submap
from dualslam.testing.link_worlds import (
    FRAME_STEP,
    Case,
    Recipe,
    build,
    drifted_poses,
    finish,
    make_case,
    make_tail_case,
    make_world,
)

ONSET = 10
ONSET_ID = ONSET * FRAME_STEP


def set_points(submap: Submap, xyz: FloatArray) -> None:
    """Put all landmarks elsewhere (L, 3)."""
    submap.landmarks["xyz_mu"][:] = xyz


def affine(submap: Submap, A: FloatArray) -> None:
    """Apply an affine map to all points and camera centres; orientations stay (for a mirror: are reflected twice)."""
    mirror = np.linalg.det(A) < 0
    set_points(submap, submap.landmarks["xyz_mu"] @ A.T)
    for k, T in submap.T_submap_kf.items():
        R = T[:3, :3]
        if mirror:
            M = A / np.abs(np.linalg.det(A)) ** (1 / 3)
            R = M @ R @ np.diag([-1.0, 1.0, 1.0])
        submap.T_submap_kf[k] = se3.from_parts(so3.orthonormalise(R), A @ T[:3, 3])


def mirrored(layout: str, seed: int, flip_pixels: bool) -> Case:
    """A mirror image of the world. `flip_pixels`: the images too, so that the mirrored map is consistent in itself."""
    case = make_case(layout, seed)
    rng = np.random.default_rng(seed)
    n = rng.normal(size=3)
    n /= np.linalg.norm(n)
    affine(case.new, np.eye(3) - 2 * np.outer(n, n))
    if flip_pixels:
        cx = case.new.K[0, 2]
        for k, keyframe in case.new.keyframes.items():
            f = keyframe.features
            uv = f.uv_rect_px * [-1, 1] + [2 * cx, 0]
            case.new.keyframes[k] = Keyframe(k, keyframe.timestamp_s, replace(f, uv_px=uv, uv_rect_px=uv))
    return case


def stretched(layout: str, seed: int, axis: int, percent: float) -> Case:
    """A copy stretched along one axis of the (turned) new map."""
    case = make_case(layout, seed)
    R = so3.exp(np.random.default_rng(seed).normal(size=3))
    affine(case.new, R @ np.diag(1.0 + 0.01 * percent * (np.arange(3) == axis)) @ R.T)
    return case


def two_scales(layout: str, seed: int, split: str, factor: float) -> Case:
    """A copy of which a part has another scale: the newer part in time, the far half, or random points."""
    case = make_case(layout, seed)
    rng = np.random.default_rng(seed)
    new = case.new
    ids = np.array(sorted(new.keyframes))
    middle = int(ids[6 + seed % 4])
    centre = new.T_submap_kf[middle][:3, 3]
    xyz = new.landmarks["xyz_mu"].copy()
    distance = np.linalg.norm(xyz - centre, axis=1)
    if split == "time":
        part = new.landmarks["first_kf"] > middle
        for k in ids[ids > middle].tolist():
            new.T_submap_kf[k][:3, 3] = centre + factor * (new.T_submap_kf[k][:3, 3] - centre)
    elif split == "depth":
        part = distance > np.median(distance)
    else:
        part = rng.random(len(xyz)) < 0.5
    xyz[part] = centre + factor * (xyz[part] - centre)
    set_points(new, xyz)
    return case


def different_places(layout: str, seed: int) -> Case:
    """Maps of two places whose keyframes bear the same ids; features too, as if one front end had made both."""
    case, other = make_case(layout, seed), make_case(layout, seed + 500)
    new = other.new
    for k in list(new.keyframes):
        if k in case.old.keyframes:
            shared = case.old.keyframes[k].features
            n = len(new.landmark_of[k])
            rows = np.arange(n) % len(shared)
            new.keyframes[k] = Keyframe(k, 0.0, shared if n == len(shared) else shared.take(rows))
            if seed % 2 and n > len(shared):  # very same features: matched by identity
                keep = new.observations["kf"] == k
                too_far = np.flatnonzero(keep & (new.observations["feature"] >= len(shared)))
                new.remove_observations(too_far)
                new.landmark_of[k] = new.landmark_of[k][: len(shared)]
                new.keyframes[k] = Keyframe(k, 0.0, shared)
    return Case(case.old, new, case.S_old_new, case.extent_mu)


def repeated_texture(layout: str, seed: int, share: float, coherent: bool) -> Case:
    """New landmarks that took the place of their neighbours one period on: displaced all alike, or each its own way."""
    case = make_case(layout, seed)
    rng = np.random.default_rng(seed)
    new = case.new
    xyz = new.landmarks["xyz_mu"].copy()
    size = float(np.median(np.linalg.norm(xyz - np.median(xyz, axis=0), axis=1)))
    period = rng.normal(size=3)
    period *= 0.3 * size / np.linalg.norm(period)
    times = np.ones(len(xyz)) if coherent else rng.integers(-2, 3, len(xyz))
    moved = rng.random(len(xyz)) < share
    xyz[moved] += times[moved, None] * period
    set_points(new, xyz)
    return case


def tail_displacement(seed: int, layout: str) -> FloatArray:
    """A wrong pose: a turn, a jump or another scale, or all of them, large enough to be wrong."""
    rng = np.random.default_rng(seed)
    size = 3.0 if layout == "street" else 0.6
    turn, jump = rng.normal(size=3), rng.normal(size=3)
    turn *= np.radians(rng.uniform(5, 25)) / np.linalg.norm(turn)
    jump *= size * rng.uniform(1.0, 2.0) / np.linalg.norm(jump)
    log_scale = rng.choice([-1.0, 1.0]) * rng.uniform(0.1, 0.4)
    kind = seed % 4
    return sim3.from_parts(
        np.exp(log_scale if kind in (2, 3) else 0.0),
        so3.exp(turn if kind in (0, 3) else np.zeros(3)),
        jump if kind in (1, 3) else np.zeros(3),
    )


def corrupted_tail(layout: str, seed: int, oldest_new: int, kept_ties: float) -> Case:
    """Frames from `ONSET` to 17 of the old map are displaced; the new map reaches back to frame `oldest_new`."""
    case = _tail_case(layout, seed, oldest_new, kept_ties)
    return replace(case, old=case.old.copy(), new=case.new.copy())


@lru_cache(maxsize=256)
def _tail_case(layout: str, seed: int, oldest_new: int, kept_ties: float) -> Case:
    return make_tail_case(layout, seed, ONSET, oldest_new, tail_displacement(seed, layout), kept_ties=kept_ties)


def creeping_tail(layout: str, seed: int, oldest_new: int, rate: float) -> Case:
    """The old map's scale runs away from frame `ONSET` on, by about `rate` more each frame: nowhere is it torn.

    Landmarks seen on both sides are placed by what both saw, so that healthy keyframes hold some that are off.
    """
    rng = np.random.default_rng(4000 + seed)
    world = make_world(layout, seed)
    poses = drifted_poses(world, ONSET - 2, rng, 0.002)
    sign, log_scale = rng.choice([-1.0, 1.0]), 0.0
    for f in range(ONSET, len(poses) - 1):
        step = se3.inverse(world.T_w_cam[f]) @ world.T_w_cam[f + 1]
        log_scale += sign * rate * rng.uniform(0.5, 1.5)
        step[:3, 3] *= np.exp(log_scale)
        poses[f + 1] = poses[f] @ step @ se3.exp(np.r_[0.2 * rate * rng.normal(size=3), np.zeros(3)])
    old = build(world, Recipe(list(range(18)), ONSET), 0, rng, poses)
    new = build(world, Recipe(list(range(23, oldest_new - 1, -1)), (oldest_new + ONSET) // 2), 1, rng)
    return finish(old, new, rng)
