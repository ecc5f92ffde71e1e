"""The atlas as a graph over Sim(3): a sparse skeleton of each submap's keyframes, and the connections between them.

Nodes are each tenth keyframe of a submap, those of its gauge, and those at which connections are attached. Neighbours
along the frames are tied by what the submap itself says of them, and so are places that share many landmarks. What
earlier solutions have bent is taken out of these measurements (`Atlas.warps`): a bend is no evidence.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import dataclass

import numpy as np

from dualslam.atlas.atlas import Atlas, Link, joined
from dualslam.atlas.edge_covariances import Covariances, EdgeCovariances
from dualslam.atlas.node_views import NodeView, NodeViews
from dualslam.core.atlas_problem import AtlasEdges, AtlasProblem
from dualslam.core.chi_square import CHI2_999, squared_distances
from dualslam.core.geometry import se3, sim3, so3
from dualslam.core.types import BoolArray, FloatArray, IntArray
from dualslam.map.submap import Submap

WITHIN = "within"
"""The kind of an edge between keyframes of one submap."""
STRIDE = 10
"""Keyframes from one node to the next."""
DRIFT, MODEL_SHARE = 2.0, 0.01
"""What a submap's factors say of its inner similarities is not all: pixels know nothing of a wrong lens or shutter.
Sigmas are taken `DRIFT` times, and to them comes a share of the motion (turn in radians, way in depths of the scene).
With these, errors on `tum_fr1_rpy`, `hololens_000` and two rendered streets are 0.03 to 2.5 sigmas (5 for a broken
submap)."""

Node = tuple[int, int]
"""Submap and keyframe."""


@dataclass(frozen=True, slots=True, eq=False)
class Skeleton:
    """A connected piece of the atlas as a problem, and what its rows stand for."""

    component: list[int]  # submaps, ascending
    problem: AtlasProblem
    nodes: list[Node]  # list of (int, int): submap and keyframe of each row
    rows: dict[int, range]  # where the nodes of each submap are
    reference: dict[int, int]  # for each submap the row of the keyframe that its frame goes by
    links: list[Link]  # those of its edges that are connections, in order; the last edges of the problem
    is_tree: bool
    """Whether there is one way only between any two of its submaps, and none was ever bent: nothing to optimise."""
    T_submap_node: FloatArray  # (N, 4, 4): keyframe to submap
    steps: dict[int, FloatArray]
    """dict of int to (K - 1, 7, 7): by submap, covariances from node to node, as its own factors give them."""

    def knots(self, submap_id: int) -> tuple[list[int], list[int]]:
        """Return rows and keyframes of a submap's nodes, ascending."""
        rows = list(self.rows[submap_id])
        return rows, [self.nodes[row][1] for row in rows]


def build_skeleton(
    atlas: Atlas,
    component: list[int],
    links: Sequence[Link],
    covariances: Covariances,
    views: NodeViews,
    known: Callable[[Link], bool],
    more_nodes: Mapping[int, set[int]] | None = None,
    with_covariances: bool = False,
    newest: Mapping[int, int] | None = None,
) -> Skeleton:
    """Make the problem of a linked set of submaps.

    - `component`: submaps that `links` join.
    - `links`: all between them, also those that are rejected so far, in the order in which they arrived.
    - `covariances`: see `EdgeCovariances`.
    - `views`: what is remembered of the submaps.
    - `known`: whether an earlier solution has believed a link.
    - `more_nodes`: keyframes, by submap, that are to be nodes besides.
    - `with_covariances`: ask for them also where there is nothing to optimise.
    - `newest`: by submap, the keyframe after which none is a node unless a link stands there.
    """
    knots_of = _knots_of(atlas, component, links, more_nodes or {}, newest or {})
    S_world_submap = _initial(atlas, component, links)
    is_tree = _is_tree(atlas, component, links)
    by_own_factors = with_covariances or not is_tree
    nodes: list[Node] = []
    rows: dict[int, range] = {}
    reference: dict[int, int] = {}
    of_submap: dict[int, NodeView] = {}
    for m, knots in knots_of.items():
        rows[m] = range(len(nodes), len(nodes) + len(knots))
        reference[m] = len(nodes) + knots.index(_reference(atlas.submaps[m]))
        nodes += [(m, k) for k in knots]
        if by_own_factors:
            of_submap[m] = views(atlas.submaps[m], knots, atlas.warps.get(m))
    T = np.concatenate([atlas.submaps[m].keyframe_poses(knots) for m, knots in knots_of.items()])
    S_world_node = np.concatenate([S_world_submap[m] @ T[rows[m].start : rows[m].stop] for m in component])
    within, steps = _within(atlas, of_submap, rows, T, covariances) if by_own_factors else _along(rows, T)
    across = _across(atlas, links, knots_of, {node: i for i, node in enumerate(nodes)}, known)
    problem = AtlasProblem(S_world_node, reference[component[0]], _joined_edges(within, across))
    return Skeleton(component, problem, nodes, rows, reference, list(links), is_tree, T, steps)


def foresee_skeleton(
    atlas: Atlas, component: list[int], links: Sequence[Link], covariances: EdgeCovariances, views: NodeViews
) -> None:
    """Compute in the background what `build_skeleton` would ask for."""
    if _is_tree(atlas, component, links):
        return
    for m, knots in _knots_of(atlas, component, links, {}, {}).items():
        submap = atlas.submaps[m]
        pairs = views(submap, knots, atlas.warps.get(m)).pairs
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
    taken_in = set(map(id, atlas.links))
    home = joined(component, [link for link in links if not link.rejected and id(link) in taken_in])[0]
    trial.placement = {m: atlas.placement[m] for m in home if m in atlas.placement}
    trial.links = [link for link in links if not link.rejected]
    return trial.S_world_submap(component)


def skeleton_knots(submap: Submap, wanted: Set[int] = frozenset(), newest: int | None = None) -> list[int]:
    """Return the keyframes of a submap that are nodes, ascending, none after `newest`; `wanted` ones besides."""
    ids = sorted(submap.keyframes)
    ids = [k for k in ids if newest is None or k <= newest] or ids
    return sorted({*ids[::STRIDE], ids[-1], _reference(submap), *wanted})


def _reference(submap: Submap) -> int:
    """Return the keyframe that a submap's frame goes by: the first of its gauge."""
    return submap.living_keyframe(submap.gauge[0])


def _nearest(knots: list[int], k: int) -> int:
    return min(knots, key=lambda knot: (abs(knot - k), knot))


def _within(
    atlas: Atlas, views: Mapping[int, NodeView], rows: Mapping[int, range], T: FloatArray, covariances: Covariances
) -> tuple[AtlasEdges, dict[int, FloatArray]]:
    """Tie the nodes of submaps to each other, as these say themselves; also return what their factors say."""
    S, depth = T.copy(), np.empty(len(T))
    steps: dict[int, FloatArray] = {}
    all_own_C: list[FloatArray] = []
    ends: list[IntArray] = []
    for m, view in views.items():
        here = slice(rows[m].start, rows[m].stop)
        own_C = covariances(atlas.submaps[m], view.pairs, atlas.held.get(m, frozenset()))
        steps[m] = own_C[: len(view.knots) - 1]
        all_own_C.append(own_C)
        ends.append(np.array(view.places, np.int64).reshape(-1, 2) + here.start)
        depth[here] = view.depth
        if view.unbend is not None:
            S[here] = view.unbend @ T[here]
    i, j = np.concatenate(ends).T
    C = _inflated(se3.inverse(T)[i] @ T[j], depth[j], np.concatenate(all_own_C))
    own = sim3.inverse(S)[i] @ S[j]
    kept = np.ones(len(i), bool)
    across = np.flatnonzero(j != i + 1)
    now = sim3.inverse(T)[i[across]] @ T[j[across]]
    kept[across] = ~_are_torn(own[across], now, C[across])
    return _edges_within(i[kept], j[kept], own[kept], C[kept]), steps


def _along(rows: Mapping[int, range], T: FloatArray) -> tuple[AtlasEdges, dict[int, FloatArray]]:
    """Tie the nodes of submaps along the frames: in a tree no edge pulls at another, whatever covariances they have."""
    i = np.concatenate([np.arange(here.start, here.stop - 1) for here in rows.values()])
    C = np.broadcast_to(np.eye(sim3.DOF), (len(i), sim3.DOF, sim3.DOF))
    steps = {m: np.broadcast_to(np.eye(sim3.DOF), (len(here) - 1, sim3.DOF, sim3.DOF)) for m, here in rows.items()}
    return _edges_within(i, i + 1, sim3.inverse(T)[i] @ T[i + 1], C), steps


def _edges_within(i: IntArray, j: IntArray, S: FloatArray, C: FloatArray) -> AtlasEdges:
    none = np.zeros(len(i), bool)
    return AtlasEdges(i, j, S, C, (WITHIN,) * len(i), none, none)


def _joined_edges(a: AtlasEdges, b: AtlasEdges) -> AtlasEdges:
    names = ("first", "second", "S_first_second", "covariance", "doubtful", "known")
    columns = {name: np.concatenate([getattr(a, name), getattr(b, name)]) for name in names}
    return AtlasEdges(kind=a.kind + b.kind, **columns)


def _are_torn(own: FloatArray, now: FloatArray, covariances: FloatArray) -> BoolArray:
    """Whether two places of each pair were bent together that nothing tied at the time: what they share resulted from
    that.
    """
    off = sim3.log(sim3.inverse(own) @ now)
    return squared_distances(off, covariances) > CHI2_999[sim3.DOF]


def _inflated(T: FloatArray, depth: FloatArray, covariances: FloatArray) -> FloatArray:
    """Return the covariances of edges with what the factors do not know.

    - `covariances` (E, 7, 7).
    - `T` (E, 4, 4): from the second keyframe to the first.
    - `depth` (E,): of the scene at the second.
    """
    motion = np.linalg.norm(so3.log(se3.rotation(T)), axis=1) + np.linalg.norm(se3.translation(T), axis=1) / depth
    units = np.ones((len(T), sim3.DOF))
    units[:, 3:6] = depth[:, None]
    model: FloatArray = (MODEL_SHARE * motion[:, None] * units) ** 2
    return DRIFT**2 * covariances + model[:, :, None] * np.eye(sim3.DOF)


def _across(
    atlas: Atlas,
    links: Sequence[Link],
    knots_of: Mapping[int, list[int]],
    row: Mapping[Node, int],
    known: Callable[[Link], bool],
) -> AtlasEdges:
    """Make the factors of connections."""
    if not links:
        return _edges_within(
            np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 4, 4)), np.zeros((0, sim3.DOF, sim3.DOF))
        )
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
    C = (C + C.transpose(0, 2, 1)) / 2
    return AtlasEdges(
        np.array([row[a] for a, _ in ends], np.int64),
        np.array([row[b] for _, b in ends], np.int64),
        S_ka_kb,
        C,
        tuple(str(link.kind) for link in links),
        np.array([link.doubtful for link in links], bool),
        np.array([known(link) for link in links], bool),
    )
