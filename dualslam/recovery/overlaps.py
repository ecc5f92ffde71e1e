"""Links between maps of one set that hold the same keyframes, though other places have joined them.

Reverse tracking refuses a link that hands the scale on too loosely to the live end. If a place joins the two maps
elsewhere, their overlap closes a cycle. By it the atlas can tell where on the way a map is bent.
"""

from __future__ import annotations

from collections.abc import Iterator, Set
from itertools import combinations

import numpy as np

from dualslam.atlas.atlas import Link, LinkKind
from dualslam.atlas.connections import Connections
from dualslam.atlas.record import FrameStamp, Record
from dualslam.core.config.settings import Config
from dualslam.core.events import EventKind
from dualslam.core.types import Failure
from dualslam.linking import LinkRefusal, estimate_link
from dualslam.map.split import sound_copy


def link_overlaps(record: Record, connections: Connections, config: Config, own: Set[int], now: FrameStamp) -> None:
    """Link the submaps of each set where they hold the same keyframes, when the run is over.

    `own`: the submaps of this run.
    """
    with record.timer.measure("overlaps"):
        for component in record.atlas.components():
            if links := list(_overlaps(record, [m for m in component if m in own], config)):
                connections.connect(links, now)


def _overlaps(record: Record, submap_ids: list[int], config: Config) -> Iterator[Link]:
    """Yield links between submaps, ascending, over the keyframes that both hold, where none stands on these yet."""
    submaps = record.atlas.submaps
    onsets = {event.submap: event.data["suspected_since"] for event in record.events.of_kind(EventKind.FAILED)}
    linked = {frozenset((link.a, link.b)) for link in record.atlas.believed if link.keyframes}
    for a, b in combinations(submap_ids, 2):
        n_shared = len(submaps[a].keyframes.keys() & submaps[b].keyframes.keys())
        if n_shared < config.linking.min_keyframes or {a, b} in linked:
            continue
        old, new = (sound_copy(submaps[m]) for m in (a, b))
        found = estimate_link(old, new, config.linking, np.random.default_rng(config.seed), onsets.get(a))
        link = found.unsure or found if isinstance(found, LinkRefusal) else found
        if not isinstance(link, Failure):
            known = link.S_old_new, link.covariance, LinkKind.RECOVERY, tuple(link.agreeing_keyframes.tolist())
            yield Link(a, b, *known, doubtful=False, is_sure=link is found)
