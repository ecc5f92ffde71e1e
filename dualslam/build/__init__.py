"""The composition root: the one place that knows front ends, back end and system, and puts them together.

In reading order: `system` (the system and the live front end), `parts` (solvers, calibration), `walks` (reverse
tracking), `workers` (background work), `checks` (mistakes in a config, reported at once).
"""

from dualslam.build.checks import check_config, fault_of_frontend
from dualslam.build.parts import adjust_submap, find_focal, find_frontend, new_initialiser, window_solver
from dualslam.build.system import LiveParts, build_system
from dualslam.build.walks import recovery_parts
from dualslam.build.workers import feature_handlers, walk_handlers
from dualslam.frontends.registry import create_frontend

__all__ = [
    "LiveParts",
    "adjust_submap",
    "build_system",
    "check_config",
    "create_frontend",
    "fault_of_frontend",
    "feature_handlers",
    "find_focal",
    "find_frontend",
    "new_initialiser",
    "recovery_parts",
    "walk_handlers",
    "window_solver",
]
