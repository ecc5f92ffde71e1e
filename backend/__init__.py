"""Factor graphs of submaps and of the atlas over GTSAM: usable by itself, on arrays.

Each name is imported when it is first used; gtsam with the first that needs it.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from dualslam.backend.atlas_solver import GtsamAtlasSolver
    from dualslam.backend.final_refinement import refine_submap
    from dualslam.backend.local_ba import SubmapBundle, bundle_adjust, bundle_adjust_arrays
    from dualslam.backend.self_calibration import estimate_calibration
    from dualslam.backend.sim3_graph import Sim3Edge, Sim3Solution, optimise_sim3
    from dualslam.backend.submap_graph import ISam2SubmapGraph
    from dualslam.backend.window import NumpyWindowSolver

_WHERE = {
    "GtsamAtlasSolver": "atlas_solver",
    "ISam2SubmapGraph": "submap_graph",
    "Sim3Edge": "sim3_graph",
    "Sim3Solution": "sim3_graph",
    "SubmapBundle": "local_ba",
    "NumpyWindowSolver": "window",
    "bundle_adjust": "local_ba",
    "bundle_adjust_arrays": "local_ba",
    "estimate_calibration": "self_calibration",
    "optimise_sim3": "sim3_graph",
    "refine_submap": "final_refinement",
}

__all__ = [
    "GtsamAtlasSolver",
    "ISam2SubmapGraph",
    "NumpyWindowSolver",
    "Sim3Edge",
    "Sim3Solution",
    "SubmapBundle",
    "bundle_adjust",
    "bundle_adjust_arrays",
    "estimate_calibration",
    "optimise_sim3",
    "refine_submap",
]


def __getattr__(name: str) -> object:
    if name not in _WHERE:
        raise AttributeError(f"module 'dualslam.backend' has no attribute {name!r}")
    value = getattr(import_module(f"dualslam.backend.{_WHERE[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
