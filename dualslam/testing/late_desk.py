"""A desk that does its work inline and gives the results out late, as processes do, but by a fixed schedule."""

from __future__ import annotations

from typing import Any

from dualslam.core.jobs import Desk, Ended, JobKind


class LateDesk:
    """Gives each result out only after so many more polls of its kind (there is one with each frame, or more)."""

    def __init__(self, inner: Desk, polls: int) -> None:
        self.inner, self.polls = inner, polls
        self.waiting: dict[JobKind, list[tuple[int, Ended]]] = {}
        self.n_polls: dict[JobKind, int] = {}
        self.maps: dict[int, int | None] = {}  # by the work's id

    def submit(self, kind: JobKind, work: Any, of: int | None = None) -> None:
        """Do the work at once, and keep its result back."""
        self.inner.submit(kind, work)
        at = self.n_polls.get(kind, 0) + self.polls
        self.waiting.setdefault(kind, []).extend((at, ended) for ended in self.inner.poll(kind))
        self.maps[id(work)] = of

    def poll(self, kind: JobKind) -> list[Ended]:
        """Return what is due."""
        now = self.n_polls[kind] = self.n_polls.get(kind, 0) + 1
        due = [ended for at, ended in self.waiting.get(kind, []) if at < now]
        self.waiting[kind] = [(at, ended) for at, ended in self.waiting.get(kind, []) if at >= now]
        return due

    def n_open(self, kind: JobKind, of: int | None = None) -> int:
        """Return how many results are kept back; `of`: of one submap."""
        return sum(of in (None, self.maps.get(id(ended.work))) for _, ended in self.waiting.get(kind, []))

    def withdraw(self, of: int) -> None:
        """Drop the results that are of use to this submap alone."""
        for kind, waiting in self.waiting.items():
            self.waiting[kind] = [(at, ended) for at, ended in waiting if self.maps.get(id(ended.work)) != of]

    def drain(self, kind: JobKind) -> list[Ended]:
        """Return all results, due or not."""
        return [ended for _, ended in self.waiting.pop(kind, [])]

    def close(self) -> None:
        """Close the desk within."""
        self.inner.close()
