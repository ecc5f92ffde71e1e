"""Revisited places: pictures of both, what was matched, what moved by how much, what was refused and why."""

from __future__ import annotations

import math
from collections import Counter
from typing import Any

from dualslam.report.markup import Markup, cards, join, number, picture, tag
from dualslam.report.run_data import RunData
from dualslam.report.samples import MAX_PLACES
from dualslam.report.statuses import count

NEAR_FRAMES = 45
"""A picture of a frame so far from the named one, at most, stands for it."""
Event = dict[str, Any]
_KINDS = {"loop_closed": "◆ a loop is closed", "merged": "◆ two maps are joined", "relocalised": "↺ found again"}
_HEADS = ("reason", "how often", "for example")


def places_section(run: RunData) -> Markup | None:
    """Return a card for each place, and the refusals; None where no place was revisited."""
    seen, refused = run.events_of(*_KINDS), run.events_of("loop_refused")
    if not seen and not refused:
        return None
    told = [_card(run, event) for event in seen[:MAX_PLACES]]
    more = f"{count(len(seen) - MAX_PLACES, 'more place')} are among the events." if len(seen) > MAX_PLACES else None
    return join([*told, None if more is None else tag("p", more), _refused(refused)])


def _card(run: RunData, event: Event) -> Markup:
    head = tag("h3", f"Frame {event['frame']} ", tag("span", _KINDS[event["event"]], cls="pill good"))
    pictures = [(int(event["keyframe"] if "keyframe" in event else event["frame"]), "now")]
    if event.get("other_frame", -1) >= 0:  # of what an earlier run has seen there is no picture
        pictures.append((int(event["other_frame"]), "then"))
    return tag("article", head, tag("p", _told(event)), _pictures(run, pictures), cls="failure")


def _told(event: Event) -> str:
    """Describe the revisits in a few sentences."""
    if event["event"] == "relocalised":
        whence = "" if event.get("from_submap") is None else f", and left submap {event['from_submap']} for it"
        place = f" by what keyframe {_frame(event['other_frame'])} shows" if "other_frame" in event else ""
        agree = f"{event['n_inliers']} landmarks agree" if "n_inliers" in event else "Its pixels agree"
        return f"The camera found itself in submap {event['submap']}{place}{whence}. {agree}."
    here, there = event["submap"], event["other_submap"]
    where = f"submap {here}" if here == there else f"submap {here}, and submap {there}"
    told = [f"It shows what keyframe {_frame(event['other_frame'])} has shown ({where})."]
    if "inliers" in event:
        told.append(f"{event['inliers']} of {event['matches']} landmark pairs agree.")
    if "found" in event:
        found, own = (f"{100 * event[name]:.0f} %" for name in ("found", "own_found"))
        told.append(f"Of what either side should see in the other's images {found} is there ({own} in its own).")
    if "drift" in event:
        scale = 100 * (math.exp(abs(event["drift_log_scale"])) - 1)
        told.append(
            f"The map had drifted by {number(100 * event['drift'], 2)} % of the way, "
            f"{number(event['drift_rot_deg'], 2)}° and {number(scale, 2)} % in scale."
        )
    if event.get("moved"):
        told.append(f"The solution moved the maps by up to {number(event['moved'], 2)} of their unit.")
    return " ".join(told)


def _frame(index: int) -> str:
    return str(index) if index >= 0 else f"{index} (of an earlier run)"


def _pictures(run: RunData, wanted: list[tuple[int, str]]) -> Markup:
    figures = []
    for index, role in wanted:
        nearest = min(run.samples, key=lambda i: (abs(i - index), i), default=None)
        if nearest is None or abs(nearest - index) > NEAR_FRAMES:
            continue
        words = f"{nearest}" if nearest == index else f"{nearest}, near {index}"
        image = picture(run.samples[nearest], f"Frame {words}: {role}")
        figures.append(tag("figure", image, tag("figcaption", tag("b", f"{words} {role}"))))
    return tag("div", figures, cls="samples") if figures else join(None)


def _refused(events: list[Event]) -> Markup | None:
    if not events:
        return None
    reasons = Counter(str(event.get("reason", "?")) for event in events)
    example = {str(event.get("reason", "?")): event for event in reversed(events)}
    rows = []
    for reason, n in reasons.most_common():
        first = example[reason]
        words = f"frame {first['frame']} and keyframe {_frame(first['other_frame'])}: {first.get('detail', '')}"
        rows.append((reason.replace("_", " "), str(n), words))
    words = f"{count(len(events), 'place')} that looked alike {'was' if len(events) == 1 else 'were'} not believed:"
    return join([tag("p", words), cards(_HEADS, rows)])
