"""The atlas graph by itself: what is believed when odometry is worse than it claims, and what 100 loops cost.

python benchmarks/atlas_graph.py [--trials 60]
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import numpy as np

from dualslam.backend.atlas_solver import GtsamAtlasSolver
from dualslam.core.atlas_problem import AtlasEdge, AtlasProblem
from dualslam.core.geometry import sim3
from dualslam.core.types import FloatArray

ODOMETRY = np.array([2e-3] * 3 + [1e-2] * 3 + [5e-3])
"""What an edge within a submap claims: rad, its length's unit, log-scale."""
LOOP = np.array([3e-3] * 3 + [1e-2] * 3 + [5e-3])


def lap(n: int, per_lap: int, radius: float) -> FloatArray:
    """Nodes on a rising circle, (N, 4, 4)."""
    nodes = []
    for i in range(n):
        a = 2 * np.pi * i / per_lap
        S = sim3.exp([0, -a, 0, 0, 0, 0, 0.0])
        S[:3, 3] = [radius * np.cos(a), 0.02 * i, radius * np.sin(a)]
        nodes.append(S)
    return np.array(nodes)


def chain(
    true: FloatArray, worse: float, claimed: float, rng: np.random.Generator
) -> tuple[list[AtlasEdge], FloatArray]:
    """Edges whose errors are `worse` times `ODOMETRY`, and that claim `claimed` times it; and what they add up to."""
    C = np.diag((claimed * ODOMETRY) ** 2)
    edges, nodes = [], [true[0]]
    for i in range(len(true) - 1):
        Z = sim3.inverse(true[i]) @ true[i + 1] @ sim3.exp(worse * ODOMETRY * rng.normal(size=7))
        edges.append(AtlasEdge(i, i + 1, Z, C, "within"))
        nodes.append(nodes[-1] @ Z)
    return edges, np.array(nodes)


def loop(true: FloatArray, i: int, j: int, rng: np.random.Generator) -> AtlasEdge:
    """A true connection."""
    Z = sim3.inverse(true[i]) @ true[j] @ sim3.exp(LOOP * rng.normal(size=7))
    return AtlasEdge(i, j, Z, np.diag(LOOP**2), "loop", doubtful=True)


def false_loop(n: int, rng: np.random.Generator, reach: float) -> AtlasEdge:
    """A false one between any two nodes; half of them claim a millionth of a true one's sigma."""
    i, j = sorted(rng.choice(n, 2, replace=False).tolist())
    Z = sim3.exp(np.r_[0.3 * rng.normal(size=3), reach * rng.normal(size=3), 0.3 * rng.normal()])
    sigmas = LOOP * (1e-6 if rng.random() < 0.5 else 1.0)
    return AtlasEdge(i, j, Z, np.diag(sigmas**2), "loop", doubtful=True)


def shares(worse: float, claimed: float, trials: int) -> tuple[float, float]:
    """Share of true and of false connections that are believed: 6 to 12 submaps of four edges, 1 to 6 connections."""
    kept, asked = np.zeros(2), np.zeros(2)
    for trial in range(trials):
        rng = np.random.default_rng(trial)
        n = 4 * int(rng.integers(6, 13))
        true = lap(n, n // 2, 10.0)
        edges, nodes = chain(true, worse, claimed, rng)
        n_odometry = len(edges)
        kinds = []
        for _ in range(int(rng.integers(1, 7))):
            kinds.append(int(rng.random() < 0.4))
            i = int(rng.integers(0, n - n // 2))
            edges.append(false_loop(n, rng, 3.0) if kinds[-1] else loop(true, i, i + n // 2, rng))
        solution = GtsamAtlasSolver(True, 0.8).solve(AtlasProblem(nodes, 0, tuple(edges)))
        for kind, believed in zip(kinds, solution.believed[n_odometry:].tolist(), strict=True):
            kept[kind] += believed
            asked[kind] += 1
    return float(kept[0] / asked[0]), float(kept[1] / asked[1])


def cost(n_true: int, n_false: int) -> None:
    """10,700 keyframes: 1,070 nodes in four laps."""
    rng = np.random.default_rng(0)
    true = lap(1070, 260, 80.0)
    edges, nodes = chain(true, 1.0, 2.0, rng)
    n_odometry = len(edges)
    for _ in range(n_true):
        i = int(rng.integers(0, len(true) - 261))
        edges.append(loop(true, i, i + 260, rng))
    edges += [false_loop(len(true), rng, 20.0) for _ in range(n_false)]
    solver, seconds = GtsamAtlasSolver(True, 0.8), []
    problem = AtlasProblem(nodes, 0, tuple(edges))
    for _ in range(2):
        started = time.process_time()
        solution = solver.solve(problem)
        seconds.append(time.process_time() - started)
        believed = solution.believed.tolist()
        known = [replace(e, known=e.doubtful and kept) for e, kept in zip(problem.edges, believed, strict=True)]
        known[-1] = replace(known[-1], known=False)
        problem = AtlasProblem(solution.S_world_node, 0, tuple(known))
    kept = solution.believed[n_odometry:]
    print(
        f"1070 nodes, {n_true} true and {n_false} false: {kept[:n_true].sum()} and {kept[n_true:].sum()} believed; "
        f"all at once {seconds[0]:.2f} s of CPU, the last one by itself {seconds[1]:.2f} s"
    )


def main() -> None:
    """Print both."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=60)
    trials = parser.parse_args().trials
    print("odometry's errors over ODOMETRY | its claimed sigmas over it | true ones believed | false ones believed")
    for worse in (1.0, 2.0, 3.0, 5.0):
        for claimed in (1.0, 2.0, 3.0):
            true, false = shares(worse, claimed, trials)
            print(f"{worse:.0f} | {claimed:.0f} | {true:.2f} | {false:.2f}")
    for n_true, n_false in ((100, 0), (100, 50)):
        cost(n_true, n_false)


if __name__ == "__main__":
    main()
