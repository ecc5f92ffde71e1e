"""Each failure told by itself: what was seen, what happened, which links were tried, and how they were judged."""

from __future__ import annotations

import base64
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from dualslam.report.markup import Markup, join, number, tag
from dualslam.report.placement import Scene, place
from dualslam.report.run_data import RunData
from dualslam.report.statuses import count
from dualslam.report.top_view import close_up, failure_letter

AROUND = 12
"""Frames before and after a loss that the close-up shows."""
SHOWN_ATTEMPTS = 8
"""Attempts of one failure that are shown at once; the rest unfolds."""
Event = dict[str, Any]
_TRIES = ("recovery_attempt", "link_refused", "linked")


@dataclass(frozen=True, slots=True)
class FailureStory:
    """The events that belong to one failure.

    Attributes
    ----------
    letter : str
    failed : dict
    restart : dict or None
        Where the next map began.
    tries : list of dict
        Attempts and links, accepted or refused, that concern the lost map.
    linked : dict or None
    fused : dict or None
    """

    letter: str
    failed: Event
    restart: Event | None
    tries: list[Event]
    linked: Event | None
    fused: Event | None

    @property
    def lost_since(self) -> int:
        """First frame of the loss."""
        return int(self.failed["lost_since"] if "lost_since" in self.failed else self.failed["frame"])


def stories(run: RunData) -> list[FailureStory]:
    """Sort the events of a run by the failure that they belong to."""
    found: list[FailureStory] = []
    for i, event in enumerate(run.events):
        if event.get("event") != "failed":
            continue
        later, lost = run.events[i + 1 :], event.get("submap")
        own = [e for e in later if e.get("old_submap") == lost]
        tries = [e for e in own if e.get("event") in _TRIES]
        linked = next((e for e in own if e["event"] == "linked"), None)
        if linked is not None:  # the attempt that led to the link says the same as the link
            tries = [e for e in tries if e.get("event") != "recovery_attempt" or e.get("reason") != "linked"]
        found.append(
            FailureStory(
                letter=failure_letter(len(found) + 1),
                failed=event,
                restart=next((e for e in later if e.get("event") == "reinitialised"), None),
                tries=tries,
                linked=linked,
                fused=next((e for e in own if e["event"] == "fused"), None),
            )
        )
    return found


def failures_section(run: RunData) -> Markup:
    """Return a card for each failure; without one, what there is to see of a run that never started."""
    scene = place(run)
    cards = [_card(run, scene, story) for story in stories(run)]
    if cards:
        return join(cards)
    if not len(run.main):
        pictures = _pictures(run, sorted(run.samples), {})
        words = "Tracking never failed, because it never began: no pair of frames gave a map that could be trusted."
        return join([tag("p", words, cls="empty"), _refused_starts(run), pictures])
    return tag("p", "Tracking never failed.", cls="empty")


# --- one failure


def _card(run: RunData, scene: Scene, story: FailureStory) -> Markup:
    verdict, cls = _verdict(run, story)
    head = tag(
        "h3", tag("span", story.letter, cls="break"), f" Frame {story.lost_since} ", tag("span", verdict, cls=cls)
    )
    parts = [head, tag("p", _told(run, story)), _sample_frames(run, story), _close_up(run, scene, story)]
    parts.append(_table(story.tries))
    return tag("article", parts, cls="failure")


def _verdict(run: RunData, story: FailureStory) -> tuple[str, str]:
    rows = [row for row in run.rows if row.submap == story.failed.get("submap")]
    if story.linked is not None:
        return "✓ linked with the map after it", "pill good"
    if any(row.in_main_map for row in rows) and story.restart is None:
        return "✕ no map after it", "pill bad"
    return "✕ not linked", "pill bad"


def _told(run: RunData, story: FailureStory) -> str:
    """Tell the failure in a few sentences."""
    failed = story.failed
    reason = str(failed.get("reason", "no reason given")).replace("_", " ")
    detail = f": {failed['detail']}" if failed.get("detail") else ""
    told = [
        f"Tracking was lost at frame {story.lost_since} and given up at frame {failed['frame']} ({reason}{detail}); "
        f"submap {failed.get('submap')} was archived whole."
    ]
    if story.restart is None:
        return " ".join([*told, "No map was started after it, until the run ended."])
    first_view = story.restart.get("first_view")
    began = f" from frames {first_view} on" if first_view is not None else ""
    gap = abs(run.row_of.get(story.restart["frame"], 0) - run.row_of.get(story.lost_since, 0))
    told.append(
        f"Submap {story.restart.get('submap')} was started at frame {story.restart['frame']}{began}, "
        f"{count(gap, 'frame')} after the loss."
    )
    return " ".join([*told, _outcome(story)])


def _outcome(story: FailureStory) -> str:
    refused = [e for e in story.tries if e.get("event") == "link_refused"]
    if story.linked is not None:
        link = story.linked
        took = f" in {number(link['seconds'])} s" if "seconds" in link else ""
        after = f" after {count(len(refused), 'refused link')}" if refused else ""
        bypassed = (story.fused or {}).get("bypassed")
        bypass = f" By-passed at the lost map's end: {count(bypassed, 'frame')}." if bypassed else ""
        return (
            f"Walking back in time, the recovery linked it{took}{after}: {_link_words(link)}.{bypass}"
            if "scale" in link
            else f"The recovery linked the two{took}{after}.{bypass}"
        )
    if not refused:
        return "No link was tried: the walk back in time met too few keyframes of the lost map."
    reasons = Counter(str(e.get("reason", "?")).replace("_", " ") for e in refused)
    common = ", ".join(f"{reason} ({n})" if len(reasons) > 1 else reason for reason, n in reasons.most_common(3))
    return f"All {count(len(refused), 'link')} that were tried were refused: {common}. The two maps stay apart."


def _link_words(link: Mapping[str, Any]) -> str:
    words = [f"scale {number(link['scale'], 4)}"]
    if "sigma_scale" in link:
        words[0] += f" ± {number(100 * link['sigma_scale'], 2)} %"
    if "inliers" in link and "matches" in link:
        words.append(f"{link['inliers']} of {link['matches']} landmark pairs agree")
    keyframes = link.get("agreeing_keyframes")
    if isinstance(keyframes, Sequence) and not isinstance(keyframes, str):
        words.append(f"keyframes {', '.join(map(str, keyframes))} agree one by one")
    return "; ".join(words)


def _close_up(run: RunData, scene: Scene, story: FailureStory) -> Markup:
    """Draw the path around the loss: far enough back to show the keyframes that a link rests on."""
    row_of = run.row_of
    onset = row_of.get(story.lost_since, 0)
    keyframes = [int(k) for k in (story.linked or {}).get("agreeing_keyframes") or [] if int(k) in row_of]
    first = min([onset - AROUND, *(row_of[k] for k in keyframes)])
    last = row_of.get(story.restart["frame"], onset) if story.restart else onset
    drawing = close_up(run, scene, (first, last + AROUND), [row_of[k] for k in keyframes])
    if drawing is None:
        return join(None)
    marks = "; ◆ keyframes that the link rests on" if keyframes else ""
    words = (
        f"The path around the loss, from above: thick where frames were recovered, dotted where there is none{marks}."
    )
    return tag("figure", drawing, tag("figcaption", words), cls="close-up")


# --- frames


def _sample_frames(run: RunData, story: FailureStory) -> Markup:
    row_of = run.row_of
    onset = row_of.get(story.lost_since, 0)
    stop = row_of.get(story.restart["frame"], len(run.rows)) if story.restart else len(run.rows)
    chosen = [i for i in run.samples if i in row_of and onset - 1 <= row_of[i] <= max(stop, onset)]
    words = {i: _role(run, story, i) for i in chosen}
    return _pictures(run, sorted(chosen, key=row_of.__getitem__), words)


def _role(run: RunData, story: FailureStory, index: int) -> str:
    row_of = run.row_of
    if row_of[index] < row_of.get(story.lost_since, 0):
        return "last tracked"
    if story.restart is not None and index == story.restart["frame"]:
        return "new map"
    if index == story.lost_since:
        return "lost"
    return "still no map"


def _pictures(run: RunData, indices: Sequence[int], words: Mapping[int, str]) -> Markup:
    if not indices:
        return join(None)
    row_of = run.row_of
    figures = []
    for i in indices:
        role = words.get(i, "")
        row = run.rows[row_of[i]]
        seen = f"{row.n_inliers} of {row.n_matches} landmarks agree" if row.n_matches else "no landmark matched"
        if role == "still no map" and row.submap is not None:
            seen = f"posed later ({row.status}): {seen}"
        data = base64.b64encode(run.samples[i]).decode()
        image = tag("img", src=f"data:image/jpeg;base64,{data}", alt=f"Frame {i}: {role or 'sample'}, {seen}")
        figures.append(tag("figure", image, tag("figcaption", tag("b", f"{i} {role}"), " ", seen)))
    return tag("div", figures, cls="samples")


def _refused_starts(run: RunData) -> Markup:
    reasons = Counter(str(e.get("reason", "?")) for e in run.events_of("initialisation_refused"))
    if not reasons:
        return join(None)
    items = [tag("li", f"{reason} ({count(n, 'time')})") for reason, n in reasons.most_common(5)]
    return tag("div", tag("p", "Starts that were refused:"), tag("ul", items))


# --- attempts


def _table(tries: Sequence[Event]) -> Markup:
    if not tries:
        return join(None)
    # The last ones tell the outcome.
    shown, folded = tries[-SHOWN_ATTEMPTS:], tries[:-SHOWN_ATTEMPTS]
    parts = [_attempts(shown)]
    if folded:
        summary = tag("summary", f"{count(len(folded), 'earlier attempt')}")
        parts.insert(0, tag("details", summary, _attempts(folded)))
    return join(parts)


def _attempts(tries: Sequence[Event]) -> Markup:
    columns = (
        "frame",
        "verdict",
        "attempt",
        "keyframes",
        "matches",
        "inliers",
        "scale",
        "rotation",
        "position",
        "time",
    )
    cells = [_cells(event) for event in tries]
    used = [c for c in columns if any(row.get(c) for row in cells)]
    head = tag("tr", [tag("th", name, scope="col") for name in used])
    body = [
        tag("tr", [tag("td", row.get(c) or "-", data_label=c, cls="words" if c == "verdict" else "num") for c in used])
        for row in cells
    ]
    table = tag("table", tag("thead", head), tag("tbody", body), cls="cards")
    note = "scale, rotation and position with one standard deviation; position in the old map's unit"
    return tag("div", table, tag("p", note, cls="note") if "scale" in used else None, cls="scroll")


def _cells(event: Event) -> dict[str, str]:
    """Return the columns of one attempt: whatever its event knows."""
    agreeing = event.get("n_agreeing_keyframes")
    shared = event.get("n_shared_keyframes", event.get("shared_keyframes"))
    keyframes = "" if shared is None else f"{shared:.0f} shared"
    scale = _with_sigma(event.get("scale"), event.get("sigma_scale"))
    rotation, position = event.get("sigma_rot_deg"), event.get("sigma_trans_mu")
    matches, inliers = _first(event, "matches", "n_matches", "n_pairs"), _first(event, "inliers", "n_inliers")
    seconds = event.get("seconds")
    return {
        "frame": str(event.get("frame", "")),
        "verdict": _judged(event),
        "attempt": str(event.get("attempt", "")),
        "keyframes": keyframes if agreeing is None else f"{agreeing:.0f} of {keyframes}",
        "matches": number(matches, 6) if matches is not None else "",
        "inliers": number(inliers, 6) if inliers is not None else "",
        "scale": scale,
        "rotation": f"± {number(rotation, 2)}°" if rotation is not None else "",
        "position": f"± {number(position, 2)}" if position is not None else "",
        "time": f"{number(seconds, 3)} s" if seconds is not None else "",
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
