"""The readout time of a rolling shutter, found together with the poses and points of keyframes that turn."""

from __future__ import annotations

from functools import partial

import numpy as np

from dualslam.backend.observability import reproject
from dualslam.backend.point_refinement import huber
from dualslam.backend.schur import System, optimise
from dualslam.core.bundle import ReadoutProblem
from dualslam.core.chi_square import MEDIAN_CHI2
from dualslam.core.errors import SolverError
from dualslam.core.estimates import ReadoutEstimate
from dualslam.core.noise_model import ROBUST_K
from dualslam.core.types import Failure, FailureReason, FloatArray, IntArray

MAX_ITERATIONS, TOLERANCE = 10, 1e-5
"""The map is at its optimum without the readout time. Tolerance: relative decrease of the cost below which to stop."""


class _ReadoutLens:
    """The `dualslam.backend.schur.Lens` whose one parameter is the readout time."""

    information = np.eye(1)  # a second: it holds the readout time where nothing turns

    def __init__(self, question: ReadoutProblem) -> None:
        self._f, self._c = np.diag(question.bundle.K)[:2], question.bundle.K[:2, 2]
        self._by_readout = question.by_readout

    def project(self, xy: FloatArray, parameters: FloatArray, rows: IntArray) -> FloatArray:
        return np.asarray(self._f * xy + self._c + parameters * self._by_readout[rows], np.float64)

    def derivatives(self, xy: FloatArray, parameters: FloatArray, rows: IntArray) -> tuple[FloatArray, FloatArray]:
        return np.broadcast_to(np.diag(self._f), (len(xy), 2, 2)), self._by_readout[rows][:, :, None]


def answer_readout(question: ReadoutProblem) -> ReadoutEstimate | Failure:
    """Return how much longer a map's images were read than its features were corrected for."""
    p, lens, loss = question.bundle, _ReadoutLens(question), partial(huber, k=ROBUST_K)
    try:
        state = optimise(p, loss, MAX_ITERATIONS, TOLERANCE, lens, np.zeros(1)).state
        covariance, _ = System(p, loss, lens).about_lens(state)
    except (SolverError, np.linalg.LinAlgError) as error:
        return Failure(FailureReason.SOLVER, str(error))
    _, front, uv_px = reproject(p.K, state.T_submap_kf, p.kf, state.xyz_mu[p.point])
    residuals = (uv_px + state.lens * question.by_readout - p.uv_px) / p.sigma_px[:, None]
    noise2 = np.median((residuals[front] ** 2).sum(axis=1)) / MEDIAN_CHI2[2]
    sigma_s = float(np.sqrt(noise2 * covariance[0, 0]))
    return ReadoutEstimate(float(state.lens[0]), sigma_s, len(p.T_submap_kf), len(p.kf))
