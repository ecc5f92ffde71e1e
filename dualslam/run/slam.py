"""The front door for a program of your own: give it images, read poses, save the map."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from dualslam.atlas.stored_map import StoredMap
from dualslam.build import build_system
from dualslam.core.camera.base import Camera
from dualslam.core.config.files import load_config
from dualslam.core.config.settings import Config
from dualslam.core.errors import InputError
from dualslam.core.metric_problem import MeasurementSource
from dualslam.core.resources import peak_rss_mb
from dualslam.core.trajectory import Trajectory
from dualslam.core.types import BoolArray, Frame
from dualslam.io.export.exported_map import ExportedMap, flatten
from dualslam.io.map_store import load_atlas
from dualslam.io.masks import read_mask
from dualslam.io.times import UNIT_NAMES, epoch_unit
from dualslam.map.frame_records import FrameResult
from dualslam.report.run_data import RunData, read_run
from dualslam.run.before import with_frontend_chosen
from dualslam.run.claims import claims_in_atlas
from dualslam.run.judgement import judge_run
from dualslam.run.results import frame_rows, trajectories_of
from dualslam.run.runner import RunReport
from dualslam.run.session import save_system
from dualslam.system.audit.verdict import Verdict
from dualslam.system.system import System


class Slam:
    """Monocular SLAM, fed image by image.

    Parameters
    ----------
    camera : Camera, or path
        Calibrated; a path is read by `Camera.read`.
    config : Config, optional
        From `load_config`; the defaults if it is not given.
    saved_map : path or StoredMap, optional
        Run folder, or map, to continue.
    localise : bool
        Find poses in the saved map and add nothing to it.
    mask : path or (H, W) bool, optional
        What shows no scene in all images: an image in which it is black, or an array that is true there.

    Attributes
    ----------
    system : System
        The state machine below: submaps, graphs, events.

    Raises
    ------
    InputError, ConfigError

    Examples
    --------
    >>> slam = dualslam.Slam(dualslam.Camera.read("calib.yaml"))
    >>> for image, t in frames:
    ...     r = slam.track(image, t)
    >>> slam.save("runs/walk")
    """

    def __init__(
        self,
        camera: Camera | str | Path,
        *,
        config: Config | None = None,
        saved_map: StoredMap | str | Path | None = None,
        localise: bool = False,
        mask: BoolArray | str | Path | None = None,
    ) -> None:
        if localise and saved_map is None:
            raise InputError("localise finds poses in a saved map: name it with saved_map.")
        if not isinstance(camera, Camera | str | Path):
            raise InputError(f"the camera is a {type(camera).__name__}; give a Camera, or the path of its file.")
        self._camera = camera if isinstance(camera, Camera) else Camera.read(camera)
        of_map = saved_map if isinstance(saved_map, str | Path) else None
        self._config, _ = with_frontend_chosen(load_config() if config is None else config, None, of_map)
        saved = load_atlas(saved_map) if isinstance(saved_map, str | Path) else saved_map
        self.system: System = build_system(self._config, self._camera, saved=saved, localise=localise)
        self._began, self._cpu_began = time.perf_counter(), time.process_time()
        self._hidden = read_mask(Path(mask), self._camera.size_px) if isinstance(mask, str | Path) else mask
        if self._hidden is not None and (
            self._hidden.dtype != bool or self._hidden.shape[::-1] != self._camera.size_px
        ):
            said = f"{self._hidden.shape} {self._hidden.dtype}"
            raise InputError(f"the mask is {said}; give (H, W) bool of the camera's images, true where no scene is.")
        self._n_frames = 0
        self._last_s = -math.inf
        self._ended = False
        self._readings: list[Any] = []

    def track(self, image: NDArray[np.uint8] | None, timestamp_s: float) -> FrameResult:
        """Take the next image.

        Parameters
        ----------
        image : (H, W) or (H, W, 3) RGB uint8, or None
            None where the camera gave no image.
        timestamp_s : float
            Seconds; ascending.

        Returns
        -------
        FrameResult
            `pose`, `position`, `status`, `doubt`, and `lost`: why there is no pose, or None.

        Raises
        ------
        InputError
            If the image is no such array, its time is not later in seconds, or the map has been saved.
        """
        error, hidden = ("the camera gave no image", None) if image is None else ("", self._hidden)
        frame = Frame(self._n_frames, timestamp_s, image, error, hidden=hidden)
        if isinstance(timestamp_s, int | float | np.number):  # others are refused below
            if timestamp_s <= self._last_s:
                raise InputError(f"frame {frame.index}: its time {timestamp_s} is not later than {self._last_s}.")
            if (unit := epoch_unit(timestamp_s)) is not None:
                raise InputError(f"frame {frame.index}: its time {timestamp_s} is in {UNIT_NAMES[unit]}; give seconds.")
        result = self.system.step(frame)
        self._n_frames, self._last_s = self._n_frames + 1, timestamp_s
        return result

    def add(self, *readings: Any) -> None:
        """Take measurements from outside the images, such as `Position`; `save` puts the map into their frame."""
        self._readings += readings

    @property
    def map(self) -> ExportedMap | None:
        """The main map so far: `xyz` and `colour` of its points, `T_world_cam` of its keyframes; None without one."""
        stored = self._stored()
        return flatten(stored) if stored.main else None

    @property
    def trajectory(self) -> Trajectory:
        """All poses in the main map so far: `index`, `timestamps_s`, `T_world_cam`."""
        return trajectories_of(self.system).main

    @property
    def verdict(self) -> Verdict:
        """How far to trust the map so far: `level` (good, usable, doubtful) and `reasons`."""
        trajectories, claims = trajectories_of(self.system), claims_in_atlas(self.system.atlas)
        rows = frame_rows(self.system, trajectories.main, claims=claims)
        return judge_run(self.system, trajectories, rows, claims=claims)

    def finish(self) -> None:
        """End the mapping: wait for running recoveries, refine. No image is taken after it; `save` calls it."""
        if not self._ended:
            self._ended = True
            self.system.finish()

    def save(self, out: str | Path, *, overwrite: bool = False) -> RunData:
        """Finish, and write a run folder: trajectory, frames, map, report.

        Raises
        ------
        InputError
            If measurements were added that cannot belong to the map; the folder is written without them.
        OutputError
            If there is a run already and `overwrite` is not set, or the folder cannot be written.
        """
        self.finish()
        given = [MeasurementSource("the program's measurements", self._readings)] if self._readings else []
        save_system(
            self.system, self._config, self._camera, self._report(), out, overwrite=overwrite, measurements=given
        )
        return read_run(out)

    def localise(self) -> Slam:
        """Finish, and return a `Slam` that finds poses in this map and adds nothing to it.

        Raises
        ------
        InputError
            If there is no map.
        """
        self.finish()
        stored = self._stored()
        if not stored.main:
            raise InputError("there is no map to localise in: no frame has a pose.")
        return Slam(self._camera, config=self._config, saved_map=stored, localise=True, mask=self._hidden)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.system.desk.close()

    def __repr__(self) -> str:
        posed = len(self.system.poses)
        return f"<Slam: {self._n_frames} frames, {posed} posed, {len(self.system.atlas.submaps)} submaps>"

    def _stored(self) -> StoredMap:
        return StoredMap(self.system.atlas, self.system.poses, self.system.camera)

    def _report(self) -> RunReport:
        latencies_ms = tuple(row.latency_ms for row in self.system.rows.values())
        return RunReport(
            n_frames=self._n_frames,
            latencies_ms=latencies_ms,
            steps_ms=latencies_ms,
            wall_s=time.perf_counter() - self._began,
            cpu_s=time.process_time() - self._cpu_began,
            peak_rss_mb=peak_rss_mb(),
        )
