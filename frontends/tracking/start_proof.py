"""Whether a start is right: the frames between its two views confirm its points, and its direction is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dualslam.core.bundle import BundleAdjuster, BundleProblem
from dualslam.core.chi_square import CHI2_95, CHI2_99, MEDIAN_CHI2
from dualslam.core.decisions import Gate
from dualslam.core.errors import SolverError
from dualslam.core.geometry import se3, so3
from dualslam.core.geometry.projection import projection_jacobians, refine_pose
from dualslam.core.interfaces import Frontend
from dualslam.core.noise_model import MIN_CONSENSUS, PROOF_VIEWS, START_POINTS, TINY
from dualslam.core.support import MAX_CHI2
from dualslam.core.types import BoolArray, Failure, FailureReason, FloatArray, IntArray, Matches, Start, View
from dualslam.frontends.tracking.local_map import nearer_than_proven, stands_before
from dualslam.frontends.tracking.resection import MIN_SAMPLE, resect
from dualslam.frontends.tracking.two_view_hypotheses import MIN_NOISE2

MIN_SUPPORT = 0.6
"""Share of the points that the frames between the two views must confirm by their own pixels."""
PROVEN = 1 / 3  # share of the points that are proven, at least: a start is made of these alone
USUAL_NOISE2 = 0.09  # variance of the residuals of starts that turn (`tum_fr1_rpy`: 0.05 to 0.12), of their sigmas'


@dataclass(frozen=True, slots=True, eq=False)
class ViewPair:
    """Two views, their matches, and one pose with the points that it gives."""

    a: View
    b: View
    matches: Matches
    T_b_a: FloatArray
    xyz: FloatArray
    good: BoolArray
    n_explained: int  # matches that fit the pose, wherever their points are: at infinity, too
    parallax_deg: float  # median
    n_near: int  # points with at least the parallax that is asked for


@dataclass(frozen=True, slots=True, eq=False)
class _Witness:
    """A view between the two: its pose, its feature of each point (or -1), the share of its matches that agree."""

    T_first_cam: FloatArray
    feature: IntArray
    support: float


class StartProof:
    """Proves two views and their pose by others, and adjusts them together."""

    def __init__(
        self, frontend: Frontend, adjuster: BundleAdjuster, K: FloatArray, size_px: tuple[int, int], seed: int
    ) -> None:
        self._frontend = frontend
        self._adjuster = adjuster
        self._K = K
        self._size_px = size_px
        self._seed = seed

    def verify(self, pair: ViewPair, views: list[View]) -> Start | Failure:
        """Return the start that two views make, with the views between them (`views` has all) that have proven it."""
        good = np.flatnonzero(pair.good)
        xyz = pair.xyz[good]
        feature = np.full((len(views), len(good)), -1, np.int64)
        feature[0], feature[-1] = pair.matches.index[good, 0], pair.matches.index[good, 1]
        T_first_cam = np.tile(se3.IDENTITY, (len(views), 1, 1))
        T_first_cam[-1] = se3.inverse(pair.T_b_a)
        support = []
        for v in range(1, len(views) - 1):
            witness = self._confirm(views[v], pair.a, feature[0], xyz)
            if isinstance(witness, Failure):
                support.append(0.0)
                continue
            T_first_cam[v], feature[v] = witness.T_first_cam, witness.feature
            support.append(witness.support)
        keep_views = (feature >= 0).any(axis=1)
        numbers = {
            "n_points": float(len(good)),
            "parallax_deg": pair.parallax_deg,
            "support": float(min(support)) if support else 0.0,
        }
        if not support or min(support) < MIN_SUPPORT:
            detail = f"the frames between confirm {numbers['support']:.0%} of the points"
            gate = Gate("share of points that the frames between confirm", numbers["support"], ">=", MIN_SUPPORT)
            return Failure(FailureReason.DOUBTFUL_INITIALISATION, detail, numbers, gates=(gate,))
        views = [views[v] for v in np.flatnonzero(keep_views)]
        return self._adjust(views, T_first_cam[keep_views], xyz, feature[keep_views], numbers)

    def _confirm(self, witness: View, first: View, feature: IntArray, xyz: FloatArray) -> _Witness | Failure:
        """Pose a witness from the points alone, without a guess, and count how many of its matches agree.

        A few points far before all others have no say in the pose that is to prove them: copies of what repeats itself
        would turn the witness until it agreed with them.
        """
        matches = self._frontend.match_wide(first.features.take(feature), witness.features)
        if len(matches) < START_POINTS // 2:
            return Failure(FailureReason.TOO_FEW_MATCHES, f"{len(matches)} of {len(xyz)} points found")
        point, seen = matches.index[:, 0], matches.index[:, 1]
        uv_px, sigma_px = witness.features.uv_rect_px[seen], witness.features.sigma_px[seen]
        leads = ~stands_before(xyz[point, 2], xyz[:, 2])
        if np.count_nonzero(~leads) < MIN_SAMPLE:
            leads[:] = True
        sigma = float(np.median(sigma_px))
        start = resect(self._K, self._size_px, uv_px[leads], xyz[point[leads]], sigma, self._seed)
        estimate = refine_pose(self._K, start.T_cam_w, xyz[point], uv_px, sigma_px, counted=leads)
        if isinstance(estimate, Failure):
            return estimate
        features = np.full(len(xyz), -1, np.int64)
        features[point[estimate.inliers]] = seen[estimate.inliers]
        return _Witness(se3.inverse(estimate.T_cam_w), features, estimate.n_inliers / len(matches))

    def _adjust(
        self, views: list[View], T_first_cam: FloatArray, xyz: FloatArray, feature: IntArray, numbers: dict[str, float]
    ) -> Start | Failure:
        view_of, point_of = np.nonzero(feature >= 0)
        seen = [view.features.take(rows[rows >= 0]) for view, rows in zip(views, feature, strict=True)]
        uv = np.concatenate([features.uv_rect_px for features in seen])
        sigma = np.concatenate([features.sigma_px for features in seen])
        fixed = np.zeros(len(views), bool)
        fixed[0] = True
        problem = BundleProblem(self._K, T_first_cam, fixed, xyz, view_of, point_of, uv, sigma)
        try:
            result = self._adjuster(problem)
        except SolverError as error:
            return Failure(FailureReason.SOLVER, str(error), numbers)
        inlier = result.chi2 < CHI2_95[2]
        rows = _seen_by_both(problem, inlier)
        T_first, T_last = result.T_submap_kf[[0, -1]]
        chi2 = float(np.median(result.chi2)) / MEDIAN_CHI2[2]
        sigma_px = problem.sigma_px[rows] * _calmer(chi2)
        direction = direction_sigma_deg(self._K, T_first, T_last, result.xyz_mu[problem.point[rows]], sigma_px)
        numbers = {**numbers, "chi2": chi2, "direction_sigma_deg": direction}
        in_front = np.all(se3.act(se3.inverse(result.T_submap_kf), result.xyz_mu)[..., 2] > 0, axis=0)
        keep = _agreeing(problem, inlier) & in_front & result.adjusted
        numbers["n_points"] = float(keep.sum())
        survivors = Gate("points after adjustment", int(keep.sum()), ">=", START_POINTS)
        share = Gate("share of points after adjustment", float(keep.mean()), ">=", MIN_SUPPORT)
        if not (survivors.passed and share.passed):
            detail = f"{keep.sum()} of {len(xyz)} points survive adjustment"
            return Failure(FailureReason.DOUBTFUL_INITIALISATION, detail, numbers, gates=(survivors, share))
        # What repeats itself along the epipolar line fits two views always, and a third, by chance, where pixels are
        # less noisy than supposed: as a point right before the camera, which pins it. So a point is taken on the word
        # of three views, by a gate in the residuals' own variance.
        inlier &= result.chi2 < CHI2_99[2] * float(np.clip(chi2, MIN_NOISE2, 1.0))
        n_views = np.bincount(problem.point[inlier], minlength=len(xyz))
        proven = keep & _agreeing(problem, inlier) & (n_views >= PROOF_VIEWS)
        # Of a pattern that repeats itself, a third view of five fits by chance. Right before the camera a point weighs
        # most. There all views must have seen it, unless others that all have seen are as near.
        proven &= ~nearer_than_proven(result.xyz_mu[:, 2], proven & (n_views == len(views)))
        numbers["n_proven"] = float(proven.sum())
        least = float(max(PROVEN * keep.sum(), MIN_CONSENSUS))
        enough = Gate("points that three views prove", int(proven.sum()), ">=", least)
        fits = Gate("chi-square per degree of freedom", chi2, "<", MAX_CHI2)
        if not enough.passed:
            detail = f"three views prove {proven.sum()} of {keep.sum()} points"
            return Failure(FailureReason.DOUBTFUL_INITIALISATION, detail, numbers, gates=(survivors, share, enough))
        if not fits.passed:
            detail = f"chi-square per degree of freedom {chi2:.1f}"
            return Failure(FailureReason.CHI_SQUARE, detail, numbers, gates=(survivors, share, enough, fits))
        feature = feature.copy()
        feature[view_of[~inlier], point_of[~inlier]] = -1
        depth = float(np.median(result.xyz_mu[proven, 2]))
        T = result.T_submap_kf.copy()
        T[:, :3, 3] /= depth
        return Start(views, T, result.xyz_mu[proven] / depth, feature[:, proven], numbers)


def _agreeing(problem: BundleProblem, inlier: BoolArray) -> BoolArray:
    """Return which points agree with both ends, and miss at most one witness."""
    n, last = len(problem.xyz_mu), len(problem.T_submap_kf) - 1
    agrees = np.bincount(problem.point[~inlier], minlength=n) <= 1
    agrees[problem.point[~inlier & ((problem.kf == 0) | (problem.kf == last))]] = False
    return agrees


def _seen_by_both(problem: BundleProblem, inlier: BoolArray) -> IntArray:
    """Return the last view's observations of points that the first sees, too."""
    in_first = np.zeros(len(problem.xyz_mu), bool)
    in_first[problem.point[(problem.kf == 0) & inlier]] = True
    last = len(problem.T_submap_kf) - 1
    return np.flatnonzero((problem.kf == last) & inlier & in_first[problem.point])


def _calmer(noise2: float) -> float:
    """Return how noisy pixels are, of those by which the bound of the direction's sigma was found; no less than drawn.

    A motion is known so much better. Of a camera that leaves a bench, no two views but its first know their direction.
    """
    return float(np.sqrt(np.clip(noise2, MIN_NOISE2, USUAL_NOISE2) / USUAL_NOISE2))


def direction_sigma_deg(
    K: FloatArray, T_w_a: FloatArray, T_w_b: FloatArray, xyz: FloatArray, sigma_px: FloatArray
) -> float:
    """Standard deviation of the direction from one camera to another, by the two views' Hessian, degrees.

    The points are eliminated by the Schur complement; the scale, which two views cannot tell, is held by its own prior.

    - `K` (3, 3), `T_w_a`, `T_w_b` (4, 4).
    - `xyz` (N, 3): points that both see.
    - `sigma_px` (N,): of their pixels.
    """
    T_a_w, T_b_w = se3.inverse(T_w_a), se3.inverse(T_w_b)
    weight = 1 / sigma_px[:, None, None] ** 2
    H_pp = np.zeros((len(xyz), 3, 3))
    for T_cam_w in (T_a_w, T_b_w):
        J_pose, J_point = projection_jacobians(K, T_cam_w, xyz)
        H_pp += np.einsum("nki,nkj->nij", J_point, J_point) / sigma_px[:, None, None] ** 2
    H_cp = np.einsum("nki,nkj->nij", J_pose, J_point) * weight
    H_cc = (np.einsum("nki,nkj->nij", J_pose, J_pose) * weight).sum(0)
    try:
        S = H_cc - np.einsum("nij,njk,nlk->il", H_cp, np.linalg.inv(H_pp), H_cp)
        t_cam = se3.translation(T_b_w)
        along = np.zeros(se3.DOF)
        along[3:] = t_cam / np.linalg.norm(t_cam)
        S += np.outer(along, along) * np.trace(H_cc)
        covariance = np.linalg.inv(S)[3:, 3:]
    except np.linalg.LinAlgError:
        return float("inf")
    across = so3.IDENTITY - np.outer(along[3:], along[3:])
    variance = float(np.linalg.eigvalsh(across @ covariance @ across)[-1])
    return float(np.degrees(np.sqrt(max(variance, 0.0)) / np.linalg.norm(t_cam)))


def direction_angle_deg(T_1: FloatArray, T_2: FloatArray) -> float:
    """Return the angle between the translations of two poses (4, 4), degrees."""
    t1, t2 = se3.translation(T_1), se3.translation(T_2)
    cosine = t1 @ t2 / max(float(np.linalg.norm(t1) * np.linalg.norm(t2)), TINY)
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
