"""Small figures and tables of numbers: the latency histogram and where the time went."""

from __future__ import annotations

import numpy as np

from dualslam.core.types import FrameStatus
from dualslam.report.markup import Markup, duration, join, number, number_row, stretched, table, tag
from dualslam.report.run_data import RunData

BINS_PER_DECADE = 8


def latency_histogram(run: RunData) -> Markup:
    """Return how the frames' wall times are spread, in bins of equal ratio."""
    latency = np.array([row.latency_ms for row in run.rows if row.status is not FrameStatus.DROPPED])
    latency = latency[latency > 0]
    if not len(latency):
        return tag("p", "No frame was looked at.", cls="empty")
    low, high = np.floor(np.log10(latency.min())), np.ceil(np.log10(latency.max()) + 1e-9)
    high = max(high, low + 1)
    n_bins = int(BINS_PER_DECADE * (high - low))
    counts, edges = np.histogram(np.log10(latency), bins=n_bins, range=(low, high))
    bars = [
        tag(
            "rect",
            tag("title", f"{number(10**a)} to {number(10**b)} ms: {c} frames"),
            x=float(i) + 0.06,
            y=float(100 * (1 - c / counts.max())),
            width=0.88,
            height=float(100 * c / counts.max()),
            cls="bar",
        )
        for i, (c, a, b) in enumerate(zip(counts.tolist(), edges[:-1], edges[1:], strict=True))
        if c
    ]
    words = [
        tag("span", duration(10.0**d), cls=f"at tick{side}", style=f"left:{100 * (d - low) / (high - low):.2f}%")
        for d in np.arange(low, high + 1)
        for side in (" inward-right" if d == low else " inward-left" if d == high else "",)
    ]
    marks = []
    for name, share in (("median", 50), ("95 %", 95), ("max", 100)):
        value = float(np.percentile(latency, share))
        left = 100 * (np.log10(value) - low) / (high - low)
        title = f"{name}: {duration(value)}"
        marks.append(tag("span", cls="at rule", style=f"left:{left:.2f}%", title=title))
    svg = stretched(n_bins, 100, bars, "Histogram of the frames' latency")
    median, p95, most = (duration(float(np.percentile(latency, q))) for q in (50, 95, 100))
    caption = f"Median {median}, 95 % of the frames below {p95}, longest {most} (upright lines)."
    return tag("figure", tag("div", svg, marks, words, cls="histogram"), tag("figcaption", caption))


def stage_table(run: RunData) -> Markup:
    """Return CPU time a frame of each stage."""
    stages = run.summary.get("stages_cpu_s") or {}
    looked_at = sum(row.status is not FrameStatus.DROPPED for row in run.rows)
    if not stages or not looked_at:
        return join(None)
    longest = max(stages.values())
    rows = [
        tag(
            "tr",
            tag("th", name, scope="row"),
            tag("td", f"{number(1e3 * seconds / looked_at)} ms", cls="num"),
            tag("td", tag("i", style=f"width:{100 * seconds / max(longest, 1e-12):.1f}%"), cls="meter"),
        )
        for name, seconds in sorted(stages.items(), key=lambda item: -item[1])
    ]
    return table((), rows, "plain stages", "CPU time a frame, by stage. A stage named (in x) is part of x.")


def beside_table(run: RunData) -> Markup:
    """Return the work of background processes, by kind of job; nothing where there were none."""
    beside = run.summary.get("beside") or {}
    if not beside:
        return join(None)
    heads = ("", "jobs", "failed", "waited at once", "longest", "CPU", "peak memory")
    rows = [
        number_row(
            kind,
            (
                *(str(queue[name]) for name in ("n_done", "n_failed", "max_waiting")),
                duration(1e3 * queue["longest_s"]),
                f"{number(queue['cpu_s'])} s",
                f"{number(queue['peak_rss_mb'], 4)} MB",
            ),
        )
        for kind, queue in beside.items()
    ]
    caption = "Background work, in processes of its own. The longest time counts from when a job was submitted."
    return table(heads, rows, "plain stages", caption)


def pace_words(run: RunData) -> Markup:
    """Return what a run in real time left out; nothing where it was none."""
    if not run.summary.get("realtime"):
        return join(None)
    pace = run.summary.get("pace") or {}
    words = (
        f"In real time: {run.summary.get('late', 0)} frames were looked at after they were due, "
        f"{run.summary.get('dropped', 0)} came too late and were dropped; a keyframe was put off at "
        f"{pace.get('put_off', 0)} frames, and the graph beside lagged by {pace.get('max_lag_keyframes', 0)} keyframes "
        "at most. Latency is from the moment a frame is due to its pose."
    )
    return tag("p", words, cls="note")
