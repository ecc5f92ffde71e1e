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
    from dualslam.backend.measurements.kinds import (
        Direction,
        Distance,
        Height,
        Position,
        RelativePose,
        RotationRate,
        SamePlace,
    )
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

_NAMES = {
    "backend.measurements.base": "Mount",
    "backend.measurements.kinds": "Direction Distance Height Position RelativePose RotationRate SamePlace",
    "build": "build_system create_frontend recovery_parts",
    "core.camera.base": "Camera",
    "core.config.files": "config_from_dict dump_config load_config",
    "core.config.settings": "Config",
    "core.errors": "ConfigError DualSlamError InputError OutputError SolverError",
    "core.resources": "keep_freed_memory limit_threads",
    "core.types": "Failure Frame",
    "io.map_store": "load_atlas save_atlas",
    "lab.disturbances": "corrupted",
    "lab.metrics.trajectory_metrics": "evaluate_run",
    "linking": "propose_correspondences",
    "map.frame_records": "FrameResult",
    "recovery.reverse_tracking": "track_in_reverse",
    "report": "comparison_page read_run report_page",
    "run.judgement": "judge_run",
    "run.results": "frame_rows trajectories_of",
    "run.runner": "run_sequence",
    "run.session": "run_to_folder",
    "run.slam": "Slam",
    "run.sources": "open_source",
    "system.system": "System",
    "viewer.progress": "Progress",
}
"""By the module that has them."""
_WHERE = {name: module for module, names in _NAMES.items() for name in names.split()}

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
