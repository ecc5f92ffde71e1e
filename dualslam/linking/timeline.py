"""A similarity tested by the shared keyframes one by one, in order of time.

The newest part of the old map may be corrupted: rigid in itself, so that it fits the new map by a clean similarity that
is wrong. Along time it shows where the old map is torn, or where the similarity changes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from dualslam.core.config.settings import LinkingConfig
from dualslam.core.geometry import se3, sim3, so3
from dualslam.core.noise_model import GATE_SIGMAS, GROUP, MAJORITY
from dualslam.core.types import BoolArray, FloatArray, IntArray
from dualslam.linking.join_test import MIN_PAIRS_PER_KEYFRAME, MIN_TIES, PAIR_CHI2, PIXEL_CHI2
from dualslam.linking.pairs import PairModel, pixel_chi2
from dualslam.map.submap import Submap

UNTESTABLE = 3.0
"""Times the expected deformation: a part whose own sigma is larger says nothing about it."""
ALONG_AXIS = 4.0
"""How much worse a camera's centre is known along its axis than across it: focal length over the landmarks' offset."""
ROTATION_SHARE = 0.25
"""How much less orientation drifts (rad) than scale does (relative)."""


@dataclass(frozen=True, slots=True, eq=False)
class KeyframeVotes:
    """How each of the K shared keyframes stands to a similarity."""

    rotation_rad: FloatArray  # (K,): angle between the camera's orientations in the two maps
    centre: FloatArray
    """(K,): distance between its centres, relative to that of the landmarks it sees (or of the overlap's centre)."""
    agrees: BoolArray  # (K,)
    can_vote: BoolArray  # (K,)


def ask_keyframes(model: PairModel, S_old_new: FloatArray, config: LinkingConfig) -> KeyframeVotes:
    """Ask each shared keyframe whether its matches and its two poses agree with a similarity."""
    c = model.pairs
    every = np.ones(len(c.view_pair), bool)
    n = c.count_by_keyframe(every)
    per = np.maximum(n, 1)
    near = model.mahalanobis2(S_old_new) < PAIR_CHI2
    share = c.count_by_keyframe(near[c.view_pair]) / per
    T_moved = sim3.act_on_pose(S_old_new, model.T_new_kf)
    turn = so3.log(se3.rotation(T_moved).swapaxes(1, 2) @ se3.rotation(model.T_old_kf))
    rotation = np.sqrt((turn**2).sum(1))
    centres = se3.translation(model.T_old_kf)
    apart = np.linalg.norm(se3.translation(T_moved) - centres, axis=1)
    distance = np.linalg.norm(c.xyz_old[c.view_pair] - centres[c.view_keyframe], axis=1)
    depth = np.array([np.median(distance[c.view_keyframe == k]) for k in range(len(c.keyframes))])
    reach = np.maximum(depth, np.linalg.norm(centres - model.centre_old, axis=1))
    bound = GATE_SIGMAS * config.deformation_sigma
    agrees = (share > MAJORITY) & (rotation < bound) & (apart < bound * reach)
    return KeyframeVotes(rotation, apart / reach, agrees, n >= MIN_PAIRS_PER_KEYFRAME)


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


def find_discontinuities(submap: Submap, oldest: int, newest: int) -> IntArray:
    """Return the ids of the keyframes before which a map is torn, ascending: its parts there are not held together.

    A place between two keyframes is torn if too few landmarks are seen on both sides in agreement with their pixels. It
    is also torn if most observations of landmarks followed across it disagree. These are seen twice on either side,
    since a single camera cannot detect a change of scale about itself.

    `oldest`, `newest`: keyframe ids; the places after `oldest` up to before `newest` are searched.
    """
    ids, places = _windows(submap, oldest, newest)
    seen, good = _own_agreement(submap, ids, PIXEL_CHI2)
    torn, contrast = np.zeros((2, len(ids)), bool), np.zeros(len(ids))
    for i, before, after in places:
        ties = good[:, before].any(1) & good[:, after].any(1)
        torn[0, i] = np.count_nonzero(ties) < MIN_TIES
        followed = (seen[:, before].sum(1) >= 2) & (seen[:, after].sum(1) >= 2)
        if np.count_nonzero(followed) >= MIN_TIES:
            share = [good[followed, side].sum() / seen[followed, side].sum() for side in (before, after)]
            torn[1, i] = min(share) <= MAJORITY
            contrast[i] = abs(share[0] - share[1])
    # Windows that reach over a discontinuity disagree already beside it: of such neighbours the clearest is the place.
    for run in np.split(np.arange(len(ids)), np.flatnonzero(np.diff(torn[1].astype(int))) + 1):
        if len(run) and torn[1, run[0]]:
            torn[1, run] = False
            torn[1, run[np.argmax(contrast[run])]] = True
    return ids[torn.any(0)]


def smallest_share_handed_on(submap: Submap, oldest: int, newest: int) -> float:
    """Return which share of what a map's keyframes see it hands on, at the place where that is least.

    Landmarks seen on both sides of a place in agreement with their pixels count, of what a keyframe sees there. Where
    an occluder comes in, its own landmarks replace most others before parallax fixes their depth.

    `oldest`, `newest`: as for `find_discontinuities`.
    """
    ids, places = _windows(submap, oldest, newest)
    _, good = _own_agreement(submap, ids, PIXEL_CHI2)
    n_good = good.sum(0)
    shares = [1.0]
    for _, before, after in places:
        ties = np.count_nonzero(good[:, before].any(1) & good[:, after].any(1))
        shares.append(ties / max(min(float(np.median(n_good[side])) for side in (before, after)), 1.0))
    return min(shares)


def _windows(submap: Submap, oldest: int, newest: int) -> tuple[IntArray, list[tuple[int, slice, slice]]]:
    """Return keyframe ids, and of each place between the two given: its row, the rows before it, the rows after it."""
    w = GROUP
    ids = np.array(sorted(submap.keyframes))
    first, last = int(np.searchsorted(ids, oldest, "right")), int(np.searchsorted(ids, newest, "right"))
    start = max(first - w, 0)
    places = range(max(first - start, 1), last - start)
    return ids[start : last + w], [(i, slice(max(i - w, 0), i), slice(i, i + w)) for i in places]


def _own_agreement(submap: Submap, ids: IntArray, gate: float) -> tuple[BoolArray, BoolArray]:
    """Return which landmarks are seen in which of the keyframes, and where their pixels agree; both (L, len(ids))."""
    obs = submap.observations
    rows = np.flatnonzero(obs["alive"] & np.isin(obs["kf"], ids))
    column = np.searchsorted(ids, obs["kf"][rows])
    landmarks, row = np.unique(obs["landmark"][rows], return_inverse=True)
    uv, sigma = submap.observed_pixels(rows)
    T_kf_submap = se3.inverse(submap.keyframe_poses(ids))
    none = np.zeros((3, 3))
    chi2 = pixel_chi2(submap.K, T_kf_submap[column], submap.landmarks["xyz_mu"][obs["landmark"][rows]], none, uv, sigma)
    seen, good = np.zeros((2, len(landmarks), len(ids)), bool)
    seen[row, column] = True
    good[row[chi2 < gate], column[chi2 < gate]] = True
    return seen, good


def measure_deformation(
    model: PairModel, S_old_new: FloatArray, inliers: BoolArray, keyframes: BoolArray, config: LinkingConfig
) -> float:
    """Return by how much drift changes the scale along time, less noise; at least half of what is expected.

    The older and the newer half of the pairs, and the cameras' path, are each compared with the whole. By a random walk
    the mean over the overlap is off by about half of what its ends differ.

    - `S_old_new` (4, 4).
    - `inliers` (M,), `keyframes` (K,) bool: pairs and keyframes that agree with it.
    """
    c = model.pairs
    views = inliers[c.view_pair] & keyframes[c.view_keyframe]
    count = np.maximum(np.bincount(c.view_pair[views], minlength=len(c)), 1)
    time = np.bincount(c.view_pair[views], c.view_keyframe[views].astype(np.float64), len(c)) / count
    early = time <= np.median(time[inliers])
    changes = [_change_of_scale(model, S_old_new, inliers & half) for half in (early, ~early)]
    changes.append(_change_of_path(model, S_old_new, keyframes))
    expected = config.deformation_sigma
    excess2 = [change**2 - sigma**2 for change, sigma in changes if sigma < UNTESTABLE * expected]
    return math.sqrt(max([0.25 * expected**2, *excess2]))


def deformation_covariance(model: PairModel, deformation: float) -> FloatArray:
    """Return (7, 7) that a deformation, which bends all pairs together, adds to a link's covariance (right
    perturbation, new).
    """
    distance = np.linalg.norm(model.pairs.xyz_new[:, None] - se3.translation(model.T_new_kf)[None], axis=2)
    sigma = np.repeat([ROTATION_SHARE, float(np.median(distance)), 1.0], [3, 3, 1]) * deformation
    from_centre = sim3.adjoint(se3.from_parts(so3.IDENTITY, model.centre_new))
    return np.asarray(from_centre @ np.diag(sigma**2) @ from_centre.T, np.float64)


def _change_of_scale(model: PairModel, S_old_new: FloatArray, part: BoolArray) -> tuple[float, float]:
    """Return the change of scale, and its sigma, by which a part of the pairs fits best: one Gauss-Newton step."""
    H, g = model.normal_equations(S_old_new, part)
    try:
        step, C = np.linalg.solve(H, g), np.linalg.inv(H)
    except np.linalg.LinAlgError:
        return 0.0, math.inf
    return (float(step[6]), math.sqrt(C[6, 6])) if (np.diag(C) > 0).all() else (0.0, math.inf)


def _change_of_path(model: PairModel, S_old_new: FloatArray, keyframes: BoolArray) -> tuple[float, float]:
    """Compare the scale of the cameras' path with that of the landmarks: in a sound map these two agree.

    A centre is known to about one pixel at the landmarks' distance, over the root of their number. Along the optical
    axis it is several times worse. Landmarks that were placed by what a corrupted part saw agree with each other in a
    wrong scale: only the path is right.
    """
    centres = model.T_old_kf[keyframes, :3, 3]
    moved = sim3.act(S_old_new, model.T_new_kf[keyframes, :3, 3])
    n = np.bincount(model.pairs.view_keyframe, minlength=len(keyframes))[keyframes]
    distance = float(np.median(np.linalg.norm(model.pairs.xyz_old - centres.mean(0), axis=1)))
    noise = ALONG_AXIS * distance / (float(model.K_old[0, 0]) * math.sqrt(float(np.median(n))))
    centres, moved = centres - centres.mean(0), moved - moved.mean(0)
    length2 = float((moved**2).sum())
    if not length2 > noise**2:
        return 0.0, math.inf
    return float((centres * moved).sum()) / length2 - 1.0, noise / math.sqrt(length2)
