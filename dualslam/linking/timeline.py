"""What the shared keyframes say about a similarity one by one, in order of time.

The newest part of the old map may be corrupted: rigid in itself, so that it fits the new map by a clean similarity that
is wrong. What gives it away lies along time: the place where the old map is torn, or where the similarity changes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dualslam.core.config import LinkingConfig
from dualslam.core.geometry import se3, sim3, so3
from dualslam.core.submap import Submap
from dualslam.core.types import BoolArray, FloatArray, IntArray
from dualslam.linking.pairs import PairModel


@dataclass(frozen=True, slots=True, eq=False)
class KeyframeVotes:
    """How each of the K shared keyframes stands to a similarity.

    Attributes
    ----------
    n_pairs : (K,) int64
        Matched pairs seen there.
    share : (K,)
        Share of them whose points agree.
    share_pixels : (K,)
        Share of their reprojections that agree, in the worse of the two directions.
    rotation_rad : (K,)
        Angle between the camera's orientations in the two maps.
    centre : (K,)
        Distance between its centres, relative to the distance of the landmarks it sees (or of the centre of the
        overlap, if that is more).
    agrees, has_say : (K,) bool
    """

    n_pairs: IntArray
    share: FloatArray
    share_pixels: FloatArray
    rotation_rad: FloatArray
    centre: FloatArray
    agrees: BoolArray
    has_say: BoolArray


def ask_keyframes(model: PairModel, S_old_new: FloatArray, config: LinkingConfig) -> KeyframeVotes:
    """Ask each shared keyframe whether its matches, its pixels and its two poses agree with a similarity."""
    c = model.pairs
    every = np.ones(len(c.view_pair), bool)
    n = c.count_by_keyframe(every)
    per = np.maximum(n, 1)
    near = model.mahalanobis2(S_old_new) < config.pair_chi2
    in_old, in_new = model.reprojection2(S_old_new)
    share = c.count_by_keyframe(near[c.view_pair]) / per
    share_pixels = np.minimum(
        c.count_by_keyframe(in_old < config.pixel_chi2), c.count_by_keyframe(in_new < config.pixel_chi2)
    )
    share_pixels = share_pixels / per
    T_moved = sim3.act_on_pose(S_old_new, model.T_new_kf)
    turn = so3.log(T_moved[:, :3, :3].swapaxes(1, 2) @ model.T_old_kf[:, :3, :3])
    rotation = np.sqrt((turn**2).sum(1))
    centres = model.T_old_kf[:, :3, 3]
    apart = np.linalg.norm(T_moved[:, :3, 3] - centres, axis=1)
    distance = np.linalg.norm(c.xyz_old[c.view_pair] - centres[c.view_keyframe], axis=1)
    depth = np.array([np.median(distance[c.view_keyframe == k]) for k in range(len(c.keyframes))])
    reach = np.maximum(depth, np.linalg.norm(centres - model.centre_old, axis=1))
    bound = config.gate_sigmas * config.deformation_sigma
    agrees = (share > config.min_majority) & (share_pixels > config.min_majority)
    agrees &= (rotation < bound) & (apart < bound * reach)
    return KeyframeVotes(n, share, share_pixels, rotation, apart / reach, agrees, n >= config.min_pairs_per_keyframe)


def leading_run(agrees: BoolArray, max_misfits: int) -> int:
    """Return the length of the run of agreement that begins at the first element: single misfits do not end it.

    More than `max_misfits` in a row do, and so does a misfit at the very end, or at the beginning (then it is 0).
    """
    if len(agrees) == 0 or not agrees[0]:
        return 0
    end, misfits = 0, 0
    for i, agree in enumerate(agrees.tolist()):
        misfits = 0 if agree else misfits + 1
        if misfits > max_misfits:
            break
        if agree:
            end = i + 1
    return end


def find_break(old: Submap, oldest_shared: int, config: LinkingConfig) -> int | None:
    """Return the id of the first keyframe after a place where the old map is torn, None where it holds together.

    A place between two keyframes is torn if too few landmarks are seen on both sides in agreement with their pixels: a
    wrong pose either ends the tracks or leaves their observations wrong on one side.

    Parameters
    ----------
    old : Submap
    oldest_shared : int
        Keyframe id; the search covers the newer keyframes and `config.look_back` older ones.
    config : LinkingConfig
    """
    ids = np.array(sorted(old.keyframes))
    first = int(np.searchsorted(ids, oldest_shared))
    ids = ids[max(first - config.look_back - config.tie_window, 0) :]
    if len(ids) < 2:
        return None
    obs = old.observations
    rows = np.flatnonzero(obs["alive"] & np.isin(obs["kf"], ids))
    column = np.searchsorted(ids, obs["kf"][rows])
    landmarks, row = np.unique(obs["landmark"][rows], return_inverse=True)
    uv, sigma = old.observed_pixels(rows)
    T_kf_old = se3.inverse(old.keyframe_poses(ids))
    p = se3.act_each(T_kf_old[column], old.landmarks["xyz_mu"][landmarks][row])
    z = np.where(p[:, 2] > 0, p[:, 2], np.nan)
    predicted = p[:, :2] / z[:, None] * np.array([old.K[0, 0], old.K[1, 1]]) + old.K[:2, 2]
    good = ((predicted - uv) ** 2).sum(1) / sigma**2 < config.pixel_chi2
    seen = np.zeros((len(landmarks), len(ids)), bool)
    seen[row[good], column[good]] = True
    for i in range(1, len(ids)):
        before = seen[:, max(i - config.tie_window, 0) : i].any(1)
        after = seen[:, i : i + config.tie_window].any(1)
        if np.count_nonzero(before & after) < config.min_ties and i >= min(config.tie_window, first):
            return int(ids[i])
    return None
