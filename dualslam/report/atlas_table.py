"""How the atlas was solved, line by line: what came in, what it cost, what was rejected, what moved."""

from __future__ import annotations

from typing import Any

from dualslam.report.markup import Markup, cards, join, number, tag
from dualslam.report.run_data import RunData

_HEADS = ("frame", "submaps", "factors", "cost before", "cost after", "rejected", "bent by", "moved by")


def atlas_section(run: RunData) -> Markup | None:
    """Return the table, or None where no submap was ever connected with another."""
    rows = [_row(event) for event in run.events_of("atlas_solved")]
    if not rows:
        return None
    words = (
        "Each connection between submaps is a factor of one graph, solved when it comes. What is rejected stays in the "
        "map and is ignored. A submap is bent by the part of a move that is not a change of its place; in its own unit."
    )
    return join([tag("p", words), cards(_HEADS, rows)])


def _row(event: dict[str, Any]) -> tuple[str, ...]:
    factors = ", ".join(f"{n} {kind}" for kind, n in event.get("factors", {}).items())
    rejected = ", ".join(f"{link['connection']} {link['other_submap']}-{link['submap']}" for link in event["rejected"])
    return (
        str(event["frame"]),
        ", ".join(map(str, event["submaps"])),
        factors,
        number(event["cost_before"], 3),
        number(event["cost_after"], 3),
        rejected or "-",
        number(event["largest_bend"], 3),
        number(event["largest_move"], 3),
    )
