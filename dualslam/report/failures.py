"""One card a failure: what was seen, what happened, which links were tried, and how they were judged."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from dualslam.core.types import FailureReason
from dualslam.report.markup import Markup, cards, join, number, picture, tag
from dualslam.report.placement import PlacedRun, place
from dualslam.report.run_data import RunData
from dualslam.report.statuses import count
from dualslam.report.top_view import close_up, failure_letter

MAX_CLOSE_UPS = 20
"""Failures of which the path is drawn: a bound on the size of the page."""
AROUND = 12
"""Frames before and after a loss that the close-up shows."""
Event = dict[str, Any]
_TRIES = ("link_refused", "linked")
SHOWN_TRIES = 8
"""Links of one failure that are shown at once; the rest unfolds."""
_WALK = ("attempt", "reached", "posed", "keyframes", "skipped", "verdict", "time")
_LINK = ("back at", "verdict", "attempt", "keyframes", "matches", "inliers", "scale", "rotation", "position", "time")


@dataclass(frozen=True, slots=True)
class FailureStory:
    """The events that belong to one failure."""

    letter: str
    failed: Event
    restart: Event | None  # where the next map began
    walks: list[Event]  # attempts at reverse tracking from a later map to the lost one
    broken: list[Event]  # recoveries that came to nothing by themselves: the worker died, the solver failed
    tries: list[Event]  # links to the lost map, accepted or refused
    linked: Event | None
    fused: Event | None
    taken_over: Event | None  # where all its frames were registered in the main map
    relocalised: Event | None  # where it was found again, before another map had started

    @property
    def lost_since(self) -> int:
        """First frame of the loss."""
        return int(self.failed["lost_since"] if "lost_since" in self.failed else self.failed["frame"])

    @property
    def mapped_since(self) -> int | None:
        """First frame after it that has a map, the next one or the lost one."""
        event = self.relocalised or self.restart
        return None if event is None else int(event["frame"])


def stories(run: RunData) -> list[FailureStory]:
    """Sort the events of a run by the failure that they belong to."""
    found: list[FailureStory] = []
    for i, event in enumerate(run.events):
        if event.get("event") != "failed":
            continue
        later, lost = run.events[i + 1 :], event.get("submap")
        next_map = next((e for e in later if e.get("event") in ("reinitialised", "relocalised")), {})
        own = [e for e in later if e.get("old_submap") == lost]
        looking = {e.get("submap") for e in later if e.get("event") == "recovery_started" and lost in e.get("lost", [])}
        walking = [e for e in later if e.get("submap") in looking]
        found.append(
            FailureStory(
                letter=failure_letter(len(found) + 1),
                failed=event,
                restart=next_map if next_map.get("event") == "reinitialised" else None,
                walks=[e for e in walking if e.get("event") == "recovery_attempt"],
                broken=[e for e in walking if e.get("event") == "recovery_failed"],
                tries=[e for e in own if e.get("event") in _TRIES],
                linked=next((e for e in own if e["event"] == "linked"), None),
                fused=next((e for e in own if e["event"] == "fused"), None),
                taken_over=next((e for e in later if lost in e.get("old_submaps", [])), None),
                relocalised=next_map if next_map.get("event") == "relocalised" else None,
            )
        )
    return found


def failures_section(run: RunData) -> Markup:
    """Return a card for each failure; without one, what there is to see of a run that never started."""
    scene = place(run)
    cards = [_card(run, scene if i < MAX_CLOSE_UPS else None, story) for i, story in enumerate(stories(run))]
    if cards:
        return join(cards)
    if not len(run.main):
        pictures = _pictures(run, sorted(run.samples), {})
        words = "Tracking never failed, because it never began: no pair of frames gave a map that could be trusted."
        return join([tag("p", words, cls="empty"), _refused_starts(run), pictures])
    return tag("p", "Tracking never failed.", cls="empty")


# --- one failure


def _card(run: RunData, scene: PlacedRun | None, story: FailureStory) -> Markup:
    words, is_good = verdict(run, story)
    pill = tag("span", f"{'✓' if is_good else '✕'} {words}", cls=f"pill {'good' if is_good else 'bad'}")
    head = tag("h3", tag("span", story.letter, cls="break"), f" Frame {story.lost_since} ", pill)
    parts = [head, tag("p", _told(run, story)), _sample_frames(run, story), _close_up(run, scene, story)]
    parts += [attempt_table(story.walks), link_table(story.tries)]
    return tag("article", parts, cls="failure")


def verdict(run: RunData, story: FailureStory) -> tuple[str, bool]:
    """Return the outcome of a failure, in a few words, and whether the lost map continues."""
    rows = [row for row in run.rows if row.submap == story.failed.get("submap")]
    if story.relocalised is not None:
        return "seen again", True
    if story.linked is not None:
        return "linked with the map after it", True
    if story.taken_over is not None:
        return "taken over by the main map", True
    if any(row.in_main_map for row in rows) and story.restart is None:
        return "no map after it", False
    return "not linked", False


def _told(run: RunData, story: FailureStory) -> str:
    """Tell the failure in a few sentences."""
    failed = story.failed
    reason = str(failed.get("reason", "no reason given")).replace("_", " ")
    detail = f": {failed['detail']}" if failed.get("detail") else ""
    told = [
        f"Tracking was lost at frame {story.lost_since} and given up at frame {failed['frame']} ({reason}{detail}); "
        f"submap {failed.get('submap')} was archived whole."
        if failed.get("reason") != FailureReason.SCALE_LOST
        else f"The scale was lost at frame {story.lost_since}, which frame {failed['frame']} has shown{detail}; "
        f"submap {failed.get('submap')} ends before it."
    ]
    suspected = failed.get("suspected_since")
    if suspected is not None and suspected != story.lost_since:
        told.append(f"There were signs of trouble since frame {suspected}: the map is not trusted from there on.")
    if story.relocalised is not None:
        gap = abs(run.row_of.get(story.relocalised["frame"], 0) - run.row_of.get(story.lost_since, 0))
        again = (
            f"It was relocalised at frame {story.relocalised['frame']}, {count(gap, 'frame')} after the loss, before"
        )
        return " ".join([*told, again, "another map had started, and continued."])
    if story.restart is None:
        return " ".join([*told, "No map was started after it, until the run ended."])
    first_view = story.restart.get("first_view")
    began = f" from frames {first_view} on" if first_view is not None else ""
    gap = abs(run.row_of.get(story.restart["frame"], 0) - run.row_of.get(story.lost_since, 0))
    told.append(
        f"Submap {story.restart.get('submap')} was started at frame {story.restart['frame']}{began}, "
        f"{count(gap, 'frame')} after the loss."
    )
    if story.walks and "k_r" in story.walks[0]:
        k, k_r = story.walks[0]["k"], story.walks[0]["k_r"]
        told.append(f"Reverse tracking could read {k} frames from before the loss and {k_r} since (k and k_r).")
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
            f"By reverse tracking, the recovery linked it{took}{after}: {_link_words(link)}.{bypass}"
            if "scale" in link
            else f"The recovery linked the two{took}{after}.{bypass}"
        )
    if story.taken_over is not None:
        frames = count(story.taken_over["frames"], "frame")
        submap = story.taken_over["submap"]
        return f"All its frames are among the {frames} that were registered in submap {submap}: no link is needed."
    broken = "".join(f" A recovery failed: {e.get('detail') or e.get('reason')}." for e in story.broken)
    if not refused:
        met_few = "reverse tracking met too few keyframes of the lost map"
        why = met_few if story.walks else "there was no reverse tracking"
        return f"No link was tried: {why}.{broken}"
    reasons = Counter(str(e.get("reason", "?")).replace("_", " ") for e in refused)
    common = ", ".join(f"{reason} ({n})" if len(reasons) > 1 else reason for reason, n in reasons.most_common(3))
    tried = f"All {len(refused)} links that were tried were" if len(refused) > 1 else "The one link that was tried was"
    return f"{tried} refused: {common}. The two maps are not joined.{broken}"


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


def _close_up(run: RunData, scene: PlacedRun | None, story: FailureStory) -> Markup:
    """Draw the path around the loss: far enough back to show the keyframes of a link."""
    if scene is None:
        return join(None)
    row_of = run.row_of
    onset = row_of.get(story.lost_since, 0)
    keyframes = [int(k) for k in (story.linked or {}).get("agreeing_keyframes") or [] if int(k) in row_of]
    first = min([onset - AROUND, *(row_of[k] for k in keyframes)])
    last = onset if story.mapped_since is None else row_of.get(story.mapped_since, onset)
    drawing = close_up(run, scene, (first, last + AROUND), [row_of[k] for k in keyframes])
    if drawing is None:
        return join(None)
    marks = "; ◆ keyframes that support the link" if keyframes else ""
    words = "The path around the loss, from above: thick where frames were recovered, dotted where none has a pose"
    return tag("figure", drawing, tag("figcaption", f"{words}{marks}."), cls="close-up")


# --- frames


def _sample_frames(run: RunData, story: FailureStory) -> Markup:
    row_of = run.row_of
    onset = row_of.get(story.lost_since, 0)
    stop = len(run.rows) if story.mapped_since is None else row_of.get(story.mapped_since, len(run.rows))
    chosen = [i for i in run.samples if i in row_of and onset - 1 <= row_of[i] <= max(stop, onset)]
    words = {i: _role(run, story, i) for i in chosen}
    return _pictures(run, sorted(chosen, key=row_of.__getitem__), words)


def _role(run: RunData, story: FailureStory, index: int) -> str:
    row_of = run.row_of
    if row_of[index] < row_of.get(story.lost_since, 0):
        return "last tracked"
    if index == story.mapped_since:
        return "seen again" if story.relocalised is not None else "new map"
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
        image = picture(run.samples[i], f"Frame {i}: {role or 'sample'}, {seen}")
        figures.append(tag("figure", image, tag("figcaption", tag("b", f"{i} {role}"), " ", seen)))
    return tag("div", figures, cls="samples")


def _refused_starts(run: RunData) -> Markup:
    reasons = Counter(str(e.get("reason", "?")) for e in run.events_of("initialisation_refused"))
    if not reasons:
        return join(None)
    items = [tag("li", f"{reason} ({count(n, 'time')})") for reason, n in reasons.most_common(5)]
    return tag("div", tag("p", "Starts that were refused:"), tag("ul", items))


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
