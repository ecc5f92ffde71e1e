"""A submap: keyframes and landmarks in one local frame, as numpy arrays: the truth that graphs are made from."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dualslam.core.geometry import se3
from dualslam.core.noise_model import TINY
from dualslam.core.types import BoolArray, FloatArray, IntArray, Keyframe, Start, Track
from dualslam.map.anchors import Anchor, RelativePose
from dualslam.map.tables import Table, landmark_table, observation_table

NO_LANDMARK = -1


class Submap:
    """Keyframes, landmarks and observations in one local frame, in that frame's own unit of length.

    Landmark ids only grow and are never reused. Rows of observations are appended, and die. So a graph can follow the
    submap by the rows added since its last update and those that died. Rows long dead leave the table
    (`keep_observations`), and the others keep their order. Keyframe ids are the indices of their frames.

    Attributes
    ----------
    id : int
    K : (3, 3) float64
        Pinhole intrinsics of the rectified pixels (`Features.uv_rect_px`).
    keyframes : dict of int to Keyframe
        In order of insertion.
    T_submap_kf : dict of int to (4, 4) float64
        Poses, camera to submap.
    landmark_of : dict of int to (N,) int64
        For each feature of a keyframe its landmark, or `NO_LANDMARK`.
    landmarks : Table
         ``xyz_mu`` (3), ``alive``, ``descriptor``, ``first_kf``, ``replaced_by``, ``condemned``.
        ``normal`` (3): mean unit vector from landmark to cameras. ``distance_mu``, ``scale``: distance and patch scale
        at the reference view. ``n_visible``, ``n_found``: how often tracking should have seen it, and did.
    observations : Table
        ``kf``, ``feature``, ``landmark``, ``alive``.
    n_dropped : int
        Rows that have left that table: a reader of rows by their numbers knows by it whether these still hold.
    anchors : dict of int to Anchor
        Keyframes that were culled as redundant.
    relative_poses : dict of int to RelativePose
        Keyframes of which more is known than their observations say.
    gauge : tuple of int
        The two keyframes of the first baseline: the first pose is fixed, their distance fixes the scale.
    condemned : set of int
        Keyframes marked invalid: by-passed by another map, or of a corrupted tail. Landmarks that no other keyframe
        sees have ``condemned`` set.
    """

    def __init__(self, submap_id: int, K: FloatArray, descriptor: NDArray[np.generic]) -> None:
        """`descriptor` is an example row of the front end's descriptors: it gives type and length."""
        self.id = submap_id
        self.K = np.asarray(K, float)
        self.keyframes: dict[int, Keyframe] = {}
        self.T_submap_kf: dict[int, FloatArray] = {}
        self.landmark_of: dict[int, IntArray] = {}
        self.anchors: dict[int, Anchor] = {}
        self.relative_poses: dict[int, RelativePose] = {}
        self.gauge: tuple[int, int] = (-1, -1)
        self.condemned: set[int] = set()
        self.landmarks = landmark_table(descriptor)
        self.observations = observation_table()
        self.n_dropped = 0
        self._counted: tuple[Table, BoolArray, IntArray] | None = None  # see `n_observations`

    @classmethod
    def from_start(cls, start: Start, submap_id: int, K: FloatArray) -> Submap:
        """Make a submap of a verified start: its views become keyframes, its points landmarks."""
        submap = cls(submap_id, K, start.views[0].features.descriptors[0])
        for view, T in zip(start.views, start.T_first_cam, strict=True):
            submap.add_keyframe(Keyframe(view.index, view.timestamp_s, view.features), T)
        last, feature = start.views[-1], start.feature
        ids = submap.add_landmarks(
            start.xyz, last.features.descriptors[feature[-1]], last.features.scale[feature[-1]], last.index
        )
        for v, view in enumerate(start.views):
            seen = feature[v] >= 0
            submap.add_observations(view.index, feature[v][seen], ids[seen])
        submap.gauge = (start.views[0].index, last.index)
        return submap

    # --- keyframes

    def add_keyframe(self, keyframe: Keyframe, T_submap_kf: FloatArray) -> None:
        """Insert a keyframe without observations."""
        if keyframe.id in self.keyframes:
            raise ValueError(f"submap {self.id} has keyframe {keyframe.id} already")
        self.keyframes[keyframe.id] = keyframe
        self.T_submap_kf[keyframe.id] = np.array(T_submap_kf, float)
        self.landmark_of[keyframe.id] = np.full(len(keyframe.features), NO_LANDMARK, np.int64)

    def remove_keyframe(self, keyframe_id: int, anchor_id: int) -> None:
        """Cull a keyframe: its observations die, its pose lives on relative to `anchor_id`."""
        rows = np.flatnonzero((self.observations["kf"] == keyframe_id) & self.observations["alive"])
        self.remove_observations(rows)
        T_kf_cam = se3.inverse(self.T_submap_kf[anchor_id]) @ self.T_submap_kf[keyframe_id]
        self.anchors[keyframe_id] = Anchor(anchor_id, T_kf_cam)
        self.relative_poses.pop(keyframe_id, None)
        self.condemned.discard(keyframe_id)
        for k, known in self.relative_poses.items():
            if known.keyframe_id == keyframe_id:
                self.relative_poses[k] = known.seen_from(anchor_id, T_kf_cam)
        if anchor_id in self.relative_poses and self.relative_poses[anchor_id].keyframe_id == anchor_id:
            del self.relative_poses[anchor_id]
        del self.keyframes[keyframe_id], self.T_submap_kf[keyframe_id], self.landmark_of[keyframe_id]

    def condemn(self, keyframe_ids: Iterable[int]) -> None:
        """Mark keyframes, and the landmarks that no other keyframe sees, as not to be relied on. All stay."""
        self.condemned |= set(keyframe_ids) & self.keyframes.keys()
        healthy = self.landmarks_of_keyframes([k for k in self.keyframes if k not in self.condemned])
        lm = self.landmarks
        lm["condemned"][:] = lm["alive"]
        lm["condemned"][healthy] = False

    def keyframe_for(self, keyframe_id: int) -> int:
        """Return a keyframe, or the one that stands for it since it was culled."""
        while keyframe_id not in self.T_submap_kf:
            keyframe_id = self.anchors[keyframe_id].keyframe_id
        return keyframe_id

    def living_keyframe(self, keyframe_id: int) -> int:
        """`keyframe_for`, or the first keyframe where neither is known."""
        is_known = keyframe_id in self.keyframes or keyframe_id in self.anchors
        return self.keyframe_for(keyframe_id) if is_known else min(self.keyframes)

    def resolve_anchor(self, keyframe_id: int, T_kf_cam: FloatArray) -> FloatArray:
        """Return ``T_submap_cam`` of a frame posed relative to a keyframe, also if that keyframe was culled since."""
        while keyframe_id not in self.T_submap_kf:
            anchor = self.anchors[keyframe_id]
            keyframe_id, T_kf_cam = anchor.keyframe_id, anchor.T_kf_cam @ T_kf_cam
        return self.T_submap_kf[keyframe_id] @ T_kf_cam

    def anchored(self, keyframe_id: int, T_submap_cam: FloatArray) -> Anchor:
        """Return where a camera stands by a keyframe, or by the one that stands for it since it was culled."""
        k = self.keyframe_for(keyframe_id)
        return Anchor(k, se3.inverse(self.T_submap_kf[k]) @ T_submap_cam)

    def keyframe_poses(self, keyframe_ids: IntArray | list[int]) -> FloatArray:
        """Return (K, 4, 4) poses, camera to submap."""
        return se3.stack([self.T_submap_kf[int(k)] for k in keyframe_ids])

    def keyframes_near(self, index: int) -> list[int]:
        """Return all keyframes by their distance in time from frame `index`, the nearest first (ties: lower id)."""
        return sorted(self.keyframes, key=lambda k: (abs(k - index), k))

    # --- landmarks

    def depths(self, landmark_ids: IntArray, T_cam_submap: FloatArray) -> FloatArray:
        """Return the depths (N,) of landmarks in a camera."""
        return np.asarray(self.landmarks["xyz_mu"][landmark_ids] @ T_cam_submap[2, :3] + T_cam_submap[2, 3])

    def seen_in(self, keyframe_id: int) -> IntArray:
        """Return the landmarks that a keyframe sees."""
        ids = self.landmark_of[keyframe_id]
        return ids[ids >= 0]

    def depths_in(self, keyframe_id: int) -> FloatArray:
        """Return their depths in its camera."""
        return self.depths(self.seen_in(keyframe_id), se3.inverse(self.T_submap_kf[keyframe_id]))

    def add_landmarks(
        self, xyz_mu: FloatArray, descriptors: NDArray[Any], scale: FloatArray, keyframe_id: int
    ) -> IntArray:
        """Append landmarks first described in `keyframe_id` (scale: of the feature there); return their ids."""
        to_camera = se3.translation(self.T_submap_kf[keyframe_id]) - xyz_mu
        distance = np.linalg.norm(to_camera, axis=1)
        return self.landmarks.append(
            len(xyz_mu),
            xyz_mu=xyz_mu,
            alive=True,
            descriptor=descriptors,
            normal=to_camera / np.maximum(distance, TINY)[:, None],
            distance_mu=distance,
            scale=scale,
            first_kf=keyframe_id,
            replaced_by=NO_LANDMARK,
            n_visible=1,
            n_found=1,
        )

    def copy_landmarks(self, other: Submap, landmark_ids: IntArray) -> IntArray:
        """Append copies of another submap's landmarks, where they are, without observations; return their ids here."""
        columns = {name: column[landmark_ids] for name, column in other.landmarks.columns().items()}
        columns["replaced_by"] = np.full(len(landmark_ids), NO_LANDMARK)
        columns["condemned"] = np.zeros(len(landmark_ids), bool)
        return self.landmarks.append(len(landmark_ids), **columns)

    def remove_landmarks(self, landmark_ids: IntArray) -> None:
        """Cull landmarks and their observations."""
        if len(landmark_ids) == 0:
            return
        self.landmarks["alive"][landmark_ids] = False
        self.remove_observations(self.rows_of_landmarks(landmark_ids))

    def count_sightings(self, track: Track) -> None:
        """Take in which landmarks a frame should have shown, and which it did: the rarely found are culled."""
        if len(track.visible_ids):
            self.landmarks["n_visible"][track.visible_ids] += 1
            self.landmarks["n_found"][track.seen_ids] += 1

    def merge_landmarks(self, keep: IntArray, drop: IntArray) -> None:
        """Make each ``drop[i]`` one with ``keep[i]``: its observations move over, save where both are in a keyframe."""
        if len(keep) == 0:
            return
        views = self._views_by_landmark([self.current_id(j) for j in (*keep.tolist(), *drop.tolist())])
        lm, n_rows = self.landmarks, len(self.observations)
        died: list[int] = []
        moved: list[tuple[int, int, int]] = []  # the tables are written once, in the order of the merges
        for kept, dropped in zip(keep.tolist(), drop.tolist(), strict=True):
            kept, dropped = self.current_id(kept), self.current_id(dropped)
            if kept == dropped:
                continue
            taken = {k for _, k, _ in views[kept]}
            for row, k, feature in views[dropped]:
                died.append(row)
                if k in taken:
                    self.landmark_of[k][feature] = NO_LANDMARK
                else:
                    self.landmark_of[k][feature] = kept
                    views[kept].append((n_rows + len(moved), k, feature))
                    moved.append((k, feature, kept))
            lm["alive"][dropped] = False
            lm["replaced_by"][dropped] = kept
            lm["n_visible"][kept] += lm["n_visible"][dropped]
            lm["n_found"][kept] += lm["n_found"][dropped]
        if moved:
            kf, features, landmarks = (np.array(column, np.int64) for column in zip(*moved, strict=True))
            self.observations.append(len(moved), kf=kf, feature=features, landmark=landmarks, alive=True)
        self.observations["alive"][died] = False

    def current_id(self, landmark_id: int) -> int:
        """Follow `replaced_by` to the landmark that stands for `landmark_id` now (it may be dead)."""
        replaced_by = self.landmarks["replaced_by"]
        while replaced_by[landmark_id] != NO_LANDMARK:
            landmark_id = int(replaced_by[landmark_id])
        return landmark_id

    def current_ids(self, landmark_ids: IntArray) -> IntArray:
        """`current_id` for an array in which `NO_LANDMARK` may stand; dead landmarks become `NO_LANDMARK`."""
        ids = np.array(landmark_ids, np.int64)
        if len(self.landmarks) == 0:
            return ids
        while True:
            heir = np.where(ids >= 0, self.landmarks["replaced_by"][ids], NO_LANDMARK)
            moved = heir != NO_LANDMARK
            if not moved.any():
                break
            ids[moved] = heir[moved]
        ids[(ids >= 0) & ~self.landmarks["alive"][ids]] = NO_LANDMARK
        return ids

    def by_heirs(self, id_of: IntArray) -> IntArray:
        """Return what landmarks are elsewhere, those merged by their heirs: `id_of` (L,) tells it of the living."""
        heir = self.current_ids(np.arange(len(id_of)))
        return np.where(heir != NO_LANDMARK, id_of[heir], NO_LANDMARK)

    # --- observations

    def add_observations(self, kf: IntArray | int, feature: IntArray, landmark: IntArray) -> IntArray:
        """Append observations; a feature that has a landmark already, or a landmark seen twice, is the caller's bug."""
        n = len(feature)
        rows = self.observations.append(n, kf=kf, feature=feature, landmark=landmark, alive=True)
        if np.ndim(kf) == 0:
            self.landmark_of[int(kf)][feature] = landmark
        else:
            for k, f, j in zip(np.asarray(kf).tolist(), feature.tolist(), landmark.tolist(), strict=True):
                self.landmark_of[k][f] = j
        return rows

    def remove_observations(self, rows: IntArray) -> None:
        """Let observation rows die; they stay in the table until `keep_observations`."""
        obs = self.observations
        rows = rows[obs["alive"][rows]]
        obs["alive"][rows] = False
        for k in np.unique(obs["kf"][rows]).tolist():
            if k in self.landmark_of:
                self.landmark_of[k][obs["feature"][rows[obs["kf"][rows] == k]]] = NO_LANDMARK

    def keep_observations(self, rows: IntArray) -> None:
        """Leave only these rows in the table, ascending, and with them all that live: they are numbered anew."""
        obs = self.observations
        if np.count_nonzero(obs["alive"][rows]) < np.count_nonzero(obs["alive"]):
            raise ValueError(f"submap {self.id}: rows of live observations are to leave the table")
        self.observations = obs.taken(rows)
        self.n_dropped += len(obs) - len(rows)

    def find_observations(self, kf: IntArray, feature: IntArray, landmark: IntArray) -> IntArray:
        """Return the rows in which keyframes see landmarks by these features; what is not there now has none."""
        rows, obs = self.rows_of_landmarks(landmark), self.observations
        wanted = set(zip(kf.tolist(), feature.tolist(), landmark.tolist(), strict=True))
        held = zip(*(obs[name][rows].tolist() for name in ("kf", "feature", "landmark")), strict=True)
        return rows[np.array([observation in wanted for observation in held], np.bool_)]

    def remove_outliers(self, rows: IntArray) -> None:
        """Drop observations that a solution contradicts, and landmarks left with fewer than two."""
        touched = np.unique(self.observations["landmark"][rows])
        self.remove_observations(rows)
        self.remove_landmarks(touched[self.n_observations(touched) < 2])

    def rows_of_landmarks(self, landmark_ids: IntArray) -> IntArray:
        """Return the live observation rows of a set of landmarks."""
        wanted = self.mask_of(landmark_ids)
        return np.flatnonzero(self.observations["alive"] & wanted[self.observations["landmark"]])

    def _views_by_landmark(self, landmark_ids: list[int]) -> dict[int, list[tuple[int, int, int]]]:
        """Return row, keyframe and feature of each landmark's live observations, by ascending row."""
        rows, obs = self.rows_of_landmarks(np.array(landmark_ids, np.int64)), self.observations
        views: dict[int, list[tuple[int, int, int]]] = {j: [] for j in landmark_ids}
        columns = (rows, obs["kf"][rows], obs["feature"][rows], obs["landmark"][rows])
        for row, k, feature, j in zip(*(column.tolist() for column in columns), strict=True):
            views[j].append((row, k, feature))
        return views

    def n_observations(self, landmark_ids: IntArray) -> IntArray:
        """Return how many keyframes see each landmark."""
        obs = self.observations
        # Rows of a table are appended, and die; none is changed otherwise. So the counts follow from the rows that have
        # come or died since the last question.
        alive, landmark = obs["alive"], obs["landmark"]
        if self._counted is None or self._counted[0] is not obs:
            self._counted = (obs, np.zeros(0, np.bool_), np.zeros(0, np.int64))
        _, was, counts = self._counted
        n = len(self.landmarks)
        died, new = np.flatnonzero(was != alive[: len(was)]), landmark[len(was) :][alive[len(was) :]]
        if len(died) or len(was) < len(alive) or len(counts) < n:
            updated = np.bincount(new, minlength=n) - np.bincount(landmark[died], minlength=n)
            updated[: len(counts)] += counts
            self._counted = (obs, alive.copy(), updated)
        return self._counted[2][landmark_ids]

    def covisible(self, landmark_ids: IntArray) -> tuple[IntArray, IntArray]:
        """Return the keyframes that see any of `landmark_ids` and how many each sees, most first (ties: older id)."""
        rows = self.rows_of_landmarks(landmark_ids)
        ids, counts = np.unique(self.observations["kf"][rows], return_counts=True)
        order = np.lexsort((ids, -counts))
        return ids[order], counts[order]

    def n_views_among(self, keyframe_ids: Iterable[int]) -> IntArray:
        """Return by how many of some keyframes each landmark is seen, dead ones too."""
        n_seen = np.zeros(len(self.landmarks), np.int64)
        for k in keyframe_ids:
            n_seen[self.seen_in(k)] += 1
        return n_seen

    def landmarks_of_keyframes(self, keyframe_ids: IntArray | list[int]) -> IntArray:
        """Return the ids of all live landmarks that any of the keyframes sees, ascending."""
        seen = np.zeros(len(self.landmarks), bool)
        for k in keyframe_ids:
            seen[self.seen_in(int(k))] = True
        return np.flatnonzero(seen & self.landmarks["alive"])

    def observed_pixels(self, rows: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return rectified pixels (R, 2) and their sigmas (R,) of observation rows."""
        uv = np.empty((len(rows), 2))
        sigma = np.empty(len(rows))
        kf, feature = self.observations["kf"][rows], self.observations["feature"][rows]
        order = np.argsort(kf, kind="stable")
        ids, starts = np.unique(kf[order], return_index=True)
        for k, here in zip(ids.tolist(), np.split(order, starts[1:]), strict=False):
            features = self.keyframes[k].features
            uv[here] = features.uv_rect_px.take(feature[here], axis=0)
            sigma[here] = features.sigma_px[feature[here]]
        return uv, sigma

    def mask_of(self, landmark_ids: IntArray) -> BoolArray:
        """Return a mask over all landmarks, dead ones too, that is true at those named (`NO_LANDMARK` names none)."""
        mask = np.zeros(len(self.landmarks), bool)
        mask[landmark_ids[landmark_ids >= 0]] = True
        return mask

    # --- whole map

    def transform(self, scale: float, T_new_old: FloatArray) -> None:
        """Apply ``p_new = scale * R p + t`` to all poses and points (a change of gauge)."""
        R, t = se3.rotation(T_new_old), se3.translation(T_new_old)
        for k, T in self.T_submap_kf.items():
            self.T_submap_kf[k] = se3.from_parts(R @ se3.rotation(T), scale * R @ se3.translation(T) + t)
        for k, anchor in self.anchors.items():
            self.anchors[k] = Anchor(anchor.keyframe_id, se3.scaled(anchor.T_kf_cam, scale))
        self.relative_poses = {k: known.scaled(scale) for k, known in self.relative_poses.items()}
        lm = self.landmarks
        lm["xyz_mu"][:] = scale * lm["xyz_mu"] @ R.T + t
        lm["normal"][:] = lm["normal"] @ R.T
        lm["distance_mu"][:] *= scale

    def apply_estimate(
        self, keyframe_ids: IntArray, T_submap_kf: FloatArray, landmark_ids: IntArray, xyz_mu: FloatArray
    ) -> None:
        """Take refined poses and points over; those of keyframes that were culled since are passed over.

        The distances at which landmarks were described grow with the map: these say how large their patches appear.
        """
        lm = self.landmarks
        first, at = np.unique(lm["first_kf"][landmark_ids], return_inverse=True)
        before = lm["xyz_mu"][landmark_ids] - self._centres(first)[at]
        for k, T in zip(keyframe_ids.tolist(), T_submap_kf, strict=True):
            if k in self.keyframes:
                self.T_submap_kf[k] = np.array(T)
        lm["xyz_mu"][landmark_ids] = xyz_mu
        after = xyz_mu - self._centres(first)[at]
        growth2 = np.einsum("ij,ij->i", after, after) / np.maximum(np.einsum("ij,ij->i", before, before), TINY**2)
        lm["distance_mu"][landmark_ids] *= np.where(np.isfinite(growth2), np.sqrt(growth2), 1.0)

    def _centres(self, keyframe_ids: IntArray) -> FloatArray:
        """Return (K, 3) where keyframes stand, culled ones too; NaN for those of another submap."""
        centres = np.full((len(keyframe_ids), 3), np.nan)
        for row, k in enumerate(keyframe_ids.tolist()):
            if k in self.T_submap_kf:
                centres[row] = se3.translation(self.T_submap_kf[k])
            elif k in self.anchors:
                centres[row] = se3.translation(self.resolve_anchor(k, se3.IDENTITY))
        return centres

    def copy(self) -> Submap:
        """Return an independent copy (keyframes and features are immutable and shared)."""
        twin = Submap(self.id, self.K, self.landmarks["descriptor"][0] if len(self.landmarks) else np.zeros(0))
        twin.keyframes = dict(self.keyframes)
        twin.T_submap_kf = {k: T.copy() for k, T in self.T_submap_kf.items()}
        twin.landmark_of = {k: a.copy() for k, a in self.landmark_of.items()}
        twin.anchors = dict(self.anchors)
        twin.relative_poses = dict(self.relative_poses)
        twin.gauge, twin.condemned = self.gauge, set(self.condemned)
        twin.landmarks, twin.observations = self.landmarks.copy(), self.observations.copy()
        twin.n_dropped = self.n_dropped
        return twin

    def take_over(self, changed: Submap) -> None:
        """Become what a copy of this submap was changed to."""
        self.K, self.gauge, self.condemned = changed.K, changed.gauge, changed.condemned
        self.keyframes, self.T_submap_kf = changed.keyframes, changed.T_submap_kf
        self.landmark_of, self.anchors = changed.landmark_of, changed.anchors
        self.relative_poses = changed.relative_poses
        self.landmarks, self.observations = changed.landmarks, changed.observations
        self.n_dropped = changed.n_dropped
