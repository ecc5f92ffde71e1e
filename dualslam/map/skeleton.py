"""The atlas as a graph over Sim(3): a sparse skeleton of each submap's keyframes, and the connections between them.

Each tenth keyframe of a submap is a node, those at which connections are attached, and those of its gauge. Neighbours
along the frames are tied by what the submap itself says of them, and so are places between which many landmarks are
shared: where a camera looks at the same desk all the time, the map is stiff. What earlier solutions have bent is taken
out of these measurements (`Atlas.warps`): a bend is no evidence.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import dataclass

import numpy as np

from dualslam.core.atlas_problem import AtlasEdge, AtlasProblem
from dualslam.core.chi_square import CHI2_999, squared_distances
from dualslam.core.geometry import se3, sim3, so3
from dualslam.core.types import BoolArray, FloatArray
from dualslam.map.atlas import Atlas, Link, joined
from dualslam.map.edge_covariances import Covariances, EdgeCovariances
from dualslam.map.submap import Submap

WITHIN = "within"
"""The kind of an edge between keyframes of one submap."""
STRIDE = 10
"""Keyframes from one node to the next."""
MIN_SHARED, MAX_ACROSS = 30, 2
"""Landmarks that two nodes which are no neighbours share at least to be tied; so many such ties a node looks for."""
DRIFT, MODEL_SHARE = 2.0, 0.01
"""What a submap's factors say of its inner similarities is not all: pixels know nothing of a lens that is not quite the
one that was assumed, or of a shutter. Sigmas are taken `DRIFT` times, and to them comes a share of the motion (turn in
radians, way in depths of the scene). Chosen on `tum_fr1_rpy`, `hololens_000` and two rendered streets, at 10 and 20
keyframes: RMS errors over what the factors say are 0.8 to 2.2 where the camera is exact, 2.4 to 18 on the sequences.
With these numbers they are 0.03 to 0.3, and 0.7 to 2.5 (a submap with a broken stretch: to 5)."""

Node = tuple[int, int]
"""Submap and keyframe."""


@dataclass(frozen=True, slots=True, eq=False)
class Skeleton:
    """A connected piece of the atlas as a problem, and what its rows stand for.

    Attributes
    ----------
    component : list of int
        Submaps, ascending.
    problem : AtlasProblem
    nodes : list of (int, int)
        Submap and keyframe of each row.
    reference : dict of int to int
        For each submap the row of the keyframe that its frame goes by.
    links : list of Link
        Those of its edges that are connections, in order; the last edges of the problem.
    is_tree : bool
        Whether there is one way only between any two of its submaps, and none was ever bent: nothing to optimise.
    T_submap_node : (N, 4, 4)
        Keyframe to submap.
    steps : dict of int to (K - 1, 7, 7)
        For each submap the covariances from node to node, as its own factors give them (a tree: of no meaning).
    """

    component: list[int]
    problem: AtlasProblem
    nodes: list[Node]
    reference: dict[int, int]
    links: list[Link]
    is_tree: bool
    T_submap_node: FloatArray
    steps: dict[int, FloatArray]

    def knots(self, submap_id: int) -> tuple[list[int], list[int]]:
        """Return rows and keyframes of a submap's nodes, ascending."""
        rows = [row for row, (m, _) in enumerate(self.nodes) if m == submap_id]
        return rows, [self.nodes[row][1] for row in rows]


def build_skeleton(
    atlas: Atlas,
    component: list[int],
    links: Sequence[Link],
    covariances: Covariances,
    known: Callable[[Link], bool],
    more_nodes: Mapping[int, set[int]] | None = None,
    with_covariances: bool = False,
    newest: Mapping[int, int] | None = None,
) -> Skeleton:
    """Make the problem of a linked set of submaps.

    Parameters
    ----------
    atlas : Atlas
    component : list of int
        Submaps that `links` join.
    links : sequence of Link
        All between them, also those that are rejected so far, in the order in which they arrived.
    covariances : callable
        See `EdgeCovariances`.
    known : callable
        Whether an earlier solution has believed a link.
    more_nodes : mapping of int to set of int, optional
        Keyframes, by submap, that are to be nodes besides.
    with_covariances : bool
        Ask for them also where there is nothing to optimise.
    newest : mapping of int to int, optional
        By submap, the keyframe after which none is a node unless a link stands there.
    """
    knots_of = _knots_of(atlas, component, links, more_nodes or {}, newest or {})
    S_world_submap = _initial(atlas, component, links)
    is_tree = _is_tree(atlas, component, links)
    nodes: list[Node] = []
    S_world_node: list[FloatArray] = []
    T_submap_node: list[FloatArray] = []
    edges: list[AtlasEdge] = []
    steps: dict[int, FloatArray] = {}
    reference: dict[int, int] = {}
    for m in component:
        submap = atlas.submaps[m]
        knots = knots_of[m]
        first = len(nodes)
        reference[m] = first + knots.index(_reference(submap))
        nodes += [(m, k) for k in knots]
        T = submap.keyframe_poses(knots)
        S_world_node += list(S_world_submap[m] @ T)
        T_submap_node += list(T)
        within, steps[m] = _within(
            atlas, submap, knots, first, None if is_tree and not with_covariances else covariances
        )
        edges += within
    edges += _across(atlas, links, knots_of, {node: i for i, node in enumerate(nodes)}, known)
    problem = AtlasProblem(np.array(S_world_node), reference[component[0]], tuple(edges))
    return Skeleton(component, problem, nodes, reference, list(links), is_tree, np.array(T_submap_node), steps)


def foresee_skeleton(atlas: Atlas, component: list[int], links: Sequence[Link], covariances: EdgeCovariances) -> None:
    """Have computed beside the tracking what `build_skeleton` would ask for."""
    if _is_tree(atlas, component, links):
        return
    for m, knots in _knots_of(atlas, component, links, {}, {}).items():
        submap = atlas.submaps[m]
        pairs = [(knots[i], knots[j]) for i, j in _places(submap, knots)]
        covariances.foresee(submap, pairs, atlas.held.get(m, frozenset()))


def _is_tree(atlas: Atlas, component: list[int], links: Sequence[Link]) -> bool:
    return len(links) < len(component) and not any(m in atlas.warps for m in component)


def _knots_of(
    atlas: Atlas,
    component: list[int],
    links: Sequence[Link],
    more_nodes: Mapping[int, set[int]],
    newest: Mapping[int, int],
) -> dict[int, list[int]]:
    wanted: dict[int, set[int]] = {m: set(more_nodes.get(m, set())) for m in component}
    for link in links:
        if not link.rejected:
            k_a, k_b = link.attached(atlas)
            wanted[link.a].add(k_a)
            wanted[link.b].add(k_b)
    return {m: skeleton_knots(atlas.submaps[m], wanted[m], newest.get(m)) for m in component}


def _initial(atlas: Atlas, component: list[int], links: Sequence[Link]) -> dict[int, FloatArray]:
    """Return where each submap stands, links that are new followed too."""
    trial = Atlas()
    trial.submaps = {m: atlas.submaps[m] for m in component}
    home = joined(component, [link for link in links if not link.rejected and link in atlas.links])[0]
    trial.placement = {m: atlas.placement[m] for m in home if m in atlas.placement}
    trial.links = [link for link in links if not link.rejected]
    return trial.S_world_submap(component)


def skeleton_knots(submap: Submap, wanted: Set[int] = frozenset(), newest: int | None = None) -> list[int]:
    """Return the keyframes of a submap that are nodes, ascending, none after `newest`; `wanted` ones besides."""
    ids = sorted(submap.keyframes)
    ids = [k for k in ids if newest is None or k <= newest] or ids
    return sorted({*ids[::STRIDE], ids[-1], _reference(submap), *wanted})


def _nearest(knots: list[int], k: int) -> int:
    return min(knots, key=lambda knot: (abs(knot - k), knot))


def _reference(submap: Submap) -> int:
    """Return the keyframe that a submap's frame goes by: the first of its gauge."""
    k = submap.gauge[0]
    while k not in submap.keyframes and k in submap.anchors:
        k = submap.anchors[k].keyframe_id
    return k if k in submap.keyframes else min(submap.keyframes)


def _within(
    atlas: Atlas, submap: Submap, knots: list[int], first: int, covariances: Covariances | None
) -> tuple[list[AtlasEdge], FloatArray]:
    """Tie a submap's nodes to each other, as it says itself; return also what its factors say from node to node."""
    places = _neighbours(knots) if covariances is None else _places(submap, knots)
    pairs = [(knots[i], knots[j]) for i, j in places]
    if covariances is None:  # in a tree no edge pulls at another, whatever they are
        own_C = C = np.broadcast_to(np.eye(7), (len(pairs), 7, 7))
    else:
        own_C = covariances(submap, pairs, atlas.held.get(submap.id, frozenset()))
        C = _inflated(submap, pairs, own_C)
    i, j = np.array(places, np.int64).reshape(-1, 2).T
    T = submap.keyframe_poses(knots)
    S = sim3.inverse(atlas.warps[submap.id].at(knots)) @ T if submap.id in atlas.warps else T
    own, now = (sim3.inverse(at[i]) @ at[j] for at in (S, T))
    kept = (j == i + 1) | ~_are_torn(own, now, C)
    edges = [
        AtlasEdge(first + int(i[n]), first + int(j[n]), own[n], C[n], WITHIN) for n in np.flatnonzero(kept).tolist()
    ]
    return edges, own_C[: len(knots) - 1]


def _neighbours(knots: list[int]) -> list[tuple[int, int]]:
    return [(i, i + 1) for i in range(len(knots) - 1)]


def _places(submap: Submap, knots: list[int]) -> list[tuple[int, int]]:
    """Return which of a submap's nodes are tied, by their places among them: the neighbours first."""
    return _neighbours(knots) + _across_knots(submap, knots)


def _are_torn(own: FloatArray, now: FloatArray, covariances: FloatArray) -> BoolArray:
    """Whether two places of each pair were bent together that nothing tied at the time.

    What they share now came of that: landmarks of a loop that became one. The loop's own factor says it, and a tie
    that had the bend taken out of it would deny it.
    """
    off = sim3.log(sim3.inverse(own) @ now)
    return squared_distances(off, covariances) > CHI2_999[7]


def _inflated(submap: Submap, pairs: list[tuple[int, int]], covariances: FloatArray) -> FloatArray:
    """Return the covariances of edges with what the factors do not know."""
    if not pairs:
        return covariances
    first, second = np.array(pairs).T.tolist()
    T = se3.inverse(submap.keyframe_poses(first)) @ submap.keyframe_poses(second)
    depth_of, distance_mu = {}, submap.landmarks["distance_mu"]
    for k in set(second):
        ids = submap.landmark_of[k]
        ids = ids[ids >= 0]
        depth_of[k] = float(np.median(distance_mu[ids])) if len(ids) else 1.0
    depth = np.array([depth_of[k] for k in second])
    motion = np.linalg.norm(so3.log(T[:, :3, :3]), axis=1) + np.linalg.norm(T[:, :3, 3], axis=1) / depth
    units = np.ones((len(pairs), 7))
    units[:, 3:6] = depth[:, None]
    model: FloatArray = (MODEL_SHARE * motion[:, None] * units) ** 2
    return DRIFT**2 * covariances + model[:, :, None] * np.eye(7)


def _across_knots(submap: Submap, knots: list[int]) -> list[tuple[int, int]]:
    """Return pairs of nodes that are no neighbours and yet see the same landmarks."""
    seen = [ids[ids >= 0] for ids in (submap.landmark_of[k] for k in knots)]
    any_sees = np.zeros(len(submap.landmarks), bool)
    any_sees[np.concatenate(seen)] = True
    column = np.cumsum(any_sees) - 1
    sees = np.zeros((len(knots), np.count_nonzero(any_sees)), np.float32)
    for i, ids in enumerate(seen):
        sees[i, column[ids]] = 1
    shared = sees @ sees.T
    place = np.arange(len(knots))
    shared[np.abs(place[:, None] - place) <= 1] = 0
    found: set[tuple[int, int]] = set()
    for i, row in enumerate(shared):
        best = np.argsort(-row, kind="stable")[:MAX_ACROSS]
        found |= {(min(i, j), max(i, j)) for j in best[row[best] >= MIN_SHARED].tolist()}
    return sorted(found)


def _across(
    atlas: Atlas,
    links: Sequence[Link],
    knots_of: Mapping[int, list[int]],
    row: Mapping[Node, int],
    known: Callable[[Link], bool],
) -> list[AtlasEdge]:
    """Make the factors of connections."""
    if not links:
        return []
    ends: list[tuple[Node, Node]] = []
    for link in links:
        k_a, k_b = link.attached(atlas)
        if link.rejected:  # it is asked again, but adds no node: what does not count changes nothing
            k_a, k_b = _nearest(knots_of[link.a], k_a), _nearest(knots_of[link.b], k_b)
        ends.append(((link.a, k_a), (link.b, k_b)))
    T_a, T_b = (np.array([atlas.submaps[m].T_submap_kf[k] for m, k in side]) for side in zip(*ends, strict=True))
    S_ka_kb = sim3.inverse(T_a) @ np.array([link.S_a_b for link in links]) @ T_b
    Ad = sim3.adjoint(sim3.inverse(T_b))
    C = Ad @ np.array([link.covariance for link in links]) @ Ad.transpose(0, 2, 1)
    C = 0.5 * (C + C.transpose(0, 2, 1))
    return [
        AtlasEdge(row[a], row[b], S_ka_kb[i], C[i], str(link.kind), link.doubtful, known(link))
        for i, (link, (a, b)) in enumerate(zip(links, ends, strict=True))
    ]
