"""How two keyframes stand to each other through a whole atlas, and how sure that is: for tests that know the truth."""

from __future__ import annotations

from dualslam.atlas.atlas import Atlas
from dualslam.atlas.node_views import NodeViews
from dualslam.atlas.skeleton import Node, build_skeleton
from dualslam.core.atlas_problem import AtlasSolver
from dualslam.core.errors import SolverError
from dualslam.core.geometry import sim3
from dualslam.core.types import FloatArray


def relative_similarity(atlas: Atlas, solver: AtlasSolver, a: Node, b: Node) -> tuple[FloatArray, FloatArray]:
    """Return ``S_ka_kb`` between two keyframes, each a submap and an id there, and its (7, 7) covariance.

    It goes by all connections that are believed, also across submaps.

    Raises
    ------
    SolverError
        If the two are not connected, or the solver cannot tell.
    """
    component = atlas.component_of(a[0])
    if b[0] not in component:
        raise SolverError(f"submaps {a[0]} and {b[0]} are not connected: keyframes in them have no relative pose")
    links = [link for link in atlas.believed if link.a in component]
    more_nodes = {m: {k for n, k in (a, b) if n == m} for m in (a[0], b[0])}
    skeleton = build_skeleton(
        atlas,
        component,
        links,
        solver.edge_covariances,
        NodeViews(),
        known=lambda link: True,
        more_nodes=more_nodes,
        with_covariances=True,
    )
    first, second = (skeleton.nodes.index(node) for node in (a, b))
    S = skeleton.problem.S_world_node
    return sim3.inverse(S[first]) @ S[second], solver.relative_covariances(skeleton.problem, first)[second]
