"""SO(3), SE(3) and Sim(3): group laws, round trips, Jacobians against numerical ones, SciPy and GTSAM as oracles."""

from __future__ import annotations

from types import ModuleType

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from dualslam.core.geometry import se3, sim3, so3

EXACT = 1e-12
ROUND_TRIP = 1e-9
NUMERICAL = 1e-7
GROUPS = [(so3, 3), (se3, 6), (sim3, 7)]
IDS = ["so3", "se3", "sim3"]


def tangent(seed: int, dimension: int, angle: float) -> np.ndarray:
    """Return a random tangent vector with the given angle, translation of size 3, log-scale of size 0.7."""
    rng = np.random.default_rng(seed)
    xi = rng.normal(size=dimension)
    xi[:3] *= angle / np.linalg.norm(xi[:3])
    xi[3:6] *= 3.0
    xi[6:] *= 0.7
    return xi


ANGLES = st.one_of(
    st.floats(0.0, np.pi - 1e-6), st.sampled_from([0.0, 1e-16, 1e-9, 1e-5, 0.999999, 1.000001, np.pi - 1e-9])
)
SEEDS = st.integers(0, 10_000)


@pytest.mark.parametrize(("group", "dimension"), GROUPS, ids=IDS)
@settings(max_examples=60)
@given(seed=SEEDS, angle=ANGLES)
def test_exp_is_the_matrix_exponential_and_log_inverts_it(
    group: ModuleType, dimension: int, seed: int, angle: float
) -> None:
    """`exp` agrees with SciPy's expm of `hat`, and exp(log) returns."""
    xi = tangent(seed, dimension, angle)
    X = group.exp(xi)
    np.testing.assert_allclose(X, expm(group.hat(xi)), atol=1e-11)
    np.testing.assert_allclose(group.exp(group.log(X)), X, atol=1e-11)
    if angle < np.pi - 1e-5:
        np.testing.assert_allclose(group.log(X), xi, atol=ROUND_TRIP)


@pytest.mark.parametrize(("group", "dimension"), GROUPS[1:], ids=IDS[1:])
@settings(max_examples=30)
@given(seed=SEEDS, angle=ANGLES)
def test_group_laws(group: ModuleType, dimension: int, seed: int, angle: float) -> None:
    """Inverse, action as a homomorphism, adjoint."""
    A = group.exp(tangent(seed, dimension, angle))
    B = group.exp(tangent(seed + 1, dimension, 1.3))
    xi = tangent(seed + 2, dimension, 0.4)
    p = np.random.default_rng(seed).normal(size=(5, 3))
    np.testing.assert_allclose(group.inverse(A) @ A, np.eye(len(A)), atol=EXACT * 100)
    np.testing.assert_allclose(group.act(A @ B, p), group.act(A, group.act(B, p)), atol=1e-11)
    np.testing.assert_allclose(group.act(A, p[0]), group.act(A, p)[0], atol=EXACT)
    conjugate = A @ group.exp(xi) @ group.inverse(A)
    np.testing.assert_allclose(conjugate, group.exp(group.adjoint(A) @ xi), atol=1e-9)


@pytest.mark.parametrize(("group", "dimension"), GROUPS, ids=IDS)
@pytest.mark.parametrize("angle", [0.0, 1e-7, 0.02, 0.9999, 1.0001, 2.0, 3.1])
def test_jacobians_match_numerical_ones(group: ModuleType, dimension: int, angle: float) -> None:
    """Left and right Jacobians by central differences, and their inverses."""
    xi = tangent(7, dimension, angle)
    h = 1e-6
    left, right = np.zeros((2, dimension, dimension))
    X_inv = np.linalg.inv(group.exp(xi))
    for i in range(dimension):
        d = np.eye(dimension)[i] * h
        plus, minus = group.exp(xi + d), group.exp(xi - d)
        left[:, i] = (group.log(plus @ X_inv) - group.log(minus @ X_inv)) / (2 * h)
        right[:, i] = (group.log(X_inv @ plus) - group.log(X_inv @ minus)) / (2 * h)
    np.testing.assert_allclose(left @ group.left_jacobian_inverse(xi), np.eye(dimension), atol=NUMERICAL)
    if group is so3:
        np.testing.assert_allclose(so3.left_jacobian(xi), left, atol=NUMERICAL)
    np.testing.assert_allclose(right @ group.right_jacobian_inverse(xi), np.eye(dimension), atol=NUMERICAL)


@pytest.mark.parametrize(("group", "dimension"), GROUPS, ids=IDS)
def test_leading_dimensions(group: ModuleType, dimension: int) -> None:
    """A batch gives what its elements give."""
    xi = np.stack([tangent(s, dimension, a) for s, a in enumerate([0.0, 1e-9, 0.5, 1.5, 3.0, 3.1])]).reshape(2, 3, -1)
    X = group.exp(xi)
    for name, argument in (("exp", xi), ("left_jacobian_inverse", xi), ("log", X), ("inverse", X), ("adjoint", X)):
        f = getattr(group, name, None)
        if f is None:
            continue
        np.testing.assert_allclose(f(argument)[1, 2], f(argument[1, 2]), atol=EXACT, err_msg=name)


@pytest.mark.parametrize("gap", [0.0, 1e-15, 1e-9, 1e-4])
def test_rotation_log_near_pi(gap: float) -> None:
    """The logarithm keeps its accuracy where the antisymmetric part vanishes."""
    axis = np.array([1.0, -2.0, 0.5]) / np.linalg.norm([1.0, -2.0, 0.5])
    R = Rotation.from_rotvec(axis * (np.pi - gap)).as_matrix()
    omega = so3.log(R)
    np.testing.assert_allclose(so3.exp(omega), R, atol=EXACT)
    assert abs(np.linalg.norm(omega) - (np.pi - gap)) < EXACT
    assert abs(so3.rotation_angle(R) - (np.pi - gap)) < EXACT


@settings(max_examples=50)
@given(seed=SEEDS, angle=ANGLES)
def test_quaternions_agree_with_scipy(seed: int, angle: float) -> None:
    """Both directions, w >= 0."""
    R = so3.exp(tangent(seed, 3, angle))
    q = so3.quat_xyzw_from_matrix(R)
    assert q[3] >= 0
    np.testing.assert_allclose(Rotation.from_quat(q).as_matrix(), R, atol=EXACT)
    np.testing.assert_allclose(so3.matrix_from_quat_xyzw(-3.0 * q), R, atol=EXACT)


def test_quaternion_sign_is_deterministic_at_half_turns() -> None:
    """Half turns about the axes: w is 0 and the axis comes out positive."""
    for i in range(3):
        R = -np.eye(3)
        R[i, i] = 1.0
        np.testing.assert_array_equal(so3.quat_xyzw_from_matrix(R), np.eye(4)[i])


def test_normalise_removes_drift() -> None:
    """A perturbed matrix becomes the nearest rotation; scale and translation stay."""
    rng = np.random.default_rng(3)
    S = sim3.exp(tangent(1, 7, 1.0))
    drifted = S.copy()
    drifted[:3, :3] += 1e-4 * rng.normal(size=(3, 3))
    R = sim3.rotation(sim3.normalise(drifted))
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=EXACT)
    np.testing.assert_allclose(sim3.normalise(drifted), S, atol=1e-3)


def test_parts_of_a_similarity() -> None:
    """Parts in, parts out; camera poses stay rigid under a similarity."""
    R, t = so3.exp([0.2, -0.4, 1.0]), np.array([1.0, 2.0, 3.0])
    S = sim3.from_parts(2.5, R, t)
    assert abs(sim3.scale(S) - 2.5) < EXACT
    np.testing.assert_allclose(sim3.rotation(S), R, atol=EXACT)
    np.testing.assert_allclose(sim3.act(S, t), 2.5 * R @ t + t, atol=EXACT)
    T = se3.exp(tangent(5, 6, 0.8))
    moved = sim3.act_on_pose(S, T)
    np.testing.assert_allclose(moved[:3, 3], sim3.act(S, T[:3, 3]), atol=EXACT)
    np.testing.assert_allclose(moved[:3, :3], R @ T[:3, :3], atol=EXACT)


def test_sim3_tangent_is_gtsams() -> None:
    """`exp` equals GTSAM's Similarity3.Expmap with the same numbers, once its translation is scaled."""
    gtsam = pytest.importorskip("gtsam")
    xi = tangent(11, 7, 1.2)
    theirs = gtsam.Similarity3.Expmap(xi)
    s, R, t = theirs.scale(), theirs.rotation().matrix(), theirs.translation()
    np.testing.assert_allclose(sim3.exp(xi), sim3.from_parts(s, R, s * t), atol=1e-9)
