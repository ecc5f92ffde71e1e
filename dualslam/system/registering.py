"""Registration at the end of a run: frames outside the main map are looked for in it, whatever their order."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from dataclasses import replace
from functools import partial

import numpy as np

from dualslam.atlas.connections import Connections
from dualslam.atlas.record import FrameStamp
from dualslam.atlas.trajectory import FramePose, Path
from dualslam.core.errors import SolverError
from dualslam.core.events import EventKind
from dualslam.core.geometry import se3
from dualslam.core.noise_model import MAX_TRIES, PROOF_VIEWS, TINY
from dualslam.core.resources import MB
from dualslam.core.types import FailureReason, FrameMethod, FrameStatus, View
from dualslam.linking.correspondences import landmarks_shown_in
from dualslam.linking.motion import find_reached
from dualslam.linking.scale_observability import position_sigmas
from dualslam.map.frame_observations import FrameObservations
from dualslam.map.submap import Submap
from dualslam.recovery.registration import REACH, Registration
from dualslam.system.state import State

log = logging.getLogger(__name__)

LOOKS_ALIKE = (FailureReason.LOOK_ALIKE, FailureReason.AMBIGUOUS_MODEL)
"""Refusals of a pose or a join because a second one explains as much."""


class Registering:
    """Keeps the features of frames without a pose, and registers them in the main map when the run is over."""

    def __init__(self, state: State, connections: Connections) -> None:
        self._state, self._connections = state, connections
        self._kept: dict[int, View] = {}
        self._nbytes = 0

    def note(self, view: View) -> None:
        """Keep a frame that has no pose, without its image; as many of them as the frame buffer may hold."""
        state = self._state
        if view.index in state.record.poses or len(view.features) < state.config.health.min_inliers:
            return
        if self._nbytes + view.features.nbytes <= state.config.buffer.max_mb * MB:
            self._kept[view.index] = replace(view, image=None)
            self._nbytes += view.features.nbytes

    def finish(self, now: FrameStamp) -> None:
        """Register frames in the submaps of the main map, the one with most frames first; tie what shows the same."""
        if self._state.record.poses:
            self._register_outside(now)
            self._tie()

    # --- steps

    def _tie(self) -> None:
        """Let keyframes of a submap that show the same share its landmarks, and bend the submap accordingly."""
        record, parts = self._state.record, self._state.parts
        with record.timer.measure("ties"):
            copies = self._showing_copies()
            for m, submap in record.atlas.submaps.items():
                if m in copies:
                    continue
                before = submap.copy()
                if not (n := parts.new_registrar(submap).tie(partial(self._find_alike, submap))):
                    continue
                try:
                    parts.settle_ties(submap)
                except SolverError as error:
                    log.warning("submap %d is not tied: %s", m, error)
                    submap.take_over(before)
                    continue
                self._connections.carry(before, submap)
                log.info("submap %d: %d pairs of features show one landmark", m, n)

    def _showing_copies(self) -> set[int]:
        """Return the submaps in which things look alike: a second pose or place explained as much as the first."""
        events = self._state.record.events.of_kind(EventKind.FAILED, EventKind.LINK_REFUSED, EventKind.LOOP_REFUSED)
        refused = [event for event in events if event.data.get("reason") in LOOKS_ALIKE]
        named = [(event.submap, event.data.get("old_submap"), event.data.get("other_submap")) for event in refused]
        return {m for submaps in named for m in submaps if m is not None}

    def _find_alike(self, submap: Submap, ids: Collection[int]) -> dict[int, list[int]]:
        """Return which of some keyframes resemble each other."""
        return self._state.parts.alike({k: submap.keyframes[k].features for k in ids}, ids, REACH + 1)

    def _register_outside(self, now: FrameStamp) -> None:
        atlas, record = self._state.record.atlas, self._state.record
        count = Counter(pose.submap_id for pose in record.own_poses())
        main = atlas.largest(count + self._shown_under_a_better_camera())
        with record.timer.measure("registration"):
            views = self._outside(main)
            if not views:
                return
            whole = len(views) > sum(count[m] for m in main)
            largest, *rest = sorted(main, key=lambda m: (-count[m], m))
            if whole:
                views |= self._views_of(rest)
            alike = self._alike(views, main)
            for m in [largest] if whole else [largest, *rest]:
                self._register(atlas.submaps[m], views, alike, now)
                views = {i: view for i, view in views.items() if i not in atlas.submaps[m].keyframes}

    def _shown_under_a_better_camera(self) -> Counter[int]:
        """Return of how many frames of lost maps each submap shows keyframes, where it found the camera for these.

        The lost maps are bent: they were tracked under another camera. So their frames are due to the later map.
        """
        record, shown = self._state.record, Counter[int]()
        for event in record.events.of_kind(EventKind.CALIBRATED):
            if event.submap is None:  # all maps took that camera
                continue
            submap = record.atlas.submaps[event.submap]
            apart = set(event.data["lost"]) - set(record.atlas.component_of(submap.id))
            on = Counter(pose.keyframe_id for pose in record.own_poses() if pose.submap_id in apart)
            shown[submap.id] += sum(n for k, n in on.items() if self._shows_enough(submap, k))
        return shown

    def _outside(self, main: list[int]) -> dict[int, View]:
        """Return the frames outside the main map: those without a pose, and the keyframes of other submaps."""
        record, parts = self._state.record, self._state.parts
        posed = {pose.index for pose in record.own_poses() if pose.submap_id in main}
        camera = parts.calibration.camera
        kept = [parts.scene.masked(self._kept[i]) for i in sorted(self._kept.keys() - record.poses.keys())]
        kept = [parts.calibration.rectified(view) for view in kept]
        if parts.shutter.readout_s:
            kept = parts.shutter.all_corrected(kept, camera)
        others = self._views_of(m for m in record.atlas.submaps if m not in main)
        views = {view.index: view for view in kept} | others
        return {i: views[i] for i in sorted(views) if i not in posed}

    def _views_of(self, submap_ids: Iterable[int]) -> dict[int, View]:
        """Return the keyframes of some submaps that their frames stand on."""
        record, found = self._state.record, dict[int, View]()
        for m in submap_ids:
            submap = record.atlas.submaps[m]
            for k in submap.keyframes.keys() & record.poses.keys() & record.rows.keys():
                if record.poses[k].submap_id == m:
                    keyframe = submap.keyframes[k]
                    found[k] = View(k, keyframe.timestamp_s, keyframe.features)
        return found

    def _alike(self, views: dict[int, View], main: list[int]) -> dict[int, list[int]]:
        """Return which frames, of these and of the main map's keyframes, each of these resembles."""
        submaps = [self._state.record.atlas.submaps[m] for m in main]
        images = {k: keyframe.features for submap in submaps for k, keyframe in submap.keyframes.items()}
        images |= {i: view.features for i, view in views.items()}
        return self._state.parts.alike(images, views.keys(), REACH + 1)

    def _register(self, submap: Submap, views: dict[int, View], alike: dict[int, list[int]], now: FrameStamp) -> None:
        """Register frames in one submap, and enter their poses; nothing, where the camera cannot have moved so."""
        record, parts = self._state.record, self._state.parts
        grown = submap.copy()
        registrar, health = parts.new_registrar(grown), self._state.config.health
        registration = Registration(grown, dict(views), alike, registrar, parts.adjust, health, parts.walk_watch)
        left_out = set[int]()
        try:
            registration.run()
            for tries_left in reversed(range(MAX_TRIES)):
                added = self._found(registration, views.keys() - left_out)
                if not (refused := self._unreached(submap, grown, added)):
                    break
                left_out |= refused
                if tries_left:
                    registration.run_without(refused)
        except SolverError as error:
            log.warning("no frame is registered in submap %d: %s", submap.id, error)
            return
        data = {"frames": len(added), "asked": len(views), "left_out": len(left_out)}
        if refused or not added:
            if left_out:
                record.event(EventKind.REGISTRATION_REFUSED, now, submap.id, **data)
            return
        before = submap.copy()
        submap.take_over(grown)
        self._connections.carry(before, submap)
        held = self._with_frames()
        self._enter(submap, added)
        record.event(EventKind.REGISTERED, now, submap.id, old_submaps=sorted(held - self._with_frames()), **data)

    def _with_frames(self) -> set[int]:
        """Return the submaps that have frames."""
        return {pose.submap_id for pose in self._state.record.own_poses()}

    def _shows_enough(self, submap: Submap, i: int) -> bool:
        """Whether a frame is a keyframe that reverse tracking left in a submap, and is posed there as well."""
        if i not in submap.keyframes or i in submap.condemned:
            return False
        n_proven = np.count_nonzero(submap.n_observations(submap.seen_in(i)) >= PROOF_VIEWS)
        return bool(n_proven >= self._state.config.health.min_inliers)

    def _found(self, registration: Registration, frames: Iterable[int]) -> list[int]:
        """Return the frames that are registered, and those that reverse tracking has posed in the submap before."""
        registered, submap = set(registration.added), registration.submap
        return [i for i in sorted(frames) if i in registered or self._shows_enough(submap, i)]

    def _unreached(self, before: Submap, grown: Submap, added: list[int]) -> set[int]:
        """Return the registered frames that no steps of the camera join with the submap's own, by covisibility."""
        if not added:
            return set()
        taken = set(added)
        own = [p for p in self._state.record.own_poses() if p.submap_id == before.id and p.index not in taken]
        poses = [FramePose(k, grown.keyframes[k].timestamp_s, grown.id, k, se3.IDENTITY) for k in added]
        path = Path.of([*own, *poses], grown)
        known = ~np.isin(path.index, added)
        sigma = position_sigmas(grown, grown.keyframes.keys() - taken)
        reached = find_reached(
            path, known, path.take(known), np.array([sigma.get(i, 0.0) for i in path.index.tolist()])
        )
        return set(path.index[~reached].tolist())

    def _enter(self, submap: Submap, added: list[int]) -> None:
        """Enter the poses of registered frames, and of the frames that hang on them in another submap."""
        record = self._state.record
        hanging = list(self._hanging_on(submap, added))
        for k in added:
            keyframe, is_new = submap.keyframes[k], k not in record.poses
            seen = FrameObservations.of(keyframe.features, submap.landmark_of[k], submap.id)
            n, pose = len(seen.landmark_ids), FramePose(k, keyframe.timestamp_s, submap.id, k, se3.IDENTITY)
            record.pose(pose, n, n, seen, FrameMethod.WIDE)
            if is_new:
                record.rows[k].status = FrameStatus.RECOVERED
        for pose, seen in hanging:
            record.pose(pose, observations=seen)

    def _hanging_on(self, submap: Submap, added: list[int]) -> Iterator[tuple[FramePose, FrameObservations]]:
        """Yield the frames that hang on registered keyframes of another submap, and have seen enough of the new one.

        The pose is in the unit of the new one, and is found anew by what the frame has seen once that is refined: the
        other submap may be bent.
        """
        record = self._state.record
        taken = {k: record.poses[k].submap_id for k in added if k in record.poses}
        shown = {m: landmarks_shown_in(submap, record.atlas.submaps[m]) for m in set(taken.values())}
        for i, pose in record.poses.items():
            m, seen = pose.submap_id, record.observations.get(i)
            if i not in record.rows or m not in shown or seen is None or seen.submap_id != m:
                continue
            other, seen = record.atlas.submaps[m], seen.in_submap(submap.id, shown[m])
            anchor = other.anchored(pose.keyframe_id, other.resolve_anchor(pose.keyframe_id, pose.T_kf_cam))
            k, own = anchor.keyframe_id, [a for a in taken if taken[a] == m and a != anchor.keyframe_id]
            is_known = len(seen.landmark_ids) >= self._state.config.health.min_inliers
            if i != k and taken.get(k) == m and own and is_known:
                scale = _scale_between(submap, other, k, min(own, key=lambda a: (abs(a - i), a)))
                T_kf_cam = se3.scaled(anchor.T_kf_cam, scale)
                yield replace(pose, submap_id=submap.id, keyframe_id=k, T_kf_cam=T_kf_cam), seen


def _scale_between(submap: Submap, other: Submap, a: int, b: int) -> float:
    """Return by how much two keyframes are farther apart in one submap than in another."""
    here, there = (float(np.linalg.norm(se3.translation(s.T_submap_kf[a] - s.T_submap_kf[b]))) for s in (submap, other))
    return here / max(there, TINY)
