"""Where each submap lies in its world, for who follows a run as it goes on."""

from __future__ import annotations

from dualslam.atlas.atlas import Atlas
from dualslam.core.geometry import sim3
from dualslam.core.types import FloatArray


class Worlds:
    """The linked sets of an atlas, each with one world; composed anew only where a connection has come or moved.

    `saved`: the submap whose frame is the world of the saved map that a run continues.
    """

    def __init__(self, atlas: Atlas, saved: int | None = None) -> None:
        self._atlas = atlas
        self._saved = saved
        self._made_from: list[object] = []
        self._found: dict[int, tuple[FloatArray, int]] = {}
        self._sure: set[int] = set()

    def of(self, submap_id: int) -> tuple[FloatArray, int]:
        """Return where a submap lies in its world, and whose frame that is.

        Returns
        -------
        (4, 4) float64
            ``S_world_submap``, as it is known now.
        int
            The submap whose frame and unit the world has: the first of its linked set, or the saved map's.
        """
        self._compose()
        return self._found[submap_id]

    def is_sure(self, submap_id: int) -> bool:
        """Whether links whose scale may be relied on join a submap with the one whose unit its world has."""
        self._compose()
        return submap_id in self._sure

    def _compose(self) -> None:
        atlas = self._atlas
        state: list[object] = [*atlas.submaps.values(), *atlas.links, *atlas.placement.values()]
        same = len(state) == len(self._made_from) and all(map(lambda a, b: a is b, state, self._made_from))
        if not same:
            self._made_from, self._found, self._sure = state, {}, set()
            for component in atlas.components():
                S_first = atlas.S_world_submap(component)
                world = self._saved if self._saved in S_first else None
                S = S_first if world is None else {m: sim3.inverse(S_first[world]) @ S_first[m] for m in component}
                world = component[0] if world is None else world
                self._found |= {m: (S[m], world) for m in component}
                self._sure.update(atlas.component_of(world, sure=True))
