"""3D-3D matches across two submaps that saw the same frames -> a verified Sim(3) link, or why there is none.

In reading order:

- `correspondences`: which landmarks are the same,
- `estimate`: the decision, step by step,
- `timeline`: what the keyframes say one by one, in order of time,
- `join_test`: the gates of all joins, and `verify`: what they ask of a link,
- `live_end` propagates the link's covariance to the current frame: by the walk's loss of scale, and the camera's error,
- `pairs`: the matches as measurements, `scale_observability`: how firmly a map holds its scale,
- `motion`: the camera's motion across gaps and seams.
"""

from dualslam.linking.correspondences import Correspondences, DescriptorMatcher, propose_correspondences
from dualslam.linking.estimate import LinkEstimate, LinkRefusal, estimate_link
from dualslam.linking.live_end import add_camera, propagate_to_live_end

__all__ = [
    "Correspondences",
    "DescriptorMatcher",
    "LinkEstimate",
    "LinkRefusal",
    "add_camera",
    "estimate_link",
    "propagate_to_live_end",
    "propose_correspondences",
]
