"""Observations that have died leave the table of a map that is still in use.

A camera that stays where it is inserts keyframes and culls them without end: of 1,000 frames before one desk 65,000
rows had died and 20,000 lived. What follows the rows by their numbers (a graph, the mirror of a replica) says which it
is done with, and hears which stay. Their order stays, so that what is made of the live ones is the same to the bit.
"""

from __future__ import annotations

import logging

import numpy as np

from dualslam.core.interfaces import RowFollower
from dualslam.map.submap import Submap

MIN_DEAD = 10_000
"""Dead rows at least: with what the graph knows of each they are 0.6 MB, and below it no operation over them counts."""

log = logging.getLogger(__name__)


def drop_dead_rows(submap: Submap, follower: RowFollower) -> int:
    """Take out of a submap's table the rows that are dead and followed no more, once they outnumber the live ones.

    The table is therefore never more than about twice as long as it must be. A drop costs a copy of the live rows; as
    many rows have come and died since the last one: a constant for each.

    `follower`: all that follows this submap by the numbers of its rows. (One that does not hear of it makes its state
    anew.)

    Returns int: how many rows have gone.
    """
    n, n_alive = len(submap.observations), int(np.count_nonzero(submap.observations["alive"]))
    least = max(MIN_DEAD, n_alive + 1)
    if n - n_alive < least:  # at most frames: the follower is not asked
        return 0
    rows = follower.rows_out(submap)
    if len(rows) < least:
        return 0
    stays = np.ones(n, np.bool_)
    stays[rows] = False
    kept = np.flatnonzero(stays)
    submap.keep_observations(kept)
    follower.keep_rows(kept)
    log.info("submap %d: %d of %d observations were dead and have left the table", submap.id, len(rows), n)
    return len(rows)
