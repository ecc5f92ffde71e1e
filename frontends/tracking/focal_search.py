"""The focal length and the lens of a camera of which nothing is known, from the first seconds of its video.

Each pair of frames is compared with every camera of a grid: a focal length, and one number for the lens (the division
model of Fitzgibbon, 2001). Without it, a wide lens is taken for twice the focal length. For each camera the relative
pose is estimated (RANSAC and refinement of PoseLib) and the robust cost of the epipolar constraint is kept. An
uninformative pair (a straight drive, a plane, a turn on the spot) has a flat cost and no effect. The sum over the pairs
is lowest at the right camera. Self-calibration goes on from there.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from operator import itemgetter

import numpy as np
import poselib
from scipy.optimize import minimize

from dualslam.core.camera.focal import FocalSearch, ToldFocal
from dualslam.core.chi_square import CHI2_999
from dualslam.core.geometry import se3
from dualslam.core.geometry.distortion import division_area_ratio, undistort_division
from dualslam.core.geometry.two_view import fundamental_from_pose, sampson_error
from dualslam.core.interfaces import Frontend
from dualslam.core.noise_model import GATE_SIGMAS, INFLATION, PAIR_MATCHES
from dualslam.core.types import Failure, FailureReason, Features, FloatArray
from dualslam.frontends.tracking.resection import poselib_camera

LAGS = (1, 2, 5, 10, 20, 40)
"""Frames between the two of a pair: a car at 10 Hz loses sight of most points within five."""
MAX_PAIRS, MIN_PAIRS = 30, 8
MAX_MATCHES = 200
"""Of a pair, for time's sake."""
MIN_MOTION, MAX_MOTION = 0.01, 0.15
"""Median way of a pair's matches, of the image's longer side: less says nothing, and more says no more."""

LOG_FOCAL_STEP, LENS_STEP, COARSE = 0.04, 0.025, 4
"""Of the grid of cameras; every fourth is asked first, then those around the best."""
LOG_FOCALS: FloatArray = np.array([math.log(0.35) + LOG_FOCAL_STEP * i for i in range(13 * COARSE)])
"""Over the image's longer side, however the telephone was held: fields of view of 110 to 22 degrees."""
LENSES: FloatArray = np.array([LENS_STEP * i for i in range(-12, 5)])
"""Of the division model, at half that side: an undistorted radius is r / (1 + lens r^2). EuRoC's is -0.22."""
FINE_CELLS = 10
"""Of the coarse grid, that are asked finely."""

LOG_FOCAL_PRIOR, LENS_PRIOR = (np.log(0.75), 0.3), (0.0, 0.1)
"""Mean and sigma, of cameras that people film with: telephones 0.7 to 0.8, webcams 0.9 to 1, action 0.45 to 0.6."""
TOLD_RIGHT = 0.9
"""How likely a source's own data tell of these images: one may have been cropped since."""
DEGREES_OF_FREEDOM = 3.0
"""Of the Student distribution of a pair's cost, as some pairs are entirely wrong. The inflation scales errors above
their residuals, as neighbouring points err alike (`INFLATION` of self-calibration)."""
MODEL_SIGMA = 0.03
"""Of the log focal length: what a lens of one number and a principal point in the middle leave."""
COARSE_ITERATIONS, FINE_ITERATIONS = (30, 60), (50, 200)
"""Of RANSAC, at least and at most."""
RESAMPLES = 100
MAX_STEPS = 40
"""Of the search between the grid's cameras."""


def search_focal(
    frontend: Frontend, features: Sequence[Features], size_px: tuple[int, int], seed: int, told: ToldFocal | None = None
) -> FocalSearch | Failure:
    """Search for the camera that pairs of frames agree about.

    - `frontend`: whose features these are.
    - `features`: of neighbouring frames.
    - `size_px`: width and height.
    - `told`: the focal length in the source's own data.

    Returns FocalSearch or Failure: fewer than `MIN_PAIRS` pairs moved enough, and the source's data have no focal
    length: `LOW_PARALLAX`.
    """
    pairs = list(_find_pairs(frontend, features, size_px, seed))
    told_px = None if told is None else told.over_side * max(size_px)
    if len(pairs) < MIN_PAIRS and told is not None and told_px is not None:
        return FocalSearch(told_px, told.log_sigma, 0.0, *size_px, len(pairs), told_px)
    if len(pairs) < MIN_PAIRS:
        return Failure(
            FailureReason.LOW_PARALLAX, f"{len(pairs)} pairs of frames tell the focal length, {MIN_PAIRS} needed"
        )
    side = max(size_px)
    focals = side * np.exp(LOG_FOCALS)
    costs = np.array([_costs_on_coarse_grid(pair, focals, seed) for pair in pairs])
    prior = _log_prior(LOG_FOCALS[None, :], LENSES[:, None], told)
    coarse = (_log_likelihood(costs, costs, pairs).sum(axis=0) + prior)[::COARSE, ::COARSE]
    for cell in np.argsort(coarse.ravel(), kind="stable")[::-1][:FINE_CELLS]:
        row, column = np.unravel_index(cell, coarse.shape)
        for pair, of_pair in zip(pairs, costs, strict=True):
            _refine_cell(pair, of_pair, focals, int(row) * COARSE, int(column) * COARSE)
    of_pairs = _log_likelihood(costs, costs, pairs)
    straight = np.flatnonzero(np.isclose(LENSES, 0.0))
    total = of_pairs.sum(axis=0) + prior
    bent = 2.0 * float(total.max() - total[straight].max()) > CHI2_999[1]
    rows = np.arange(len(LENSES)) if bent else straight
    log_focal, sigma, lens = _estimate(of_pairs[:, rows], prior[rows], LENSES[rows], seed)
    if sigma < LOG_FOCAL_STEP:
        log_focal, lens = _between_nodes(pairs, costs, side, log_focal, lens if bent else None, told)
    return FocalSearch(float(side * np.exp(log_focal)), sigma, lens, *size_px, len(pairs), told_px)


@dataclass(frozen=True, slots=True, eq=False)
class _Pair:
    """Matched pixels (N, 2) from the middle of the image, their sigma, and the radius at which the lens is given."""

    uv_a: FloatArray
    uv_b: FloatArray
    sigma_px: float
    radius_px: float

    def straightened(self, lens: float) -> _Straight:
        """Return the pair without the lens."""
        xy_a, xy_b = self.uv_a / self.radius_px, self.uv_b / self.radius_px
        a, b = (self.radius_px * undistort_division(xy, lens) for xy in (xy_a, xy_b))
        zoom_a, zoom_b = (np.abs(division_area_ratio(xy, lens)) ** -0.5 for xy in (xy_a, xy_b))
        return _Straight(a, b, (zoom_a + zoom_b) / 2, self.sigma_px)


@dataclass(frozen=True, slots=True, eq=False)
class _Straight:
    """A pair as cameras without a lens would have seen it."""

    a: FloatArray  # (N, 2)
    b: FloatArray  # (N, 2)
    zoom: FloatArray  # (N,): by how much the lens had shrunk the pixels' surroundings
    sigma_px: float

    def fresh_pose(
        self, focal: float, iterations: tuple[int, int] = FINE_ITERATIONS, seed: int = 0
    ) -> poselib.CameraPose:
        """Return a relative pose by RANSAC, of at least and at most so many iterations."""
        least, most = iterations
        gate_px = GATE_SIGMAS * self.sigma_px
        options = {"max_epipolar_error": gate_px, "min_iterations": least, "max_iterations": most, "seed": seed}
        camera = poselib_camera(_K(focal), (1, 1))
        return poselib.estimate_relative_pose(self.a, self.b, camera, camera, options, {})[0]

    def best_cost(self, focal: float, starts: Sequence[poselib.CameraPose]) -> tuple[float, poselib.CameraPose]:
        """Return the least robust cost of the epipolar constraint from some poses on, and its pose."""
        K = _K(focal)
        camera = poselib_camera(K, (1, 1))
        options = {"loss_type": "CAUCHY", "loss_scale": self.sigma_px, "max_iterations": 15}
        found = []
        for start in starts:
            pose, _ = poselib.refine_relative_pose(self.a, self.b, start, camera, camera, options)
            F = fundamental_from_pose(K, se3.from_parts(pose.R, pose.t))
            error2 = sampson_error(F, self.a, self.b) / (self.zoom * self.sigma_px) ** 2
            found.append((float(np.log1p(error2).sum()), pose))
        return min(found, key=itemgetter(0))


def _find_pairs(
    frontend: Frontend, features: Sequence[Features], size_px: tuple[int, int], seed: int
) -> Iterator[_Pair]:
    """Yield for frames spread over all the pair that is likely to tell most: many matches that have gone far."""
    rng = np.random.default_rng(seed)
    middle: FloatArray = (np.array(size_px, float) - 1.0) / 2
    for first in range(0, len(features) - 1, max(1, -(-len(features) // MAX_PAIRS))):
        best, most = None, 0.0
        for lag in LAGS:
            if first + lag >= len(features):
                break
            a, b = features[first], features[first + lag]
            index = frontend.match_wide(a, b).index
            if len(index) < PAIR_MATCHES:
                continue
            uv_a, uv_b = a.uv_px[index[:, 0]], b.uv_px[index[:, 1]]
            motion = float(np.median(np.linalg.norm(uv_a - uv_b, axis=1))) / max(size_px)
            worth = len(index) * min(motion, MAX_MOTION) ** 2
            if motion >= MIN_MOTION and worth > most:
                sigma = float(np.median(np.concatenate([a.sigma_px[index[:, 0]], b.sigma_px[index[:, 1]]])))
                best, most = (uv_a, uv_b, sigma), worth
        if best is None:
            continue
        uv_a, uv_b, sigma = best
        options = {"max_epipolar_error": GATE_SIGMAS * sigma, "max_iterations": 300, "min_iterations": 50, "seed": seed}
        inlier = np.array(poselib.estimate_fundamental(uv_a, uv_b, options, {})[1]["inliers"], bool)
        chosen = rng.permutation(np.flatnonzero(inlier))[:MAX_MATCHES]
        if len(chosen) >= PAIR_MATCHES:
            yield _Pair(uv_a[chosen] - middle, uv_b[chosen] - middle, sigma, max(size_px) / 2)


# --- how well a camera explains a pair


def _costs_on_coarse_grid(pair: _Pair, focals: FloatArray, seed: int) -> FloatArray:
    """Return the pair's cost at every camera, (lenses, focals): that of the coarse grid's nearest."""
    costs = np.empty((len(LENSES), len(focals)))
    for row in range(0, len(LENSES), COARSE):
        straight, pose = pair.straightened(LENSES[row]), None
        for column in range(0, len(focals), COARSE):
            starts = [] if pose is None else [pose]
            if column % (2 * COARSE) == 0:
                starts.append(straight.fresh_pose(focals[column], COARSE_ITERATIONS, seed))
            cost, pose = straight.best_cost(focals[column], starts)
            costs[row : row + COARSE, column : column + COARSE] = cost
    return costs


def _refine_cell(pair: _Pair, costs: FloatArray, focals: FloatArray, row: int, column: int) -> None:
    """Ask a pair about all cameras of a cell of the coarse grid, from the pose of its corner on."""
    pose = None
    for i in range(row, min(row + COARSE, len(LENSES))):
        straight = pair.straightened(LENSES[i])
        along = range(column, column + COARSE)
        for j in along if (i - row) % 2 == 0 else reversed(along):
            if pose is None:
                pose = straight.fresh_pose(focals[j])
            costs[i, j], pose = straight.best_cost(focals[j], [pose])


def _K(focal: float) -> FloatArray:
    """Return the intrinsics of pixels that count from the middle of the image."""
    return np.diag([focal, focal, 1.0])


# --- what all pairs say together


def _log_prior(log_focal: FloatArray, lens: FloatArray, told: ToldFocal | None) -> FloatArray:
    """Return the logarithm of the prior of cameras, of the shape that both make together."""
    of_focal = _log_normal(log_focal, *LOG_FOCAL_PRIOR)
    if told is not None:
        right, wrong = _log_normal(log_focal, math.log(told.over_side), told.log_sigma), of_focal
        of_focal = np.logaddexp(right + math.log(TOLD_RIGHT), wrong + math.log(1.0 - TOLD_RIGHT))
    return of_focal + _log_normal(lens, *LENS_PRIOR)


def _log_normal(values: FloatArray, mean: float, sigma: float) -> FloatArray:
    return np.asarray(-0.5 * ((values - mean) / sigma) ** 2 - math.log(sigma), np.float64)


def _log_likelihood(costs: FloatArray, on_grid: FloatArray, pairs: Sequence[_Pair]) -> FloatArray:
    """Return what each pair's costs (pairs, ...) say, in the noise that its costs (pairs, lenses, focals) show."""
    shape = (-1,) + (1,) * (costs.ndim - 1)
    least = on_grid.min(axis=(1, 2)).reshape(shape)
    noise = np.maximum(least / np.array([len(pair.uv_a) for pair in pairs]).reshape(shape), 1e-3)
    excess, nu = np.maximum(costs - least, 0.0) / noise, DEGREES_OF_FREEDOM
    return np.asarray(-0.5 * (nu + 1.0) * np.log1p(excess / (nu * INFLATION**2)), np.float64)


def _between_nodes(
    pairs: Sequence[_Pair], costs: FloatArray, side: int, log_focal: float, lens: float | None, told: ToldFocal | None
) -> tuple[float, float]:
    """Return the best log focal length and lens near a node of the grid; without a lens none is looked for."""
    poses = [pair.straightened(lens or 0.0).fresh_pose(side * np.exp(log_focal)) for pair in pairs]

    def misfit(x: np.ndarray[tuple[int], np.dtype[np.float64]]) -> float:
        log_f, bend = float(x[0]), float(x[1]) if lens is not None else 0.0
        found = np.empty(len(pairs))
        for i, pair in enumerate(pairs):
            found[i], poses[i] = pair.straightened(bend).best_cost(side * np.exp(log_f), [poses[i]])
        prior = _log_prior(np.array(log_f), np.array(bend), told)
        return -float(prior) - float(_log_likelihood(found, costs, pairs).sum())

    start = np.array([log_focal] if lens is None else [log_focal, lens])
    corners = start + np.vstack([np.zeros(len(start)), np.diag([LOG_FOCAL_STEP, LENS_STEP][: len(start)])])
    best = minimize(
        misfit,
        start,
        method="Nelder-Mead",
        options={"initial_simplex": corners, "maxfev": MAX_STEPS, "xatol": 0.1 * LENS_STEP, "fatol": 0.1},
    ).x
    return float(best[0]), float(best[1]) if lens is not None else 0.0


def _estimate(of_pairs: FloatArray, prior: FloatArray, lenses: FloatArray, seed: int) -> tuple[float, float, float]:
    """Return the log focal length, its sigma, and the lens.

    The sigma is of the posterior, of pairs drawn again (they may share an error), and of what the model leaves.
    """
    rng = np.random.default_rng(seed)
    n = len(of_pairs)
    drawn = [_moments(of_pairs[rng.integers(0, n, n)].sum(axis=0) + prior, lenses) for _ in range(RESAMPLES)]
    mean, variance, lens = _moments(of_pairs.sum(axis=0) + prior, lenses)
    means = np.array([m for m, _, _ in drawn])
    return mean, float(np.sqrt(variance + means.var() + MODEL_SIGMA**2)), lens


def _moments(log_posterior: FloatArray, lenses: FloatArray) -> tuple[float, float, float]:
    """Return the mean and the variance of the log focal length over the longer side, and the mean of the lens."""
    weight = np.exp(log_posterior - log_posterior.max())
    weight /= weight.sum()
    of_focal = weight.sum(axis=0)
    mean = float(of_focal @ LOG_FOCALS)
    return mean, float(of_focal @ (LOG_FOCALS - mean) ** 2), float(weight.sum(axis=1) @ lenses)
