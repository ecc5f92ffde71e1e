"""From the overlap, where a link is measured, to the new map's live end, for which it is made."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from dualslam.core.config.settings import LinkingConfig
from dualslam.core.geometry import se3, sim3
from dualslam.core.types import Failure, FailureReason
from dualslam.linking.camera_bend import NO_BEND, Bend
from dualslam.linking.estimate import LinkEstimate, LinkRefusal
from dualslam.linking.gates import PIXEL_CHI2
from dualslam.linking.join_test import LinkEvidence, live_scale_gate
from dualslam.linking.scale_observability import scale_sigma_between
from dualslam.map.submap import Submap

HOPELESS = 3.0
"""Times the bound: more keyframes at the far end make the walk's share smaller, down to what it lost on the way."""
SETTLED_KEYFRAMES, SETTLED = 12, 1.3
"""With so many of them the share is nearly down there: from 12 to 43 it went from 3.5 to 2.9 % (a rendered street), on
a HoloLens walk from 22 to 43 it stayed at 7.0 %. So many times the bound is then as hopeless, until the live end, which
is what is known badly, has grown."""


def propagate_to_live_end(
    link: LinkEstimate, new: Submap, live_since: int, config: LinkingConfig, bend: Bend = NO_BEND
) -> LinkEstimate | Failure:
    """Add to a link's covariance what reverse tracking has lost of the scale, and refuse it where that is too much.

    So does what the map may be bent by its camera.

    - `new`: as the walk has left it.
    - `live_since`: the keyframe that the walk set out from: it and those after it are the live end.
    - `bend`: of the new map, under the camera that its pixels ask for.

    Returns LinkEstimate or Failure: with its `sigma_scale` at the live end. The numbers have the walk's share of it,
    `sigma_scale_reverse`, and the camera's, `sigma_scale_camera`, where there is one.
    """
    live = np.array([k for k in new.keyframes if k >= live_since], np.int64)
    walk = scale_sigma_between(new, link.agreeing_keyframes, live, PIXEL_CHI2)
    sigma = math.hypot(link.sigma_scale, walk, bend.log_scale)
    numbers = {"sigma_scale": sigma, "sigma_scale_reverse": walk}
    if bend.log_scale:
        numbers["sigma_scale_camera"] = abs(bend.log_scale)
    detail = "nothing holds the scale between the overlap and the live end"
    if math.isfinite(walk):
        detail = f"scale known to {sigma:.1%} at the live end, {walk:.1%} of it by the walk"
    settled = len(link.agreeing_keyframes) >= SETTLED_KEYFRAMES
    hopeless = walk > (SETTLED if settled else HOPELESS) * config.max_live_scale_sigma
    reason = FailureReason.SCALE_LOST if hopeless else FailureReason.SCALE
    evidence = LinkEvidence((live_scale_gate(sigma, detail, reason, config),))
    compared = evidence.comparisons
    if not evidence.is_accepted:
        return LinkRefusal(reason, detail, numbers, walk_sigma=walk, gates=compared)
    # The live end grows and shrinks about the place where the maps overlap.
    held = [k for k in link.agreeing_keyframes.tolist() if k in new.keyframes]
    about = sim3.adjoint(se3.from_parts(np.eye(3), new.keyframe_poses(held)[:, :3, 3].mean(0)))
    lost = np.diag([bend.rotation_rad**2] * 3 + [0.0] * 3 + [walk**2 + bend.log_scale**2])
    covariance = link.covariance + about @ lost @ about.T
    known = link.numbers | numbers
    carried = replace(link, covariance=covariance, sigma_scale=sigma, numbers=known, gates=(*link.gates, *compared))
    if evidence.is_sure:
        return carried
    return LinkRefusal(reason, detail, numbers, walk_sigma=walk, unsure=carried, gates=compared)
