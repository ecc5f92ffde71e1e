"""When a tracked frame becomes a keyframe: by its parallax, or as the camera has moved past unmapped image content.

Known content gives the parallax: a bench before a far wall moves by a quarter of the image while the wall hardly does.
"""

from __future__ import annotations

import numpy as np

from dualslam.core.arrays import median
from dualslam.core.config.settings import KeyframeConfig
from dualslam.core.decisions import Gate, Ruling
from dualslam.core.geometry import se3
from dualslam.core.geometry.projection import MIN_DEPTH
from dualslam.core.interfaces import Frontend
from dualslam.core.noise_model import PROOF_VIEWS, TINY
from dualslam.core.types import BoolArray, Features, FloatArray, IntArray, Track
from dualslam.frontends.tracking.turning import unit_rays
from dualslam.map.submap import NO_LANDMARK, Submap

MIN_PARALLAX_DEG = 0.5
"""...and the camera has moved enough to see the scene's median depth under this angle (or tracking is weak)."""
MAX_TRACKED_RATIO = 0.6
"""A keyframe is due when a smaller share of the last one's landmarks is still tracked."""
MAX_FRAMES = 30
"""Frames after which one is due if the camera has moved at all."""
FULL_PARALLAX_DEG, LEAST = 1.4, 0.6
"""Parallax from which on `MAX_TRACKED_RATIO` holds as it is; with less it is smaller in proportion, down to this share.
At 1 degree half of the scene is too far to be triangulated, and a pixel is a tenth of the depth. With 2 degrees and a
half `euroc_takeoff` breaks: its bench has left before a keyframe comes."""

N_LIKE = 5
"""Keyframes of earlier runs, those that see most of what a frame sees, that are asked whether one shows the same."""

LEAST_HOLD = 0.5
"""Share of the hold that must be left, of the share of the number: on roads near landmarks leave all the time, and with
more than half keyframes come a tenth more often there."""


def keyframe_due(track: Track, submap: Submap, reference_id: int, config: KeyframeConfig, first_id: int = 0) -> Ruling:
    """Decide by what is still tracked of the last keyframe and by how far the camera has moved since.

    - `reference_id`: the last keyframe, in the direction in which the frames come.
    - `first_id`: number of this run's first frame: how long ago another run was says nothing.
    """
    if track.view.index in submap.keyframes:
        return Ruling(False, detail="it is one already")
    weak = Gate("inliers", track.n_inliers, "<", config.weak_landmarks)
    if weak.passed:
        return Ruling(True, (weak,))
    n_frames = abs(track.view.index - reference_id) if reference_id >= first_id else 0
    share = _share_in(track.landmark_ids, submap, reference_id)
    parallax = parallax_deg(track, submap, reference_id)
    if parallax >= MIN_PARALLAX_DEG and _n_holding(track, submap) < config.weak_landmarks:
        # A few near ones hold the position, like a bench that a camera takes off from: while they leave, the many far
        # ones are still in view, and a keyframe that came when these change would find the scale already lost.
        share = min(share, _share_in(track.landmark_ids, submap, reference_id, by_hold=True) / LEAST_HOLD)
    gates = _shows_other(share, parallax, n_frames, config)
    return Ruling(any(gate.passed for gate in gates), (weak, *gates))


def keyframe_like(track: Track, submap: Submap, first_id: int, config: KeyframeConfig) -> int | None:
    """Return the keyframe of an earlier run that makes one of this frame superfluous, if there is one.

    It sees the same from much the same place; whether the frame's own content is found there does not matter.

    `first_id`: number of this run's first frame.
    """
    if track.n_inliers < config.weak_landmarks:
        return None
    in_view = np.union1d(track.visible_ids, track.landmark_ids)
    covisible, _ = submap.covisible(track.seen_ids)
    for k in covisible[covisible < first_id][:N_LIKE].tolist():
        gates = _shows_other(_share_in(in_view, submap, k), parallax_deg(track, submap, k), 0, config)
        if not any(gate.passed for gate in gates):
            return int(k)
    return None


def _shows_other(share: float, parallax: float, n_frames: int, config: KeyframeConfig) -> list[Gate]:
    """Return the comparisons of which one says that a frame shows other things than a keyframe, or from elsewhere.

    `share`: of the keyframe's landmarks, that the frame shows. `n_frames`: that lie between the two.
    """
    moved = Gate("parallax to the last keyframe in degrees", parallax, ">", config.max_parallax_deg)
    # A turn in place reveals nothing that could be triangulated, until half of what was known is out of view.
    turns = parallax < MIN_PARALLAX_DEG
    worth = 0.5 if turns else min(max(parallax / FULL_PARALLAX_DEG, LEAST), 1.0)
    left = Gate("share of the last keyframe's landmarks", share, "<", worth * MAX_TRACKED_RATIO)
    late = Gate("frames since the last keyframe", n_frames, ">=", MAX_FRAMES)
    return [moved, left] if turns else [moved, left, late]


def _share_in(landmark_ids: IntArray, submap: Submap, keyframe_id: int, by_hold: bool = False) -> float:
    """Return the share of a keyframe's established landmarks that are among some; `by_hold`: of their hold on it."""
    reference = submap.seen_in(keyframe_id)
    established = submap.n_observations(reference) >= min(PROOF_VIEWS, len(submap.keyframes))
    reference = reference[established]
    if not len(reference):
        return 0.0
    shown = submap.mask_of(landmark_ids)[reference]
    if not by_hold:
        return float(shown.mean())
    hold = _hold(reference, submap, se3.inverse(submap.T_submap_kf[keyframe_id]))
    return float(hold @ shown / hold.sum())


def _hold(landmark_ids: IntArray, submap: Submap, T_cam_submap: FloatArray) -> FloatArray:
    """Return by how much each landmark holds a camera: what a pixel tells of its position falls as depth squared."""
    return np.maximum(submap.depths(landmark_ids, T_cam_submap), MIN_DEPTH) ** -2.0


def _n_holding(track: Track, submap: Submap) -> float:
    """Return how many landmarks, all as near as each other, would hold the position as evenly as those tracked do."""
    hold = _hold(track.seen_ids, submap, track.T_cam_submap)
    return float(hold.sum() ** 2 / (hold @ hold)) if len(hold) else 0.0


def parallax_deg(track: Track, submap: Submap, reference_id: int) -> float:
    """Angle under which the baseline to a keyframe is seen from the scene's median depth, degrees; 0 of no scene."""
    ids = track.seen_ids
    if not len(ids):
        return 0.0
    T_cam_submap = track.T_cam_submap
    depth = submap.depths(ids, T_cam_submap)
    centre = se3.translation(se3.inverse(T_cam_submap))
    baseline = float(np.linalg.norm(centre - se3.translation(submap.T_submap_kf[reference_id])))
    return float(np.degrees(np.arctan2(baseline, max(median(depth), TINY))))


MIN_SHARE = 0.4
"""Of the image that must be unmapped before it is looked at, as that takes a matching: more than in any of 400 frames
of a road and 300 of a room. From a quarter on, the room has a tenth more keyframes."""
CELLS_ACROSS, MIN_IN_CELL = 8, 5  # the image's cells, and how many features make one that shows something


def passes_unmapped(
    track: Track, submap: Submap, keyframe_id: int, frontend: Frontend, parallax_deg: float, n: int
) -> bool:
    """Whether unmapped content has moved between frame and keyframe by more than a turn does.

    - `track`: of a frame.
    - `keyframe_id`: of the submap: the last keyframe.
    - `parallax_deg`: at which a keyframe is due if what is mapped shows it. At 1 degree, turns on the spot make some
      too.
    - `n`: so many matches must show it.
    """
    features, keyframe = track.view.features, submap.keyframes[keyframe_id].features
    rows = np.flatnonzero(_unmapped(features, track.landmark_ids >= 0))
    if len(rows) == 0:
        return False
    free = np.flatnonzero(submap.landmark_of[keyframe_id] == NO_LANDMARK)
    matches = frontend.match_wide(features.take(rows), keyframe.take(free)).index
    if len(matches) < n:
        return False
    uv_px, uv_kf_px = features.uv_rect_px[rows[matches[:, 0]]], keyframe.uv_rect_px[free[matches[:, 1]]]
    here = se3.rotation(track.T_cam_submap).T @ unit_rays(submap.K, uv_px)
    there = se3.rotation(submap.T_submap_kf[keyframe_id]) @ unit_rays(submap.K, uv_kf_px)
    sine = np.linalg.norm(np.cross(here, there, axis=0), axis=0)
    return int((sine > np.sin(np.radians(parallax_deg))).sum()) >= n


def _unmapped(features: Features, has_landmark: BoolArray) -> BoolArray:
    """Return which features lie in cells without a landmark; none where these are a small share of the image."""
    u, v = features.uv_rect_px.T
    cell_px = max(float(np.ptp(u)), 1.0) / CELLS_ACROSS
    column, row = (np.floor(x / cell_px).astype(np.int64) for x in (u, v))
    cell = (row - row.min()) * (CELLS_ACROSS + 2) + column - column.min()
    shows = np.bincount(cell) >= MIN_IN_CELL
    bare = shows & (np.bincount(cell, has_landmark) == 0)
    return np.asarray(bare[cell] & (bare.sum() > MIN_SHARE * shows.sum()))
