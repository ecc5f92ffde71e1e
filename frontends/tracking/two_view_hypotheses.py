"""Relative poses that two matched views allow: by the turn of what is far, an essential matrix, a homography."""

from __future__ import annotations

import numpy as np
import poselib

from dualslam.core.chi_square import CHI2_95, MEDIAN_CHI2
from dualslam.core.geometry import se3, so3
from dualslam.core.geometry.two_view import (
    decompose_homography,
    fundamental_from_pose,
    homography_transfer_error,
    sampson_error,
)
from dualslam.core.noise_model import GATE_SIGMAS, TINY
from dualslam.core.types import BoolArray, FloatArray, IntArray
from dualslam.frontends.tracking.resection import poselib_camera
from dualslam.frontends.tracking.turning import MIN_PIXELS

RANSAC = {"max_iterations": 1000, "min_iterations": 100}
N_SAMPLES = 200
"""Pairs of matches that a turn, and then a translation, is tried from: of a layer of a sixth, one at 99.6 %."""
N_SCORED = 400
"""Matches, at random, that score them: a layer of a tenth is still 40."""
N_LAYERS = 2
MIN_FAR_SHARE = 0.1
"""Share of all matches that must move as one turn does to be a layer of far points and not chance."""
PLANAR_SHARE = 0.6
"""Of what the essential matrix explains: a board gives 0.65 and more, a street 0.3 to 0.4, a room 0.3 to 0.7."""
MIN_NOISE2 = 0.04
"""Of pixels a fifth as noisy as supposed: below, the pictures are drawn, and what is off is the lens."""


class TurnHypotheses:
    """Matches of two views under turns and translations.

    - `K` (3, 3).
    - `uv_a_px`, `uv_b_px` (N, 2): matched pixels of two views, undistorted; N > 0.
    - `sigma_px` (N,): of a pixel's coordinate.

    - `n_moved`: matches that the turn of most does not explain: they alone tell of a translation.
    """

    def __init__(
        self, uv_a_px: FloatArray, uv_b_px: FloatArray, sigma_px: FloatArray, K: FloatArray, seed: int
    ) -> None:
        self._views = _Views(uv_a_px, uv_b_px, sigma_px, K)
        self._rng = np.random.default_rng(seed)
        self._all = np.arange(len(uv_a_px))
        self._turn = self._views.turn_of_most(self._all, self._rng)
        self._far = self._views.moved_by(self._turn)
        self.n_moved = int(np.count_nonzero(~self._far))

    def poses(self) -> list[FloatArray]:
        """Return poses whose rotation a layer of points shows alone, and whose translation the others fit best with it.

        The first layer may be a near plane that moved like a turn: what it leaves is asked for the next.

        Returns list of (4, 4): t_b_a with a baseline of 1; at most `N_LAYERS`, or none.
        """
        views, rng, R, far = self._views, self._rng, self._turn, self._far
        enough = max(MIN_PIXELS, MIN_FAR_SHARE * len(self._all))
        left, poses = self._all, []
        for layer in range(N_LAYERS):
            if len(left) < enough:
                break
            if layer > 0:
                R = views.turn_of_most(left, rng)
                far = views.moved_by(R)
            left = left[~far[left]]
            if far.sum() < enough:
                break
            near = np.flatnonzero(~far)
            t = views.direction_with(R, near, rng) if len(near) >= MIN_PIXELS else None
            if t is not None:
                poses.append(se3.from_parts(R, t))
        return poses


class _Views:
    """Matched rays of two views."""

    def __init__(self, uv_a_px: FloatArray, uv_b_px: FloatArray, sigma_px: FloatArray, K: FloatArray) -> None:
        self._K, self._K_inv = K, np.linalg.inv(K)
        self._uv_b, self._variance = uv_b_px, sigma_px**2
        ones = np.ones(len(uv_a_px))
        # On the plane z = 1, and as unit vectors.
        self._a, self._b = (np.column_stack([uv, ones]) @ self._K_inv.T for uv in (uv_a_px, uv_b_px))
        self._ray_a, self._ray_b = (x / np.linalg.norm(x, axis=1)[:, None] for x in (self._a, self._b))

    def turn_of_most(self, rows: IntArray, rng: np.random.Generator) -> FloatArray:
        """Return the rotation by which most of some matches moved."""
        i, j = rows[rng.integers(len(rows), size=(2, N_SAMPLES))]
        turns = _triads(self._ray_b[i], self._ray_b[j]) @ _triads(self._ray_a[i], self._ray_a[j]).swapaxes(1, 2)
        scored = rng.permutation(rows)[:N_SCORED]
        best = turns[int(np.argmax(np.count_nonzero(self._moved_by(turns, scored), axis=1)))]
        layer = rows[self.moved_by(best)[rows]]
        U, _, Vt = np.linalg.svd(self._ray_b[layer].T @ self._ray_a[layer])
        return np.asarray(U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt)

    def moved_by(self, R_b_a: FloatArray) -> BoolArray:
        """Return (N,) which matches lie where a turn alone takes them."""
        return self._moved_by(R_b_a[None], np.arange(len(self._a)))[0]

    def _moved_by(self, turns: FloatArray, rows: IntArray) -> BoolArray:
        # All turns in one product, x, y and z each a block of its own: twice as fast as along strided columns.
        moved = (self._K @ turns).swapaxes(0, 1).reshape(-1, 3) @ np.ascontiguousarray(self._a[rows].T)
        x, y, z = moved.reshape(3, len(turns), len(rows))
        z = np.where(z > TINY, z, np.inf)
        u, v = self._uv_b[rows].T
        x /= z
        x -= u
        x *= x
        y /= z
        y -= v
        y *= y
        x += y
        # Both pixels have noise.
        return np.asarray(x < 2.0 * CHI2_95[2] * self._variance[rows])

    def direction_with(self, R: FloatArray, near: IntArray, rng: np.random.Generator) -> FloatArray | None:
        """Return the direction of translation that most matches allow with a rotation; None where none has parallax."""
        turned = self._a[near] @ R.T
        normals = np.cross(turned, self._b[near])  # the translation is at right angles to each
        i, j = rng.integers(len(near), size=(2, N_SAMPLES))
        directions = np.cross(normals[i], normals[j])
        length = np.linalg.norm(directions, axis=1)
        directions = directions[length > 1e-15] / length[length > 1e-15, None]
        if len(directions) == 0:
            return None
        scored = rng.permutation(len(self._a))[:N_SCORED]
        fits = self._sampson2(R, directions, scored) < CHI2_95[1] * self._variance[scored]
        t = directions[int(np.argmax(np.count_nonzero(fits, axis=1)))]
        # Of its two signs the one with more points in front: the parallax turns a ray towards the translation.
        ahead = np.einsum("ni,ni->n", normals, np.cross(turned, t[None]))
        return np.asarray(t if np.count_nonzero(ahead > 0) * 2 > len(near) else -t)

    def _sampson2(self, R: FloatArray, directions: FloatArray, rows: IntArray) -> FloatArray:
        """Return squared Sampson errors (B, N) in pixels of some matches, for a rotation and several translations."""
        turned, b = self._a[rows] @ R.T, self._b[rows]
        constraint = directions @ np.cross(turned, b).T
        across = so3.hat(-directions)
        line_b = turned @ (across @ self._K_inv)[..., :2]
        line_a = b @ (across @ R @ self._K_inv)[..., :2]
        return np.asarray(constraint**2 / sum(line[..., k] ** 2 for line in (line_a, line_b) for k in (0, 1)))


def _triads(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return (N, 3, 3) right-handed frames of pairs of rays, an axis a column."""
    across = np.cross(first, second)
    across /= np.maximum(np.linalg.norm(across, axis=1), TINY)[:, None]
    return np.stack([first, across, np.cross(first, across)], axis=2)


class RelativePoses:
    """The relative poses that two matched views allow, to be asked for in the order of what they cost.

    - `sigma_px` (N,), `K` (3, 3), `size_px` (width, height).
    - `uv_a_px`, `uv_b_px` (N, 2): matched pixels, undistorted; N > 0.
    """

    def __init__(
        self,
        uv_a_px: FloatArray,
        uv_b_px: FloatArray,
        sigma_px: FloatArray,
        K: FloatArray,
        size_px: tuple[int, int],
        seed: int,
    ) -> None:
        self._uv_a, self._uv_b, self._sigma_px = uv_a_px, uv_b_px, sigma_px
        self._K, self._size_px, self._seed = K, size_px, seed
        self._turns = TurnHypotheses(uv_a_px, uv_b_px, sigma_px, K, seed)

    @property
    def n_moved(self) -> int:
        """Matches that a turn does not explain; without them there is nothing to tell a translation from."""
        return self._turns.n_moved

    def of_turns(self) -> list[FloatArray]:
        """Return T_b_a (4, 4), translation of length 1, with the turns that what is far shows: two at most."""
        camera = poselib_camera(self._K, self._size_px)
        # Refined, what is of one basin with another comes to the same, and no longer looks like a second answer.
        scale_px = 2.0 * float(np.median(self._sigma_px))
        refinement = {"loss_type": "TRUNCATED", "loss_scale": scale_px, "max_iterations": 25}
        poses = []
        for by_turn in self._turns.poses():
            start = poselib.CameraPose()
            start.R, start.t = se3.rotation(by_turn), se3.translation(by_turn)
            refined, _ = poselib.refine_relative_pose(self._uv_a, self._uv_b, start, camera, camera, refinement)
            poses.append(_unit_baseline(refined.R, refined.t))
        return poses

    def of_essential_matrix(self) -> FloatArray:
        """Return the T_b_a that explains most of the matches."""
        return estimate_relative_pose(self._uv_a, self._uv_b, self._sigma_px, self._K, self._size_px, self._seed)

    def of_plane(self, T_b_a: FloatArray) -> list[FloatArray]:
        """Return the four T_b_a of a homography, where it explains most of what the essential matrix' pose does.

        Before a plane a homography explains as much with less freedom. Only the matches that the essential matrix
        explains are used: wrong ones meet a line by chance, a point hardly ever.
        """
        uv_a, uv_b, variance = self._uv_a, self._uv_b, self._sigma_px**2
        gate_px = GATE_SIGMAS * float(np.median(self._sigma_px))
        options = {"max_reproj_error": gate_px, "seed": self._seed, **RANSAC}
        H_b_a, _ = poselib.estimate_homography(uv_a, uv_b, options, {})
        sampson2 = np.asarray(sampson_error(fundamental_from_pose(self._K, T_b_a), uv_a, uv_b), np.float64)
        right = sampson2 < CHI2_95[1] * variance
        # Pixels are better than their sigmas suppose: how much better, the epipolar distances tell. A point transferred
        # has the noise of both images.
        noise2 = float(np.median(sampson2[right] / variance[right])) / MEDIAN_CHI2[1] if right.any() else 1.0
        transfer2 = np.asarray(homography_transfer_error(H_b_a, uv_a, uv_b).mean(axis=1), np.float64)
        flat = transfer2 < CHI2_95[2] * 2.0 * variance * np.clip(noise2, MIN_NOISE2, 1.0)
        share = float((right & flat).sum() / max(int(right.sum()), 1))
        poses = decompose_homography(H_b_a, self._K).T_b_a if share > PLANAR_SHARE else ()
        return [_unit_baseline(se3.rotation(T), se3.translation(T)) for T in poses]


def estimate_relative_pose(
    uv_a_px: FloatArray, uv_b_px: FloatArray, sigma_px: FloatArray, K: FloatArray, size_px: tuple[int, int], seed: int
) -> FloatArray:
    """Return T_b_a (4, 4) with a baseline of 1: the essential matrix that explains most of the matches."""
    camera = poselib_camera(K, size_px)
    gate_px = 2.0 * float(np.median(sigma_px))
    options = {"max_epipolar_error": gate_px, "seed": seed, **RANSAC}
    pose, _ = poselib.estimate_relative_pose(uv_a_px, uv_b_px, camera, camera, options, {})
    return _unit_baseline(pose.R, pose.t)


def _unit_baseline(R_b_a: FloatArray, t_b_a: FloatArray) -> FloatArray:
    return se3.from_parts(R_b_a, t_b_a / max(float(np.linalg.norm(t_b_a)), TINY))
