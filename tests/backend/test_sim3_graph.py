"""The graph over similarities."""

from __future__ import annotations

import numpy as np
import pytest

from dualslam.backend.sim3_graph import Sim3Edge, optimise_sim3
from dualslam.core.errors import SolverError
from tests.backend.test_convert import random_sim3, sim3_exp

SIGMAS = np.array([0.01, 0.01, 0.01, 0.02, 0.02, 0.02, 0.01])
COVARIANCE = np.diag(SIGMAS**2)


def ring(n, rng, noise=1.0, closing=True):
    """True nodes on a circle of changing scale, edges measured with noise, and what dead reckoning makes of them."""
    truth = []
    for a in np.linspace(0, 2 * np.pi, n, endpoint=False):
        S = sim3_exp(np.array([0, a, 0, 0, 0, 0, 0.3 * np.sin(a)]))
        S[:3, 3] = [10 * np.cos(a), 0.0, 10 * np.sin(a)]
        truth.append(S)
    edges = []
    for i in range(n if closing else n - 1):
        j = (i + 1) % n
        measured = np.linalg.inv(truth[i]) @ truth[j] @ sim3_exp(noise * SIGMAS * rng.normal(size=7))
        edges.append(Sim3Edge(i, j, measured, COVARIANCE, doubtful=j == 0))
    guess = {0: truth[0]}
    for e in edges[: n - 1]:
        guess[e.second] = guess[e.first] @ e.S_first_second
    return truth, edges, guess


def centre_errors(nodes, truth):
    return np.array([np.linalg.norm(nodes[i][:3, 3] - S[:3, 3]) for i, S in enumerate(truth)])


def log_scales(nodes):
    return np.array([np.log(np.cbrt(np.linalg.det(nodes[i][:3, :3]))) for i in sorted(nodes)])


def test_exact_edges_give_the_truth_whatever_the_guess():
    rng = np.random.default_rng(0)
    truth, edges, _ = ring(20, rng, noise=0.0)
    guess = {i: S @ sim3_exp(0.1 * rng.normal(size=7)) for i, S in enumerate(truth)}
    solution = optimise_sim3(guess, edges, {0: truth[0]})
    for i, S in enumerate(truth):
        np.testing.assert_allclose(solution.S_world_node[i], S, atol=1e-5)
    assert solution.cost_after < 1e-8


def test_closing_a_loop_takes_the_drift_out():
    truth, edges, guess = ring(60, np.random.default_rng(1))
    solution = optimise_sim3(guess, edges)
    assert centre_errors(solution.S_world_node, truth).max() < 0.5 * centre_errors(guess, truth).max()
    true_scales = log_scales(dict(enumerate(truth)))
    drift = np.abs(log_scales(guess) - true_scales).max()
    assert np.abs(log_scales(solution.S_world_node) - true_scales).max() < drift
    assert solution.inliers.all()
    assert solution.cost_after < solution.cost_before


def test_false_links_are_refused():
    rng = np.random.default_rng(2)
    truth, edges, guess = ring(60, rng)
    n_ring = len(edges)
    for i in range(5, 25):
        j = i + 30
        S = np.linalg.inv(truth[i]) @ truth[j] @ sim3_exp(SIGMAS * rng.normal(size=7))
        if i % 2:
            S = S @ random_sim3(rng)
        edges.append(Sim3Edge(i, j, S, COVARIANCE, doubtful=True))
    solution = optimise_sim3(guess, edges, robust=True)
    np.testing.assert_array_equal(solution.inliers[n_ring:], np.arange(5, 25) % 2 == 0)
    assert solution.inliers[:n_ring].all()
    assert centre_errors(solution.S_world_node, truth).max() < 0.5


def test_each_piece_has_a_gauge():
    rng = np.random.default_rng(3)
    nodes = {i: random_sim3(rng) for i in range(6)}
    edges = [Sim3Edge(i, i + 1, np.linalg.inv(nodes[i]) @ nodes[i + 1], COVARIANCE) for i in (0, 1, 3)]
    solution = optimise_sim3(nodes, edges, {1: nodes[1]})
    for i, S in nodes.items():
        np.testing.assert_allclose(solution.S_world_node[i], S, atol=1e-6)


def test_long_chain_with_a_loop():
    truth, edges, guess = ring(1500, np.random.default_rng(4))
    solution = optimise_sim3(guess, edges)
    assert centre_errors(solution.S_world_node, truth).max() < 0.6 * centre_errors(guess, truth).max()


def test_covariances_against_monte_carlo():
    chosen, found = 4, []
    truth, _, _ = ring(8, np.random.default_rng(0), noise=0.0)
    for seed in range(120):
        _, edges, guess = ring(8, np.random.default_rng(1000 + seed))
        solution = optimise_sim3(guess, edges, {0: truth[0]})
        off = np.linalg.inv(truth[chosen]) @ solution.S_world_node[chosen]
        s = np.cbrt(np.linalg.det(off[:3, :3]))
        R = off[:3, :3] / s
        found.append(np.r_[(R - R.T)[[2, 0, 1], [1, 2, 0]] / 2, off[:3, 3], np.log(s)])
    covariance = solution.relative_covariances([(0, chosen)])[0]
    ratio = np.array(found).std(0) / np.sqrt(np.diag(covariance))
    assert (ratio > 0.75).all()
    assert (ratio < 1.25).all()


def test_covariance_of_one_edge_is_the_edges_own():
    rng = np.random.default_rng(5)
    A = rng.normal(size=(7, 7)) * 0.01
    C = A @ A.T + 1e-6 * np.eye(7)
    S = random_sim3(rng)
    first = random_sim3(rng)
    solution = optimise_sim3({0: first, 1: first @ S}, [Sim3Edge(0, 1, S, C)], {0: first})
    np.testing.assert_allclose(solution.relative_covariances([(0, 1)])[0], C, rtol=1e-3, atol=1e-7)


def test_bad_input_is_named():
    with pytest.raises(SolverError, match="at least one node"):
        optimise_sim3({}, [])
    with pytest.raises(SolverError, match="node 7"):
        optimise_sim3({0: np.eye(4)}, [Sim3Edge(0, 7, np.eye(4), COVARIANCE)])
    with pytest.raises(SolverError, match="not a similarity"):
        optimise_sim3({0: np.zeros((4, 4))}, [])
    with pytest.raises(SolverError, match="failed"):
        optimise_sim3({0: np.eye(4), 1: np.eye(4)}, [Sim3Edge(0, 1, np.eye(4), -np.eye(7))])
