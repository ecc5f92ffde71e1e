"""One whole run: build the system, feed it a sequence, keep what it found in a run folder."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from hashlib import sha256
from itertools import islice
from pathlib import Path
from typing import Any, Protocol

from dualslam import __version__
from dualslam.build import build_system
from dualslam.build.parts import atlas_solver, metric_parts
from dualslam.core.camera.base import Camera
from dualslam.core.camera.focal import FocalSearch
from dualslam.core.config.files import dump_config
from dualslam.core.config.settings import Config
from dualslam.core.errors import InputError, OutputError, SolverError
from dualslam.core.events import EventKind
from dualslam.core.interfaces import Sequence
from dualslam.core.metric_problem import MeasurementSource
from dualslam.core.resources import spare_cores
from dualslam.core.schedule import SCHEDULE, Recorded, header_of
from dualslam.core.types import Frame
from dualslam.io.colours import Colours, keyframe_indices, landmark_colours, save_colours, save_pictures
from dualslam.io.map_store import load_atlas, save_atlas
from dualslam.io.masks import hidden_pixels, masked
from dualslam.io.run_folder import TRAJECTORY, RunFolder, RunRecord, check_vacant
from dualslam.io.sequence import RecordedSequence, Selection
from dualslam.io.trajectory_files import Trajectory
from dualslam.io.video import WebcamSequence
from dualslam.lab.disturbances import corrupted
from dualslam.map.frame_records import FrameResult
from dualslam.report import PlaceAlbum, SampleKeeper, read_run, report_page
from dualslam.run.before import with_frontend_chosen
from dualslam.run.claims import claims_in_atlas
from dualslam.run.interrupts import Interrupts
from dualslam.run.judgement import judge_run
from dualslam.run.map_camera import camera_that_fits, in_size_of_map
from dualslam.run.measuring import Measured, measure, write_measured, write_relative
from dualslam.run.no_map import ImageFaults, StartRefusals
from dualslam.run.results import Trajectories, frame_rows, summarise, trajectories_of, truth_of_frames
from dualslam.run.runner import RunReport, run_sequence
from dualslam.run.sources import WorldSequence
from dualslam.system.audit.verdict import Reason
from dualslam.system.system import System
from dualslam.viewer.map_page import map_page
from dualslam.workers.desk import WorkerDesk

log = logging.getLogger(__name__)

SEARCHED_SIGMA = 0.031
"""Of the log focal length of a camera that was searched for, beside what self-calibration claims: what the lens leaves
that it has no model for. With it the errors of eight pieces of recordings come to what is claimed (docs/notes, "A
camera of which nothing is known")."""

SAVE_S, SAVING_SHARE = 10.0, 0.01
"""How often frames and trajectory are written while a run goes on, which may be killed. Where that takes long it comes
less often, so that this is its share of the time."""
N_PICTURES = 60
"""On ``map.html``, beside the slider: 200 KB."""
SEEN_AGAIN = (EventKind.LOOP_CLOSED, EventKind.MERGED, EventKind.RELOCALISED)
"""Of these places pictures are kept."""


class Watcher(Protocol):
    """Someone who looks on while a run goes on, such as a live view."""

    def begin(self, system: System) -> None:
        """Learn of the system, before its first frame."""
        ...

    def after(self, frame: Frame, result: FrameResult) -> None:
        """Look at a frame and its result."""
        ...

    def is_paused(self) -> bool:
        """Whether the run is to wait before its next frame."""
        ...

    def end(self) -> None:
        """Look at the whole map, once the run has ended."""
        ...


class Watchers:
    """Several who look on, as one: the run waits where any of them wants it to."""

    def __init__(self, watchers: Iterable[Watcher]) -> None:
        self._all = tuple(watchers)

    def begin(self, system: System) -> None:
        """Let all learn of the system."""
        for each in self._all:
            each.begin(system)

    def after(self, frame: Frame, result: FrameResult) -> None:
        """Let all look at a frame."""
        for each in self._all:
            each.after(frame, result)

    def is_paused(self) -> bool:
        """Whether any of them wants the run to wait."""
        return any(each.is_paused() for each in self._all)

    def end(self) -> None:
        """Let all look at the whole map."""
        for each in self._all:
            each.end()


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """A run that has been written down."""

    out: Path
    summary: dict[str, Any]  # as in ``summary.json``
    report: RunReport
    system: System  # with the whole map
    trajectories: Trajectories

    @property
    def has_map(self) -> bool:
        """Whether any frame has a pose."""
        return bool(self.summary["posed"])


def run_to_folder(
    config: Config,
    sequence: Sequence,
    out: str | Path,
    *,
    overwrite: bool = False,
    realtime: bool = False,
    on_frame: Callable[[FrameResult], None] | None = None,
    build: Callable[..., System] | None = None,
    saved_map: str | Path | None = None,
    localise: bool = False,
    focal: FocalSearch | None = None,
    watcher: Watcher | None = None,
    replay: str | Path | None = None,
    decisions: bool = False,
    measurements: Iterable[MeasurementSource] = (),
) -> Outcome:
    """Run on a sequence and write a run folder. What an interrupted run, or one that crashed, has found is kept.

    Parameters
    ----------
    config : Config
    sequence : Sequence
        As it is recorded: the config's corruptions are put on it here. With ground truth (an attribute
        `ground_truth`), the summary holds the errors.
    out : path
    overwrite, realtime : bool
    on_frame : callable, optional
        Called with each frame's result.
    build : callable, optional
        Makes the system, as `build_system` does, which is asked if it is not given. Of keywords it gets `schedule`, if
        a run is repeated, and `saved` and `localise`, if a map is given.
    saved_map : path, optional
        Run folder whose map this run finds its frames in, and extends. It is read and never written.
    localise : bool
        Find poses in it, and add nothing.
    focal : FocalSearch, optional
        How the camera was found, where nothing was known of it; for the summary.
    watcher : Watcher, optional
    replay : path, optional
        Run folder whose schedule is repeated, in one process: when answers were used, and which frames were dropped.
    decisions : bool
        Write ``decisions.jsonl``: every decision with its numbers and thresholds.
    measurements : iterable of MeasurementSource
        From outside the images: they put the map into their frame at the end.

    Raises
    ------
    ConfigError, InputError, OutputError
    Exception
        Any exception of the system, of `on_frame` or, after its first frame, of the sequence. It is raised once the
        results are written, and a note on it says where.
    KeyboardInterrupt
        If results were being written; a note on it says which are there.
    """
    if not hasattr(sequence, "camera"):
        raise InputError(f"the sequence is a {type(sequence).__name__}; open_source opens one.")
    given = _given(sequence, realtime) | {
        "saved_map": None if saved_map is None else str(saved_map),
        "localise": localise and saved_map is not None,
    }
    if focal is not None:
        given["focal_search"] = focal.as_dict()
    source, sequence = sequence, corrupted(masked(sequence, config.camera.mask), config.corruptions)
    check_out(out, overwrite=overwrite, saved_map=saved_map, replay=replay)
    may_look = isinstance(source, RecordedSequence | WorldSequence) and not realtime
    config, chosen = with_frontend_chosen(config, sequence if may_look else None, saved_map)
    if chosen is not None:
        given["frontend_choice"] = asdict(chosen)
        log.info("front end %s: %s", chosen.name, chosen.why)
    recorded = None if replay is None else Recorded.read(Path(replay) / SCHEDULE)
    parts: dict[str, Any] = {} if recorded is None else {"schedule": recorded}
    colours: Colours = {}
    camera = sequence.camera
    if saved_map is not None:
        comes_once = isinstance(sequence, WebcamSequence)
        sequence = in_size_of_map(sequence, saved_map)
        camera = sequence.camera
        if not comes_once:
            camera = camera_that_fits(config, sequence, camera, saved_map)
        saved = load_atlas(saved_map)
        colours = saved.colours
        parts |= {"saved": saved, "localise": localise}
    system = (build or build_system)(config, camera, **parts)
    with closing(system.desk), RunFolder(out, overwrite=overwrite) as folder:
        folder.write_config(dump_config(config))
        origin = _origin(config, given)
        system.desk.on_record = folder.append_schedule
        folder.append_schedule(header_of(system.desk.policy, realtime, **origin))
        if recorded is not None:
            warn_of_differences(recorded, origin)
        if decisions:
            system.events.decisions.write = lambda decision: folder.append_decision(
                system.numbers.told(decision).as_dict()
            )

        refusals = StartRefusals()
        poses_so_far = _PosesSoFar(system, folder)

        def after_frame(result: FrameResult) -> None:
            _write_new_events(system, folder)
            poses_so_far.write_if_due()
            refusals.note(result)
            if on_frame is not None:
                on_frame(result)

        prepare = system.features_beside() if realtime and spare_cores(1) else None
        if realtime and isinstance(system.desk.executor, WorkerDesk):
            system.desk.executor.wait_until_ready()
        album = PlaceAlbum(folder.write_sample)
        watcher = Watchers(()) if watcher is None else watcher
        faults = ImageFaults()
        watched = _Watched(system, SampleKeeper(folder.write_sample), album, watcher, faults)
        with Interrupts() as interrupts:
            report = run_sequence(
                watched,
                sequence,
                realtime=realtime,
                prepare=prepare,
                pace=system.pace,
                on_frame=after_frame,
                is_paused=watcher.is_paused,
                interrupts=interrupts,
                repeats=recorded,
            )
            poses_so_far.end()
            system.desk.close()  # a system that broke, or was left, has not come to it
            for index in report.dropped:
                folder.append_schedule({"dropped": index})
            if system.rows:
                last = next(reversed(system.rows.values()))
                ended = system.numbers.index_of(last.index)
                folder.append_schedule({"ended": ended, "interrupted": report.interrupted})
            if report.interrupted and system.rows:
                system.events.add(EventKind.INTERRUPTED, last.index, last.timestamp_s, last.submap)
            try:
                folder.restore()
                _write_new_events(system, folder)
                has_map = bool(system.poses) or saved_map is not None
                given["no_map"] = None if has_map else faults.sentence() or refusals.sentence()
                summary, trajectories = _write_results(
                    system, report, config, sequence, folder, given, list(measurements)
                )
                if recorded is not None and replay is not None:
                    summary["replay"] = _compared(folder, Path(replay), recorded)
                    folder.write_summary(summary)
                if isinstance(source, RecordedSequence) and not report.interrupted:
                    _write_colours(system, source, folder, colours)
                save_pictures(folder.map_path, album.evenly(N_PICTURES))
                _write_pages(folder)
            except (OutputError, KeyboardInterrupt) as end:
                end.add_note(folder.what_is_there())
                raise
            except Exception as error:
                if report.bug is None:
                    raise
                raise report.bug from error  # the map of a system that broke may be in pieces
    _raise_what_ended(report, interrupts, out)
    _raise_refused(summary, out)
    return Outcome(Path(out), summary, report, system, trajectories)


def save_system(
    system: System,
    config: Config,
    camera: Camera,
    report: RunReport,
    out: str | Path,
    *,
    overwrite: bool = False,
    measurements: Iterable[MeasurementSource] = (),
    given: Mapping[str, Any] | None = None,
    colours: Colours | None = None,
    reasons: Iterable[Reason] = (),
) -> None:
    """Write the run folder of a finished system that a program fed by itself.

    - `camera`: as it was given.
    - `given`: what the summary says of the run's origin besides, or instead.
    - `colours` (mapping of int to (N, 3) uint8): of each submap's landmarks.
    - `reasons`: what is known against the run besides.

    Raises `InputError` if the measurements cannot belong to the map; the folder is written without them.
    Raises `OutputError`.
    """
    sequence = _Fed(camera)
    check_out(out, overwrite=overwrite)
    with RunFolder(out, overwrite=overwrite) as folder:
        folder.write_config(dump_config(config))
        _write_new_events(system, folder)
        origin = _given(sequence, False) | {"saved_map": None, "localise": False, "no_map": None} | dict(given or {})
        summary, _ = _write_results(system, report, config, sequence, folder, origin, list(measurements), reasons)
        if colours:
            save_colours(folder.map_path, colours)
        _write_pages(folder)
    _raise_refused(summary, out)


class _Fed:
    """Stands for the sequence if a program has fed a system."""

    name, rate_hz = "python", 0.0

    def __init__(self, camera: Camera) -> None:
        self.camera = camera

    def __len__(self) -> int:
        return 0

    def __iter__(self) -> Iterator[Frame]:
        return iter(())


def _raise_what_ended(report: RunReport, interrupts: Interrupts, out: str | Path) -> None:
    """Raise what has broken a run, or interrupted it too late to end it, now that its results are written."""
    if not report.interrupted:
        try:
            interrupts.act_late()
        except KeyboardInterrupt as late:
            late.add_note(f"All results are in {out}.")
            raise
    if report.bug is not None:
        report.bug.add_note(f"What was found until then is in {out}.")
        raise report.bug
    if report.error is not None:
        raise type(report.error)(f"{report.error} What was found until then is in {out}.")


def _raise_refused(summary: Mapping[str, Any], out: str | Path) -> None:
    if refused := summary.get("measurements", {}).get("refused"):
        raise InputError(f"{refused} The run without measurements is in {out}.")


def _origin(config: Config, given: dict[str, Any]) -> dict[str, Any]:
    """Return what a run's trajectory depends on besides its schedule, for the schedule's first line."""
    return {
        "version": __version__,
        "sequence": given["sequence"],
        "selection": given["selection"],
        "workers": config.recovery.workers,
        "config": sha256(dump_config(config).encode()).hexdigest()[:16],
    }


def warn_of_differences(recorded: Recorded, origin: dict[str, Any]) -> None:
    """Tell in what a repetition differs from the recorded run before it begins."""
    for name, value in origin.items():
        if recorded.header.get(name) != value:
            log.warning("the recorded run has another %s: %s, not %s", name, recorded.header.get(name), value)


def _compared(folder: RunFolder, replay: Path, recorded: Recorded) -> dict[str, Any]:
    """Return whether a repetition has come to the same trajectory, and where it has come apart."""
    files = [path / TRAJECTORY for path in (folder.path, replay)]
    same = files[1].is_file() and files[0].read_bytes() == files[1].read_bytes()
    return {"run": str(replay), "same_trajectory": same, "departure": recorded.departure or None}


def check_out(
    out: str | Path, *, overwrite: bool = False, saved_map: str | Path | None = None, replay: str | Path | None = None
) -> None:
    """Refuse a folder that a run must not write to. `run_to_folder` asks too: this is for who computes before it.

    Raises `InputError`, `OutputError`.
    """
    if replay is not None and Path(out).resolve() == Path(replay).resolve():
        raise InputError(f"{out} holds the run that is to be repeated; give another folder to write to.")
    if saved_map is not None and Path(out).resolve() == Path(saved_map).resolve():
        raise InputError(f"{out} holds the map that this run is to continue; give another folder to write to.")
    check_vacant(Path(out), overwrite=overwrite)


def _given(sequence: Sequence, realtime: bool) -> dict[str, Any]:
    """Return what a run takes besides its config, without which the config does not give the same run again."""
    selection: Selection | None = getattr(sequence, "selection", None)  # not every sequence has one
    return {
        "sequence": sequence.name,
        "source": getattr(sequence, "source", "") or None,
        "topic": getattr(sequence, "topic", None),
        "calibration": getattr(sequence, "calibration", "") or None,
        "selection": None if selection is None else asdict(selection),
        "realtime": realtime,
        "camera": sequence.camera.to_dict(),
    }


def refined_camera(system: System, was_searched: bool) -> dict[str, Any] | None:
    """Return what self-calibration has made of the camera, and how sure it is; None where nothing."""
    sigma = system.log_focal_sigma
    if sigma is None:
        return None
    if was_searched:
        sigma = math.hypot(sigma, SEARCHED_SIGMA)
    return {"focal_px": float(system.camera.K[0, 0]), "log_focal_sigma": sigma, "camera": system.camera.to_dict()}


def _write_results(
    system: System,
    report: RunReport,
    config: Config,
    sequence: Sequence,
    folder: RunFolder,
    given: dict[str, Any],
    sources: list[MeasurementSource],
    reasons: Iterable[Reason] = (),
) -> tuple[dict[str, Any], Trajectories]:
    """Write all that comes at the end of a run; return the summary, which begins with `given`, and the trajectories."""
    trajectories = trajectories_of(system)
    measured, refused = _measured(system, config, trajectories, sources)
    if measured is not None and measured.undone:
        trajectories = trajectories_of(system)
    dropped = set(report.dropped)
    looked_at = [i for i in map(system.numbers.index_of, system.rows) if i not in dropped]
    claims = claims_in_atlas(system.atlas)
    rows = frame_rows(system, trajectories.main, dict(zip(looked_at, report.latencies_ms, strict=False)), claims)
    crashed = report.bug is not None
    verdict = judge_run(system, trajectories, rows, crashed, measured, reasons, claims)
    rows = [replace(row, doubt=verdict.doubt_about(row.index)) for row in rows]
    truth: Trajectory | None = getattr(sequence, "ground_truth", None)
    summary = (
        given
        | {"refined": refined_camera(system, "focal_search" in given)}
        | summarise(system, report, trajectories, config, truth, verdict)
    )
    hidden = hidden_pixels(sequence, system.hidden)
    summary["hidden_share"] = 0.0 if hidden is None else float(hidden.mean())
    if hidden is not None:
        folder.write_mask(hidden)
    if system.log_focal_sigma is not None:
        folder.write_camera(system.camera)
    if measured is not None:
        summary["measurements"] = measured.summary()
    elif refused:
        summary["measurements"] = {"refused": refused}
    folder.write(RunRecord(rows, trajectories.main, trajectories.unlinked, summary))
    if truth is not None and "no_errors" not in summary:
        folder.write_truth(truth_of_frames(truth, rows))
    save_atlas(folder.map_path, system.atlas, system.poses, system.camera)
    index_of = {i: system.numbers.index_of(i) for i in system.rows}
    if measured is not None:
        write_measured(folder.path, measured, index_of)
        log.info("%s", measured.line())
    elif len(trajectories.main):
        solver = atlas_solver(config)
        write_relative(folder.path, system.atlas, system.poses, trajectories.main_submaps, solver, index_of)
    return summary, trajectories


def _measured(
    system: System, config: Config, trajectories: Trajectories, sources: list[MeasurementSource]
) -> tuple[Measured | None, str]:
    """Return the run in the frame of its measurements; or None, and the sentence that refuses them."""
    if not sources or not len(trajectories.main):
        return None, ""
    try:
        found = measure(system.atlas, system.poses, trajectories.main_submaps, sources, metric_parts(config))
    except (InputError, SolverError) as error:
        return None, str(error)
    return found, ""


def _write_colours(system: System, sequence: RecordedSequence, folder: RunFolder, before: Colours) -> None:
    """Read the keyframes again, in colour, and keep the landmarks' colours; `before`: those of a saved map."""
    numbers = {system.numbers.index_of(i): i for i in system.rows}
    try:
        frames = sequence.in_colour(keyframe_indices(system.atlas, numbers))
        save_colours(folder.map_path, landmark_colours(system.atlas, frames, numbers, before))
    except InputError as error:  # the source has gone meanwhile: the map is complete without
        log.warning("the map has no colours: %s", error)


def _write_pages(folder: RunFolder) -> None:
    run = read_run(folder.path)
    if (page := map_page(run)) is not None:
        folder.write_map_page(page)
    folder.write_report(report_page(run))


class _PosesSoFar:
    """Frames and trajectory, written on a thread while a run goes on: what a process leaves that is killed."""

    def __init__(self, system: System, folder: RunFolder) -> None:
        self._system, self._folder = system, folder
        self._thread = ThreadPoolExecutor(1)
        self._writing: Future[None] | None = None
        self._due_s = time.monotonic() + SAVE_S

    def write_if_due(self) -> None:
        """Begin to write.

        Raises `OutputError` if the last time it could not be done.
        """
        if self._writing is not None and self._writing.done():
            self._writing.result()
            self._writing = None
        if self._writing is None and time.monotonic() >= self._due_s:
            self._writing = self._thread.submit(self._write, trajectories_of(self._system), time.monotonic())

    def _write(self, found: Trajectories, began_s: float) -> None:
        rows = frame_rows(self._system, found.main, claims={})
        self._folder.write_poses(RunRecord(rows, found.main, found.unlinked))
        ended_s = time.monotonic()
        self._due_s = ended_s + max(SAVE_S, (ended_s - began_s) / SAVING_SHARE)

    def end(self) -> None:
        """Wait for what is being written."""
        self._thread.shutdown()


class _Watched:
    """A system whose frames are looked at: for sample pictures, and by who watches the run."""

    def __init__(
        self, system: System, samples: SampleKeeper, album: PlaceAlbum, watcher: Watcher, faults: ImageFaults
    ) -> None:
        self._system, self._samples, self._album, self._watcher = system, samples, album, watcher
        self._faults = faults
        self._n_events = len(system.events)
        watcher.begin(system)

    def keep(self, frame: Frame) -> None:
        self._system.keep(frame)

    def step(self, frame: Frame) -> FrameResult:
        result = self._system.step(frame)
        if frame.image is not None and not self._system.poses:
            self._faults.note(frame.image)
        self._samples.take(frame, result.status)
        self._album.take(frame, result.status)
        self._show_places()
        self._watcher.after(frame, result)
        return result

    def finish(self, interrupted: bool = False) -> None:
        try:
            self._system.finish(interrupted)
            self._show_places()
        except KeyboardInterrupt:
            self._watcher.end()  # the run has ended for who looks on, too
            raise
        finally:
            self._samples.finish()
        self._watcher.end()

    def _show_places(self) -> None:
        numbers = self._system.numbers
        for event in islice(self._system.events, self._n_events, None):
            if event.event in SEEN_AGAIN:
                frames = [event.data.get("keyframe", event.frame), event.data.get("other_frame")]
                self._album.show([numbers.index_of(i) for i in frames if i is not None])
        self._n_events = len(self._system.events)


def _write_new_events(system: System, folder: RunFolder) -> None:
    for event in islice(system.events, folder.n_events, None):
        folder.append_event(system.numbers.told(event))
