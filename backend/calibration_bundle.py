"""The bundle adjustment of self-calibration: poses, points and one lens that all keyframes share."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise

import numpy as np

from dualslam.backend.final_refinement import LEAST_NOISE
from dualslam.backend.schur import Lens, Loss, Optimum, State, System, optimise
from dualslam.core.bundle import BundleProblem
from dualslam.core.camera.corrected import LensCorrection
from dualslam.core.chi_square import MEDIAN_CHI2
from dualslam.core.errors import SolverError
from dualslam.core.noise_model import MAX_TRIES, MIN_DEPTH_MU, TINY
from dualslam.core.types import FloatArray

MAX_ITERATIONS = 100
"""Most need a few. Where the focal length is far off, the way is long and bent: lens and focal length make up for each
other."""


@dataclass(frozen=True, slots=True, eq=False)
class CalibratedOptimum:
    """Where the cost is least."""

    T_submap_kf: FloatArray
    """(K, 4, 4): the problem's keyframes; the fixed one stays where it was, and so does its distance from the one
    farthest from it."""
    correction: FloatArray  # (5,): of the camera as it was given
    covariance: FloatArray  # (5, 5): of the correction, by the Hessian, prior and all
    follows: FloatArray  # (K, 6, 5): with a change d of the correction the poses go to ``T_submap_kf exp(follows @ d)``
    noise_ratio: float  # of the typical residual to its sigma
    # Sum of the Huber losses, and the prior's.
    cost_before: float
    cost_after: float
    poses_under: Callable[[FloatArray], FloatArray]
    """From another correction (5,) to the poses (K, 4, 4) at which the cost is least, were the camera to stay there."""


class CorrectedLens:
    """The `dualslam.backend.schur.Lens` whose parameters are those of a `LensCorrection`.

    - `K` (3, 3): of the camera as it was given.
    - `information` (5, 5): of the prior.
    """

    def __init__(self, K: FloatArray, information: FloatArray) -> None:
        self.K, self.information = K, information

    def project(self, xy: FloatArray, parameters: FloatArray) -> FloatArray:
        """Return the pixels (R, 2) of rays (x, y, 1), (R, 2)."""
        return LensCorrection.of_vector(parameters).distort_px(self.K, xy)

    def derivatives(self, xy: FloatArray, parameters: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return how pixels change with the rays (R, 2, 2) and with the parameters (R, 2, 5)."""
        k1, k2 = parameters[3:]
        focal = math.exp(parameters[0]) * np.array([self.K[0, 0], self.K[1, 1]])
        r2 = (xy * xy).sum(axis=1)
        bent = focal * xy
        spread = 1 + k1 * r2 + k2 * r2 * r2
        by_ray = bent[:, :, None] * xy[:, None, :] * (2 * k1 + 4 * k2 * r2)[:, None, None]
        by_ray += focal[:, None] * np.eye(2) * spread[:, None, None]
        by_lens = np.zeros((len(xy), 2, 5))
        by_lens[:, :, 0] = bent * spread[:, None]
        by_lens[:, 0, 1] = by_lens[:, 1, 2] = 1.0
        by_lens[:, :, 3], by_lens[:, :, 4] = bent * r2[:, None], bent * (r2 * r2)[:, None]
        return by_ray, by_lens


class _HeldLens(CorrectedLens):
    """One that stays as it is."""

    def __init__(self, K: FloatArray, parameters: FloatArray) -> None:
        super().__init__(K, np.zeros((0, 0)))
        self._parameters = parameters

    def project(self, xy: FloatArray, parameters: FloatArray) -> FloatArray:
        return super().project(xy, self._parameters)

    def derivatives(self, xy: FloatArray, parameters: FloatArray) -> tuple[FloatArray, FloatArray]:
        by_ray, by_lens = super().derivatives(xy, self._parameters)
        return by_ray, by_lens[:, :, :0]


def optimise_with_camera(
    problem: BundleProblem, start: FloatArray, prior: FloatArray, loss: Loss, tolerance: float
) -> CalibratedOptimum:
    """Minimise over poses, points and correction, without the few points that end behind a camera.

    - `problem`: in the rectified pixels of the camera as it was given; of each map the first pose is fixed.
    - `start`, `prior` (5,): the correction to begin at, and the prior sigmas of its parts about zero.
    - `tolerance`: relative decrease of the cost below which to stop.

    Raises `SolverError` if there is no optimum, or nothing fixes the correction.
    """
    lens = CorrectedLens(problem.K, np.diag(prior**-2.0))
    kept, found = _in_front(problem, loss, tolerance, lens, start)
    state = _in_unit_of(kept, problem, found.state)
    return CalibratedOptimum(
        state.T_submap_kf,
        state.lens,
        *System(kept, loss, lens).about_lens(state),
        noise_ratio(kept, state),
        found.cost_before,
        found.cost_after,
        partial(_poses_under, replace(kept, T_submap_kf=state.T_submap_kf, xyz_mu=state.xyz_mu), loss, tolerance),
    )


def _poses_under(problem: BundleProblem, loss: Loss, tolerance: float, correction: FloatArray) -> FloatArray:
    """Return the poses (K, 4, 4) at which the cost is least, were the camera another one."""
    lens = _HeldLens(problem.K, correction)
    kept, found = _in_front(problem, loss, tolerance, lens, np.zeros(0))
    return _in_unit_of(kept, problem, found.state).T_submap_kf


def _in_front(
    problem: BundleProblem, loss: Loss, tolerance: float, lens: Lens, start: FloatArray
) -> tuple[BundleProblem, Optimum]:
    """Minimise, and again without the points that are behind a camera; return what is left, and its optimum."""
    p = problem
    for _ in range(MAX_TRIES + 1):
        found = optimise(p, loss, MAX_ITERATIONS, tolerance, lens, start)
        T, xyz = found.state.T_submap_kf, found.state.xyz_mu
        depth = np.einsum("ri,ri->r", T[p.kf, :3, 2], xyz[p.point] - T[p.kf, :3, 3])
        behind = np.unique(p.point[depth <= MIN_DEPTH_MU])
        if not len(behind):
            return p, found
        # From where it has got to: the others have found their places.
        stays = np.ones(len(xyz), bool)
        stays[behind] = False
        rows = stays[p.point]
        point = (np.cumsum(stays) - 1)[p.point[rows]]
        kept = {"kf": p.kf[rows], "point": point, "uv_px": p.uv_px[rows], "sigma_px": p.sigma_px[rows]}
        p, start = replace(p, T_submap_kf=T, xyz_mu=xyz[stays], **kept), found.state.lens
    raise SolverError("points go behind their cameras again and again")


def _in_unit_of(kept: BundleProblem, problem: BundleProblem, state: State) -> State:
    """Return a state of `kept` whose maps have the units of `problem`: by the pose farthest from each one's first."""
    T, xyz = state.T_submap_kf.copy(), state.xyz_mu.copy()
    begins = np.append(np.flatnonzero(problem.fixed), len(T))
    first = np.zeros(len(xyz), np.int64)
    first[kept.point] = kept.kf
    for begin, end in pairwise(begins.tolist()):
        centre = problem.T_submap_kf[begin, :3, 3]
        distance = np.linalg.norm(problem.T_submap_kf[begin:end, :3, 3] - centre, axis=1)
        far = begin + int(np.argmax(distance))
        unit = distance.max() / max(np.linalg.norm(T[far, :3, 3] - centre), TINY)
        own = (first >= begin) & (first < end)
        T[begin:end, :3, 3] = centre + unit * (T[begin:end, :3, 3] - centre)
        xyz[own] = centre + unit * (xyz[own] - centre)
    return State(T, xyz, state.lens)


def noise_ratio(problem: BundleProblem, state: State) -> float:
    """Return the ratio of the typical residual to its sigma."""
    p, T = problem, state.T_submap_kf
    p_cam = np.einsum("rji,rj->ri", T[p.kf, :3, :3], state.xyz_mu[p.point] - T[p.kf, :3, 3])
    uv = LensCorrection.of_vector(state.lens).distort_px(p.K, p_cam[:, :2] / p_cam[:, 2:])
    chi2 = ((uv - p.uv_px) ** 2).sum(1) / p.sigma_px**2
    return max(LEAST_NOISE, math.sqrt(float(np.median(chi2)) / MEDIAN_CHI2[2]))
