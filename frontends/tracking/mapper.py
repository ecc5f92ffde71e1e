"""Effect of a new keyframe on the map: observations, culling, merged duplicates, new landmarks."""

from __future__ import annotations

from collections.abc import Set

import numpy as np

from dualslam.core.arrays import median, rank_in_runs
from dualslam.core.camera.base import Camera
from dualslam.core.chi_square import CHI2_95
from dualslam.core.config.settings import MappingConfig
from dualslam.core.geometry import se3
from dualslam.core.geometry.triangulation import triangulate_two_view
from dualslam.core.geometry.two_view import fundamental_from_pose
from dualslam.core.interfaces import Frontend
from dualslam.core.noise_model import CELLS_ACROSS, COVISIBLE, PROOF_VIEWS, SAME_POINT_PX, TINY
from dualslam.core.types import BoolArray, Features, FloatArray, IntArray, Keyframe, Track
from dualslam.frontends.features.matching import match_epipolar
from dualslam.frontends.tracking.local_map import LocalMap
from dualslam.map.submap import NO_LANDMARK, Submap

MIN_FOUND_RATIO = 0.25
"""A young landmark that tracking finds in fewer of the frames that should see it is culled."""
MIN_PARALLAX_DEG = 1.0
"""Smallest angle between the two rays of a new landmark, unless it is a far one."""
MAX_OBSERVATIONS = 250
"""Known landmarks that a keyframe holds on to, spread over its image: more make the solver slower, not better."""
TRIANGULATE_AGAINST = 6
"""Older keyframes that a new keyframe is paired with."""

FEW = 0.5
"""Share of `MAX_OBSERVATIONS` below which a keyframe takes far points as landmarks, too."""
FAR_SIGMAS = 2.0
"""Parallax of a far point, in standard deviations of its two pixels: its depth is known to half."""


def spread_choice(uv_px: FloatArray, priority: IntArray, n: int, size_px: tuple[int, int]) -> BoolArray:
    """Choose up to `n` features, evenly from all cells of the image, the highest priority in each cell first.

    `uv_px` (N, 2), `priority` (N,), `size_px` (width, height).

    Returns (N,) bool.
    """
    chosen = np.ones(len(uv_px), bool)
    if len(uv_px) <= n:
        return chosen
    column = np.clip(uv_px[:, 0] * CELLS_ACROSS / size_px[0], 0, CELLS_ACROSS - 1).astype(np.int64)
    row = np.clip(uv_px[:, 1] * CELLS_ACROSS / size_px[0], 0, None).astype(np.int64)
    cell = row * CELLS_ACROSS + column
    order = np.lexsort((np.arange(len(cell)), -priority, cell))
    rank = np.empty(len(cell), np.int64)
    rank[order] = rank_in_runs(cell[order])
    chosen[np.lexsort((np.arange(len(cell)), -priority, rank))[n:]] = False
    return chosen


class Mapper:
    """Extends a submap by keyframes; knows nothing of the order in which they come."""

    def __init__(self, frontend: Frontend, config: MappingConfig, submap: Submap, camera: Camera) -> None:
        self._frontend = frontend
        self._config = config
        self._submap = submap
        self._camera = camera
        self._young: list[tuple[int, IntArray]] = []  # keyframe count at birth, landmark ids
        self._n_inserted = 0
        self._gate_chi2 = CHI2_95[2]  # as it is for the keyframe that grows

    def observe(self, track: Track) -> None:
        """Make a tracked frame a keyframe that sees the landmarks by which it was tracked, and nothing new."""
        submap, view = self._submap, track.view
        T_submap_kf = se3.inverse(track.T_cam_submap)
        submap.add_keyframe(Keyframe(view.index, view.timestamp_s, view.features), T_submap_kf)
        feature = np.flatnonzero(track.landmark_ids >= 0)
        n_seen = submap.n_observations(track.landmark_ids[feature])
        uv_px = np.nan_to_num(self._camera.unrectify(view.features.uv_rect_px[feature]))
        kept = spread_choice(uv_px, n_seen, MAX_OBSERVATIONS, self._camera.size_px)
        feature = feature[kept]
        submap.add_observations(view.index, feature, track.landmark_ids[feature])

    def grow(self, track: Track, apart: Set[int] = frozenset(), noise2: float = 1.0) -> None:
        """Grow the map about the keyframe that a tracked frame has become, from the current poses.

        - `apart`: keyframes across a gap, with which nothing new is triangulated: few landmarks tie them, so that their
          epipolar lines are off, and false matches get depths that confirm the poses.
        - `noise2`: variance of the map's whitened residuals. Observations that fit worse are not admitted.
        """
        view = track.view
        self._gate_chi2 = CHI2_95[2] * min(noise2, 1.0)
        self._n_inserted += 1
        self._cull_young()
        neighbours = self._neighbours(view.index)
        self._search_neighbour_landmarks(view.index, neighbours, track.landmark_ids)
        # Features whose landmark was left out are no candidates for a new one.
        on_this_side = self._on_this_side(view.index, neighbours, apart)
        new = self._triangulate(view.index, on_this_side, candidates=track.landmark_ids == NO_LANDMARK)
        self._search_new_in_neighbours(new, neighbours)
        self._young.append((self._n_inserted, new))
        self._refresh_descriptions(view.index)

    # --- steps

    def _neighbours(self, keyframe_id: int) -> list[int]:
        """Older keyframes to pair with: the most covisible, with baselines as different as they come."""
        submap = self._submap
        found, counts = submap.covisible(submap.seen_in(keyframe_id))
        keep = (found != keyframe_id) & (counts >= COVISIBLE)
        covisible = [int(k) for k in found[keep][:TRIANGULATE_AGAINST]]
        if covisible:
            return covisible
        # Beyond a gap relocalisation hardly a landmark may be known: what the frames on the other side see is found by
        # its features.
        return [k for k in submap.keyframes_near(keyframe_id) if k != keyframe_id][:TRIANGULATE_AGAINST]

    def _on_this_side(self, keyframe_id: int, neighbours: list[int], apart: Set[int]) -> list[int]:
        """Return the neighbours that no gap parts from a keyframe; those nearest in time where there is a gap."""
        if not any(k in apart for k in neighbours):
            return neighbours
        near = [k for k in self._submap.keyframes_near(keyframe_id) if k not in apart and k != keyframe_id]
        return near[:TRIANGULATE_AGAINST]

    def _cull_young(self) -> None:
        """Cull landmarks on probation that tracking does not find, or that too few keyframes came to see."""
        submap, kept = self._submap, []
        for born, ids in self._young:
            ids = ids[submap.landmarks["alive"][ids]]
            age = self._n_inserted - born
            lm = submap.landmarks
            ratio = lm["n_found"][ids] / np.maximum(lm["n_visible"][ids], 1)
            bad = ratio < MIN_FOUND_RATIO
            if age >= 2:
                bad |= submap.n_observations(ids) < PROOF_VIEWS
            submap.remove_landmarks(ids[bad])
            if age < PROOF_VIEWS:
                kept.append((born, ids[~bad]))
        self._young = kept

    def _search_neighbour_landmarks(self, k: int, neighbours: list[int], tracked: IntArray) -> None:
        """Look for neighbours' landmarks that tracking missed: new observations, or duplicates to merge."""
        submap = self._submap
        others = submap.landmarks_of_keyframes(neighbours)
        local = LocalMap.of_landmarks(submap, others[~submap.mask_of(tracked)[others]])
        self._observe_in(k, local)

    def _observe_in(self, k: int, local: LocalMap) -> None:
        """Search landmarks in a keyframe; a free feature becomes an observation, a taken one a pair to merge."""
        submap, frontend = self._submap, self._frontend
        features = submap.keyframes[k].features
        T_kf_submap = se3.inverse(submap.T_submap_kf[k])
        prediction, matches = local.search(
            frontend, self._camera, T_kf_submap, submap.K, features, SAME_POINT_PX, frontend.max_distance_strict
        )
        row, feature = matches.index[:, 0], matches.index[:, 1]
        error = (features.uv_rect_px[feature] - prediction.uv_px[row]) / features.sigma_px[feature][:, None]
        close = np.einsum("ij,ij->i", error, error) < self._gate_chi2
        ids, feature = local.landmark_ids[prediction.rows[row[close]]], feature[close]
        there = submap.landmark_of[k][feature]
        free = there == NO_LANDMARK
        submap.add_observations(k, feature[free], ids[free])
        # Merge towards the landmark that more keyframes see.
        ids, there = ids[~free], there[~free]
        if len(ids):
            n_seen = submap.n_observations(np.stack([ids, there]))
            swap = n_seen[0] > n_seen[1]
            submap.merge_landmarks(np.where(swap, ids, there), np.where(swap, there, ids))

    def _triangulate(self, k: int, neighbours: list[int], candidates: BoolArray) -> IntArray:
        """Triangulate the keyframe's free features against several older keyframes.

        If matches bring too few landmarks, far points are taken too: they hold the rotation until near ones come into
        view. A keyframe with landmarks enough does without: the depths of far points err towards near.
        """
        near_deg = MIN_PARALLAX_DEG
        created = [self._triangulate_pair(k, other, candidates, near_deg) for other in neighbours]
        if np.count_nonzero(self._submap.landmark_of[k] >= 0) < FEW * MAX_OBSERVATIONS:
            far_deg = min(near_deg, self._far_parallax_deg(k))
            created += [self._triangulate_pair(k, other, candidates, far_deg) for other in neighbours]
        return np.concatenate(created) if created else np.zeros(0, np.int64)

    def _far_parallax_deg(self, k: int) -> float:
        """Return the smallest parallax that the keyframe's pixels tell from none, degrees."""
        noise_px = np.sqrt(2.0) * float(np.median(self._submap.keyframes[k].features.sigma_px))
        return float(np.degrees(np.arctan(FAR_SIGMAS * noise_px / self._submap.K[0, 0])))

    def _triangulate_pair(self, k: int, other: int, candidates: BoolArray, min_parallax_deg: float) -> IntArray:
        submap = self._submap
        a, b = submap.keyframes[k].features, submap.keyframes[other].features
        rows_a = np.flatnonzero((submap.landmark_of[k] == NO_LANDMARK) & candidates)
        rows_b = np.flatnonzero(submap.landmark_of[other] == NO_LANDMARK)
        T_submap_a, T_submap_b = submap.T_submap_kf[k], submap.T_submap_kf[other]
        baseline = float(np.linalg.norm(se3.translation(T_submap_a) - se3.translation(T_submap_b)))
        depth = self._median_depth(other)
        if not _wide_enough(depth, baseline, min_parallax_deg) or len(rows_a) == 0 or len(rows_b) == 0:
            return np.zeros(0, np.int64)
        T_b_a = se3.inverse(T_submap_b) @ T_submap_a
        matches = match_epipolar(
            self._frontend,
            a,
            b,
            rows_a,
            rows_b,
            fundamental_from_pose(submap.K, T_b_a),
            octave_tolerance=self._octave_tolerance(depth, baseline),
        )
        fa, fb = matches.index[:, 0], matches.index[:, 1]
        points = triangulate_two_view(a.uv_rect_px[fa], b.uv_rect_px[fb], submap.K, T_submap_a, T_submap_b)
        ok = (
            (points.depth_a > 0)
            & (points.depth_b > 0)
            & (points.cos_parallax < np.cos(np.radians(min_parallax_deg)))
            & (points.error2_a < self._gate_chi2 * a.sigma_px[fa] ** 2)
            & (points.error2_b < self._gate_chi2 * b.sigma_px[fb] ** 2)
            & self._scales_agree(a, b, fa, fb, points.depth_a, points.depth_b)
        )
        fa, fb = fa[ok], fb[ok]
        ids = submap.add_landmarks(points.xyz[ok], a.descriptors[fa], a.scale[fa], k)
        submap.add_observations(other, fb, ids)
        submap.add_observations(k, fa, ids)
        return ids

    def _octave_tolerance(self, depth_mu: float, baseline_mu: float) -> int:
        """Octaves between two views of a point: one, and as many as going so far towards the scene brings in scale."""
        growth = np.log1p(baseline_mu / max(depth_mu, TINY)) / np.log(self._frontend.scale_factor)
        return 1 + int(growth)

    def _median_depth(self, k: int) -> float:
        """Median depth of a keyframe's landmarks; infinite if it has none."""
        depths = self._submap.depths_in(k)
        return median(depths) if len(depths) else np.inf

    def _scales_agree(
        self, a: Features, b: Features, fa: IntArray, fb: IntArray, depth_a: FloatArray, depth_b: FloatArray
    ) -> BoolArray:
        """A patch at twice the distance has half the scale, to within 1.5 octaves' ratio."""
        ratio = (depth_a * a.scale[fa]) / np.maximum(depth_b * b.scale[fb], TINY)
        tolerance = 1.5 * self._frontend.scale_factor
        return (ratio < tolerance) & (ratio > 1 / tolerance)

    def _search_new_in_neighbours(self, new: IntArray, neighbours: list[int]) -> None:
        """Look for the new landmarks in the neighbours that did not take part in their triangulation."""
        submap = self._submap
        for other in neighbours:
            alive = new[submap.landmarks["alive"][new]]
            unseen = alive[~submap.mask_of(submap.landmark_of[other])[alive]]
            if len(unseen) == 0:
                continue
            self._observe_in(other, LocalMap.of_landmarks(submap, unseen))

    def _refresh_descriptions(self, k: int) -> None:
        """Describe each landmark that the keyframe sees as it looks from here: the view nearest to the next frames."""
        submap, lm = self._submap, self._submap.landmarks
        feature = np.flatnonzero(submap.landmark_of[k] >= 0)
        ids = submap.landmark_of[k][feature]
        features = submap.keyframes[k].features
        to_camera = se3.translation(submap.T_submap_kf[k]) - lm["xyz_mu"][ids]
        distance = np.linalg.norm(to_camera, axis=1)
        lm["descriptor"][ids] = features.descriptors[feature]
        lm["normal"][ids] = to_camera / np.maximum(distance, TINY)[:, None]
        lm["distance_mu"][ids] = distance
        lm["scale"][ids] = features.scale[feature]

    def redundant_keyframe(self, candidates: list[int]) -> int | None:
        """Return the first candidate whose landmarks are nearly all seen by three others at the same or finer scale."""
        n_seen = self._submap.n_observations(np.arange(len(self._submap.landmarks)))
        for k in candidates:
            # Seen by too few others at whatever scale: no need to look at scales.
            enough = n_seen[self._submap.seen_in(k)] > PROOF_VIEWS
            if (len(enough) == 0 or self._are_nearly_all(enough)) and self._is_redundant(k):
                return k
        return None

    def _are_nearly_all(self, seen: BoolArray) -> bool:
        return float(seen.mean()) > self._config.redundant_ratio

    def _is_redundant(self, k: int) -> bool:
        submap = self._submap
        feature = np.flatnonzero(submap.landmark_of[k] >= 0)
        ids = submap.landmark_of[k][feature]
        if len(ids) == 0:
            return True
        own = np.zeros(len(submap.landmarks), np.int64)
        own[ids] = submap.keyframes[k].features.octave[feature]
        rows = submap.rows_of_landmarks(ids)
        obs = submap.observations
        rows = rows[obs["kf"][rows] != k]
        rows = rows[np.argsort(obs["kf"][rows], kind="stable")]
        others, starts = np.unique(obs["kf"][rows], return_index=True)
        octaves = [
            submap.keyframes[other].features.octave[obs["feature"][here]]
            for other, here in zip(others.tolist(), np.split(rows, starts[1:]), strict=False)
        ]
        landmark = obs["landmark"][rows]
        octave = np.concatenate(octaves) if octaves else landmark
        as_fine = np.bincount(landmark[octave <= own[landmark] + 1], minlength=len(submap.landmarks))
        return self._are_nearly_all(as_fine[ids] >= PROOF_VIEWS)


def _wide_enough(depth_mu: float, baseline_mu: float, min_parallax_deg: float) -> bool:
    """Whether the baseline can give the scene's median depth the smallest parallax that is asked for."""
    return bool(baseline_mu > 0.5 * np.radians(min_parallax_deg) * depth_mu)
