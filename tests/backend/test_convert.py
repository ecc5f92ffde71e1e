"""GTSAM's objects and ours say the same."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from dualslam.backend import convert


def so3_hat(w):
    return np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])


def expm(A, terms=40):
    out, power = np.eye(len(A)), np.eye(len(A))
    for n in range(1, terms):
        power = power @ A / n
        out = out + power
    return out


def sim3_exp(xi):
    A = np.zeros((4, 4))
    A[:3, :3] = so3_hat(xi[:3]) + xi[6] * np.eye(3)
    A[:3, 3] = xi[3:6]
    return expm(A)


def random_sim3(rng):
    return sim3_exp(np.r_[rng.normal(size=3), rng.normal(size=3), 0.5 * rng.normal()])


def test_similarity_acts_alike_and_comes_back():
    rng = np.random.default_rng(0)
    for _ in range(20):
        S, p = random_sim3(rng), rng.normal(size=3)
        theirs = convert.to_similarity3(S)
        np.testing.assert_allclose(theirs.transformFrom(p), S[:3, :3] @ p + S[:3, 3], atol=1e-12)
        np.testing.assert_allclose(convert.from_similarity3(theirs), S, atol=1e-12)
        other = random_sim3(rng)
        composed = convert.from_similarity3(theirs.compose(convert.to_similarity3(other)))
        np.testing.assert_allclose(composed, S @ other, atol=1e-11)


def test_tangent_coordinates_are_the_same_numbers():
    rng = np.random.default_rng(1)
    for _ in range(20):
        xi = np.r_[rng.normal(size=3), rng.normal(size=3), 0.5 * rng.normal()]
        np.testing.assert_allclose(convert.from_similarity3(gtsam.Similarity3.Expmap(xi)), sim3_exp(xi), atol=1e-11)


@pytest.mark.parametrize("matrix", [np.zeros((4, 4)), np.diag([1.0, 1.0, -1.0, 1.0]), np.full((4, 4), np.nan)])
def test_what_is_no_similarity_is_refused(matrix):
    with pytest.raises(ValueError, match="not a similarity"):
        convert.to_similarity3(matrix)


def test_poses_and_points_come_back_in_order_of_their_keys():
    rng = np.random.default_rng(2)
    T = np.array([np.eye(4)] * 3)
    for i in range(3):
        T[i, :3, :3] = expm(so3_hat(rng.normal(size=3)))
        T[i, :3, 3] = rng.normal(size=3)
    xyz = rng.normal(size=(4, 3))
    values = gtsam.Values()
    convert.insert_poses(values, np.array([70000, 0, 5]), T)
    convert.insert_points(values, np.array([3, 1 << 40, 2, 9]), xyz)
    np.testing.assert_allclose(convert.poses_of(values), T[[1, 2, 0]], atol=1e-14)
    np.testing.assert_array_equal(convert.points_of(values), xyz[[2, 0, 3, 1]])
    assert convert.pose_key(5) == gtsam.symbol("x", 5)
    assert convert.is_pose_key(convert.pose_key(5))
    assert not convert.is_pose_key(5)
    assert convert.keyframe_of(convert.pose_key(70000)) == 70000
    assert convert.points_of(gtsam.Values()).shape == (0, 3)
    assert convert.poses_of(gtsam.Values()).shape == (0, 4, 4)


def test_a_rotation_a_little_off_is_put_right():
    T = np.eye(4)
    T[0, 1] = 1e-4
    R = convert.from_pose3(convert.to_pose3(T))[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
