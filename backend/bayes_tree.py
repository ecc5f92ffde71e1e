"""iSAM2's Bayes tree as plain arrays, and how much of it an update touched."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from dualslam.core.types import IntArray

_NODE = re.compile(r'^(\d+)\[label="([^"]*)"\];$')
_EDGE = re.compile(r"^(\d+)->(\d+)$")


@dataclass(frozen=True, slots=True)
class UpdateStatistics:
    """Effect of one step of the incremental solver."""

    relinearised: int  # variables that had moved beyond their threshold and got a new linearisation
    reeliminated: int  # variables whose conditional was computed anew


@dataclass(frozen=True, slots=True, eq=False)
class BayesTree:
    """The square-root information matrix as a tree: each clique is p(frontal variables | separator)."""

    parent: IntArray
    """(C,): clique above each one, -1 for a root. Parents come before their children."""
    # Frontal variables of each clique.
    keyframes: tuple[tuple[int, ...], ...]
    landmarks: tuple[tuple[int, ...], ...]
    separators: tuple[tuple[int, ...], ...]
    """Keyframes that each clique is conditioned on; they are frontal somewhere above it."""
    separator_landmarks: IntArray  # (C,): how many landmarks it is conditioned on besides

    def __len__(self) -> int:
        return len(self.parent)

    @property
    def depth(self) -> IntArray:
        """(C,) number of cliques above each one."""
        depth = np.zeros(len(self), np.int64)
        for clique, above in enumerate(self.parent.tolist()):
            depth[clique] = 0 if above < 0 else depth[above] + 1
        return depth


def parse_bayes_tree(dot: str) -> BayesTree:
    """Read the text that `gtsam.ISAM2.dot` writes: the tree itself is not within reach from Python."""
    labels: dict[str, str] = {}
    above: dict[str, str] = {}
    for line in dot.splitlines():
        if node := _NODE.match(line.strip()):
            labels[node.group(1)] = node.group(2)
        elif edge := _EDGE.match(line.strip()):
            above[edge.group(2)] = edge.group(1)
    children: dict[str, list[str]] = {}
    for name in labels:
        children.setdefault(above.get(name, ""), []).append(name)
    ordered: list[str] = []
    waiting = list(reversed(children.get("", [])))
    while waiting:
        name = waiting.pop()
        ordered.append(name)
        waiting += reversed(children.get(name, []))
    row = {name: i for i, name in enumerate(ordered)}
    variables = [[_split(part) for part in (labels[name] + ":").split(":")[:2]] for name in ordered]
    return BayesTree(
        parent=np.array([row[above[name]] if name in above else -1 for name in ordered], np.int64),
        keyframes=tuple(frontal[0] for frontal, _ in variables),
        landmarks=tuple(frontal[1] for frontal, _ in variables),
        separators=tuple(separator[0] for _, separator in variables),
        separator_landmarks=np.array([len(separator[1]) for _, separator in variables], np.int64),
    )


def _split(variables: str) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return keyframes (``x3``) and landmarks (``12``) of a list of variables."""
    names = [name.strip() for name in variables.split(",") if name.strip()]
    keyframes = tuple(int(name[1:]) for name in names if name.startswith("x"))
    return keyframes, tuple(int(name) for name in names if not name.startswith("x"))
