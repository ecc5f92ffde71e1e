"""Tables of one failure's recovery: reverse tracking and the links that were tried, with numbers and verdicts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from dualslam.report.markup import Markup, cards, join, number, tag
from dualslam.report.statuses import count

SHOWN_TRIES = 8
"""Links of one failure that are shown at once; the rest unfolds."""
Event = dict[str, Any]
_WALK = ("attempt", "reached", "posed", "keyframes", "skipped", "verdict", "time")
_LINK = ("back at", "verdict", "attempt", "keyframes", "matches", "inliers", "scale", "rotation", "position", "time")


def attempt_table(walks: Sequence[Event]) -> Markup:
    """Return a table of the attempts at reverse tracking."""
    return (
        _titled("Reverse tracking", _table(_WALK, [_attempt_cells(event) for event in walks]), None)
        if walks
        else join(None)
    )


def link_table(tries: Sequence[Event]) -> Markup:
    """Return a table of the links that were tried; the last ones, which tell the outcome, are open."""
    if not tries:
        return join(None)
    shown, folded = tries[-SHOWN_TRIES:], tries[:-SHOWN_TRIES]
    tables = [_table(_LINK, [_link_cells(event) for event in shown])]
    if folded:
        summary = tag("summary", count(len(folded), "earlier one"))
        tables.insert(0, tag("details", summary, _table(_LINK, [_link_cells(event) for event in folded])))
    known = any("scale" in event for event in tries)
    note = "scale, rotation and position with one standard deviation; position in the old map's unit" if known else None
    return _titled("Links tried", join(tables), note)


def _titled(title: str, table: Markup, note: str | None) -> Markup:
    return tag("div", tag("h4", title), table, tag("p", note, cls="note") if note else None)


def _table(columns: Sequence[str], cells: Sequence[dict[str, str]]) -> Markup:
    used = [c for c in columns if any(row.get(c) for row in cells)]
    classes = {c: "words" if c == "verdict" else "num" for c in used}
    return cards(used, [[row.get(c) or "-" for c in used] for row in cells], classes)


def _attempt_cells(event: Event) -> dict[str, str]:
    skipped = event.get("skipped_frames")
    verdict = str(event.get("verdict", ""))
    return {
        "attempt": str(event.get("attempt", "")),
        "reached": f"frame {event.get('frame', '-')}",
        "posed": count(event["frames"], "frame") if "frames" in event else "",
        "keyframes": str(event.get("new_keyframes", "")),
        "skipped": "" if skipped is None else count(skipped, "frame"),
        "verdict": f"✓ {verdict}" if verdict == "linked" else verdict,
        "time": _seconds(event),
    }


def _link_cells(event: Event) -> dict[str, str]:
    """Return the columns of one attempt: whatever its event knows."""
    agreeing = event.get("n_agreeing_keyframes")
    shared = event.get("n_shared_keyframes", event.get("shared_keyframes"))
    keyframes = "" if shared is None else f"{shared:.0f} shared"
    scale = _with_sigma(event.get("scale"), event.get("sigma_scale"))
    rotation, position = event.get("sigma_rot_deg"), event.get("sigma_trans_mu")
    matches, inliers = _first(event, "matches", "n_matches", "n_pairs"), _first(event, "inliers", "n_inliers")
    return {
        "back at": _where(event),
        "verdict": _judged(event),
        "attempt": str(event.get("attempt", "")),
        "keyframes": keyframes if agreeing is None else f"{agreeing:.0f} of {keyframes}",
        "matches": number(matches, 6) if matches is not None else "",
        "inliers": number(inliers, 6) if inliers is not None else "",
        "scale": scale,
        "rotation": f"± {number(rotation, 2)}°" if rotation is not None else "",
        "position": f"± {number(position, 2)}" if position is not None else "",
        "time": _seconds(event),
    }


def _judged(event: Event) -> str:
    if event.get("event") == "linked":
        return f"✓ linked with submap {event.get('old_submap')}"
    reason = str(event.get("reason", "")).replace("_", " ")
    detail = str(event.get("verdict") or event.get("detail") or "")
    if event.get("event") == "link_refused":
        return f"✕ refused: {reason}{' - ' if detail else ''}{detail}"
    return detail or reason or "tried"


def _with_sigma(scale: float | None, sigma: float | None) -> str:
    if scale is None:
        return ""
    return number(scale, 4) + ("" if sigma is None else f" ± {number(100 * sigma, 2)} %")


def _first(event: Event, *names: str) -> float | None:
    return next((event[name] for name in names if event.get(name) is not None), None)


def _where(event: Event) -> str:
    # A link that was made is noted at the live frame; the refused ones at the frame that the walk had come to.
    agreeing = event.get("agreeing_keyframes")
    return f"frame {agreeing[0]}" if agreeing else f"frame {event.get('frame', '-')}"


def _seconds(event: Event) -> str:
    seconds = event.get("seconds")
    return "" if seconds is None else f"{number(seconds, 3)} s"
