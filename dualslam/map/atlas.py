"""The submaps of a run and the Sim(3) links between them."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from dualslam.core.geometry import sim3
from dualslam.core.types import FloatArray
from dualslam.map.submap import Submap


class LinkKind(StrEnum):
    """Where a link comes from."""

    ROLLOVER = "rollover"
    RECOVERY = "recovery"
    LOOP = "loop"


@dataclass(frozen=True, slots=True, eq=False)
class Link:
    """A Sim(3) between two submaps: ``p_a = S_a_b @ p_b``.

    Attributes
    ----------
    a, b : int
        Submap ids.
    S_a_b : (4, 4) float64
        ``[[s R, t], [0, 1]]``.
    covariance : (7, 7) float64
        Tangent order rotation, translation, log-scale; zero for a link that is exact by construction.
    kind : LinkKind
    keyframes : tuple of int
        Shared keyframes that it stands on, ascending; none for an exact link.
    """

    a: int
    b: int
    S_a_b: FloatArray
    covariance: FloatArray
    kind: LinkKind
    keyframes: tuple[int, ...] = ()


class Atlas:
    """A graph whose nodes are submaps and whose edges are links. Nothing is ever deleted."""

    def __init__(self) -> None:
        self.submaps: dict[int, Submap] = {}
        self.links: list[Link] = []

    def add(self, submap: Submap) -> None:
        """Take a submap in."""
        if submap.id in self.submaps:
            raise ValueError(f"submap {submap.id} is in the atlas already")
        self.submaps[submap.id] = submap

    def link(self, link: Link) -> None:
        """Join two submaps."""
        self.links.append(link)

    def components(self) -> list[list[int]]:
        """Return the linked sets of submaps, each ascending, in order of their first submap."""
        component = {m: m for m in self.submaps}
        for link in self.links:
            old, new = sorted((component[link.a], component[link.b]), reverse=True)
            component = {m: new if c == old else c for m, c in component.items()}
        roots = sorted(set(component.values()))
        return [[m for m in sorted(self.submaps) if component[m] == root] for root in roots]

    def S_world_submap(self, component: list[int]) -> dict[int, FloatArray]:
        """Return the transform of each submap of a linked set into the frame of its first one.

        Parameters
        ----------
        component : list of int
            Submap ids; links that lead out of it are not followed.
        """
        found: dict[int, FloatArray] = {component[0]: np.eye(4)}
        grown = True
        while grown:
            grown = False
            for link in self.links:
                if link.a not in component or link.b not in component:
                    continue
                if link.a in found and link.b not in found:
                    found[link.b] = found[link.a] @ link.S_a_b
                    grown = True
                elif link.b in found and link.a not in found:
                    found[link.a] = found[link.b] @ sim3.inverse(link.S_a_b)
                    grown = True
        return found
