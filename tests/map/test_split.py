"""A submap that is full goes on in the next: exactly, for 5,000 keyframes in a chain."""

from __future__ import annotations

import numpy as np
import pytest

from dualslam.atlas.atlas import Atlas, Link, LinkKind
from dualslam.atlas.trajectory import FramePose, compose
from dualslam.backend.submap_graph import ISam2SubmapGraph
from dualslam.core.config.settings import GraphConfig
from dualslam.core.geometry import se3, so3
from dualslam.core.types import FloatArray, Keyframe
from dualslam.map.split import next_submap
from dualslam.map.submap import Submap
from dualslam.testing.point_world import CAMERA, SIZE_PX, make_features

N_KEYFRAMES = 2000
N_SHARED = 12
SOLVE_EVERY = 3
PER_KEYFRAME = 3
"""Points that come into view with each keyframe; each is seen by those less than 1.2 m away, 12 on either side."""


class Corridor:
    """A camera that looks aside while it goes along a wavy line, past points that come and go."""

    def __init__(self, n: int, noise_px: float) -> None:
        rng = np.random.default_rng(0)
        i = np.arange(n)
        self.T = se3.from_parts(
            so3.exp(np.column_stack([0 * i, 0.05 * np.sin(0.05 * i), 0.03 * np.sin(0.03 * i)])),
            np.column_stack([0.1 * i, 0.2 * np.sin(0.04 * i), 0.1 * np.sin(0.07 * i)]),
        )
        n_points = PER_KEYFRAME * n
        along = 0.1 * np.arange(n_points) / PER_KEYFRAME
        self.xyz = np.column_stack([along, rng.uniform(-0.7, 0.7, n_points), rng.uniform(1.2, 2.2, n_points)])
        self.noise_px = noise_px
        self.rng = rng

    def seen(self, k: int) -> tuple[np.ndarray, FloatArray]:
        near = np.arange(max(0, PER_KEYFRAME * (k - 12)), min(len(self.xyz), PER_KEYFRAME * (k + 12)))
        p = (self.xyz[near] - self.T[k, :3, 3]) @ self.T[k, :3, :3]
        uv = CAMERA.project(p) + self.noise_px * self.rng.normal(size=(len(near), 2))
        inside = (uv > 0).all(1) & (uv < SIZE_PX).all(1)
        return near[inside], uv[inside]


class Chain:
    """Builds submap after submap as the system does, from exact associations."""

    def __init__(self, corridor: Corridor, config: GraphConfig, drift: float) -> None:
        self.corridor, self.config, self.drift = corridor, config, drift
        self.atlas = Atlas()
        self.poses: list[FramePose] = []
        self.n_rebuilt = 0
        self.submap = Submap(0, CAMERA.K, np.zeros(1, np.uint8))
        self.atlas.add(self.submap)
        self.graph = ISam2SubmapGraph(config)
        self.id_of: dict[int, int] = {}

    def add(self, k: int) -> None:
        points, uv = self.corridor.seen(k)
        n = len(uv)
        features = make_features(uv, np.full(n, 0.5), np.zeros(n, np.int64), np.zeros((n, 1), np.uint8))
        T = self.corridor.T[k]
        if k > 3:  # predicted: the step is known to a few percent
            step = se3.inverse(self.corridor.T[k - 1]) @ T
            step[:3, 3] *= 1 + self.drift * self.corridor.rng.normal()
            T = self.submap.T_submap_kf[k - 1] @ step
        self.submap.add_keyframe(Keyframe(k, 0.1 * k, features), T)
        new = np.array([p not in self.id_of for p in points.tolist()], bool)
        ids = self.submap.add_landmarks(
            self._placed(k, points[new]), np.zeros((int(new.sum()), 1), np.uint8), np.ones(int(new.sum())), k
        )
        self.id_of.update(zip(points[new].tolist(), ids.tolist(), strict=True))
        self.submap.add_observations(k, np.arange(len(points)), np.array([self.id_of[p] for p in points.tolist()]))
        self.poses.append(FramePose(k, 0.1 * k, self.submap.id, k, np.eye(4)))
        if k == 3:
            self.submap.gauge = (0, 3)
        if k >= 3 and k % SOLVE_EVERY == 0:
            self._solve()
        if len(self.submap.keyframes) >= self.config.max_keyframes:
            self._roll_over()

    def _placed(self, k: int, points: np.ndarray) -> FloatArray:
        """Where triangulation would put new points: right relative to the newest keyframe."""
        T_submap_world = self.submap.T_submap_kf[k] @ se3.inverse(self.corridor.T[k])
        return se3.act(T_submap_world, self.corridor.xyz[points])

    def _solve(self) -> None:
        e = self.graph.update(self.submap)
        self.submap.apply_estimate(e.keyframe_ids, e.T_submap_kf, e.landmark_ids, e.xyz_mu)
        self.n_rebuilt += e.rebuilt

    def _roll_over(self) -> None:
        full = self.submap
        self.submap = next_submap(full, len(self.atlas.submaps), N_SHARED)
        self.atlas.add(self.submap)
        self.atlas.link(Link(full.id, self.submap.id, np.eye(4), np.zeros((7, 7)), LinkKind.ROLLOVER))
        self.graph = ISam2SubmapGraph(self.config)
        self.graph.rebuild(self.submap)
        # The same pixels hold the same points in both.
        old_of = {}
        for k in self.submap.keyframes:
            both = (full.landmark_of[k] >= 0) & (self.submap.landmark_of[k] >= 0)
            old, new = full.landmark_of[k][both].tolist(), self.submap.landmark_of[k][both].tolist()
            old_of.update(zip(old, new, strict=True))
        self.id_of = {p: old_of[j] for p, j in self.id_of.items() if j in old_of}


def test_next_submap_is_the_same_map_in_the_same_frame() -> None:
    chain = Chain(Corridor(60, 0.5), GraphConfig(), 0.02)
    for k in range(60):
        chain.add(k)
    full = chain.submap
    twin = next_submap(full, 1, N_SHARED)
    shared = list(full.keyframes)[-N_SHARED:]
    assert list(twin.keyframes) == shared
    assert twin.gauge == (shared[0], shared[-1])
    for k in shared:
        np.testing.assert_array_equal(twin.T_submap_kf[k], full.T_submap_kf[k])
        assert twin.keyframes[k] is full.keyframes[k]
        # Each feature that still has a landmark has the one with the same point and history.
        both = twin.landmark_of[k] >= 0
        assert both.mean() > 0.8
        for name in ("xyz_mu", "descriptor", "scale", "distance_mu", "n_found"):
            mine = twin.landmarks[name][twin.landmark_of[k][both]]
            np.testing.assert_array_equal(mine, full.landmarks[name][full.landmark_of[k][both]])
    assert (twin.n_observations(np.arange(len(twin.landmarks))) >= 2).all()
    # The old map is left as it was.
    assert len(full.keyframes) == 60
    twin.landmarks["xyz_mu"][:] = 0
    assert np.abs(full.landmarks["xyz_mu"]).min() > 0


@pytest.mark.slow
def test_two_thousand_keyframes_in_a_chain() -> None:
    chain = Chain(Corridor(N_KEYFRAMES, 0.3), GraphConfig(), 0.01)
    for k in range(N_KEYFRAMES):
        chain.add(k)
    atlas = chain.atlas
    assert len(atlas.submaps) == 1 + (N_KEYFRAMES - N_SHARED) // (GraphConfig().max_keyframes - N_SHARED)
    assert atlas.components() == [list(atlas.submaps)]
    assert chain.n_rebuilt == 0
    found = compose(chain.poses, atlas, atlas.S_world_submap(list(atlas.submaps)))
    assert found.index.tolist() == list(range(N_KEYFRAMES))
    steps = se3.inverse(found.T_world_cam[:-1]) @ found.T_world_cam[1:]
    truth = se3.inverse(chain.corridor.T[:-1]) @ chain.corridor.T[1:]
    error = se3.log(se3.inverse(steps) @ truth)
    # Nothing breaks at the overlaps: neighbouring keyframes are as right across them as elsewhere.
    first = [list(m.keyframes)[N_SHARED] - 1 for m in list(atlas.submaps.values())[1:]]
    length = np.linalg.norm(error[:, 3:], axis=1)
    assert length[first].max() < 2 * np.quantile(length, 0.99)
    assert np.linalg.norm(error[:, :3], axis=1).max() < 0.01


def test_a_hand_that_comes_back_leaves_its_widest_baseline_as_gauge() -> None:
    chain = Chain(Corridor(60, 0.5), GraphConfig(), 0.02)
    for k in range(60):
        chain.add(k)
    full = chain.submap
    shared = list(full.keyframes)[-N_SHARED:]
    last, middle = shared[-1], shared[N_SHARED // 2]
    full.T_submap_kf[last] = full.T_submap_kf[shared[0]]  # the last one stands where the first one does
    first, second = next_submap(full, 1, N_SHARED).gauge
    centres = full.keyframe_poses(shared)[:, :3, 3]
    assert {first, second} != {shared[0], last}
    baseline = np.linalg.norm(full.T_submap_kf[first][:3, 3] - full.T_submap_kf[second][:3, 3])
    assert baseline == np.linalg.norm(centres[:, None] - centres, axis=2).max()
    assert baseline > np.linalg.norm(full.T_submap_kf[middle][:3, 3] - centres[0])
