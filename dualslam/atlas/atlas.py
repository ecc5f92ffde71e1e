"""The submaps of a run, the Sim(3) connections between them, and where the solution has put them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from dualslam.atlas.warp import Warp
from dualslam.core.geometry import se3, sim3
from dualslam.core.types import FloatArray
from dualslam.map.submap import Submap

ROLLOVER_SIGMAS = np.array([1e-3] * 3 + [2e-3] * 3 + [2e-3])
"""How far a submap that has rolled over and its full predecessor may come apart where they share keyframes (rad, unit
of the submap, log-scale): stiffer than ten keyframes of either, and yet to be bent by a loop."""


class LinkKind(StrEnum):
    """Where a link comes from."""

    ROLLOVER = "rollover"
    RECOVERY = "recovery"
    LOOP = "loop"
    MERGE = "merge"


@dataclass(frozen=True, slots=True, eq=False)
class Link:
    """A connection: a Sim(3) between two submaps, or two places of one, measured about two keyframes.

    Attributes
    ----------
    a, b : int
        Submap ids; equal for a loop within a submap.
    S_a_b : (4, 4) float64
        ``[[s R, t], [0, 1]]``: ``p_a = S_a_b @ p_b``, in the submaps' current frames.
    covariance : (7, 7) float64
        Of the right perturbation ``S_a_b @ exp(xi)``: rotation, translation, log-scale, in the frame and unit of b.
    kind : LinkKind
    keyframes : tuple of int
        Shared keyframes that it stands on, ascending; none where the submaps share no frames.
    keyframe_a, keyframe_b : int
        The keyframes between which its factor stands; -1: the newest of `keyframes` that is there.
    doubtful : bool
        Whether it may be rejected where others contradict it.
    rejected : bool
        The atlas does not believe it: it joins nothing, but is asked again at each solution.
    is_sure : bool
        Whether its scale may be relied on: if not, what lies beyond it has a doubt.
    """

    a: int
    b: int
    S_a_b: FloatArray
    covariance: FloatArray
    kind: LinkKind
    keyframes: tuple[int, ...] = ()
    keyframe_a: int = -1
    keyframe_b: int = -1
    doubtful: bool = True
    rejected: bool = False
    is_sure: bool = True

    @classmethod
    def of_rollover(cls, full: Submap, following: Submap) -> Link:
        """Join a full submap and the next, which starts in its frame: stiff, but not rigid."""
        shared = tuple(sorted(full.keyframes.keys() & following.keyframes.keys()))
        middle = shared[len(shared) // 2]
        covariance = rollover_covariance(following, middle)
        return cls(
            full.id, following.id, se3.IDENTITY, covariance, LinkKind.ROLLOVER, shared, middle, middle, doubtful=False
        )

    @classmethod
    def of_keyframes(
        cls,
        atlas: Atlas,
        a: tuple[int, int],
        b: tuple[int, int],
        S_ka_kb: FloatArray,
        covariance: FloatArray,
        kind: LinkKind,
        doubtful: bool = True,
    ) -> Link:
        """Make the link of a similarity that was measured between two keyframes.

        - `a`, `b` (int, int): submap and keyframe.
        - `S_ka_kb` (4, 4): from the second keyframe's frame to the first one's, in the units of their submaps.
        - `covariance` (7, 7): of ``S_ka_kb @ exp(xi)``: in the second keyframe's frame.
        """
        T_a, T_b = atlas.submaps[a[0]].T_submap_kf[a[1]], atlas.submaps[b[0]].T_submap_kf[b[1]]
        Ad = sim3.adjoint(T_b)
        S_a_b = T_a @ S_ka_kb @ sim3.inverse(T_b)
        return cls(a[0], b[0], S_a_b, Ad @ covariance @ Ad.T, kind, (), a[1], b[1], doubtful)

    @property
    def sigma_scale(self) -> float:
        """Standard deviation of the logarithm of its scale, which is the same in any frame."""
        return float(np.sqrt(self.covariance[6, 6]))

    def attached_as(self, other: Link) -> bool:
        """Whether it is the same connection as another state of it."""
        places = ((k.a, k.b, k.keyframe_a, k.keyframe_b, k.keyframes, k.kind) for k in (self, other))
        return next(places) == next(places)

    def attached(self, atlas: Atlas) -> tuple[int, int]:
        """Return the keyframes of a and b that its factor stands between, as they are there now."""
        a, b = atlas.submaps[self.a], atlas.submaps[self.b]
        return _present(a, self.keyframe_a, self.keyframes), _present(b, self.keyframe_b, self.keyframes)


class Atlas:
    """Submaps and the links between them. Nothing is ever deleted.

    Attributes
    ----------
    submaps : dict of int to Submap
    links : list of Link
        In the order in which they came.
    placement : dict of int to (4, 4)
        Where the last solution has put the submaps of linked sets with cycles: into the frame of the set's first.
        Sets without one need no solution: links are composed.
    warps : dict of int to Warp
        How solutions have bent submaps so far: from what their own graphs say to where their keyframes stand.
    held : dict of int to frozenset of int
        Keyframes whose `Submap.relative_poses` hold a bend: they are no evidence of their own.
    """

    def __init__(self) -> None:
        self.submaps: dict[int, Submap] = {}
        self.links: list[Link] = []
        self.placement: dict[int, FloatArray] = {}
        self.warps: dict[int, Warp] = {}
        self.held: dict[int, frozenset[int]] = {}

    def add(self, submap: Submap) -> None:
        """Take a submap in."""
        if submap.id in self.submaps:
            raise ValueError(f"submap {submap.id} is in the atlas already")
        self.submaps[submap.id] = submap

    def link(self, link: Link) -> None:
        """Join two submaps."""
        self.links.append(link)

    @property
    def believed(self) -> list[Link]:
        """The links that join something."""
        return [link for link in self.links if not link.rejected]

    def components(self, sure: bool = False) -> list[list[int]]:
        """Return the linked sets of submaps (`sure`: by sure connections), each ascending, in order of their first
        submap.
        """
        return joined(self.submaps, [link for link in self.believed if link.is_sure or not sure])

    def largest(self, n_frames: Mapping[int, int]) -> list[int]:
        """Return the linked set with most frames, by the number of those that each submap has posed."""
        return max(self.components(), key=lambda c: sum(n_frames[m] for m in c), default=[])

    def component_of(self, submap_id: int, sure: bool = False) -> list[int]:
        """Return the linked set of a submap, ascending; `sure`: as for `components`."""
        return next(component for component in self.components(sure) if submap_id in component)

    def S_world_submap(self, component: list[int]) -> dict[int, FloatArray]:
        """Return the transform of each submap of a linked set (`component`) into the frame of its first one."""
        found: dict[int, FloatArray] = {component[0]: np.eye(4)}
        if component[0] in self.placement:
            S_first_world = sim3.inverse(self.placement[component[0]])
            every = {m for link in self.believed for m in (link.a, link.b)} | set(component)
            own = next(c for c in joined(every, self.believed) if component[0] in c)
            found |= {m: S_first_world @ self.placement[m] for m in component[1:] if m in own and m in self.placement}
        grown = True
        while grown:
            grown = False
            for link in self.believed:
                if link.a not in component or link.b not in component:
                    continue
                if link.a in found and link.b not in found:
                    found[link.b] = found[link.a] @ link.S_a_b
                    grown = True
                elif link.b in found and link.a not in found:
                    found[link.a] = found[link.b] @ sim3.inverse(link.S_a_b)
                    grown = True
        return found


def rollover_covariance(following: Submap, keyframe_id: int) -> FloatArray:
    """Return the (7, 7) covariance of a rollover's link: `ROLLOVER_SIGMAS` at a keyframe that both submaps share.

    Taken for sigmas at the origin of the coordinates, which lies far behind, they would let the seam turn about that.
    """
    Ad = sim3.adjoint(following.T_submap_kf[keyframe_id])
    return np.asarray(Ad @ np.diag(ROLLOVER_SIGMAS**2) @ Ad.T)


def joined(submap_ids: Iterable[int], links: Iterable[Link]) -> list[list[int]]:
    """Return the sets of submaps that links join, each ascending, in order of their first submap."""
    ids = sorted(submap_ids)
    component = {m: m for m in ids}
    for link in links:
        old, new = sorted((component[link.a], component[link.b]), reverse=True)
        if old != new:
            component = {m: new if c == old else c for m, c in component.items()}
    roots = sorted(set(component.values()))
    return [[m for m in ids if component[m] == root] for root in roots]


def _present(submap: Submap, keyframe_id: int, shared: tuple[int, ...]) -> int:
    """Return the keyframe of a submap at which a link is attached, or its heir; by default the newest."""
    wanted = [keyframe_id] if keyframe_id >= 0 else sorted(shared, reverse=True)
    known = [k for k in wanted if k in submap.keyframes or k in submap.anchors]
    return submap.keyframe_for(known[0]) if known else max(submap.keyframes)
