"""Events and numbers of an atlas solution."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import chain, compress, repeat

import numpy as np

from dualslam.atlas.atlas import Link
from dualslam.atlas.moving import Move
from dualslam.atlas.record import FrameStamp, Record
from dualslam.atlas.skeleton import WITHIN, Skeleton
from dualslam.atlas.warp import Warp
from dualslam.core.atlas_problem import AtlasSolution
from dualslam.core.events import EventKind
from dualslam.core.geometry import se3, sim3
from dualslam.core.types import Failure

STILL = 1e-4
"""Bends up to this (radians, share of scale, submap units: below a tenth of a pixel) leave the arrays to the bit."""


@dataclass(frozen=True, slots=True, eq=False)
class AtlasReport:
    """Effect of an atlas solution."""

    rejected: tuple[Link, ...] = ()  # all that are rejected now, in the linked sets that were solved
    newly_rejected: tuple[Link, ...] = ()
    readmitted: tuple[Link, ...] = ()
    factors: dict[str, int] = field(default_factory=dict)  # edges by kind, rejected ones left out
    # Half the sum of squared whitened residuals.
    cost_before: float = 0.0
    cost_after: float = 0.0
    drift: float = 1.0
    """Errors within submaps over what they claim, as sure connections show (the largest of the linked sets)."""
    newest_chi2: float | None = None
    """Of the connection that came last, against all others (7 degrees of freedom); None where nothing ties its ends."""
    bent: dict[int, float] = field(default_factory=dict)
    """By submap: farthest move of a keyframe within its submap's frame, in the submap's unit; those that moved."""
    placed: dict[int, float] = field(default_factory=dict)  # by submap: how far its frame's keyframe went in the world
    seconds: float = 0.0
    failure: Failure | None = None  # the solver's: nothing has changed

    def __bool__(self) -> bool:
        """Whether there is a solution."""
        return self.failure is None


@dataclass(frozen=True, slots=True, eq=False)
class Solved:
    """A linked set with its solution, and what that moves (None: all stays)."""

    skeleton: Skeleton
    solution: AtlasSolution
    moves: list[Move] | None

    @classmethod
    def of(cls, skeleton: Skeleton, solution: AtlasSolution, new: Sequence[Link]) -> Solved:
        """Say what a solution moves. `new`: connections that came with it."""
        if new and changes_nothing(skeleton, solution, new):
            return cls(skeleton, solution, None)
        return cls(skeleton, solution, [] if skeleton.is_tree else moves_of(skeleton, solution))

    @property
    def bends(self) -> list[Move]:
        """The moves that bend a submap."""
        return [move for move in self.moves or () if move.bent]

    @property
    def n_within(self) -> int:
        """Edges within submaps: the first of the problem, before the connections."""
        return len(self.skeleton.problem.edges) - len(self.skeleton.links)

    @property
    def believed(self) -> list[bool]:
        """Of the connections."""
        return [bool(kept) for kept in self.solution.believed[self.n_within :]]

    @property
    def kinds(self) -> Iterator[str]:
        """Of the edges that are believed."""
        kinds = chain(repeat(WITHIN, self.n_within), (str(link.kind) for link in self.skeleton.links))
        return compress(kinds, self.solution.believed.tolist())

    @property
    def newest_chi2(self) -> float | None:
        """Of the last connection against all others; None where nothing else ties its ends."""
        chi2 = self.solution.chi2[-1] if self.skeleton.links else float("nan")
        return float(chi2) if np.isfinite(chi2) else None

    def report(self, links: Sequence[Link], readmitted: Sequence[int], newly_rejected: Sequence[int]) -> AtlasReport:
        """Report what was done. `links`: of the atlas, in its current state; the others: rows of it."""
        return AtlasReport(
            rejected=tuple(link for link in links if link.rejected and link.a in self.skeleton.component),
            newly_rejected=tuple(links[i] for i in newly_rejected),
            readmitted=tuple(links[i] for i in readmitted),
            factors=dict(Counter(self.kinds)),
            cost_before=self.solution.cost_before,
            cost_after=self.solution.cost_after,
            drift=self.solution.drift,
            newest_chi2=self.newest_chi2,
            bent={move.submap_id: move.bend_mu for move in self.bends},
            placed=placed_by(self.skeleton, self.solution) if self.moves is not None else {},
        )


def changes_nothing(skeleton: Skeleton, solution: AtlasSolution, new: Sequence[Link]) -> bool:
    """Whether all that is new was rejected, and what was there before is believed as before."""
    fresh = set(map(id, new))
    n = len(skeleton.links)
    for link, kept in zip(skeleton.links, solution.believed[len(solution.believed) - n :].tolist(), strict=True):
        if kept == (link.rejected or id(link) in fresh):
            return False
    return True


def moves_of(skeleton: Skeleton, solution: AtlasSolution) -> list[Move]:
    """Return what a solution does to each submap, whose frame stays with the keyframe of its gauge."""
    moves = []
    for m in skeleton.component:
        rows, knots = skeleton.knots(m)
        T = skeleton.T_submap_node[rows]
        at = skeleton.reference[m]
        S_world_submap = solution.S_world_node[at] @ sim3.inverse(skeleton.T_submap_node[at])
        S = sim3.inverse(S_world_submap) @ solution.S_world_node[rows] @ sim3.inverse(T)
        bent = bool(np.abs(sim3.log(S)).max() > STILL)
        warp = Warp(np.array(knots, np.int64), sim3.normalise(S))
        centres = se3.translation(T)
        bend_mu = float(np.linalg.norm(sim3.act_each(S, centres) - centres, axis=1).max())
        moves.append(Move(m, warp, S_world_submap, bend_mu, bent, skeleton.steps[m]))
    return moves


def placed_by(skeleton: Skeleton, solution: AtlasSolution) -> dict[int, float]:
    """Return how far the keyframe that each submap's frame goes by has moved in the world."""
    gone = np.linalg.norm(se3.translation(solution.S_world_node - skeleton.problem.S_world_node), axis=1)
    return {m: float(gone[row]) for m, row in skeleton.reference.items()}


def together(reports: Sequence[AtlasReport]) -> AtlasReport:
    """Return one report of several linked sets."""
    factors = Counter[str]()
    for report in reports:
        factors.update(report.factors)
    return AtlasReport(
        rejected=tuple(link for r in reports for link in r.rejected),
        newly_rejected=tuple(link for r in reports for link in r.newly_rejected),
        readmitted=tuple(link for r in reports for link in r.readmitted),
        factors=dict(factors),
        cost_before=sum(r.cost_before for r in reports),
        cost_after=sum(r.cost_after for r in reports),
        drift=max((r.drift for r in reports), default=1.0),
        newest_chi2=next((r.newest_chi2 for r in reports if r.newest_chi2 is not None), None),
        bent={m: bend for r in reports for m, bend in r.bent.items()},
        placed={m: gone for r in reports for m, gone in r.placed.items()},
    )


def named(link: Link) -> dict[str, object]:
    """A connection as the event log names it."""
    return {
        "connection": str(link.kind),
        "other_submap": link.a,
        "keyframe": link.keyframe_b,
        "other_keyframe": link.keyframe_a,
    }


def tell(record: Record, report: AtlasReport, solved: Sequence[Solved], now: FrameStamp) -> None:
    """Record what solutions did, in the order of their linked sets."""
    record.event(
        EventKind.ATLAS_SOLVED,
        now,
        solved[0].skeleton.component[0],
        submaps=[m for each in solved for m in each.skeleton.component],
        factors=report.factors,
        cost_before=report.cost_before,
        cost_after=report.cost_after,
        drift=report.drift,
        rejected=[{"submap": link.b, **named(link)} for link in report.rejected],
        bent={str(m): bend for m, bend in report.bent.items()},
        largest_bend=max(report.bent.values(), default=0.0),
        largest_move=max(report.placed.values(), default=0.0),
        seconds=report.seconds,
    )
    for kind, links in (
        (EventKind.CONNECTION_REJECTED, report.newly_rejected),
        (EventKind.CONNECTION_READMITTED, report.readmitted),
    ):
        for link in links:
            record.event(kind, now, link.b, **named(link))
