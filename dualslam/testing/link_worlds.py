"""Pairs of submaps with known truth: one path through a street or a room, mapped forwards (old) and backwards (new)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from dualslam.core.geometry import se3, sim3, so3
from dualslam.core.geometry.triangulation import triangulate_n_view
from dualslam.core.types import BoolArray, Features, FloatArray, IntArray, Keyframe
from dualslam.map.submap import Submap

FRAME_STEP = 3  # keyframe ids are frame indices, every third frame is a keyframe


@dataclass(frozen=True)
class World:
    """Truth, and what all maps share: the features of each frame.

    Attributes
    ----------
    K : (3, 3), T_w_cam : (F, 4, 4), xyz : (P, 3)
    seen : (F, P) bool
    uv : (F, P, 2), noisy pixels, NaN where not seen
    feature_of : (F, P) int64, or -1
    features : list of Features
    """

    K: FloatArray
    T_w_cam: FloatArray
    xyz: FloatArray
    seen: BoolArray
    uv: FloatArray
    feature_of: IntArray
    features: list[Features]


def hamming(a: np.ndarray, b: np.ndarray) -> FloatArray:
    """Return the number of bits in which binary descriptors (..., bytes) differ."""
    return np.bitwise_count(a ^ b).sum(-1).astype(float)


@lru_cache(maxsize=64)
def make_world(layout: str, seed: int, n_frames: int = 24, noise_px: float = 0.8, per_view: int = 220) -> World:
    """Make the world of a layout (`street`, ...), and what a camera on its way through it sees in each frame."""
    rng = np.random.default_rng(seed)
    i = np.arange(n_frames)
    if layout == "street":
        K, size = np.array([[700.0, 0, 600], [0, 700, 190], [0, 0, 1]]), np.array([1200, 380])
        centre = np.column_stack([0.5 * np.sin(0.1 * i + seed), 0.03 * np.sin(i), 0.8 * i])
        heading = 0.08 * np.sin(0.15 * i + seed)
        n = 1100
        side = rng.choice([-1.0, 1.0], n) * rng.uniform(2.5, 8, n)
        xyz = np.column_stack([side, rng.uniform(-4, 1.5, n), rng.uniform(2, 0.8 * n_frames + 25, n)])
        near, far = 2.0, 30.0
    else:
        K, size = np.array([[525.0, 0, 320], [0, 525, 240], [0, 0, 1]]), np.array([640, 480])
        centre = np.column_stack([0.08 * i, 0.05 * np.sin(0.5 * i), 0.15 * np.sin(0.2 * i + seed)])
        heading = 0.25 * np.sin(0.2 * i + seed)
        n = 1100
        xyz = rng.uniform([-2.5, -1.6, 1.2], [4.5, 1.6, 4.5], (n, 3))
        wall = rng.integers(0, 3, n)
        xyz[wall == 0, 2] = 4.0
        xyz[wall == 1, 1] = 1.4
        near, far = 0.5, 7.0
    R = so3.exp(np.column_stack([0.02 * np.sin(0.4 * i), heading, 0.02 * np.cos(0.3 * i)]))
    T = se3.from_parts(R, centre)
    cam = se3.act(se3.inverse(T), xyz[None])
    with np.errstate(divide="ignore", invalid="ignore"):
        uv = cam[..., :2] / cam[..., 2:] * K[[0, 1], [0, 1]] + K[:2, 2]
    seen = (cam[..., 2] > near) & (cam[..., 2] < far) & (uv > 0).all(-1) & (uv < size).all(-1)
    seen &= rng.random(seen.shape) < np.minimum(1.0, per_view / np.maximum(seen.sum(1), 1))[:, None]
    octave = rng.integers(0, 3, seen.shape)
    sigma = noise_px * 1.2**octave
    uv = np.where(seen[..., None], uv + sigma[..., None] * rng.normal(size=uv.shape), np.nan)
    words = rng.integers(0, 256, (len(xyz), 32), dtype=np.uint8)
    feature_of = np.full(seen.shape, -1)
    features = []
    for f in range(n_frames):
        points = np.flatnonzero(seen[f])
        feature_of[f, points] = np.arange(len(points))
        flips = np.packbits(rng.random((len(points), 256)) < 0.08, axis=1)
        s = sigma[f, points]
        features.append(
            Features(uv[f, points], uv[f, points], s, s / noise_px, octave[f, points], 0 * s, words[points] ^ flips)
        )
    return World(K, T, xyz, seen, uv, feature_of, features)


def drifted_poses(world: World, anchor: int, rng: np.random.Generator, drift: float) -> FloatArray:
    """Return poses that drift away from the truth on both sides of a frame: random walks of rotation and of scale.

    `drift`: relative error of each step's length, and ten times the rotation error (rad) of each step.
    """
    T = world.T_w_cam.copy()
    for direction in (1, -1):
        log_scale = 0.0
        frames = range(anchor, len(T) - 1) if direction == 1 else range(anchor, 0, -1)
        for f in frames:
            step = se3.inverse(world.T_w_cam[f]) @ world.T_w_cam[f + direction]
            log_scale += drift * rng.normal()
            step[:3, 3] *= np.exp(log_scale)
            T[f + direction] = T[f] @ step @ se3.exp(np.r_[0.1 * drift * rng.normal(size=3), np.zeros(3)])
    return T


@dataclass
class Recipe:
    """How a map is made of some frames of a world."""

    frames: list[int]
    anchor: int
    drift: float = 0.002
    tracked: float = 0.85
    outliers: float = 0.05


def build(
    world: World, recipe: Recipe, submap_id: int, rng: np.random.Generator, poses: FloatArray | None = None
) -> Submap:
    """Map frames in the given order, points triangulated from noisy pixels with drifting poses; gauge: the world's."""
    submap = Submap(submap_id, world.K, world.features[0].descriptors[0])
    poses = drifted_poses(world, recipe.anchor, rng, recipe.drift) if poses is None else poses
    frames = np.array(recipe.frames)
    for f in frames.tolist():
        submap.add_keyframe(Keyframe(FRAME_STEP * f, 0.1 * FRAME_STEP * f, world.features[f]), poses[f])
    add_points(submap, world, frames, poses, recipe, rng)
    submap.gauge = (FRAME_STEP * recipe.frames[0], FRAME_STEP * recipe.frames[1])
    return submap


def add_points(
    submap: Submap, world: World, frames: IntArray, poses: FloatArray, recipe: Recipe, rng: np.random.Generator
) -> None:
    """Triangulate what the keyframes of a submap see, some of it wrong, as the recipe says."""
    visible = (world.seen[frames] & (rng.random((len(frames), len(world.xyz))) < recipe.tracked)).T
    points = np.flatnonzero(visible.sum(1) >= 2)
    visible = visible[points]
    uv = np.where(visible[..., None], world.uv[frames][:, points].swapaxes(0, 1), 0.0)
    made = triangulate_n_view(uv, world.K, se3.inverse(poses[frames]), visible)
    with np.errstate(invalid="ignore"):
        good = (made.min_cos_parallax < np.cos(np.radians(1.0))) & (np.nan_to_num(made.depth, nan=1.0) > 0).all(1)
        good &= np.nanmax(np.where(visible, made.error2, np.nan), 1) < 25.0
    points, visible, xyz = points[good], visible[good], made.xyz[good]
    wrong = rng.random(len(xyz)) < recipe.outliers
    centre = poses[frames[len(frames) // 2], :3, 3]
    xyz[wrong] = centre + (xyz[wrong] - centre) * rng.uniform(0.6, 1.6, (int(wrong.sum()), 1))
    first = frames[np.argmax(visible, axis=1)]
    for f in np.unique(first).tolist():
        new = np.flatnonzero(first == f)
        feature = world.feature_of[f, points[new]]
        features = world.features[f]
        ids = submap.add_landmarks(xyz[new], features.descriptors[feature], features.scale[feature], FRAME_STEP * f)
        for v, g in enumerate(frames.tolist()):
            here = visible[new, v]
            submap.add_observations(FRAME_STEP * g, world.feature_of[g, points[new[here]]], ids[here])


def thinned(submap: Submap, place: int, n_ties: int) -> Submap:
    """Return a copy in which only so many landmarks are seen on both sides of the keyframe `place` (id)."""
    thin = submap.copy()
    obs = thin.observations
    after = obs["kf"] >= place
    both = np.intersect1d(obs["landmark"][after], obs["landmark"][~after])
    cut = np.flatnonzero(np.isin(obs["landmark"], both[n_ties:]) & after)
    thin.remove_observations(cut)
    return thin


@dataclass(frozen=True)
class Case:
    """Two submaps and the truth. `extent_mu`: size of the overlap in the old map."""

    old: Submap
    new: Submap
    S_old_new: FloatArray
    extent_mu: float


def random_gauge(rng: np.random.Generator, spread: float = 3.0) -> FloatArray:
    """Return a random similarity (4, 4): the frame and unit of a monocular map are anybody's."""
    return sim3.exp(np.r_[rng.normal(size=3), rng.normal(size=3) * spread, rng.uniform(-1.5, 1.5)])


def regauge(submap: Submap, S_new_old: FloatArray) -> None:
    """Put a submap into another frame and unit."""
    submap.transform(
        float(sim3.scale(S_new_old)), se3.from_parts(sim3.rotation(S_new_old), sim3.translation(S_new_old))
    )


def make_case(
    layout: str, seed: int, old_frames: range = range(16), new_frames: range = range(6, 24), **recipe: float
) -> Case:
    """Make two healthy maps that overlap, in different gauges."""
    old, new = _two_maps(layout, seed, old_frames, new_frames, tuple(sorted(recipe.items())))
    return finish(old.copy(), new.copy(), np.random.default_rng(3000 + seed))


@lru_cache(maxsize=64)
def _two_maps(
    layout: str, seed: int, old_frames: range, new_frames: range, recipe: tuple[tuple[str, float], ...]
) -> tuple[Submap, Submap]:
    rng = np.random.default_rng(1000 + seed)
    world = make_world(layout, seed)
    anchor = (new_frames.start + old_frames.stop - 1) // 2
    old = build(world, Recipe(list(old_frames), anchor, **dict(recipe)), 0, rng)
    new = build(world, Recipe(list(reversed(new_frames)), anchor, **dict(recipe)), 1, rng)
    return old, new


def finish(old: Submap, new: Submap, rng: np.random.Generator) -> Case:
    """Put both maps into gauges of their own."""
    S_old_w, S_new_w = random_gauge(rng), random_gauge(rng)
    regauge(old, S_old_w)
    regauge(new, S_new_w)
    shared = [k for k in old.keyframes if k in new.keyframes]
    points = old.landmarks["xyz_mu"][old.landmarks_of_keyframes(shared or list(old.keyframes))]
    extent = float(np.linalg.norm(np.percentile(points, 90, axis=0) - np.percentile(points, 10, axis=0)))
    return Case(old, new, S_old_w @ sim3.inverse(S_new_w), extent)


def make_bent_case(layout: str, seed: int, n_bent: int, stretch: float, n_shared: int = 22) -> Case:
    """Make a new map whose oldest steps grow: each of the `n_bent` oldest is `stretch` times as long as the next."""
    rng = np.random.default_rng(4000 + seed)
    world = make_world(layout, seed)
    old = build(world, Recipe(list(range(n_shared)), n_shared), 0, rng)
    poses = drifted_poses(world, n_shared, rng, 0.002)
    for f in range(n_bent, 0, -1):
        poses[:f, :3, 3] = poses[f, :3, 3] + stretch * (poses[:f, :3, 3] - poses[f, :3, 3])
    new = build(world, Recipe(list(reversed(range(24))), n_shared), 1, rng, poses)
    return finish(old, new, np.random.default_rng(5000 + seed))


def make_tail_case(
    layout: str,
    seed: int,
    onset: int,
    oldest_new: int,
    D: FloatArray,
    old_frames: range = range(18),
    kept_ties: float = 0.0,
) -> Case:
    """Make an old map whose part from frame `onset` on is displaced by a wrong pose D (Sim(3)) of that frame's camera.

    The tail is a clean map in itself. `kept_ties`: share of the tail's landmarks that are attached to landmarks of the
    healthy part, from whose places their observations are then off.
    """
    rng = np.random.default_rng(2000 + seed)
    world = make_world(layout, seed)
    new_frames = range(oldest_new, 24)
    anchor = (oldest_new + onset) // 2
    recipe = Recipe(list(old_frames), anchor)
    poses = drifted_poses(world, anchor, rng, recipe.drift)
    healthy, tail = np.arange(old_frames.start, onset), np.arange(onset, old_frames.stop)
    S_w_tail = poses[onset] @ D @ se3.inverse(poses[onset])
    old = Submap(0, world.K, world.features[0].descriptors[0])
    for f in old_frames:
        T = sim3.act_on_pose(S_w_tail, poses[f]) if f >= onset else poses[f]
        old.add_keyframe(Keyframe(FRAME_STEP * f, 0.1 * FRAME_STEP * f, world.features[f]), T)
    moved = np.array([old.T_submap_kf[FRAME_STEP * f] for f in old_frames])
    add_points(old, world, healthy, moved, recipe, rng)
    n_healthy = len(old.landmarks)
    add_points(old, world, tail, moved, recipe, rng)
    if kept_ties:
        _attach(old, world, onset, n_healthy, kept_ties, rng)
    new = build(world, Recipe(list(reversed(new_frames)), anchor), 1, rng)
    return finish(old, new, rng)


def _attach(old: Submap, world: World, onset: int, n_healthy: int, share: float, rng: np.random.Generator) -> None:
    point_of = {}
    obs = old.observations
    for row in np.flatnonzero(obs["landmark"] < n_healthy).tolist():
        f = int(obs["kf"][row]) // FRAME_STEP
        point_of[int(np.flatnonzero(world.feature_of[f] == obs["feature"][row])[0])] = int(obs["landmark"][row])
    keep, drop = [], []
    for j in range(n_healthy, len(old.landmarks)):
        row = int(np.flatnonzero(obs["landmark"] == j)[0])
        f = int(obs["kf"][row]) // FRAME_STEP
        point = int(np.flatnonzero(world.feature_of[f] == obs["feature"][row])[0])
        if point in point_of and rng.random() < share:
            keep.append(point_of[point])
            drop.append(j)
    old.merge_landmarks(np.array(keep, np.int64), np.array(drop, np.int64))


def link_error(case: Case, S_old_new: FloatArray) -> tuple[float, float, float]:
    """Return errors: relative scale, degrees, position (worst shared camera) relative to the extent."""
    E = sim3.inverse(case.S_old_new) @ S_old_new
    angle = float(np.degrees(np.linalg.norm(so3.log(sim3.rotation(E)))))
    shared = [k for k in case.old.keyframes if k in case.new.keyframes]
    centres = case.new.keyframe_poses(shared)[:, :3, 3]
    off = np.linalg.norm(sim3.act(S_old_new, centres) - sim3.act(case.S_old_new, centres), axis=1).max()
    return abs(float(sim3.scale(E)) - 1.0), angle, float(off) / case.extent_mu


def is_wrong(case: Case, S_old_new: FloatArray) -> bool:
    """Whether a link is wrong: off by more than 5 % in scale, 3 degrees, or 5 % in position."""
    scale, angle, position = link_error(case, S_old_new)
    return scale > 0.05 or angle > 3.0 or position > 0.05
