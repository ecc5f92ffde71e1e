"""A camera that drives round in a circle: submaps of it that drift as monocular ones do, with the truth."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from dualslam.atlas.atlas import Atlas, Link, LinkKind
from dualslam.atlas.beside import atlas_handlers
from dualslam.atlas.connections import Connections
from dualslam.atlas.record import Record
from dualslam.atlas.trajectory import FramePose, compose
from dualslam.backend.atlas_solver import GtsamAtlasSolver
from dualslam.backend.point_refinement import refit_points
from dualslam.backend.submap_graph import ISam2SubmapGraph
from dualslam.core.config.settings import GraphConfig
from dualslam.core.geometry import se3, sim3
from dualslam.core.jobs import InlineDesk
from dualslam.core.types import BoolArray, FloatArray, FrameStatus, Keyframe
from dualslam.map.frame_records import FrameRow
from dualslam.map.split import next_submap
from dualslam.map.submap import Submap
from dualslam.testing.point_world import CAMERA, SIZE_PX, make_features
from dualslam.testing.relative import relative_similarity

N_SHARED = 8
LINK_SIGMAS = np.array([2e-3] * 3 + [5e-3] * 3 + [5e-3])
N_ROUND = 120
"""Keyframes of one lap, 0.2 apart."""
RADIUS = N_ROUND * 0.2 / (2 * np.pi)


def ring_pose(k: float) -> FloatArray:
    """A camera on a circle that looks outwards and a little ahead."""
    a = 2 * np.pi * k / N_ROUND
    out, along = np.array([np.cos(a), 0.0, np.sin(a)]), np.array([-np.sin(a), 0.0, np.cos(a)])
    forward = (out + 0.5 * along) / np.linalg.norm(out + 0.5 * along)
    down = np.array([0.0, 1.0, 0.0])
    return se3.from_parts(np.column_stack([np.cross(down, forward), down, forward]), RADIUS * out)


@dataclass
class DriftingMap:
    """Builds submaps from exact associations; scale, turn and place walk off from keyframe to keyframe.

    Each keyframe's error is a similarity that the landmarks which it describes share, so that within a place the map
    is right: what its own factors say is kept, and yet the whole has drifted.
    """

    n: int
    drift: FloatArray = field(default_factory=lambda: np.array([1e-3] * 3 + [2e-3] * 3 + [4e-3]))
    noise_px: float = 0.3
    seed: int = 0
    robust: bool = True

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(self.seed)
        self.T_true = np.array([ring_pose(k) for k in range(self.n)])
        i = np.arange(12 * N_ROUND)
        a = 2 * np.pi * i / 12 / N_ROUND
        r = RADIUS + self.rng.uniform(1.0, 2.5, len(i))
        self.xyz = np.column_stack([r * np.cos(a), self.rng.uniform(-0.8, 0.8, len(i)), r * np.sin(a)])
        steps = sim3.exp(self.drift * self.rng.normal(size=(self.n, 7)))
        T = [self.T_true[0]]
        for k in range(1, self.n):
            T.append(T[-1] @ steps[k] @ se3.inverse(self.T_true[k - 1]) @ self.T_true[k])
        self.S_drifted = np.array(T)
        self.record = Record()
        self.solver = GtsamAtlasSolver(self.robust, 0.8)
        self.connections = Connections(
            self.record,
            self.solver,
            lambda: ISam2SubmapGraph(GraphConfig()),
            InlineDesk(atlas_handlers(self.solver)),
            lambda: self.front_ends,
        )
        self.front_ends: list[Any] = []
        self.now = FrameRow(0, 0.0, FrameStatus.TRACKED)
        self.submap = self._new_submap(0)
        self.place_of: dict[int, int] = {}  # landmark of the submap by point
        self.last_seen: dict[int, int] = {}
        self.points: dict[int, np.ndarray] = {}  # of each keyframe's features

    @property
    def atlas(self) -> Atlas:
        """The atlas of the record."""
        return self.record.atlas

    def relative(self, a: tuple[int, int], b: tuple[int, int]) -> tuple[FloatArray, FloatArray]:
        """Return the similarity between two keyframes as the atlas has it, and its covariance."""
        return relative_similarity(self.atlas, self.solver, a, b)

    def _new_submap(self, submap_id: int) -> Submap:
        submap = Submap(submap_id, CAMERA.K, np.zeros(1, np.uint8))
        self.record.atlas.add(submap)
        return submap

    def seen(self, k: int) -> tuple[np.ndarray, FloatArray]:
        """Return the points that keyframe `k` sees, and their pixels (n, 2)."""
        p = (self.xyz - self.T_true[k][:3, 3]) @ self.T_true[k][:3, :3]
        apart = np.abs(np.arange(len(self.xyz)) / 12 - k) % N_ROUND
        near = np.minimum(apart, N_ROUND - apart) < 12
        ok: BoolArray = near & (p[:, 2] > 0.3)
        uv = np.full((len(p), 2), np.nan)
        uv[ok] = CAMERA.project(p[ok])
        ok &= (np.nan_to_num(uv, nan=-1) > 0).all(1) & (np.nan_to_num(uv, nan=1e9) < SIZE_PX).all(1)
        return np.flatnonzero(ok), uv[ok] + self.noise_px * self.rng.normal(size=(int(ok.sum()), 2))

    def add(self, k: int, in_world: FloatArray | None = None) -> None:
        """Add keyframe `k` where the drift has taken it; `in_world` takes the drifted world to the submap's frame."""
        S = self.S_drifted[k] if in_world is None else in_world @ self.S_drifted[k]
        points, uv = self.seen(k)
        self.points[k] = points
        features = make_features(
            uv, np.full(len(uv), 0.5), np.zeros(len(uv), np.int64), np.zeros((len(uv), 1), np.uint8)
        )
        self.submap.add_keyframe(Keyframe(k, 0.1 * k, features), sim3.act_on_pose(S, np.eye(4)))
        # A revisit after a lap is not recognised.
        self.place_of = {p: j for p, j in self.place_of.items() if k - self.last_seen[p] < N_ROUND // 2}
        self.last_seen.update(dict.fromkeys(points.tolist(), k))
        new = np.array([p not in self.place_of for p in points.tolist()], bool)
        xyz = sim3.act(S @ se3.inverse(self.T_true[k]), self.xyz[points[new]])
        ids = self.submap.add_landmarks(xyz, np.zeros((int(new.sum()), 1), np.uint8), np.ones(int(new.sum())), k)
        self.place_of.update(zip(points[new].tolist(), ids.tolist(), strict=True))
        self.submap.add_observations(k, np.arange(len(points)), np.array([self.place_of[p] for p in points.tolist()]))
        self.now = FrameRow(k, 0.1 * k, FrameStatus.TRACKED)
        self.record.rows[k] = self.now
        self.record.pose(FramePose(k, 0.1 * k, self.submap.id, k, np.eye(4)))
        if self.submap.gauge[0] < 0 and len(self.submap.keyframes) == 4:
            ids_ = list(self.submap.keyframes)
            self.submap.gauge = (ids_[0], ids_[-1])

    def roll_over(self) -> None:
        """Continue in a new submap that shares its first keyframes with the full one."""
        full = self.submap
        self.submap = next_submap(full, len(self.atlas.submaps), N_SHARED)
        self.atlas.add(self.submap)
        old_of: dict[int, int] = {}
        for k in self.submap.keyframes:
            both = (full.landmark_of[k] >= 0) & (self.submap.landmark_of[k] >= 0)
            old, new = full.landmark_of[k][both].tolist(), self.submap.landmark_of[k][both].tolist()
            old_of.update(zip(old, new, strict=True))
        self.place_of = {p: old_of[j] for p, j in self.place_of.items() if j in old_of}
        self.connections.connect([Link.of_rollover(full, self.submap)], self.now)

    def begin_anew(self) -> None:
        """Start a submap that shares nothing with the one before."""
        self.submap = self._new_submap(len(self.atlas.submaps))
        self.place_of = {}

    def unit(self, m: int, k: int) -> float:
        """Submap units per true one around a keyframe: by the depths of what it sees."""
        submap = self.atlas.submaps[m]
        ids = submap.landmark_of[k]
        depth = submap.depths(ids[ids >= 0], se3.inverse(submap.T_submap_kf[k]))
        true = (self.xyz[self.points[k][ids >= 0]] - self.T_true[k][:3, 3]) @ self.T_true[k][:3, 2]
        return float(np.exp(np.median(np.log(depth / true))))

    def true_S(self, a: tuple[int, int], b: tuple[int, int]) -> FloatArray:
        """The similarity between two keyframes of submaps, by the truth and the submaps' units there."""
        S = se3.inverse(self.T_true[a[1]]) @ self.T_true[b[1]]
        units = [self.unit(*node) for node in (a, b)]
        return sim3.from_parts(units[0] / units[1], S[:3, :3], units[0] * S[:3, 3])

    def loop(
        self,
        a: tuple[int, int],
        b: tuple[int, int],
        off: FloatArray | None = None,
        sigmas: FloatArray = LINK_SIGMAS,
        kind: LinkKind = LinkKind.LOOP,
    ) -> Link:
        """A connection that is true up to its noise, or wrong by `off`."""
        S = self.true_S(a, b) @ sim3.exp(sigmas * self.rng.normal(size=7))
        if off is not None:
            S = S @ sim3.exp(off)
        return Link.of_keyframes(self.atlas, a, b, S, np.diag(sigmas**2), kind)

    def errors(self) -> FloatArray:
        """Distance of each frame's centre from the truth, all aligned by the best similarity; true units."""
        component = max(self.atlas.components(), key=len)
        found = compose(self.record.poses.values(), self.atlas, self.atlas.S_world_submap(component))
        estimate, truth = found.T_world_cam[:, :3, 3], self.T_true[found.index][:, :3, 3]
        return np.linalg.norm(align(estimate, truth) - truth, axis=1)

    def pixel_errors(self) -> dict[tuple[int, int], float]:
        """Median reprojection error of each keyframe, pixels."""
        found = {}
        for m, submap in self.atlas.submaps.items():
            for k in submap.keyframes:
                ids = submap.landmark_of[k]
                T = submap.T_submap_kf[k]
                p = (submap.landmarks["xyz_mu"][ids[ids >= 0]] - T[:3, 3]) @ T[:3, :3]
                uv = submap.keyframes[k].features.uv_rect_px[ids >= 0]
                found[m, k] = float(np.median(np.linalg.norm(CAMERA.project(p) - uv, axis=1)))
        return found


def align(estimate: FloatArray, truth: FloatArray) -> FloatArray:
    """Take points onto others by the best similarity."""
    return sim3.act(fit_similarity(estimate, truth), estimate)


def fit_similarity(from_: FloatArray, to: FloatArray) -> FloatArray:
    """Return the similarity that takes points nearest to others (Umeyama)."""
    a, b = from_ - from_.mean(0), to - to.mean(0)
    U, D, Vt = np.linalg.svd(b.T @ a)
    sign = np.diag([1, 1, np.sign(np.linalg.det(U @ Vt))])
    s = (D * np.diag(sign)).sum() / (a**2).sum()
    R = U @ sign @ Vt
    return sim3.from_parts(s, R, to.mean(0) - s * R @ from_.mean(0))


def lap_in_submaps(n: int = 130, every: int = 50, robust: bool = True, **options: object) -> DriftingMap:
    """A lap and a bit, in submaps that have rolled over."""
    world = DriftingMap(n, robust=robust, **options)  # type: ignore[arg-type]
    for k in range(n):
        world.add(k)
        if len(world.submap.keyframes) >= every and k < n - 10:
            world.roll_over()
    for submap in world.atlas.submaps.values():
        for _ in range(4):
            submap.landmarks["xyz_mu"][:] = refit_points(submap, 0.8, np.arange(len(submap.landmarks)))
    return world
