"""`report.html`: one run on one page, made from its run folder alone, and asking for nothing outside itself."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dualslam.core.config.settings import Config
from dualslam.core.types import FrameStatus
from dualslam.io.run_folder import EVENTS, MAP_PAGE, MASK
from dualslam.report.charts import beside_table, latency_histogram, pace_words, stage_table
from dualslam.report.failures import failures_section, stories, verdict
from dualslam.report.markup import Markup, cards, document, duration, join, number, picture, table, tag
from dualslam.report.places import places_section
from dualslam.report.run_data import RunData, read_run
from dualslam.report.statuses import WITHOUT_POSE, count, event_words, seen_again
from dualslam.report.timeline import timeline
from dualslam.report.top_view import top_view
from dualslam.report.trust import camera_words, next_steps, trust_section

MAX_EVENTS = 500
"""A bound on the size of the page."""
VERDICTS = {
    "good": "Nothing in this run speaks against its trajectory.",
    "usable": "What is posed can be used; something is missing, or less sure than usual.",
    "doubtful": "Part of this trajectory is probably wrong.",
}
_EVENT_COLUMNS = {"frame": "num", "time": "num", "event": None, "submap": "num", "what belongs to it": "words"}
_HEADS = ("frame", "submaps", "factors", "cost before", "cost after", "rejected", "bent by", "moved by")


def report_page(run: RunData | str | Path) -> str:
    """Return the whole page of a run, or of the run in a folder.

    Raises `InputError` if the folder cannot be read as one (`read_run`).
    """
    if not isinstance(run, RunData):
        run = read_run(run)
    sequence = run.summary.get("sequence", run.name)
    map_link = tag("p", tag("a", "Turn the map in three dimensions", href=MAP_PAGE), ", frame by frame.")
    versions = ", ".join(f"{name} {version}" for name, version in (run.summary.get("versions") or {}).items())
    footer = f"Run folder {run.name}, seed {run.summary.get('seed', 'to')}. {versions}."
    body = [
        _header(run, str(sequence)),
        _section("Trajectory", [top_view(run), map_link if (run.path / MAP_PAGE).is_file() else None]),
        _section("What to do next", next_steps(run)),
        _section("Every frame", timeline(run)),
        _section("Failures and recoveries", failures_section(run)),
        _section("Trust", trust_section(run)),
        _section("Places seen again", places_section(run)),
        _section("Connections between submaps", atlas_section(run)),
        _section("Time", [pace_words(run), latency_histogram(run), stage_table(run), beside_table(run)]),
        _section("Configuration", _configuration(run)),
        _section("All events", _events(run)),
        tag("footer", tag("p", footer)),
    ]
    return document(f"{sequence} - dualslam report", body)


def notebook_cell(run: RunData) -> Markup:
    """Return the head of the page and the trajectory from above, in a frame: its styles are not the notebook's."""
    sequence = str(run.summary.get("sequence", run.name))
    page = document(sequence, [_header(run, sequence), top_view(run)])
    return tag("iframe", srcdoc=page, style="width: 100%; height: 640px; border: 0", title=f"run {run.name}")


def _header(run: RunData, sequence: str) -> Markup:
    lead = tag("p", headline(run), cls="lead")
    told = (_verdict(run), lead, _saved_map(run), _mask(run), _warnings(run), camera_words(run), _tiles(run))
    return tag("header", tag("h1", sequence), *told)


def _verdict(run: RunData) -> Markup | None:
    """Return how far to trust the run, why, and what to do; None for a run of an earlier version."""
    told = run.summary.get("verdict")
    if told is None:
        return None
    words = tag("p", tag("strong", f"Verdict: {told['level']}."), f" {VERDICTS[told['level']]}", cls="lead")
    reasons = [tag("p", f"⚠ {reason['text']}", cls="warning") for reason in told["reasons"]]
    return join([words, *reasons])


def headline(run: RunData) -> str:
    """Tell the outcome of the run in one sentence."""
    n = len(run.rows)
    if not len(run.main):
        why = run.summary.get("no_map")
        return f"No map: none of {count(n, 'frame')} has a pose{'' if why is None else f'; {why}'}."
    posed = f"{100 * len(run.main) / max(n, 1):.1f} % of {count(n, 'frame')} are posed in the main map"
    told = stories(run)
    if not told:
        failures = "Tracking never failed"
    else:
        ends = Counter(verdict(run, story)[0] for story in told)
        failures = (
            f"Tracking failed once: {next(iter(ends))}"
            if len(told) == 1
            else f"Tracking failed {len(told)} times: {', '.join(f'{n} {words}' for words, n in ends.items())}"
        )
    # The end of a failure is on its card already.
    also = seen_again(run.summary, -sum(story.relocalised is not None for story in told))
    apart = f"; {count(len(run.unlinked), 'submap')} stayed apart" if run.unlinked else ""
    return f"{'; '.join([failures, *also])}; {posed}{apart}."


def _saved_map(run: RunData) -> Markup | None:
    """Tell of the map that a run began with: it explains numbers of more than this run's frames."""
    s = run.summary
    if not s.get("saved_map"):
        return None
    aim = "finds its frames in" if s.get("localise") else "continues"
    keyframes = f"{s.get('saved_keyframes', 0)} of the {s.get('keyframes', 0)} keyframes are of it"
    words = f"This run {aim} the map saved in {s['saved_map']}: {keyframes}."
    return tag("p", f"{words} Frames below 0 are those of earlier runs, -1 their last.", cls="note")


def _mask(run: RunData) -> Markup | None:
    """Show which pixels were left out."""
    if run.mask is None:
        return None
    share = f"{100 * run.summary.get('hidden_share', 0.0):.1f} %"
    words = (
        f"{share} of the image shows no scene and was left out (black): it stands still, or the run was given a mask."
    )
    image = picture(run.mask, f"Mask: {share} of the image is left out", "png", width="240")
    return tag("figure", image, tag("figcaption", f"{words} {MASK} is ready for --mask.", cls="note"))


def _warnings(run: RunData) -> Markup:
    ends = {"interrupted": "was interrupted", "crashed": "crashed"}
    words = [
        f"This run {end}: the page shows what it had found by then." for k, end in ends.items() if run.summary.get(k)
    ]
    if run.events_of("camera_stands"):
        words.append("The camera stood still for a while, as something moved before it: no map was started of that.")
    unreadable, dropped = run.count(FrameStatus.UNREADABLE), run.count(FrameStatus.DROPPED)
    if unreadable:
        words.append(f"{count(unreadable, 'image')} could not be read.")
    if dropped:
        words.append(f"{count(dropped, 'frame')} came too late to be looked at (real time).")
    return join([tag("p", f"⚠ {sentence}", cls="warning") for sentence in words])


def _submap_words(s: Mapping[str, Any]) -> str:
    words = f"{s.get('keyframes', 0)} keyframes, {s.get('landmarks', 0)} landmarks"
    if s.get("condemned_keyframes"):
        words += f"; of these {s['condemned_keyframes']} and {s.get('condemned_landmarks', 0)} by-passed"
    if s.get("rejected_connections"):
        words += f"; {count(s['rejected_connections'], 'connection')} rejected"
    return words


def _tiles(run: RunData) -> Markup:
    s = run.summary
    latency = s.get("latency_ms") or {}
    rpe = s.get("rpe") or {}
    unposed = sum(run.count(status) for status in WITHOUT_POSE)
    tiles = [
        _tile("coverage", f"{100 * s.get('coverage', 0):.1f} %", f"{s.get('posed', 0)} of {len(run.rows)} frames"),
        _tile("failures", str(s.get("failures", 0)), f"{count(unposed, 'frame')} without a pose"),
        _tile("recoveries", str(s.get("recoveries", 0)), _recovery_words(s)),
        _tile("submaps", str(s.get("submaps", 0)), _submap_words(s)),
    ]
    if s.get("ate_rmse_m") is not None:
        tiles.append(_tile("ATE", f"{number(s['ate_rmse_m'])} m", "RMSE of the main map, Sim(3)-aligned"))
    if rpe.get("rotation_deg_median") is not None:
        translation = rpe.get("translation_pct_median")
        rest = "" if translation is None else f", {number(translation)} % of the way"
        tiles.append(_tile("error over 1 s", f"{number(rpe['rotation_deg_median'])}°", f"median rotation{rest}"))
    if latency:
        words = f"median; 95 % below {duration(latency['p95'])}"
        tiles.append(_tile("latency", duration(latency["median"]), words))
    tiles.append(_tile("speed", f"{number(s.get('fps'))} fps", f"peak memory {number(s.get('peak_rss_mb'), 4)} MB"))
    return tag("dl", tiles, cls="tiles")


def _recovery_words(summary: dict[str, Any]) -> str:
    seconds = sorted(summary.get("recovery_s") or [])
    if not seconds:
        words = "links made by reverse tracking"
    else:
        words = f"links made; {number(seconds[len(seconds) // 2])} s each (median)"
    return "; ".join([words, *seen_again(summary)])


def _tile(name: str, value: str, words: str) -> Markup:
    return tag("div", tag("dt", name), tag("dd", value), tag("dd", words, cls="note"))


def _section(title: str, content: object) -> Markup | None:
    return None if content is None else tag("section", tag("h2", title), content)


def _configuration(run: RunData) -> Markup:
    default = Config().model_dump(mode="json")
    usual = dict(flattened(default))
    rows = [
        tag("tr", tag("th", name, scope="row"), tag("td", _short(value)), tag("td", _short(was)))
        for name, value in flattened(run.config)
        if (was := usual.get(name)) != value
    ]
    changes = tag("div", table(("field", "here", "default"), rows, "plain"), cls="scroll")
    words = tag("p", "All fields have their default values.", cls="empty")
    whole = tag("details", tag("summary", "The whole configuration"), tag("pre", run.config_text))
    return join([changes if rows else words, whole])


def _short(value: object) -> str:
    """Return a setting's value; one that a run found itself has more digits than anybody reads."""
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def flattened(config: dict[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    """Return all fields of a configuration by their dotted names, with their values."""
    found: list[tuple[str, Any]] = []
    for name, value in config.items():
        found += flattened(value, f"{prefix}{name}.") if isinstance(value, dict) else [(prefix + name, value)]
    return found


def _events(run: RunData) -> Markup:
    if not run.events:
        return tag("p", "Nothing happened.", cls="empty")
    rows = [
        (
            str(event.get("frame", "")),
            f"{event.get('timestamp_s', 0.0):.2f} s",
            str(event.get("event", "")).replace("_", " "),
            "-" if event.get("submap") is None else str(event["submap"]),
            event_words(event),
        )
        for event in run.events[:MAX_EVENTS]
    ]
    words = count(len(run.events), "event")
    if len(run.events) > MAX_EVENTS:
        words += f", of which the first {MAX_EVENTS} are here and all in {EVENTS}"
    return tag("details", tag("summary", words), cards(tuple(_EVENT_COLUMNS), rows, _EVENT_COLUMNS))


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
