"""How firmly a map holds its scale from one place to another.

A link is measured where two maps overlap, for the new map's live end. In between the scale is handed on from landmark
to landmark. How much of it arrives stands in the normal equations of the map: all poses and points between the places
are unknown together. The result is the ratio of the scales at which the cameras of either place see their points, which
does not depend on the gauge.

The same equations tell how well the size of the camera's path is known. It can be unsure where depths are firm.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse
from scipy.spatial.distance import cdist

from dualslam.core.arrays import sum_by
from dualslam.core.geometry import se3
from dualslam.core.geometry.alignment import COVARIANCE_INFLATION
from dualslam.core.geometry.projection import project_points, projection_jacobians
from dualslam.core.noise_model import GROUP, TINY
from dualslam.core.types import FloatArray, IntArray
from dualslam.linking.join_test import PIXEL_CHI2
from dualslam.map.submap import Submap

N_AROUND = 2 * GROUP
"""Keyframes before and after the two places that hold them in shape: what lies farther off shares little with them."""
SCALE_INFLATION = 1.8
"""Errors of neighbouring pixels and views are alike, and do not average out as the sigmas suppose. Chosen so that what
is true comes to what is claimed on plain stretches (`benchmarks/covariances.py`, seeds 1 to 3)."""
N_GAUGE = 7
"""Directions of the poses that no observation fixes: a similarity of the whole."""
SLACK = 1e-12
"""Relative to a block of the normal equations: what keeps a point without parallax from being singular."""
NO_TIE = 1e-7
"""Relative to the median stiffness: directions that are softer than this are as free as the gauge."""


def scale_sigma_between(submap: Submap, here: IntArray, there: IntArray) -> float:
    """Return the standard deviation of the log of the scale at one place relative to another.

    - `submap`: solved. Its keyframes between those given, and some around, count with what they saw.
    - `here`, `there`: keyframe ids of the two places, which may overlap; unknown ones are passed over.

    Returns float: inflated as the links' own covariances are. Infinite where the places do not hang together, or one is
    empty.
    """
    return answer_scale(ask_scale(submap, [(here, there)]))[0]


def scale_sigmas_in_all(
    submap: Submap, places: Sequence[tuple[IntArray, IntArray]], excess: Mapping[int, float]
) -> list[float]:
    """Return the standard deviation of the log of the scale between pairs of places, by all that a submap has seen.

    Each observation is as noisy as its keyframe's residuals say, and neighbours' errors are alike.

    `excess`: of `noise_excess`.
    """
    return [SCALE_INFLATION * sigma for sigma in answer_scale(_ask_all(submap, places, excess))]


def relative_scales(
    submap: Submap, stretches: Sequence[IntArray], places: Sequence[IntArray], excess: Mapping[int, float]
) -> FloatArray:
    """Return the standard deviations (S + P, S + P) of the log of the ratio of scales between any two parts of a map.

    By all that it has seen, as `scale_sigmas_in_all`. The scale of a stretch is the size of its path: the RMS distance
    of its keyframes from their centre, each counted by how well its position is known where the others are. That of a
    place, where a link stands, is the one at which it sees its points.
    Infinite where nothing ties two parts to each other.

    - `stretches`, `places`: keyframe ids of each; two at least in a stretch.
    - `excess`: of `noise_excess`.
    """
    problem, n = normal_equations(submap, excess), len(stretches) + len(places)
    if problem is None:
        return np.where(np.eye(n, dtype=bool), 0.0, np.inf)
    free, root = _directions(problem.reduced)
    seen = [_scale_at(problem, place) for place in places]
    by_points = [np.full(len(root), np.nan) if each is None else _by_poses(problem, *each) for each in seen]
    weight = _firmness(problem)
    g = np.array([*(_size_at(problem, part, weight) for part in stretches), *by_points])
    between = np.asarray(SCALE_INFLATION * np.sqrt(COVARIANCE_INFLATION) * cdist(g @ root, g @ root), np.float64)
    between[~(cdist(g @ free, g @ free, "sqeuclidean") <= SLACK)] = np.inf
    np.fill_diagonal(between, 0.0)
    return between


def position_sigmas(submap: Submap, held: Collection[int]) -> dict[int, float]:
    """Return the standard deviation of each keyframe's position against some that are held, by all that it has seen.

    Infinite where nothing ties it to them.
    """
    ids = np.array(sorted(submap.keyframes), np.int64)
    problem = normal_equations(submap, dict.fromkeys(submap.keyframes, 1.0))
    free = ids[~np.isin(ids, list(held))]
    sigma = dict.fromkeys(submap.keyframes, 0.0) | dict.fromkeys(free.tolist(), np.inf)
    if problem is None or not len(free):
        return sigma
    rows = (6 * np.searchsorted(ids, free)[:, None] + np.arange(6)).ravel()
    values, vectors = np.linalg.eigh(problem.reduced[np.ix_(rows, rows)])
    by_place = vectors.reshape(len(free), 6, -1)[:, 3:]
    stiff = values > NO_TIE * float(np.median(values))
    variance = (by_place[:, :, stiff] ** 2 / values[stiff]).sum(axis=(1, 2))
    tied = (by_place[:, :, ~stiff] ** 2).sum(axis=(1, 2)) <= SLACK
    return sigma | dict(zip(free[tied].tolist(), np.sqrt(variance[tied]).tolist(), strict=True))


def normal_equations(submap: Submap, excess: Mapping[int, float]) -> NormalEquations | None:
    """Return those of all keyframes, and of the landmarks that two of them see, if there are any.

    `excess`: of `noise_excess`.
    """
    ids = np.array(sorted(submap.keyframes), np.int64)
    return _linearise(_ask_all(submap, [(ids, ids)], excess))


def spread_by_poses(
    submap: Submap, keyframe_ids: IntArray, landmark_ids: IntArray, by_point: FloatArray, excess: Mapping[int, float]
) -> FloatArray:
    """Return the covariance (D, D) of something that depends on landmarks, by the errors of the poses they follow.

    What a few keyframes see follows their poses all alike. It does not average out over the landmarks.

    - `keyframe_ids`: that see the landmarks. `N_AROUND` keyframes before and after them count as well.
    - `by_point` (N, D, 3): derivatives by the landmarks `landmark_ids` (N,).
    - `excess`: of `noise_excess`.
    """
    problem = _linearise(_ask_all(submap, [(keyframe_ids, keyframe_ids)], excess, N_AROUND))
    assert problem is not None, "landmarks are seen twice"
    row = np.searchsorted(problem.landmarks, landmark_ids).clip(0, len(problem.landmarks) - 1)
    known = problem.landmarks[row] == landmark_ids
    g = np.zeros((by_point.shape[1], *problem.xyz.shape))
    g[:, row[known]] = by_point[known].transpose(1, 0, 2)
    _, root = _directions(problem.reduced)
    by_pose = np.array([_by_poses(problem, np.zeros(len(problem.reduced)), each) for each in g]) @ root
    return np.asarray(SCALE_INFLATION**2 * COVARIANCE_INFLATION * by_pose @ by_pose.T)


def _ask_all(
    submap: Submap,
    places: Sequence[tuple[IntArray, IntArray]],
    excess: Mapping[int, float],
    n_around: int | None = None,
) -> ScaleQuestion:
    """Ask all that a submap has seen, or `n_around` keyframes about the places, each keyframe with its own noise."""
    question = ask_scale(submap, places, len(submap.keyframes) if n_around is None else n_around)
    noise = np.array([excess[k] for k in question.ids.tolist()])[question.kf]
    return replace(question, sigma_px=noise * question.sigma_px)


@dataclass(frozen=True, slots=True, eq=False)
class ScaleQuestion:
    """All that `answer_scale` needs of a submap: arrays of its own. It can be pickled."""

    places: Sequence[tuple[IntArray, IntArray]]  # sequence of (IntArray, IntArray): keyframe ids of the pairs of places
    K: FloatArray  # (3, 3)
    ids: IntArray  # (F,): keyframes that count; none where there is no place
    T_submap_kf: FloatArray  # (F, 4, 4)
    landmarks: IntArray  # (N,): ids, ascending
    xyz: FloatArray  # (N, 3)
    # Rows of `ids` and `xyz` of each observation.
    kf: IntArray  # (R,)
    point: IntArray  # (R,)
    uv_px: FloatArray  # (R, 2)
    sigma_px: FloatArray  # (R,)


def ask_scale(submap: Submap, places: Sequence[tuple[IntArray, IntArray]], n_around: int = N_AROUND) -> ScaleQuestion:
    """Collect what `answer_scale` needs for an answer, which takes longer and may be given elsewhere.

    - `places`: pairs of places as in `scale_sigma_between`, answered from one set of normal equations.
    - `n_around`: keyframes before and after them that count as well.
    """
    held = np.array(sorted(submap.keyframes), np.int64)
    pairs = [(here[np.isin(here, held)], there[np.isin(there, held)]) for here, there in places]
    asked = np.concatenate([ids for pair in pairs for ids in pair])
    ids = held[:0]
    if len(asked):
        first, last = np.searchsorted(held, [asked.min(), asked.max()])
        ids = held[max(first - n_around, 0) : last + n_around + 1]
    obs = submap.observations
    rows = np.flatnonzero(obs["alive"] & np.isin(obs["kf"], ids))
    uv, sigma = submap.observed_pixels(rows)
    landmarks, point = np.unique(obs["landmark"][rows], return_inverse=True)
    kf, xyz = np.searchsorted(ids, obs["kf"][rows]), submap.landmarks["xyz_mu"][landmarks]
    return ScaleQuestion(pairs, submap.K, ids, submap.keyframe_poses(ids), landmarks, xyz, kf, point, uv, sigma)


def answer_scale(question: ScaleQuestion) -> list[float]:
    """Return what `scale_sigma_between` does, for each pair of places."""
    problem = _linearise(question)
    if problem is None:
        return [np.inf] * len(question.places)
    free, root = _directions(problem.reduced)
    return [_sigma(problem, free, root, here, there) for here, there in question.places]


def _directions(reduced: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the directions of the poses (6 F, n) that nothing fixes, and a root of the covariance of others but the
    gauge.
    """
    values, vectors = np.linalg.eigh(reduced)
    stiff = values[N_GAUGE:] > NO_TIE * float(np.median(values))
    vectors = vectors[:, N_GAUGE:]
    return vectors[:, ~stiff], vectors[:, stiff] / np.sqrt(values[N_GAUGE:][stiff])


def _sigma(problem: NormalEquations, free: FloatArray, root: FloatArray, here: IntArray, there: IntArray) -> float:
    """Ask the normal equations, with their `_directions`, for one pair of places."""
    g = [_scale_at(problem, ids) for ids in (there, here)]
    if g[0] is None or g[1] is None:
        return np.inf
    g_point = g[0][1] - g[1][1]
    g_pose = _by_poses(problem, g[0][0] - g[1][0], g_point)
    if ((g_pose @ free) ** 2 > SLACK).any():
        return np.inf
    of_points = np.einsum("ni,nij,nj->", g_point, problem.inverse, g_point)
    variance = float(of_points + ((g_pose @ root) ** 2).sum())
    return float(np.sqrt(COVARIANCE_INFLATION * max(variance, 0.0)))


@dataclass(frozen=True, slots=True, eq=False)
class NormalEquations:
    """The normal equations of F keyframes and N points, the points' blocks inverted."""

    ids: IntArray  # (F,)
    T_cam_submap: FloatArray  # (F, 4, 4)
    landmarks: IntArray  # (N,): ids, ascending
    xyz: FloatArray  # (N, 3)
    # Rows of each observation.
    kf: IntArray  # (R,)
    point: IntArray  # (R,)
    inverse: FloatArray  # (N, 3, 3): covariances of the points, given the poses
    H_cross: sparse.bsr_array  # (6 F, 3 N) sparse
    reduced: FloatArray  # (6 F, 6 F): of the poses, the points eliminated


def _linearise(question: ScaleQuestion) -> NormalEquations | None:
    """Return the normal equations; none where no point is seen twice."""
    q = question
    T, ids = se3.inverse(q.T_submap_kf), q.ids
    all_xyz, n_rows = q.xyz[q.point], len(q.kf)
    J_pose, J_point, good = np.zeros((n_rows, 2, 6)), np.zeros((n_rows, 2, 3)), np.zeros(n_rows, bool)
    for f in range(len(ids)):
        seen = np.flatnonzero(q.kf == f)
        seen = seen[all_xyz[seen] @ T[f, 2, :3] + T[f, 2, 3] > 0]
        J_pose[seen], J_point[seen] = projection_jacobians(q.K, T[f], all_xyz[seen])
        predicted, _ = project_points(q.K, T[f], all_xyz[seen])
        good[seen] = ((predicted - q.uv_px[seen]) ** 2).sum(1) < PIXEL_CHI2 * q.sigma_px[seen] ** 2
    # A point seen once says nothing of the poses.
    good &= np.bincount(q.point[good], minlength=len(q.xyz))[q.point] >= 2
    kf, weight = q.kf[good], 1.0 / q.sigma_px[good] ** 2
    J_pose, J_point = J_pose[good], J_point[good]
    points, point = np.unique(q.point[good], return_inverse=True)
    if len(points) == 0:
        return None
    order = np.lexsort((point, kf))  # as the blocks of a sparse matrix are stored
    kf, point, weight, J_pose, J_point = kf[order], point[order], weight[order], J_pose[order], J_point[order]
    n_f, n_p = len(ids), len(points)
    weighted = (weight[:, None, None] * J_pose).transpose(0, 2, 1)
    H_point = sum_by(point, (weight[:, None, None] * J_point).transpose(0, 2, 1) @ J_point, n_p)
    H_point += SLACK * np.trace(H_point, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    inverse = np.asarray(np.linalg.inv(H_point), np.float64)
    H_pose, blocks = sum_by(kf, weighted @ J_pose, n_f), weighted @ J_point
    start = np.concatenate([[0], np.cumsum(np.bincount(kf, minlength=n_f))])
    H_cross, through = (
        sparse.bsr_array((values, point, start), shape=(6 * n_f, 3 * n_p))
        for values in (blocks, blocks @ inverse[point])
    )
    reduced = -np.asarray((through @ H_cross.T).toarray())
    for f in range(n_f):
        reduced[6 * f : 6 * f + 6, 6 * f : 6 * f + 6] += H_pose[f]
    reduced = (reduced + reduced.T) / 2
    return NormalEquations(ids, T, q.landmarks[points], q.xyz[points], kf, point, inverse, H_cross, reduced)


def _scale_at(problem: NormalEquations, ids: IntArray) -> tuple[FloatArray, FloatArray] | None:
    """Return the derivative of the mean log depth that some keyframes see: by the poses (6 F,), the points (N, 3).

    A point counts by how well its own depth is known where the poses are.
    """
    seen = np.isin(problem.kf, np.searchsorted(problem.ids, ids))
    if not seen.any():
        return None
    kf, point = problem.kf[seen], problem.point[seen]
    T = problem.T_cam_submap[kf]
    p = se3.act_each(T, problem.xyz[point])
    by_pose = np.column_stack([p[:, 1], -p[:, 0], np.zeros((len(p), 3)), np.ones(len(p))]) / p[:, 2:]
    by_point = T[:, 2, :3] / p[:, 2:]
    share = 1.0 / np.maximum(np.einsum("ri,rij,rj->r", by_point, problem.inverse[point], by_point), TINY)
    share /= share.sum()
    g_pose = sum_by(kf, share[:, None] * by_pose, len(problem.ids))
    g_point = sum_by(point, share[:, None] * by_point, len(problem.xyz))
    return g_pose.reshape(-1), g_point


def _by_poses(problem: NormalEquations, g_pose: FloatArray, g_point: FloatArray) -> FloatArray:
    """Return a functional's derivative by the poses (6 F,) when the points follow them."""
    follows = np.einsum("nij,nj->ni", problem.inverse, g_point)
    return np.asarray(g_pose - problem.H_cross @ follows.reshape(-1), np.float64)


def _firmness(problem: NormalEquations) -> FloatArray:
    """Return the inverse variance (F,) of each keyframe's position where the others are."""
    n = len(problem.ids)
    H = problem.reduced.reshape(n, 6, n, 6)[np.arange(n), :, np.arange(n)]
    H = H + (SLACK * np.trace(H, axis1=1, axis2=2) + TINY)[:, None, None] * np.eye(6)
    return np.asarray(1.0 / np.trace(np.linalg.inv(H)[:, 3:, 3:], axis1=1, axis2=2), np.float64)


def _size_at(problem: NormalEquations, ids: IntArray, weight: FloatArray) -> FloatArray:
    """Return the derivative (6 F,) of the log of the path's size at some keyframes by the poses."""
    rows = np.searchsorted(problem.ids, ids)
    T, share = problem.T_cam_submap[rows], weight[rows, None] / weight[rows].sum()
    offset = se3.translation(se3.inverse(T))
    offset = offset - (share * offset).sum(axis=0)
    squares = max(float((share * offset**2).sum()), np.finfo(float).tiny)
    by_pose = np.zeros((len(problem.ids), 6))
    by_pose[rows, 3:] = -np.einsum("nij,nj->ni", se3.rotation(T), share * offset) / squares
    return by_pose.reshape(-1)
