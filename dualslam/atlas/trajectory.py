"""Per-frame poses: measured relative to a keyframe, composed when asked for, never stored."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from dualslam.atlas.atlas import Atlas
from dualslam.core.geometry import se3, sim3, so3
from dualslam.core.trajectory import Trajectory
from dualslam.core.types import BoolArray, FloatArray, IntArray
from dualslam.map.anchors import Anchor
from dualslam.map.submap import Submap


@dataclass(frozen=True, slots=True, eq=False)
class FramePose:
    """Where a frame was measured to be: relative to a keyframe of a submap."""

    index: int
    timestamp_s: float
    submap_id: int
    keyframe_id: int
    T_kf_cam: FloatArray

    def at(self, anchor: Anchor) -> FramePose:
        """Return the frame where an anchor in the same submap stands."""
        return replace(self, keyframe_id=anchor.keyframe_id, T_kf_cam=anchor.T_kf_cam)


@dataclass(frozen=True, slots=True, eq=False)
class Path:
    """The way of a camera in a submap, from frame to frame as they came."""

    index: IntArray  # (N,): of the frames
    times_s: FloatArray  # (N,): ascending: negative timestamps where a source is read from its end
    T_map_cam: FloatArray  # (N, 4, 4)
    refound: BoolArray  # (N,): frames that were found again by wide matching, and not by those before them

    @classmethod
    def of(cls, poses: Iterable[FramePose], submap: Submap) -> Path:
        """Return the path of frames that are posed in a submap, as if none had been found again."""
        by_index = sorted(poses, key=lambda pose: pose.index)
        times_s = np.array([pose.timestamp_s for pose in by_index], np.float64)
        T = [submap.resolve_anchor(pose.keyframe_id, pose.T_kf_cam) for pose in by_index]
        index = np.array([pose.index for pose in by_index], np.int64)
        return cls.of_trajectory(Trajectory(times_s, se3.stack(T), index))

    @classmethod
    def of_trajectory(cls, trajectory: Trajectory) -> Path:
        """Return the path of frames that are ordered by index, as if none had been found again."""
        t = trajectory.timestamps_s
        times_s = -t if len(t) > 1 and t[-1] < t[-2] else t
        order = times_s.argsort(kind="stable")
        return cls(trajectory.index[order], times_s[order], trajectory.T_world_cam[order], np.zeros(len(t), bool))

    def __len__(self) -> int:
        return len(self.times_s)

    @property
    def centres(self) -> FloatArray:
        """Where the camera was, (N, 3)."""
        return se3.translation(self.T_map_cam)

    def way_between(self, i: int, j: int) -> float:
        """Return the length of the way between two frames, given by their indices."""
        rows = (self.index >= min(i, j)) & (self.index <= max(i, j))
        return float(np.linalg.norm(np.diff(self.centres[rows], axis=0), axis=1).sum())

    def take(self, rows: BoolArray) -> Path:
        """Return the path of some of the frames."""
        return Path(self.index[rows], self.times_s[rows], self.T_map_cam[rows], self.refound[rows])

    def moved(self, S: FloatArray) -> Path:
        """Return the path in other coordinates, by a Sim(3) (4, 4)."""
        return replace(self, T_map_cam=sim3.act_on_pose(S, self.T_map_cam))

    def then(self, later: Path) -> Path:
        """Return the path that goes on with those frames of another that are later than all of its own."""
        rest = later if not len(self.times_s) else later.take(later.times_s > self.times_s[-1])
        both = zip(*((path.index, path.times_s, path.T_map_cam, path.refound) for path in (self, rest)), strict=True)
        return Path(*(np.concatenate(arrays) for arrays in both))

    def similarity_to(self, other: Path, min_frames: int) -> FloatArray | None:
        """Return the Sim(3) (4, 4) that takes this path to another by the frames in both; None where these are few.

        The turn is that of the cameras: of a straight way the places leave it open.
        """
        _, mine, theirs = np.intersect1d(self.index, other.index, return_indices=True)
        if len(mine) < min_frames:
            return None
        a, b = other.T_map_cam[theirs], self.T_map_cam[mine]
        R = so3.orthonormalise((se3.rotation(a) @ se3.rotation(b).swapaxes(1, 2)).sum(axis=0))
        mean_a, mean_b = se3.translation(a).mean(axis=0), se3.translation(b).mean(axis=0)
        spread_a, spread_b = np.linalg.norm(se3.translation(a) - mean_a), np.linalg.norm(se3.translation(b) - mean_b)
        if not spread_a * spread_b > 0:
            return None
        s = spread_a / spread_b
        return sim3.from_parts(s, R, mean_a - s * R @ mean_b)


def compose(poses: Iterable[FramePose], atlas: Atlas, S_world_submap: dict[int, FloatArray]) -> Trajectory:
    """Compose the poses of the frames that stand in the given submaps, in their common frame.

    `S_world_submap` (dict of int to (4, 4)): the submaps to take in; frames of others are left out.
    """
    kept = sorted((p for p in poses if p.submap_id in S_world_submap), key=lambda p: p.index)
    T = np.array([atlas.submaps[p.submap_id].resolve_anchor(p.keyframe_id, p.T_kf_cam) for p in kept])
    T_world_cam, submap_of = T.reshape(-1, 4, 4), np.array([p.submap_id for p in kept], np.int64)
    for m, S in S_world_submap.items():
        T_world_cam[submap_of == m] = sim3.act_on_pose(S, T_world_cam[submap_of == m])
    timestamps_s = np.array([p.timestamp_s for p in kept], float)
    return Trajectory(timestamps_s, T_world_cam, np.array([p.index for p in kept], np.int64))


class Worlds:
    """The linked sets of an atlas, each with one world: that of a `saved` map, if one is continued, else its first
    submap's.
    """

    def __init__(self, atlas: Atlas, saved: int | None = None) -> None:
        self._atlas = atlas
        self._saved = saved
        self._made_from: list[object] = []
        self._found: dict[int, tuple[FloatArray, int]] = {}
        self._sure: set[int] = set()

    def of(self, submap_id: int) -> tuple[FloatArray, int]:
        """Return the current ``S_world_submap`` (4, 4), and the submap whose frame and unit the world has."""
        self._compose()
        return self._found[submap_id]

    def is_sure(self, submap_id: int) -> bool:
        """Whether links whose scale may be relied on join a submap with the one whose unit its world has."""
        self._compose()
        return submap_id in self._sure

    def _compose(self) -> None:
        atlas = self._atlas
        state: list[object] = [*atlas.submaps.values(), *atlas.links, *atlas.placement.values()]
        same = len(state) == len(self._made_from) and all(map(lambda a, b: a is b, state, self._made_from))
        if not same:
            self._made_from, self._found, self._sure = state, {}, set()
            for component in atlas.components():
                S_first = atlas.S_world_submap(component)
                world = self._saved if self._saved in S_first else None
                S = S_first if world is None else {m: sim3.inverse(S_first[world]) @ S_first[m] for m in component}
                world = component[0] if world is None else world
                self._found |= {m: (S[m], world) for m in component}
                self._sure.update(atlas.component_of(world, sure=True))
