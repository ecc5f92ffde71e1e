"""The attempts at a recovery and the parts that each is made of, as the composition root builds them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from dualslam.core.camera.base import Camera
from dualslam.core.config.settings import Config
from dualslam.core.estimates import PreferredCamera
from dualslam.core.interfaces import SubmapGraph, VisualOdometry
from dualslam.core.types import Failure, IntArray, LateFrame, View
from dualslam.linking import DescriptorMatcher, LinkEstimate, estimate_link
from dualslam.map.submap import Submap
from dualslam.recovery.job import RecoveryJob


@dataclass(frozen=True, slots=True, eq=False)
class Attempt:
    """One way to track in reverse, by the name of the front end that its poses come from.

    `find_lack`: returns why the attempt cannot be made in this installation. It is asked before each attempt.
    `max_unrecognised`: for an attempt that is only made if those before it leave something to do better. It ends at so
    many frames in a row that show something and are not recognised.
    """

    name: str
    new_odometry: Callable[[RecoveryJob, Submap, SubmapGraph], VisualOdometry]
    find_lack: Callable[[], Failure | None] = lambda: None
    max_unrecognised: int | None = None


@dataclass(frozen=True, slots=True, eq=False)
class RecoveryParts:
    """The parts of a recovery, built by the composition root of the process in which it runs.

    `posing`: the way back where there is no lost map, but frames without a pose.
    `find_camera`: asks keyframes of a map that a walk has grown about the camera.
    `read`: finds the live front end's features in a frame that came too late.
    `foresee`: precomputes the features that crossing a gap may need in a frame.
    """

    attempts: tuple[Attempt, ...]
    posing: Attempt
    new_graph: Callable[[], SubmapGraph]
    matcher: DescriptorMatcher
    find_camera: Callable[[RecoveryJob, Submap, IntArray], PreferredCamera | None]
    config: Config
    read: Callable[[LateFrame, Camera], View | Failure]
    foresee: Callable[[View], None] = lambda view: None

    def link(self, old: Submap, new: Submap, onset: int | None) -> LinkEstimate | Failure:
        """Try to link a submap with an older one, which is suspected to be corrupted from a frame on."""
        rng = np.random.default_rng(self.config.seed)
        return estimate_link(old, new, self.config.linking, rng, onset, self.matcher)

    @property
    def max_scale_sigma(self) -> float:
        """Largest standard deviation of a link's scale at the live end."""
        return self.config.linking.max_live_scale_sigma
