"""Terminal output of a run: progress, the last line, and a table of where the time went."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

from dualslam.cli.logs import CLEARED
from dualslam.core.interfaces import Sequence
from dualslam.report.statuses import count, seen_again
from dualslam.run.session import Outcome, Watcher
from dualslam.viewer.progress import Progress


@contextmanager
def progress(sequence: Sequence, quiet: bool) -> Iterator[Watcher | None]:
    """Say on stderr how far the frames are, if a person watches; otherwise nothing."""
    if quiet or not sys.stderr.isatty():
        yield None
        return
    try:
        total: int | None = len(sequence)
    except TypeError:  # a webcam has no length
        total = None
    shown = Progress(total)
    try:
        yield shown
    finally:
        shown.end()


@contextmanager
def waiting(what: str, quiet: bool) -> Iterator[None]:
    """Say on stderr, if a person watches, what goes on that nothing counts."""
    if quiet or not sys.stderr.isatty():
        yield
        return
    print(f"{what} ...", end="", file=sys.stderr, flush=True)
    try:
        yield
    finally:
        print(CLEARED, end="", file=sys.stderr, flush=True)


def final_line(outcome: Outcome) -> str:
    """Return coverage, submaps, failures, revisited places, speed, why there is no map, and place in one line."""
    s = outcome.summary
    n_apart = s["posed_in_all_submaps"] - s["posed"]
    is_one = s["submaps"] > 1 and s["links"] >= s["submaps"] - 1 and not n_apart
    parts = [
        f"coverage {100 * s['coverage']:.1f} % ({s['posed']} of {s['frames']} frames)",
        count(s["submaps"], "submap") + (" (linked)" if is_one else ""),
        count(s["failures"], "failure"),
    ]
    if s["recoveries"]:
        parts.append(count(s["recoveries"], "recovery", "recoveries"))
    parts += seen_again(s)
    if s["first_id"] and n_apart:
        parts.append(f"{count(n_apart, 'frame')} posed in submaps that are not joined to the saved map")
    if s["dropped"]:
        parts.append(f"{s['dropped']} frames dropped")
    if s.get("ate_rmse_m") is not None:
        parts.append(f"ATE {s['ate_rmse_m']:.3g} m")
    if "focal_search" in s and (refined := s["refined"]) is not None:
        sigma_px = refined["focal_px"] * refined["log_focal_sigma"]
        parts.append(f"focal length {refined['focal_px']:.0f} ± {sigma_px:.0f} px")
    parts.append(f"{s['fps']:.1f} frames/s")
    lead = "interrupted: " if s["interrupted"] else "" if outcome.has_map else f"{_nothing(outcome)}: "
    why = f"; {s['no_map']}" if s.get("no_map") else ""
    return f"{lead}{', '.join(parts)}{why}; results in {outcome.out}"


def verdict_line(outcome: Outcome) -> str:
    """Return in one line how far to trust a run, and why."""
    verdict = outcome.summary["verdict"]
    return " ".join([f"verdict: {verdict['level']}.", *(reason["text"] for reason in verdict["reasons"])])


def no_map_line(outcome: Outcome) -> str:
    """Return in one line why a run has no map: an error, which is printed even if nothing else is (``--quiet``)."""
    why = outcome.summary.get("no_map")
    return f"{_nothing(outcome)}{f': {why}' if why else ''}; results in {outcome.out}"


def _nothing(outcome: Outcome) -> str:
    return "not found in the saved map" if outcome.summary["first_id"] else "no map"


def stage_table(outcome: Outcome) -> str:
    """Return CPU and wall time of each stage, of the background processes, and of the whole."""
    n_frames = max(len(outcome.report.latencies_ms), 1)
    total_s, system = outcome.report.cpu_s, outcome.system
    lines = [f"{'stage':<28}{'calls':>8}{'CPU s':>10}{'ms/frame':>10}{'share':>8}{'wall s':>10}{'longest ms':>12}"]

    def add(name: str, calls: int, seconds: float, wall_s: float | None = None, longest_s: float | None = None) -> None:
        share = 100 * seconds / total_s if total_s else 0.0
        line = f"{name:<28}{calls:>8}{seconds:>10.2f}{1e3 * seconds / n_frames:>10.2f}{share:>7.1f}%"
        line += "" if wall_s is None else f"{wall_s:>10.2f}"
        lines.append(line if longest_s is None else f"{line}{1e3 * longest_s:>12.0f}")

    for name, stage in sorted(system.timer.stages.items(), key=lambda item: -item[1].seconds):
        timed = stage.wall_s > 0
        add(name, stage.calls, stage.seconds, *((stage.wall_s, stage.longest_s) if timed else ()))
    for kind, queue in outcome.summary["beside"].items():
        add(f"beside: {kind}", queue["n_done"], queue["cpu_s"], longest_s=queue["longest_s"], wall_s=queue["wall_s"])
    add("whole, all processes", n_frames, total_s, outcome.report.wall_s)
    lines += [
        "(the whole holds reading and everything between the stages; a stage named (in x) is part of x)",
        "(beside: in processes of their own, --workers; their longest counts from when a job was submitted)",
    ]
    return "\n".join(lines)
