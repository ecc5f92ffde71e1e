"""Monocular SLAM on GTSAM submaps that recovers from tracking failure by reverse tracking.

The Python interface; each name is imported when it is first used, so ``import dualslam`` is light::

    import dualslam

    slam = dualslam.Slam(dualslam.Camera.read("calib.yaml"))
    for image, t in frames:
        r = slam.track(image, t)
    slam.save("runs/walk")
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

__version__ = "0.1.0"

if TYPE_CHECKING:
    from dualslam.backend.measurements.base import Mount
    from dualslam.backend.measurements.kinds import Direction, Distance, Height, Position, RelativePose, SamePlace
    from dualslam.backend.measurements.rotation_rate import RotationRate
    from dualslam.build import build_system, create_frontend, recovery_parts
    from dualslam.core.camera.base import Camera
    from dualslam.core.config.files import config_from_dict, dump_config, load_config
    from dualslam.core.config.settings import Config
    from dualslam.core.errors import ConfigError, DualSlamError, InputError, OutputError, SolverError
    from dualslam.core.resources import keep_freed_memory, limit_threads
    from dualslam.core.types import Failure, Frame
    from dualslam.io.map_store import load_atlas, save_atlas
    from dualslam.lab.disturbances import corrupted
    from dualslam.lab.metrics.trajectory_metrics import evaluate_run
    from dualslam.linking import propose_correspondences
    from dualslam.map.frame_records import FrameResult
    from dualslam.recovery.reverse_tracking import track_in_reverse
    from dualslam.report import comparison_page, read_run, report_page
    from dualslam.run.judgement import judge_run
    from dualslam.run.results import frame_rows, trajectories_of
    from dualslam.run.runner import run_sequence
    from dualslam.run.session import run_to_folder
    from dualslam.run.slam import Slam
    from dualslam.run.sources import open_source
    from dualslam.system.system import System
    from dualslam.viewer.progress import Progress

_WHERE = {
    "Mount": "backend.measurements.base",
    "SamePlace": "backend.measurements.kinds",
    "Distance": "backend.measurements.kinds",
    "Height": "backend.measurements.kinds",
    "Direction": "backend.measurements.kinds",
    "RotationRate": "backend.measurements.rotation_rate",
    "RelativePose": "backend.measurements.kinds",
    "Position": "backend.measurements.kinds",
    "Camera": "core.camera.base",
    "Config": "core.config.settings",
    "ConfigError": "core.errors",
    "DualSlamError": "core.errors",
    "Failure": "core.types",
    "Frame": "core.types",
    "FrameResult": "map.frame_records",
    "InputError": "core.errors",
    "OutputError": "core.errors",
    "Progress": "viewer.progress",
    "Slam": "run.slam",
    "SolverError": "core.errors",
    "System": "system.system",
    "build_system": "build",
    "comparison_page": "report",
    "config_from_dict": "core.config.files",
    "corrupted": "lab.disturbances",
    "create_frontend": "build",
    "dump_config": "core.config.files",
    "evaluate_run": "lab.metrics.trajectory_metrics",
    "frame_rows": "run.results",
    "keep_freed_memory": "core.resources",
    "judge_run": "run.judgement",
    "limit_threads": "core.resources",
    "load_atlas": "io.map_store",
    "load_config": "core.config.files",
    "open_source": "run.sources",
    "propose_correspondences": "linking",
    "read_run": "report",
    "recovery_parts": "build",
    "report_page": "report",
    "run_sequence": "run.runner",
    "run_to_folder": "run.session",
    "save_atlas": "io.map_store",
    "trajectories_of": "run.results",
    "track_in_reverse": "recovery.reverse_tracking",
}

__all__ = [
    "Camera",
    "Config",
    "ConfigError",
    "Direction",
    "Distance",
    "DualSlamError",
    "Failure",
    "Frame",
    "FrameResult",
    "Height",
    "InputError",
    "Mount",
    "OutputError",
    "Position",
    "Progress",
    "RelativePose",
    "RotationRate",
    "SamePlace",
    "Slam",
    "SolverError",
    "System",
    "__version__",
    "build_system",
    "comparison_page",
    "config_from_dict",
    "corrupted",
    "create_frontend",
    "dump_config",
    "evaluate_run",
    "frame_rows",
    "judge_run",
    "keep_freed_memory",
    "limit_threads",
    "load_atlas",
    "load_config",
    "open_source",
    "propose_correspondences",
    "read_run",
    "recovery_parts",
    "report_page",
    "run_sequence",
    "run_to_folder",
    "save_atlas",
    "track_in_reverse",
    "trajectories_of",
]


def __getattr__(name: str) -> object:
    if name not in _WHERE:
        raise AttributeError(f"module 'dualslam' has no attribute {name!r}")
    if name == "Slam":  # a program of five lines calls nothing before it
        import_module("dualslam.core.resources").limit_threads()
    value = getattr(import_module(f"dualslam.{_WHERE[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
