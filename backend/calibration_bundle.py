"""The bundle adjustment of self-calibration: poses, points and one lens that all keyframes share."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from dualslam.backend.final_refinement import LEAST_NOISE
from dualslam.backend.point_refinement import huber
from dualslam.backend.schur import Lens, Optimum, State, System, optimise
from dualslam.core.bundle import BundleProblem
from dualslam.core.camera.corrected import LensCorrection
from dualslam.core.chi_square import MEDIAN_CHI2
from dualslam.core.errors import SolverError
from dualslam.core.noise_model import MAX_TRIES, MIN_DEPTH_MU
from dualslam.core.types import FloatArray

MAX_ITERATIONS, TOLERANCE = 100, 1e-5
"""Most need a few. Where the focal length is far off, the way is long and bent: lens and focal length make up for each
other."""


@dataclass(frozen=True, slots=True, eq=False)
class CalibratedOptimum:
    """Where the cost is least."""

    T_submap_kf: FloatArray
    """(K, 4, 4): the problem's keyframes; the first stays where it was, and so does its distance from the one farthest
    from it."""
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
    problem: BundleProblem, start: FloatArray, prior: FloatArray, robust_k: float
) -> CalibratedOptimum:
    """Minimise over poses, points and correction, without the few points that end behind a camera.

    - `problem`: in the rectified pixels of the camera as it was given; `fixed` is not looked at.
    - `start`, `prior` (5,): the correction to begin at, and the prior sigmas of its parts about zero.
    - `robust_k`: Huber threshold in sigmas.

    Raises `SolverError` if there is no optimum, or nothing fixes the correction.
    """
    problem = replace(problem, fixed=np.arange(len(problem.T_submap_kf)) == 0)
    lens = CorrectedLens(problem.K, np.diag(prior**-2.0))
    kept, found = _in_front(problem, robust_k, lens, start)
    state = _in_unit_of(problem, found.state)
    return CalibratedOptimum(
        state.T_submap_kf,
        state.lens,
        *System(kept, partial(huber, k=robust_k), lens).about_lens(state),
        _noise_ratio(kept, state),
        found.cost_before,
        found.cost_after,
        partial(_poses_under, replace(kept, T_submap_kf=state.T_submap_kf, xyz_mu=state.xyz_mu), robust_k),
    )


def _poses_under(problem: BundleProblem, robust_k: float, correction: FloatArray) -> FloatArray:
    """Return the poses (K, 4, 4) at which the cost is least, were the camera another one."""
    lens = _HeldLens(problem.K, correction)
    _, found = _in_front(problem, robust_k, lens, np.zeros(0))
    return _in_unit_of(problem, found.state).T_submap_kf


def _in_front(problem: BundleProblem, robust_k: float, lens: Lens, start: FloatArray) -> tuple[BundleProblem, Optimum]:
    """Minimise, and again without the points that are behind a camera; return what is left, and its optimum."""
    p, loss = problem, partial(huber, k=robust_k)
    for _ in range(MAX_TRIES + 1):
        found = optimise(p, loss, MAX_ITERATIONS, TOLERANCE, lens, start)
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


def _in_unit_of(problem: BundleProblem, state: State) -> State:
    """Return a state in the unit in which the pose farthest from the first is as far from it as in the problem."""
    centre = problem.T_submap_kf[0, :3, 3]
    distance = np.linalg.norm(problem.T_submap_kf[:, :3, 3] - centre, axis=1)
    far = int(np.argmax(distance))
    T = state.T_submap_kf.copy()
    unit = distance[far] / np.linalg.norm(T[far, :3, 3] - centre)
    T[:, :3, 3] = centre + unit * (T[:, :3, 3] - centre)
    return State(T, centre + unit * (state.xyz_mu - centre), state.lens)


def _noise_ratio(problem: BundleProblem, state: State) -> float:
    """Return the ratio of the typical residual to its sigma."""
    p, T = problem, state.T_submap_kf
    p_cam = np.einsum("rji,rj->ri", T[p.kf, :3, :3], state.xyz_mu[p.point] - T[p.kf, :3, 3])
    uv = LensCorrection.of_vector(state.lens).distort_px(p.K, p_cam[:, :2] / p_cam[:, 2:])
    chi2 = ((uv - p.uv_px) ** 2).sum(1) / p.sigma_px**2
    return max(LEAST_NOISE, math.sqrt(float(np.median(chi2)) / MEDIAN_CHI2[2]))
