"""Self-calibration: what a submap's own observations say about the camera that took them.

A batch bundle adjustment of a window of keyframes. The calibration is one more variable, shared by all of them, with a
prior at the given one. Whether the answer is worth anything depends on the motion: driving straight ahead leaves the
focal length to the prior, turning fixes it. The verdict is therefore a test, with two questions. Do the data fix the
focal length, or does the prior? Is the whole too far from the present calibration to be chance? All parameters are
estimated together and those that the data say little about are left to their priors: holding them at zero was tried,
and gave the focal length what was theirs (7-Scenes: 4 % instead of 8 %).

The noise is that of the residuals, whatever sigmas the submap was made with: those allow for the error of the camera
model itself, which is what is asked for here. Neighbouring observations err alike (a landmark is matched to the same
patch again and again), so the Hessian's covariance is too small: on rendered images with the exact camera the squared
Mahalanobis distance of the correction from zero was 5 to 71, with five degrees of freedom. So the noise is taken to be
`INFLATION` times as large. Where the camera is wrong, that distance was 990 to 1450 (7-Scenes' colour
camera) and 2700 to 3300 (KITTI 03 in its turn).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np

from dualslam.backend.calibration_bundle import CalibratedOptimum, noise_ratio, optimise_with_camera
from dualslam.backend.final_refinement import FORGETS_AT
from dualslam.backend.observability import compute_depth_sigmas, compute_residuals, take_mask
from dualslam.backend.point_refinement import huber, refit_points
from dualslam.backend.schur import Loss, State, geman_mcclure
from dualslam.core.bundle import BundleProblem
from dualslam.core.camera.base import Camera
from dualslam.core.camera.calibrated_size import PRINCIPAL_POINT_SIGMA
from dualslam.core.camera.corrected import LensCorrection, correct, correction_of, given_camera
from dualslam.core.chi_square import CHI2_999
from dualslam.core.config.settings import CalibrationConfig
from dualslam.core.errors import SolverError
from dualslam.core.estimates import MAX_PRIOR_SIGMAS, CalibrationEstimate, PreferredCamera
from dualslam.core.geometry import se3, so3
from dualslam.core.geometry.umeyama import umeyama
from dualslam.core.noise_model import INFLATION, PROOF_VIEWS
from dualslam.core.types import Failure, FailureReason, FloatArray, IntArray
from dualslam.map.submap import Submap

MAX_KEYFRAMES = 60
"""Keyframes of the window, neighbours in time; of all such windows the one with most turning."""
MIN_ROTATION_DEG = 15.0
"""Turning, summed over the window, below which nothing is tried: the focal length could not be known."""
LENS_SIGMA = 0.03
"""Prior of the radial distortion that is left in the rectified image: the displacement at 45 degrees from the axis (or
at the image's corner, if that is farther out), relative to the radius."""
MAX_SIGMA = 0.02
"""Of the log focal length: a bound for answers about a camera that is far off, by more than `FAR_SIGMAS`, or hardly
known, by `CalibrationConfig.log_focal_sigma`. There 2 % are better than none; on a straight road answers that are less
sure than this are wrong (KITTI 03: 34 % off with a sigma of 3 %)."""
FAR_SIGMAS = 6.0
"""Standard deviations that count as far. The worst answer seen was off by five of its own: they are too small along
the valley in which focal length and k1 make up for each other."""
MIN_DISTANCE2 = CHI2_999[5]
"""Squared Mahalanobis distance from the present calibration above which the new one is taken: chi-square, 5 degrees of
freedom, 99.9 %."""

MAX_DEPTH_SIGMA = 0.3
"""Relative; landmarks whose distance is known no better make the problem singular and say nothing."""
MIN_OBSERVATIONS = 1000
TOGETHER_OBSERVATIONS = 120
"""For each keyframe, where all maps are asked together. With a third of these, three runs of `kitti_03` differ by 0.3 %
in focal length (sigma 0.7 %), with these by 0.08 % (0.4 %)."""
TOLERANCE, TOGETHER_TOLERANCE = 1e-5, 1e-4
"""Relative decrease of the cost at which to stop: where one submap is asked, and where all are. The second ends within
0.15 of its sigmas of where the first would, in half the time (`kitti_03` also with SIFT, `hololens_000`)."""


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
        A failure if the window holds too little, or the solver failed. Use an estimate only if it is `accepted`.
    """
    problem = _ask(submap, choose_window(submap, MAX_KEYFRAMES), camera, config, seed)
    if isinstance(problem, Failure):
        return problem
    return estimate_correction(problem, camera.width, correction_of(camera), config, robust_k, present_covariance)


def calibrate_together(
    submaps: Sequence[Submap],
    camera: Camera,
    present_covariance: FloatArray | None,
    *,
    change_camera: Callable[[Submap, Camera], None],
    config: CalibrationConfig,
    robust_k: float = 1.345,
    seed: int = 0,
) -> tuple[CalibrationEstimate, list[Submap]] | Failure:
    """Ask all maps of a run about their camera, together and whole, under a loss that forgets false matches.

    - `submaps`: are not changed. They have two keyframes or more.
    - `change_camera`: gives a submap the pixels and the intrinsics of another camera.
    - `camera`, `config`, `robust_k`, `seed`, `present_covariance`: as for `estimate_calibration`.

    Returns the estimate, and copies of the submaps, changed to it. Earliest keyframe and unit of each are as before.
    Raises `InputError` if the correction has no inverse somewhere in the image.
    """
    start, ids = time.perf_counter(), [np.array(sorted(each.keyframes), np.int64) for each in submaps]
    each_n = [TOGETHER_OBSERVATIONS * len(kf) for kf in ids]
    problem = _concatenate(
        [make_problem(s, kf, camera, n, seed) for s, kf, n in zip(submaps, ids, each_n, strict=True)]
    )
    if len(problem.kf) < MIN_OBSERVATIONS:
        return Failure(FailureReason.TOO_FEW_INLIERS, f"{len(problem.kf)} observations in {len(submaps)} maps")
    present = correction_of(camera)
    as_now = State(problem.T_submap_kf, problem.xyz_mu, present.vector)
    forgets = partial(geman_mcclure, shape=FORGETS_AT * noise_ratio(problem, as_now))
    answer = _answer(problem, camera.width, present, config, forgets, TOGETHER_TOLERANCE, present_covariance)
    if isinstance(answer, Failure):
        return answer
    estimate = _judged(answer, problem, config, start, 0.0)
    if isinstance(estimate, Failure):
        return estimate
    changed, begin, found = [], 0, correct(camera, estimate.correction)
    for submap, kf in zip(submaps, ids, strict=True):
        each = submap.copy()
        change_camera(each, found)
        T = answer.best.T_submap_kf[begin : begin + len(kf)]
        begin += len(kf)
        seen = each.landmarks_of_keyframes(kf)
        each.apply_estimate(kf, T, seen, each.landmarks["xyz_mu"][seen])
        each.landmarks["xyz_mu"][seen] = refit_points(each, robust_k, seen)
        changed.append(each)
    return estimate, changed


def find_preferred_camera(
    submap: Submap,
    keyframe_ids: IntArray,
    camera: Camera,
    config: CalibrationConfig,
    robust_k: float = 1.345,
    seed: int = 0,
    present_covariance: FloatArray | None = None,
) -> PreferredCamera | None:
    """Say which camera some keyframes of a submap would rather have, however little they know of it.

    - `submap`: is not changed.
    - `keyframe_ids` (K,): ascending.
    - `camera`, `config`, `robust_k`, `seed`, `present_covariance`: as for `estimate_calibration`. Without
      `CalibrationConfig.refine` the camera is taken at its word.

    Returns PreferredCamera or None: none where they say nothing.
    """
    problem = _ask(submap, keyframe_ids, camera, config, seed) if config.refine else None
    if problem is None or isinstance(problem, Failure):
        return None
    present, loss = correction_of(camera), partial(huber, k=robust_k)
    answer = _answer(problem, camera.width, present, config, loss, TOLERANCE, present_covariance)
    if isinstance(answer, Failure):
        return None
    try:
        now, preferred = (answer.best.poses_under(each) for each in (present.vector, answer.correction))
    except (SolverError, np.linalg.LinAlgError):
        return None
    off = np.zeros((0, 5)) if present_covariance is None else np.linalg.cholesky(present_covariance).T
    return PreferredCamera(
        float(answer.off[0]),
        math.sqrt(answer.covariance[0, 0]),
        answer.distance2,
        answer.distance2 > MIN_DISTANCE2,
        keyframe_ids,
        now,
        preferred,
        preferred @ se3.exp(np.einsum("kij,nj->nki", answer.best.follows, off)),
    )


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

    - `problem`: in the rectified pixels of the camera as it was given.
    - `width_px`: of the image: the prior of the principal point is relative to it.
    - `present`: that the poses and points were made with.
    - `present_covariance` (5, 5): of `present`, if it was estimated; the calibration that was given is taken at its
      word.
    """
    start, loss = time.perf_counter(), partial(huber, k=robust_k)
    answer = _answer(problem, width_px, present, config, loss, TOLERANCE, present_covariance)
    if isinstance(answer, Failure):
        return answer
    change = _path_change(answer, present) if answer.distance2 > MIN_DISTANCE2 else 0.0
    estimate = _judged(answer, problem, config, start, change)
    if not isinstance(estimate, Failure) and estimate.prior_sigmas > MAX_PRIOR_SIGMAS:
        return Failure(FailureReason.SCALE, "the calibration would be too far from the given one", estimate.numbers)
    return estimate


def _judged(
    answer: _Answer, problem: BundleProblem, config: CalibrationConfig, start: float, path_change: float
) -> CalibrationEstimate | Failure:
    estimate = CalibrationEstimate(
        LensCorrection.of_vector(answer.correction),
        answer.covariance,
        answer.distance2,
        answer.distance2 > MIN_DISTANCE2,
        answer.best.cost_before,
        answer.best.cost_after,
        len(problem.T_submap_kf),
        len(problem.kf),
        time.perf_counter() - start,
        float((np.abs(answer.correction) / answer.prior).max()),
        path_change,
    )
    sigma = math.sqrt(answer.covariance[0, 0])
    far = abs(float(answer.off[0])) > FAR_SIGMAS * math.sqrt(answer.of_difference[0, 0])
    if sigma > (MAX_SIGMA if far else min(config.max_focal_sigma, MAX_SIGMA)):
        return Failure(FailureReason.DEGENERATE, "the motion does not fix the focal length", estimate.numbers)
    return estimate


@dataclass(frozen=True, slots=True, eq=False)
class _Answer:
    """A problem's information on its camera, as if pixels erred by `INFLATION` times as much."""

    best: CalibratedOptimum  # as they err
    prior: FloatArray  # (5,): sigmas
    correction: FloatArray  # (5,)
    covariance: FloatArray  # (5, 5)
    off: FloatArray  # (5,): the correction less the present one
    of_difference: FloatArray  # (5, 5): its covariance

    @property
    def distance2(self) -> float:
        """Squared Mahalanobis distance from the present correction."""
        return float(self.off @ np.linalg.solve(self.of_difference, self.off))


def _answer(
    problem: BundleProblem,
    width_px: int,
    present: LensCorrection,
    config: CalibrationConfig,
    loss: Loss,
    tolerance: float,
    present_covariance: FloatArray | None,
) -> _Answer | Failure:
    prior = prior_sigmas(problem, width_px, config)
    try:
        best = optimise_with_camera(problem, present.vector, prior, loss, tolerance)
        correction, covariance = _weigh(best, prior, INFLATION * best.noise_ratio)
    except (SolverError, np.linalg.LinAlgError) as error:
        return Failure(FailureReason.SOLVER, str(error))
    of_difference = covariance if present_covariance is None else covariance + present_covariance
    return _Answer(best, prior, correction, covariance, correction - present.vector, of_difference)


def _path_change(answer: _Answer, present: LensCorrection) -> float:
    """Return by how much keyframes move with the camera, RMS, over their path; zero where they lie on a line.

    Both maps are solved from the same observations alone: other ties would count as an effect of the camera.
    """
    try:
        now = answer.best.poses_under(present.vector)[:, :3, 3]
    except (SolverError, np.linalg.LinAlgError):
        return 0.0
    path = float(np.linalg.norm(np.diff(now, axis=0), axis=1).sum())
    aligned = umeyama(answer.best.T_submap_kf[:, :3, 3], now)
    return 0.0 if isinstance(aligned, Failure) else aligned.rmse / path


def _weigh(best: CalibratedOptimum, prior: FloatArray, inflation: float) -> tuple[FloatArray, FloatArray]:
    """Return the correction and its covariance, had the sigmas of all pixels been `inflation` times as large.

    Only the calibration has a prior, so that the information in its marginal is the sum of the data's and the prior's.
    """
    of_prior = np.diag(prior**-2.0)
    of_both = np.linalg.inv(best.covariance)
    covariance = np.asarray(np.linalg.inv((of_both - of_prior) / inflation**2 + of_prior), np.float64)
    return covariance @ of_both @ best.correction / inflation**2, covariance


# --- what goes in


def _ask(
    submap: Submap, window: IntArray, camera: Camera, config: CalibrationConfig, seed: int
) -> BundleProblem | Failure:
    """Collect what some keyframes say, if it can be anything about the focal length."""
    rotation_deg = math.degrees(_rotation_steps(submap, window).sum())
    if rotation_deg < MIN_ROTATION_DEG:
        return Failure(
            FailureReason.DEGENERATE,
            f"{rotation_deg:.0f} deg of turning in {len(window)} keyframes say nothing about the focal length",
        )
    problem = make_problem(submap, window, camera, config.max_observations, seed)
    if len(problem.kf) < MIN_OBSERVATIONS:
        return Failure(FailureReason.TOO_FEW_INLIERS, f"{len(problem.kf)} observations in {len(window)} keyframes")
    return problem


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
    good = np.flatnonzero((n_views >= PROOF_VIEWS) & (depth_sigmas < MAX_DEPTH_SIGMA))
    good = np.random.default_rng(seed).permutation(good)
    good = np.sort(good[np.cumsum(n_views[good]) <= max_observations])
    chosen = np.flatnonzero(ok & take_mask(good, n_landmarks)[landmark])
    given = given_camera(camera)
    raw = np.concatenate([submap.keyframes[k].features.uv_px for k in window.tolist()])
    offset = np.cumsum([0, *(len(submap.keyframes[k].features) for k in window.tolist())])
    uv_given, _ = given.rectify(raw[offset[kf[chosen]] + obs["feature"][rows[chosen]]])
    finite = np.isfinite(uv_given).all(1)
    chosen, uv_given = chosen[finite], uv_given[finite]
    return BundleProblem(
        given.K,
        T,
        np.arange(len(window)) == 0,
        xyz[good],
        kf[chosen],
        np.searchsorted(good, landmark[chosen]),
        uv_given,
        sigma[chosen],
    )


def _concatenate(problems: Sequence[BundleProblem]) -> BundleProblem:
    """Make one problem of several that share a camera."""
    first_kf = np.cumsum([0, *(len(p.T_submap_kf) for p in problems)])
    first_point = np.cumsum([0, *(len(p.xyz_mu) for p in problems)])
    return BundleProblem(
        problems[0].K,
        np.concatenate([p.T_submap_kf for p in problems]),
        np.concatenate([p.fixed for p in problems]),
        np.concatenate([p.xyz_mu for p in problems]),
        np.concatenate([p.kf + first for p, first in zip(problems, first_kf, strict=False)]),
        np.concatenate([p.point + first for p, first in zip(problems, first_point, strict=False)]),
        np.concatenate([p.uv_px for p in problems]),
        np.concatenate([p.sigma_px for p in problems]),
    )


def prior_sigmas(problem: BundleProblem, width_px: int, config: CalibrationConfig) -> FloatArray:
    """Return the (5,) prior sigmas. Those of the distortion shrink where the image reaches beyond 45 degrees."""
    K = problem.K
    xy = (problem.uv_px - K[:2, 2]) / (K[0, 0], K[1, 1])
    r2 = max(1.0, float((xy * xy).sum(1).max(initial=0.0)))
    centre = PRINCIPAL_POINT_SIGMA * width_px
    return np.array([config.log_focal_sigma, centre, centre, LENS_SIGMA / r2, LENS_SIGMA / (r2 * r2)])


def _rotation_steps(submap: Submap, ids: IntArray) -> FloatArray:
    R = submap.keyframe_poses(ids)[:, :3, :3]
    return np.array([np.linalg.norm(so3.log(a.T @ b)) for a, b in pairwise(R)])
