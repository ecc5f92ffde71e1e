"""Problems of the atlas: whole linked sets to be solved, and the covariances that they need."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

from dualslam.atlas.atlas import Link, joined
from dualslam.atlas.edge_covariances import Covariances, EdgeCovariances
from dualslam.atlas.node_views import NodeViews
from dualslam.atlas.record import Record
from dualslam.atlas.skeleton import Skeleton, build_skeleton, foresee_skeleton, skeleton_knots
from dualslam.core.atlas_problem import AtlasSolver
from dualslam.core.jobs import Desk


class AtlasProblems:
    """Makes the problems of the linked sets that connections touch.

    `desk`: where covariances are computed that a problem to come will need.

    Attributes
    ----------
    covariances : EdgeCovariances
        What the submaps say of their own edges.
    views : NodeViews
        What their nodes see.
    """

    def __init__(self, record: Record, solver: AtlasSolver, desk: Desk) -> None:
        self._record = record
        self.covariances = EdgeCovariances(solver.edge_covariances, desk)
        self.views = NodeViews()
        self._newest: dict[int, int] = {}  # by submap: its newest keyframe at the last request

    def foresee(self, touched: set[int], new: Sequence[Link]) -> None:
        """Compute in the background what the solution with connections to come needs of the submaps."""
        atlas = self._record.atlas
        for component, links in self._touched(touched, new):
            foresee_skeleton(atlas, component, links, self.covariances, self.views)
        # What has come by the time that they are there goes with the keyframes that were asked about.
        self._newest = {m: max(submap.keyframes) for m, submap in atlas.submaps.items()}

    def foresee_rollover(self, submap_id: int) -> None:
        """Ask a full submap for its covariances now: the first loop of a long run would wait for those of all."""
        atlas = self._record.atlas
        submap = atlas.submaps[submap_id]
        pairs = list(pairwise(skeleton_knots(submap)))
        self.covariances.foresee(submap, pairs, atlas.held.get(submap_id, frozenset()))

    @property
    def foreseeing(self) -> bool:
        """Whether that is still being computed."""
        return self.covariances.foreseeing

    def now(self, touched: set[int], new: Sequence[Link]) -> list[Skeleton]:
        """Make the problems of all linked sets that are touched, as the submaps are now.

        Raises `SolverError` if a submap cannot tell its covariances.
        """
        self._newest = {}
        return self._make(touched, new, self.covariances)

    def foreseen(self, touched: set[int], new: Sequence[Link], again: bool) -> list[Skeleton]:
        """Make them with what was prefetched; `again`: with covariances that hold for the current submaps.

        Raises `SolverError`: as for `now`.
        """
        skeletons = self._make(touched, new, self.covariances if again else self.covariances.as_foreseen)
        self._newest = {}
        return skeletons

    def _make(self, touched: set[int], new: Sequence[Link], covariances: Covariances) -> list[Skeleton]:
        fresh = set(map(id, new))

        def known(link: Link) -> bool:
            return id(link) not in fresh and not link.rejected

        return [
            build_skeleton(self._record.atlas, component, links, covariances, self.views, known, newest=self._newest)
            for component, links in self._touched(touched, new)
        ]

    def _touched(self, touched: set[int], new: Sequence[Link]) -> Iterator[tuple[list[int], list[Link]]]:
        """Give the linked sets that new connections make of what they touch, each with its connections."""
        atlas = self._record.atlas
        links = [*atlas.links, *new]
        for component in joined(atlas.submaps, links):
            if touched & set(component):
                yield component, [link for link in links if link.a in component]
