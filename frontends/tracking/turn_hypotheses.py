"""Relative poses whose rotation the far part of a scene shows by itself.

Before a near plane, a pose that takes the turn for parallax puts far points in front of the camera, and wins the count.
Here the rotation comes first, from a layer of matches that move as one turn does, then the translation from the others.
"""

from __future__ import annotations

import numpy as np

from dualslam.core.chi_square import CHI2_95
from dualslam.core.geometry import se3, so3
from dualslam.core.noise_model import TINY
from dualslam.core.types import BoolArray, FloatArray, IntArray
from dualslam.frontends.tracking.turning import MIN_PIXELS

N_SAMPLES = 200
"""Pairs of matches that a turn, and then a translation, is tried from: of a layer of a sixth, one at 99.6 %."""
N_SCORED = 400
"""Matches, at random, that score them: a layer of a tenth is still 40."""
N_LAYERS = 2
MIN_FAR_SHARE = 0.1
"""Share of all matches that must move as one turn does to be a layer of far points and not chance."""


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
