"""Whether the focal length changes during a run: a zoom, or a focus that moves."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from dualslam.backend.calibration_bundle import CorrectedLens, noise_ratio
from dualslam.backend.final_refinement import FORGETS_AT
from dualslam.backend.schur import FIRST_DAMPING, State, System, geman_mcclure
from dualslam.backend.self_calibration import MIN_OBSERVATIONS, make_problem, prior_sigmas
from dualslam.core.camera.base import Camera
from dualslam.core.camera.corrected import correction_of
from dualslam.core.chi_square import CHI2_999
from dualslam.core.config.settings import CalibrationConfig
from dualslam.core.errors import SolverError
from dualslam.core.estimates import FocalChange
from dualslam.core.noise_model import INFLATION, TINY
from dualslam.core.types import IntArray
from dualslam.map.submap import Submap

STEPS = 3
"""From the map as it is; eight give the same answers."""
MODEL_SIGMA = 0.01
"""Of what each part says, besides its pixels: no lens model is exact, and a part uses some of it only. The first
answers of `kitti_03`, from several frames on, are up to 1.3 % off."""


@dataclass(frozen=True, slots=True)
class _Part:
    """Neighbouring keyframes, and what they alone say of the logarithm of the focal length."""

    first: int
    focal: float
    variance: float


def find_focal_change(
    submaps: Sequence[Submap], camera: Camera, *, config: CalibrationConfig, seed: int = 0
) -> FocalChange | None:
    """Find the keyframe from which on the images show another focal length than before, if there is one.

    Parts of the maps, of half as many keyframes as a map is first asked with, are asked by themselves. False matches
    are forgotten, and pixels err by `INFLATION` times as much as they seem to. The change counts beyond the 99.9 %
    quantile of its chi-square.

    - `submaps`: are not changed; they share a clock.
    - `camera`: that rectified the features of their keyframes.
    """
    if not config.refine:
        return None
    parts = [part for submap in submaps for part in _parts_of(submap, camera, config, seed)]
    return _largest_change(sorted(parts, key=lambda part: part.first))


def _parts_of(submap: Submap, camera: Camera, config: CalibrationConfig, seed: int) -> Iterable[_Part]:
    ids = np.array(sorted(submap.keyframes), np.int64)
    for window in np.array_split(ids, max(1, round(2 * len(ids) / config.first_keyframes))):
        if (part := _ask(submap, window, camera, config, seed)) is not None:
            yield part


def _ask(submap: Submap, window: IntArray, camera: Camera, config: CalibrationConfig, seed: int) -> _Part | None:
    problem = make_problem(submap, window, camera, config.max_observations, seed)
    if len(problem.kf) < MIN_OBSERVATIONS:
        return None
    state = State(problem.T_submap_kf, problem.xyz_mu, correction_of(camera).vector)
    noise, prior = noise_ratio(problem, state), prior_sigmas(problem, camera.width, config)
    prior[0] = 1.0  # of the focal length the part alone is to speak
    variance = (INFLATION * noise) ** 2
    lens = CorrectedLens(problem.K, np.diag(variance / prior**2))
    system = System(problem, partial(geman_mcclure, shape=FORGETS_AT * noise), lens)
    try:
        for _ in range(STEPS):
            moved = system.step(state, FIRST_DAMPING)
            if moved is None:
                return None
            state = moved
        of_both = 1.0 / (variance * system.about_lens(state)[0][0, 0])
    except (SolverError, np.linalg.LinAlgError):
        return None
    # The prior, about zero, is of the camera as given: the part's own say is what is left without it.
    information = of_both - prior[0] ** -2
    if not (np.isfinite(state.lens).all() and information > TINY):
        return None
    return _Part(int(window[0]), float(of_both * state.lens[0] / information), float(1 / information) + MODEL_SIGMA**2)


def _largest_change(parts: Sequence[_Part]) -> FocalChange | None:
    """Return the most significant difference between what comes before and after a part's beginning."""
    if len(parts) < 2:
        return None
    information = np.array([1.0 / part.variance for part in parts])
    known = np.cumsum(information)
    said = np.cumsum(information * np.array([part.focal for part in parts]))
    before, after = known[:-1], known[-1] - known[:-1]
    change = (said[-1] - said[:-1]) / after - said[:-1] / before
    sigma = np.sqrt(1.0 / before + 1.0 / after)
    n = int(np.argmax(np.abs(change) / sigma))
    if (change[n] / sigma[n]) ** 2 <= CHI2_999[1]:
        return None
    return FocalChange(parts[n + 1].first, float(change[n]), float(sigma[n]))
