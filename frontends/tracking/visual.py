"""The visual front end: frames in, keyframes of one submap out, in either direction of time.

The same object tracks live frames and, given those of the buffer latest first, tracks in reverse.
"""

from __future__ import annotations

from collections.abc import Set

import numpy as np

from dualslam.core.camera.base import Camera
from dualslam.core.config.settings import Config
from dualslam.core.decisions import Ruling
from dualslam.core.estimates import GraphEstimate, KeyframeReport
from dualslam.core.geometry import se3
from dualslam.core.interfaces import N_WINDOW, Frontend, SubmapGraph, WindowSolver
from dualslam.core.types import Failure, FailureReason, FloatArray, FrameMethod, IntArray, Rival, Track, View
from dualslam.frontends.gap.refinding import Refinder
from dualslam.frontends.gap.uncertainty import track_uncertainty
from dualslam.frontends.tracking.keyframing import keyframe_due, keyframe_like, passes_unmapped
from dualslam.frontends.tracking.mapper import Mapper
from dualslam.frontends.tracking.patch_alignment import PatchAlignment
from dualslam.frontends.tracking.pixel_search import PixelSearch
from dualslam.frontends.tracking.tracker import GivenPose, Tracker
from dualslam.map.anchors import RelativePose
from dualslam.map.submap import Submap
from dualslam.map.submap_change import change_of_frame

REBUILD_INLIER_RATIO = 0.65
"""Share of a keyframe's matches that must agree with its pose, or the graph is made anew in batch: the incremental
estimate has then fallen behind its optimum, and good observations would be dropped as outliers."""
REBUILD_SPACING = 8
"""Keyframes at least between two such batches."""

CULL_BEHIND = 2  # the newest keyframes are not judged redundant: the next ones may need them
N_CULL_CANDIDATES = 10  # of the covisible keyframes, the nearest in what they see
YOUNG_MAP = 10  # keyframes up to which the graph poses each: two or three say little about a fourth
MIN_WINDOW_MATCHES = 40  # landmarks of a keyframe below which a window of its neighbours may be led astray


class VisualFrontEnd:
    """Tracks frames against a submap and extends it by keyframes.

    `camera`: as it was given; it says what an image shows. `refinder`: finds landmarks across gaps in the images
    themselves; without it features alone tie the keyframes there. `looks_everywhere`: see `Tracker`. `window`: poses
    new keyframes before the map grows about them; without it the graph does. `pixels`: see `Tracker`. `first_id`:
    number of this run's first frame; keyframes before it are those of the saved map that it continues.
    """

    def __init__(
        self,
        frontend: Frontend,
        config: Config,
        submap: Submap,
        graph: SubmapGraph,
        camera: Camera,
        *,
        refinder: Refinder | None = None,
        looks_everywhere: bool = False,
        window: WindowSolver | None = None,
        first_id: int = 0,
        pixels: PixelSearch | None = None,
    ) -> None:
        self.submap = submap
        self.graph = graph
        self._frontend = frontend
        self._config = config
        self._tracker = Tracker(
            frontend,
            config.tracking,
            submap,
            camera,
            config.seed,
            looks_everywhere,
            config.linking.max_live_scale_sigma,  # all that is mapped beyond inherits it
            pixels,
        )
        self._mapper = Mapper(frontend, config.mapping, submap, camera)
        self._refinder = refinder
        self._window = window
        self._alignment = None if refinder is None else PatchAlignment(refinder.images, refinder.camera)
        self._first_id = first_id
        self._careful = True  # the next keyframe is the graph's to pose
        self._after_gap = False
        self._apart: frozenset[int] = frozenset()  # keyframes across the last gap, where few landmarks bridge it
        self._reference_id = -1
        self._since_rebuild = 0
        self._kept: frozenset[int] = frozenset()
        self._path: list[int] = []  # keyframes in the order in which this front end met them

    @property
    def reference_id(self) -> int:
        """The keyframe that frames are posed against."""
        return self._reference_id

    def start_at(self, keyframe_id: int) -> None:
        """Begin at a keyframe of the submap, at rest."""
        keyframe = self.submap.keyframes[keyframe_id]
        view = View(keyframe.id, keyframe.timestamp_s, keyframe.features)
        T_cam_submap = se3.inverse(self.submap.T_submap_kf[keyframe_id])
        landmark_ids = self.submap.landmark_of[keyframe_id].copy()
        n = int((landmark_ids >= 0).sum())
        track = Track(
            view, T_cam_submap, T_cam_submap, landmark_ids, np.zeros(0, np.int64), n, n, 1.0, False, np.zeros((6, 6))
        )
        self._tracker.start(track)
        self._reference_id = keyframe_id
        self._path = [keyframe_id]

    def grow_weak_start(self, noise2: float) -> None:
        """Triangulate what else the views of a start match, where its last view holds few landmarks.

        A start holds only points that three views prove. Points of two views help tracking at once; the mapper culls
        them.
        """
        start = self._tracker.last
        assert start is not None, "start_at() comes first"
        if start.n_inliers >= self._config.keyframes.weak_landmarks:
            return
        self._mapper.grow(start, noise2=noise2)
        self._solve()
        self._tracker.refresh()

    def keep(self, keyframe_ids: Set[int]) -> None:
        """Never cull these keyframes, however redundant they become."""
        self._kept = frozenset(keyframe_ids)

    def adopt(self, graph: SubmapGraph, before: Submap) -> None:
        """Go on with another graph of the same submap, whose poses and points have moved since it was `before`."""
        self._careful |= graph is not self.graph
        self.graph = graph
        if self._refinder is not None:
            self._refinder.forget(_moved_features(before, self.submap))
        self._tracker.follow(change_of_frame(before, self.submap, [self._reference_id]))

    def track(self, view: View) -> Track | Failure:
        """Pose a frame against the submap."""
        return self._noted(view, self._tracker.track(view))

    def follow(self, view: View) -> Track | Failure:
        """Pose the frame next to the last one, by guided matching alone."""
        return self._noted(view, self._tracker.track(view, may_relocalise=False))

    def lies_beyond_gap(self, view: View) -> bool:
        """Whether the motion of the last frames does not lead to this one: others between them are missing."""
        return self._tracker.lies_beyond_gap(view)

    def _noted(self, view: View, track: Track | Failure) -> Track | Failure:
        self._note_gap(track)
        if track and view.index in self.submap.keyframes:
            self._meet(view.index)
        return track

    def track_at(self, view: View, pose: GivenPose) -> Track:
        """Take a frame's pose from elsewhere, and find the submap's landmarks in it."""
        track = self._tracker.track_at(view, pose)
        self._note_gap(track)
        if view.index in self.submap.keyframes:
            self._meet(view.index)
        return track

    def scale_sigma_at(self, view: View, pose: GivenPose) -> float:
        """Return how well a frame beyond a gap would hold the scale under a given pose (standard deviation of its log).

        By the submap's landmarks that it would see as a keyframe, those among them that are found again in its image.
        `track_at` goes on from there.
        """
        track = self._tracker.look_at(view, pose)
        if self._refinder is not None:
            self._refinder.begin(view.index)
            track = self._refinder.extend(track, pose_is_given=True)
        found = track_uncertainty(self.submap, track)
        return np.inf if found is None else found[1]

    def track_near(self, view: View, T_cam_submap: FloatArray) -> Track | Failure:
        """Pose a frame by the submap's landmarks, from a pose that is near its own; `take` goes on from there."""
        return self._tracker.track_near(view, T_cam_submap)

    def relocalise(self, view: View, keyframe_id: int) -> Track | Failure:
        """Pose a frame by what a keyframe of the submap and those about it show; go on from there, at rest."""
        self.start_at(keyframe_id)
        return self._tracker.relocalise(view, keyframe_id)

    def look_about(self) -> None:
        """Go by the keyframe that sees most of what the last frame saw, without making that one a keyframe."""
        last = self._tracker.last
        if last is None:
            return
        covisible, _ = self.submap.covisible(last.seen_ids)
        if len(covisible):
            self._reference_id = int(covisible[0])
        self._tracker.refresh()

    def take(self, track: Track) -> None:
        """Go on from a track."""
        self._tracker.take(track)
        self._note_gap(track)

    @property
    def rivals(self) -> tuple[Rival, ...]:
        """None: a pose that has one is not believed."""
        return ()

    def confirmed(self) -> Track | None:
        """Return None: a frame has its pose at once, or none."""
        return None

    def relative_pose(self, track: Track) -> FloatArray:
        """Return ``T_kf_cam``, the track's pose relative to the reference keyframe.

        The reference keyframe itself stands where the graph has put it, not where its frame was tracked.
        """
        if track.view.index == self._reference_id:
            return se3.IDENTITY
        return se3.inverse(self.submap.T_submap_kf[self._reference_id]) @ se3.inverse(track.T_cam_submap)

    def keyframe_due(self, track: Track) -> Ruling:
        """Whether the frame should become a keyframe: not where an earlier run has left one that shows the same."""
        if track.method is FrameMethod.DIRECT:
            return Ruling(False, (), "its landmarks were found by pixels alone")
        ruling = self._shows_other(track)
        if ruling and self._known(track) is not None:
            return Ruling(False, ruling.gates, "a keyframe of an earlier run shows the same")
        return ruling

    def go_by_known(self, track: Track) -> None:
        """Go by the keyframe of an earlier run that makes one of this frame superfluous."""
        if not self._first_id or not self._shows_other(track):
            return
        known = self._known(track)
        if known is not None and known != self._reference_id:
            if known in self._path:  # it is passed again
                self._path.remove(known)
            self._meet(known)
            self._tracker.refresh()

    def _shows_other(self, track: Track) -> Ruling:
        """Whether a frame shows other things than its reference keyframe, or from elsewhere."""
        config, last = self._config, self._reference_id
        ruling = keyframe_due(track, self.submap, last, config.keyframes, self._first_id)
        if ruling or track.view.index in self.submap.keyframes:
            return ruling
        parallax_deg, n = config.keyframes.max_parallax_deg, config.tracking.min_inliers
        if passes_unmapped(track, self.submap, last, self._frontend, parallax_deg, n):
            return Ruling(True, ruling.gates, "the camera passes something that is not mapped")
        return ruling

    def _known(self, track: Track) -> int | None:
        """Return the keyframe of an earlier run that shows the same."""
        return keyframe_like(track, self.submap, self._first_id, self._config.keyframes) if self._first_id else None

    def insert_keyframe(
        self, track: Track, in_haste: bool = False, pose_is_given: bool = False
    ) -> KeyframeReport | Failure:
        """Make the frame a keyframe: pose it by its matches, extend the map from there, solve.

        `in_haste`: no patches are aligned. `pose_is_given`: its pose and covariance come from elsewhere, and count
        beside the landmarks that it sees.

        New landmarks of a wrong pose would confirm it. The keyframe is therefore posed by its matches before any is
        made: by a window of its neighbours, or by the whole graph where these could be led astray. Where most of the
        matches are refused, the frame's pose is wrong: the map is left without it.
        """
        if pose_is_given:
            known = RelativePose(self._reference_id, self.relative_pose(track), track.covariance)
            self.submap.relative_poses[track.view.index] = known
        track = self._refound(track, pose_is_given)
        self._mapper.observe(track)
        self._align(self._rows_of(track.view.index), in_haste)
        matched = self._rows_of(track.view.index)
        rebuild = self._rebuild_due(track)
        posed = self._pose(track, len(matched), pose_is_given)
        n_refused = int(np.isin(matched, posed.outlier_rows).sum())
        if n_refused > self._config.health.max_refused * len(matched):
            self._withdraw(track.view.index)
            detail = f"the map contradicts {n_refused} of {len(matched)} matches of keyframe {track.view.index}"
            return Failure(FailureReason.CHI_SQUARE, detail, {"n_refused": float(n_refused)})
        n_before = len(self.submap.observations)
        self._mapper.grow(track, self._apart, posed.noise2)
        grown_rows = np.arange(n_before, len(self.submap.observations))
        self._align(grown_rows[self.submap.observations["alive"][grown_rows]], in_haste)
        grown = self._solve(rebuild)
        self._meet(track.view.index)
        self._cull_keyframe()
        self._tracker.refresh()
        failed = posed.rebuilt or (grown.rebuilt and not rebuild)
        return KeyframeReport(posed, grown, failed)

    def _align(self, rows: IntArray, in_haste: bool) -> None:
        """Align observations with older ones of their landmarks, where images are kept and there is time."""
        if self._alignment is not None and not in_haste:
            self._alignment.refine(self.submap, rows)

    def _pose(self, track: Track, n_matched: int, pose_is_given: bool) -> GraphEstimate:
        """Pose the new keyframe, and drop what contradicts it."""
        careful = self._careful or pose_is_given or track.wide or self._window is None
        if not careful and len(self.submap.keyframes) > YOUNG_MAP and n_matched >= MIN_WINDOW_MATCHES:
            assert self._window is not None
            posed = self._window(self.submap, [track.view.index, *reversed(self._path[1 - N_WINDOW :])])
            if not isinstance(posed, Failure):
                return self._taken(posed)
        self._careful = False
        return self._solve()

    def _note_gap(self, track: Track | Failure) -> None:
        """Keyframes beyond frames that found no pose, or one by wide matching alone, are to be tied to those before."""
        if isinstance(track, Failure):
            self._after_gap = self._careful = True
            return
        if track.wide:
            self._careful = True
            bridged = np.count_nonzero(track.landmark_ids >= 0) >= self._config.keyframes.weak_landmarks
            self._apart = frozenset() if bridged else frozenset(self.submap.keyframes)
            if self._refinder is not None and not bridged:
                self._refinder.begin(track.view.index)
        if self._refinder is not None and self._after_gap:
            self._refinder.begin(track.view.index)
        self._after_gap = False

    def _refound(self, track: Track, pose_is_given: bool) -> Track:
        """Look for landmarks in the image itself where hardly any tie the new keyframe to those before it."""
        if self._refinder is None:
            return track
        if np.count_nonzero(track.landmark_ids >= 0) < self._config.keyframes.weak_landmarks:
            self._refinder.begin(track.view.index)
        track = self._refinder.extend(track, pose_is_given)
        self._refinder.remember(track.view)
        return track

    def _rows_of(self, keyframe_id: int) -> IntArray:
        obs = self.submap.observations
        return np.flatnonzero((obs["kf"] == keyframe_id) & obs["alive"])

    def _solve(self, rebuild: bool = False) -> GraphEstimate:
        """Bring the graph up to date with the submap, and the submap with its estimate."""
        # Its parts are solved: what is doubtful is how they lie to each other, which takes a few iterations.
        estimate = self.graph.rebuild(self.submap, near_optimum=True) if rebuild else self.graph.update(self.submap)
        return self._taken(estimate)

    def _taken(self, estimate: GraphEstimate) -> GraphEstimate:
        """Give an estimate to the submap, and drop what it contradicts."""
        self.submap.apply_estimate(*estimate.values)
        self.submap.remove_outliers(estimate.outlier_rows)
        return estimate

    def _withdraw(self, keyframe_id: int) -> None:
        """Take a keyframe that the map contradicts out again."""
        self.submap.remove_keyframe(keyframe_id, self._reference_id)
        self.submap.apply_estimate(*self.graph.update(self.submap).values)
        self._tracker.refresh()

    def _rebuild_due(self, track: Track) -> bool:
        """Whether the frame contradicts the map so much that the incremental estimate is to be made anew in batch."""
        self._since_rebuild += 1
        doubtful = track.n_inliers < REBUILD_INLIER_RATIO * track.n_matches
        if not doubtful or self._since_rebuild < REBUILD_SPACING:
            return False
        self._since_rebuild = 0
        return True

    def _meet(self, keyframe_id: int) -> None:
        if keyframe_id != self._reference_id:
            self._reference_id = keyframe_id
            self._path.append(keyframe_id)

    def _cull_keyframe(self) -> None:
        """Cull at most one keyframe that has become redundant; those of the gauge stay."""
        submap = self.submap
        covisible, _ = submap.covisible(submap.seen_in(self._reference_id))
        kept = {*submap.gauge, *self._path[-CULL_BEHIND:], *self._kept}
        candidates = [k for k in covisible.tolist() if k not in kept][:N_CULL_CANDIDATES]
        culled = self._mapper.redundant_keyframe(candidates)
        if culled is not None:
            if culled in self._path:
                self._path.remove(culled)
            submap.remove_keyframe(culled, self._reference_id)


def _moved_features(before: Submap, after: Submap) -> list[int]:
    """Return the keyframes whose features are not at the pixels of the image where they were."""
    pairs = (
        (k, before.keyframes[k].features.uv_px, after.keyframes[k].features.uv_px)
        for k in after.keyframes
        if k in before.keyframes
    )
    return [k for k, was, now in pairs if was is not now and not np.array_equal(was, now)]
