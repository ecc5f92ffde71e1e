"""Self-calibration: what a submap's own observations say about the camera that took them.

A batch bundle adjustment of a window of keyframes in which the calibration is one more variable, shared by all of them,
with a prior at the calibration that was given. Whether the answer is worth anything depends on the motion: driving
straight ahead leaves the focal length to the prior, turning fixes it. The verdict is therefore a test, with two
questions. Do the data fix the focal length, or does the prior? Is the whole too far from the present calibration to be
chance? All parameters are estimated together and those that the data say little about are left to their priors: holding
them at zero was tried, and gave the focal length what was theirs (7-Scenes: 4 % instead of 8 %).

The noise is that of the residuals, whatever sigmas the submap was made with: those allow for the error of the camera
model itself, which is what is asked for here. Neighbouring observations err alike (a landmark is matched to the same
patch again and again), so the Hessian's covariance is too small: on rendered images with the exact camera the squared
Mahalanobis distance of the correction from zero was 5 to 71 with five degrees of freedom, so the noise is taken to be
`CalibrationConfig.inflation` times as large. Where the camera is wrong, that distance was 990 to 1450 (7-Scenes' colour
camera) and 2700 to 3300 (KITTI 03 in its turn).
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from itertools import pairwise

import gtsam
import numpy as np

from backend import convert
from backend.factors import baseline_factor, pose_prior
from backend.membership import MIN_DEPTH_MU, compute_depth_sigmas, compute_residuals
from backend.noise import PixelNoise
from backend.silence import silenced
from backend.solver import GTSAM_ERRORS, SolverFailure
from dualslam.core.bundle import BundleProblem
from dualslam.core.calibration_config import CalibrationConfig
from dualslam.core.camera import Camera
from dualslam.core.corrected_camera import LensCorrection, correction_of, given_camera
from dualslam.core.geometry import so3
from dualslam.core.interfaces import CalibrationEstimate
from dualslam.core.submap import Submap
from dualslam.core.types import BoolArray, Failure, FailureReason, FloatArray, IntArray

MIN_VIEWS = 3
"""Keyframes of the window that must see a landmark: two views have little to say beyond their own relative pose."""
MAX_DEPTH_SIGMA = 0.3
"""Relative; landmarks whose distance is known no better make the problem singular and say nothing."""
MIN_OBSERVATIONS = 1000
MAX_PRIOR_SIGMAS = 6.0
"""A correction farther from the given calibration than this says that something else is wrong."""
ASPECT_SIGMA, SKEW_SIGMA, TANGENTIAL_SIGMA = 1e-4, 1e-7, 1e-7
MEDIAN_CHI2_2DOF = 1.386
MIN_NOISE_RATIO = 0.05
"""Residuals smaller than this share of their sigmas would be an exact simulation."""
CALIBRATION_KEY = 1 << 60
MAX_ITERATIONS, TOLERANCE = 25, 1e-5
MAX_DROPS = 3
"""Times that it is tried again without points that went behind a camera."""


@dataclass(frozen=True, slots=True, eq=False)
class _Optimum:
    correction: FloatArray  # (5,)
    covariance: FloatArray  # (5, 5)
    noise_ratio: float  # of the residuals to their sigmas
    cost_before: float
    cost_after: float


def estimate_calibration(
    submap: Submap,
    camera: Camera,
    config: CalibrationConfig,
    robust_k: float = 1.345,
    seed: int = 0,
    present_covariance: FloatArray | None = None,
) -> CalibrationEstimate | Failure:
    """Ask a submap about its camera.

    Parameters
    ----------
    submap : Submap
        Is not changed.
    camera : Camera
        Which rectified the features of its keyframes.
    config : CalibrationConfig
    robust_k : float
        Huber threshold in sigmas.
    seed : int
        Of the choice among landmarks, where there are too many.
    present_covariance : (5, 5), optional
        Of the correction that `camera` has, if it was estimated.

    Returns
    -------
    CalibrationEstimate or Failure
        A failure where the window holds too little, or the solver failed; an estimate is to be used only where it
        is `accepted`.
    """
    window = choose_window(submap, config.max_keyframes)
    rotation_deg = math.degrees(_rotation_steps(submap, window).sum())
    if rotation_deg < config.min_rotation_deg:
        return Failure(
            FailureReason.DEGENERATE,
            f"{rotation_deg:.0f} deg of turning in {len(window)} keyframes say nothing about the focal length",
        )
    problem = make_problem(submap, window, camera, config.max_observations, seed)
    if len(problem.kf) < MIN_OBSERVATIONS:
        return Failure(FailureReason.TOO_FEW_INLIERS, f"{len(problem.kf)} observations in {len(window)} keyframes")
    return estimate_correction(problem, camera.width, correction_of(camera), config, robust_k, present_covariance)


def estimate_correction(
    problem: BundleProblem,
    width_px: int,
    present: LensCorrection,
    config: CalibrationConfig,
    robust_k: float = 1.345,
    present_covariance: FloatArray | None = None,
) -> CalibrationEstimate | Failure:
    """Estimate the correction of a camera, and judge it.

    Against an earlier answer of the same map the test is one of two estimates: the covariance of their difference is
    that of neither alone. It is at most the sum of both, as if each had data of its own, and that is what is asked for:
    what they have in common, systematic errors first of all, does not tell which one is right.

    Parameters
    ----------
    problem : BundleProblem
        In the rectified pixels of the camera as it was given; `fixed` is not looked at.
    width_px : int
        Of the image: the prior of the principal point is relative to it.
    present : LensCorrection
        That the poses and points were made with.
    config : CalibrationConfig
    robust_k : float
    present_covariance : (5, 5), optional
        Of `present`, if it was estimated; the calibration that was given is taken at its word.
    """
    start = time.perf_counter()
    prior = prior_sigmas(problem, width_px, config)
    try:
        best = _optimise_in_front(problem, present.vector, prior, robust_k)
        correction, covariance = _weigh(best, prior, config.inflation * best.noise_ratio)
    except (*GTSAM_ERRORS, np.linalg.LinAlgError) as error:
        return Failure(FailureReason.SOLVER, str(SolverFailure.of(error)))
    off = correction - present.vector
    of_difference = covariance if present_covariance is None else covariance + present_covariance
    distance2 = float(off @ np.linalg.solve(of_difference, off))
    estimate = CalibrationEstimate(
        LensCorrection.of_vector(correction),
        covariance,
        distance2,
        distance2 > config.min_distance2,
        best.cost_before,
        best.cost_after,
        len(problem.T_submap_kf),
        len(problem.kf),
        time.perf_counter() - start,
    )
    sigma = math.sqrt(covariance[0, 0])
    far = abs(float(off[0])) > config.far_sigmas * math.sqrt(of_difference[0, 0])
    if sigma > (config.far_sigma_ratio if far else config.max_sigma_ratio) * prior[0]:
        return Failure(FailureReason.DEGENERATE, "the motion does not fix the focal length", estimate.numbers)
    if (np.abs(correction) > MAX_PRIOR_SIGMAS * prior).any():
        return Failure(FailureReason.SCALE, "the calibration would be too far from the given one", estimate.numbers)
    return estimate


def _weigh(best: _Optimum, prior: FloatArray, inflation: float) -> tuple[FloatArray, FloatArray]:
    """Return the correction and its covariance, had the sigmas of all pixels been `inflation` times as large.

    Only the calibration has a prior, so that the information in its marginal is the sum of the data's and the prior's.
    """
    of_prior = np.diag(prior**-2.0)
    of_both = np.linalg.inv(best.covariance)
    covariance = np.asarray(np.linalg.inv((of_both - of_prior) / inflation**2 + of_prior), np.float64)
    return covariance @ of_both @ best.correction / inflation**2, covariance


# --- what goes in


def choose_window(submap: Submap, max_keyframes: int) -> IntArray:
    """Return the ids of at most so many keyframes, neighbours in time: those among which the camera turned most."""
    ids = np.array(sorted(submap.keyframes), np.int64)
    if len(ids) <= max_keyframes:
        return ids
    turned = np.concatenate([[0.0], np.cumsum(_rotation_steps(submap, ids))])
    within = turned[max_keyframes - 1 :] - turned[: len(ids) - max_keyframes + 1]
    # Where several turn alike, the newest: its poses and points are the freshest.
    first = int(np.flatnonzero(within >= within.max() - 1e-9)[-1])
    return ids[first : first + max_keyframes]


def make_problem(
    submap: Submap, window: IntArray, camera: Camera, max_observations: int, seed: int = 0
) -> BundleProblem:
    """Collect the window's observations, as many landmarks as fit, in the pixels of the camera as it was given."""
    obs, n_landmarks = submap.observations, len(submap.landmarks)
    rows = np.flatnonzero(obs["alive"] & np.isin(obs["kf"], window))
    T = submap.keyframe_poses(window)
    kf, landmark = np.searchsorted(window, obs["kf"][rows]), obs["landmark"][rows]
    uv, sigma = submap.observed_pixels(rows)
    xyz = submap.landmarks["xyz_mu"]
    res = compute_residuals(submap.K, T, kf, xyz[landmark], uv, sigma)
    ok = np.isfinite(res.chi2)
    depth_sigmas = compute_depth_sigmas(submap.K, T, kf[ok], res.xyz_cam[ok], sigma[ok], landmark[ok], n_landmarks)
    n_views = np.bincount(landmark[ok], minlength=n_landmarks)
    good = np.flatnonzero((n_views >= MIN_VIEWS) & (depth_sigmas < MAX_DEPTH_SIGMA))
    good = np.random.default_rng(seed).permutation(good)
    good = np.sort(good[np.cumsum(n_views[good]) <= max_observations])
    chosen = np.flatnonzero(ok & _mask(good, n_landmarks)[landmark])
    given = given_camera(camera)
    raw = np.concatenate([submap.keyframes[k].features.uv_px for k in window.tolist()])
    offset = np.cumsum([0, *(len(submap.keyframes[k].features) for k in window.tolist())])
    uv_given, _ = given.rectify(raw[offset[kf[chosen]] + obs["feature"][rows[chosen]]])
    finite = np.isfinite(uv_given).all(1)
    chosen, uv_given = chosen[finite], uv_given[finite]
    return BundleProblem(
        given.K,
        T,
        np.zeros(len(window), bool),
        xyz[good],
        kf[chosen],
        np.searchsorted(good, landmark[chosen]),
        uv_given,
        sigma[chosen],
    )


def prior_sigmas(problem: BundleProblem, width_px: int, config: CalibrationConfig) -> FloatArray:
    """Return the (5,) prior sigmas. Those of the distortion shrink where the image reaches beyond 45 degrees."""
    K = problem.K
    xy = (problem.uv_px - K[:2, 2]) / (K[0, 0], K[1, 1])
    r2 = max(1.0, float((xy * xy).sum(1).max(initial=0.0)))
    centre = config.principal_point_sigma * width_px
    return np.array([config.log_focal_sigma, centre, centre, config.k1_sigma / r2, config.k2_sigma / (r2 * r2)])


def _rotation_steps(submap: Submap, ids: IntArray) -> FloatArray:
    R = submap.keyframe_poses(ids)[:, :3, :3]
    return np.array([np.linalg.norm(so3.log(a.T @ b)) for a, b in pairwise(R)])


def _mask(ids: IntArray, size: int) -> BoolArray:
    mask = np.zeros(size, bool)
    mask[ids] = True
    return mask


# --- the bundle adjustment


class _BehindCameraError(RuntimeError):
    """Points of the optimum lie behind a camera that saw them: the factor counts no error there, and fixes nothing."""

    def __init__(self, points: IntArray) -> None:
        super().__init__(f"{len(points)} points went behind their cameras")
        self.points = points


def _optimise_in_front(problem: BundleProblem, start: FloatArray, prior: FloatArray, robust_k: float) -> _Optimum:
    """Minimise, without the few points that a step has put behind a camera."""
    for _ in range(MAX_DROPS):
        try:
            return _optimise(problem, start, prior, robust_k)
        except _BehindCameraError as error:
            problem = _without(problem, error.points)
    return _optimise(problem, start, prior, robust_k)


def _without(problem: BundleProblem, points: IntArray) -> BundleProblem:
    p, dropped = problem, _mask(points, len(problem.xyz_mu))
    rows = ~dropped[p.point]
    point = (np.cumsum(~dropped) - 1)[p.point[rows]]
    return replace(
        p, xyz_mu=p.xyz_mu[~dropped], kf=p.kf[rows], point=point, uv_px=p.uv_px[rows], sigma_px=p.sigma_px[rows]
    )


def _optimise(problem: BundleProblem, start: FloatArray, prior: FloatArray, robust_k: float) -> _Optimum:
    """Minimise over poses, points and calibration; the points are eliminated first, the calibration last."""
    p = problem
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    noise, factor = PixelNoise(robust_k), gtsam.GeneralSFMFactor2Cal3DS2
    keyframes, points = np.arange(len(p.T_submap_kf)), np.arange(len(p.xyz_mu))
    poses = convert.pose_keys(keyframes)
    for uv, sigma, k, j in zip(p.uv_px, p.sigma_px.tolist(), p.kf.tolist(), p.point.tolist(), strict=True):
        graph.push_back(factor(uv, noise(sigma), poses[k], j, CALIBRATION_KEY))
    distance = np.linalg.norm(p.T_submap_kf[:, :3, 3] - p.T_submap_kf[0, :3, 3], axis=1)
    far = int(np.argmax(distance))
    graph.push_back(pose_prior(0, p.T_submap_kf[0]))
    graph.push_back(baseline_factor(0, far, float(distance[far])))
    graph.push_back(
        gtsam.PriorFactorCal3DS2(
            CALIBRATION_KEY, _to_cal3_ds2(p.K, np.zeros(5)), gtsam.noiseModel.Gaussian.Covariance(_prior(p.K, prior))
        )
    )
    values.insert(CALIBRATION_KEY, _to_cal3_ds2(p.K, start))
    convert.insert_poses(values, keyframes, p.T_submap_kf)
    convert.insert_points(values, points, p.xyz_mu)
    params = gtsam.LevenbergMarquardtParams()
    params.setMaxIterations(MAX_ITERATIONS)
    params.setRelativeErrorTol(TOLERANCE)
    params.setLinearSolverType("SEQUENTIAL_CHOLESKY")
    params.setOrdering(gtsam.Ordering([*points.tolist(), *poses, CALIBRATION_KEY]))
    with silenced():  # the factor prints each point that a step puts behind a camera
        before = float(graph.error(values))
        optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, params)
        result = optimizer.optimize()
    T, xyz = convert.poses_of(result), convert.points_of(result)
    behind = np.unique(p.point[_depths(p, T, xyz) <= MIN_DEPTH_MU])
    if len(behind):
        raise _BehindCameraError(behind)
    found = np.asarray(result.atCal3DS2(CALIBRATION_KEY).vector())
    correction, J = _from_cal3_ds2(found, p.K)
    marginal = np.asarray(gtsam.Marginals(graph, result).marginalCovariance(CALIBRATION_KEY))
    noise_ratio = _noise_ratio(p, T, xyz, correction)
    return _Optimum(correction, J @ marginal @ J.T, noise_ratio, before, float(optimizer.error()))


def _depths(problem: BundleProblem, T: FloatArray, xyz: FloatArray) -> FloatArray:
    """Return the depth (R,) of each observed point in its camera."""
    p = problem
    return np.einsum("ri,ri->r", T[p.kf, :3, 2], xyz[p.point] - T[p.kf, :3, 3])


def _noise_ratio(problem: BundleProblem, T: FloatArray, xyz: FloatArray, correction: FloatArray) -> float:
    """Return the ratio of the typical residual to its sigma."""
    p = problem
    p_cam = np.einsum("rji,rj->ri", T[p.kf, :3, :3], xyz[p.point] - T[p.kf, :3, 3])
    uv = LensCorrection.of_vector(correction).distort_px(p.K, p_cam[:, :2] / p_cam[:, 2:])
    chi2 = ((uv - p.uv_px) ** 2).sum(1) / p.sigma_px**2
    return max(MIN_NOISE_RATIO, math.sqrt(float(np.median(chi2)) / MEDIAN_CHI2_2DOF))


def _to_cal3_ds2(K: FloatArray, correction: FloatArray) -> gtsam.Cal3DS2:
    corrected = LensCorrection.of_vector(correction).intrinsics(K)
    fx, fy, cx, cy = corrected[0, 0], corrected[1, 1], corrected[0, 2], corrected[1, 2]
    return gtsam.Cal3DS2(fx, fy, 0.0, cx, cy, correction[3], correction[4], 0.0, 0.0)


def _from_cal3_ds2(vector: FloatArray, K: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the correction (5,) of (fx, fy, skew, cx, cy, k1, k2, p1, p2), and its derivative (5, 9)."""
    fx, fy, _, cx, cy, k1, k2 = vector[:7]
    log_focal = 0.5 * (math.log(fx / K[0, 0]) + math.log(fy / K[1, 1]))
    J = np.zeros((5, 9))
    J[0, 0], J[0, 1] = 0.5 / fx, 0.5 / fy
    J[1, 3] = J[2, 4] = J[3, 5] = J[4, 6] = 1.0
    return np.array([log_focal, cx - K[0, 2], cy - K[1, 2], k1, k2]), J


def _prior(K: FloatArray, sigmas: FloatArray) -> FloatArray:
    """Return the (9, 9) covariance of a `Cal3DS2` in which the two focal lengths grow as one."""
    focal = np.array([K[0, 0], K[1, 1]])
    covariance = np.zeros((9, 9))
    covariance[:2, :2] = sigmas[0] ** 2 * np.outer(focal, focal) + np.diag((ASPECT_SIGMA * focal) ** 2)
    rest = np.array([SKEW_SIGMA * focal[0], *sigmas[1:], TANGENTIAL_SIGMA, TANGENTIAL_SIGMA])
    covariance[range(2, 9), range(2, 9)] = rest**2
    return covariance
