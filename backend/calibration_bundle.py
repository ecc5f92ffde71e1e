"""The bundle adjustment of self-calibration: poses, points and one camera that all keyframes share."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import gtsam
import numpy as np

from dualslam.backend import convert
from dualslam.backend.factors import baseline_factor, pose_prior
from dualslam.backend.gtsam_output import without_gtsam_output
from dualslam.backend.noise import PixelNoise
from dualslam.backend.observability import MIN_DEPTH_MU
from dualslam.core.bundle import BundleProblem
from dualslam.core.camera.corrected import LensCorrection
from dualslam.core.chi_square import MEDIAN_CHI2
from dualslam.core.types import FloatArray, IntArray

ASPECT_SIGMA, SKEW_SIGMA, TANGENTIAL_SIGMA = 1e-4, 1e-7, 1e-7
MIN_NOISE_RATIO = 0.05
"""Residuals smaller than this share of their sigmas would be an exact simulation."""
CALIBRATION_KEY = 1 << 60
MAX_ITERATIONS, TOLERANCE = 100, 1e-5
"""Most need a few. Where the focal length is far off, the way is long and bent, as lens and focal length make up for
each other: Ceres' rule for the damping gets there, GTSAM's own stays near the start (KITTI 03 from 36 % off)."""
MAX_DROPS = 3
"""Times that it is tried again without points that went behind a camera."""


@dataclass(frozen=True, slots=True, eq=False)
class CalibratedOptimum:
    """Where the cost is least.

    Attributes
    ----------
    T_submap_kf : (K, 4, 4)
        The problem's keyframes; the first stays where it was, and so does its distance from the one farthest from it.
    correction : (5,)
        Of the camera as it was given.
    covariance : (5, 5)
        Of the correction, by the Hessian, prior and all.
    noise_ratio : float
        Of the typical residual to its sigma.
    cost_before, cost_after : float
        Sum of the Huber losses.
    poses_under : callable
        From another correction (5,) to the poses (K, 4, 4) at which the cost is least, were the camera to stay there.
    """

    T_submap_kf: FloatArray
    correction: FloatArray
    covariance: FloatArray
    noise_ratio: float
    cost_before: float
    cost_after: float
    poses_under: Callable[[FloatArray], FloatArray]


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    """The optimum of a problem, with what its covariance is made from; `vector`: the `Cal3DS2`."""

    problem: BundleProblem
    graph: gtsam.NonlinearFactorGraph
    values: gtsam.Values
    T_submap_kf: FloatArray
    xyz_mu: FloatArray
    vector: FloatArray
    cost_before: float
    cost_after: float


class _BehindCameraError(RuntimeError):
    """Points of the optimum lie behind a camera that saw them: the factor counts no error there, and fixes nothing."""

    def __init__(self, points: IntArray, reached: BundleProblem, correction: FloatArray) -> None:
        super().__init__(f"{len(points)} points went behind their cameras")
        self.points, self.reached, self.correction = points, reached, correction


def optimise_with_camera(
    problem: BundleProblem, start: FloatArray, prior: FloatArray, robust_k: float
) -> CalibratedOptimum:
    """Minimise over poses, points and calibration, without the few points that a step has put behind a camera.

    Parameters
    ----------
    problem : BundleProblem
        In the rectified pixels of the camera as it was given; `fixed` is not looked at.
    start, prior : (5,)
        The correction to begin at, and the prior sigmas of its parts about zero.
    robust_k : float
        Huber threshold in sigmas.

    Raises
    ------
    RuntimeError, LinAlgError, ...
        What GTSAM and numpy raise (`dualslam.backend.solver.GTSAM_ERRORS`).
    """
    found = _in_front(problem, start, prior, robust_k)
    correction, J = _from_cal3_ds2(found.vector, problem.K)
    marginal = np.asarray(gtsam.Marginals(found.graph, found.values).marginalCovariance(CALIBRATION_KEY))
    noise_ratio = _noise_ratio(found.problem, found.T_submap_kf, found.xyz_mu, correction)
    return CalibratedOptimum(
        found.T_submap_kf,
        correction,
        J @ marginal @ J.T,
        noise_ratio,
        found.cost_before,
        found.cost_after,
        partial(_poses_under, found, robust_k),
    )


def _poses_under(found: _Found, robust_k: float, correction: FloatArray) -> FloatArray:
    """Return the poses (K, 4, 4) at which the cost is least, were the camera another one.

    It begins where the normal equations at the optimum lead: a few steps are left.
    """
    keyframes = np.arange(len(found.T_submap_kf))
    ordering = gtsam.Ordering([*range(len(found.xyz_mu)), *convert.pose_keys(keyframes)])
    given_calibration, _ = found.graph.linearize(found.values).eliminatePartialSequential(ordering)
    step = gtsam.VectorValues()
    step.insert(CALIBRATION_KEY, _to_cal3_ds2(found.problem.K, correction).vector() - found.vector)
    near = found.values.retract(given_calibration.optimize(step))
    problem = replace(found.problem, T_submap_kf=convert.poses_of(near), xyz_mu=convert.points_of(near))
    return _in_front(problem, correction, None, robust_k).T_submap_kf


def _in_front(problem: BundleProblem, start: FloatArray, prior: FloatArray | None, robust_k: float) -> _Found:
    """Minimise without the points that a step has put behind a camera; without a prior the correction stays."""
    for _ in range(MAX_DROPS):
        try:
            return _optimise(problem, start, prior, robust_k)
        except _BehindCameraError as error:
            # From where it has got to: the others have found their places.
            problem, start = _without(error.reached, error.points), error.correction
    return _optimise(problem, start, prior, robust_k)


def _without(problem: BundleProblem, points: IntArray) -> BundleProblem:
    p, dropped = problem, np.zeros(len(problem.xyz_mu), np.bool_)
    dropped[points] = True
    rows = ~dropped[p.point]
    point = (np.cumsum(~dropped) - 1)[p.point[rows]]
    return replace(
        p, xyz_mu=p.xyz_mu[~dropped], kf=p.kf[rows], point=point, uv_px=p.uv_px[rows], sigma_px=p.sigma_px[rows]
    )


def _optimise(problem: BundleProblem, start: FloatArray, prior: FloatArray | None, robust_k: float) -> _Found:
    """Minimise over poses and points, which are eliminated first; and calibration, last, where it has a prior."""
    p = problem
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    noise, camera = PixelNoise(robust_k), _to_cal3_ds2(p.K, start)
    keyframes, points = np.arange(len(p.T_submap_kf)), np.arange(len(p.xyz_mu))
    poses = convert.pose_keys(keyframes)
    for uv, sigma, k, j in zip(p.uv_px, p.sigma_px.tolist(), p.kf.tolist(), p.point.tolist(), strict=True):
        if prior is None:
            graph.push_back(gtsam.GenericProjectionFactorCal3DS2(uv, noise(sigma), poses[k], j, camera))
        else:
            graph.push_back(gtsam.GeneralSFMFactor2Cal3DS2(uv, noise(sigma), poses[k], j, CALIBRATION_KEY))
    distance = np.linalg.norm(p.T_submap_kf[:, :3, 3] - p.T_submap_kf[0, :3, 3], axis=1)
    far = int(np.argmax(distance))
    graph.push_back(pose_prior(0, p.T_submap_kf[0]))
    graph.push_back(baseline_factor(0, far, float(distance[far])))
    ordering = [*points.tolist(), *poses]
    if prior is not None:
        of_prior = gtsam.noiseModel.Gaussian.Covariance(_prior(p.K, prior))
        graph.push_back(gtsam.PriorFactorCal3DS2(CALIBRATION_KEY, _to_cal3_ds2(p.K, np.zeros(5)), of_prior))
        values.insert(CALIBRATION_KEY, camera)
        ordering.append(CALIBRATION_KEY)
    convert.insert_poses(values, keyframes, p.T_submap_kf)
    convert.insert_points(values, points, p.xyz_mu)
    params = gtsam.LevenbergMarquardtParams.CeresDefaults()
    params.setDiagonalDamping(False)
    params.setMaxIterations(MAX_ITERATIONS)
    params.setRelativeErrorTol(TOLERANCE)
    params.setLinearSolverType("SEQUENTIAL_CHOLESKY")
    params.setOrdering(gtsam.Ordering(ordering))
    with without_gtsam_output():  # the factor prints each point that a step puts behind a camera
        optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, params)
        before = float(optimizer.error())
        result = optimizer.optimize()
    T, xyz = convert.poses_of(result), convert.points_of(result)
    vector = np.asarray((camera if prior is None else result.atCal3DS2(CALIBRATION_KEY)).vector())
    behind = np.unique(p.point[_depths(p, T, xyz) <= MIN_DEPTH_MU])
    if len(behind):
        reached = replace(p, T_submap_kf=T, xyz_mu=xyz)
        raise _BehindCameraError(behind, reached, _from_cal3_ds2(vector, p.K)[0])
    return _Found(p, graph, result, T, xyz, vector, before, float(optimizer.error()))


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
    return max(MIN_NOISE_RATIO, math.sqrt(float(np.median(chi2)) / MEDIAN_CHI2[2]))


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
