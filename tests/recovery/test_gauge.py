"""Which keyframes hold a map's gauge once it is linked."""

from __future__ import annotations

import numpy as np

from dualslam.backend.submap_graph import ISam2SubmapGraph
from dualslam.core.config.settings import GraphConfig, LinkingConfig
from dualslam.linking import DescriptorMatcher, LinkEstimate, estimate_link
from dualslam.map.submap_change import solve
from dualslam.recovery.fusion import gauge_at_overlap
from dualslam.testing.link_worlds import hamming, make_case


def test_the_widest_baseline_of_the_overlap_holds_the_gauge() -> None:
    """Else the scale of the overlap drifts away under the link while the map is still solved at its other end."""
    case = make_case("street", 0, range(14), range(10, 24))
    for submap in (case.old, case.new):
        solve(submap, ISam2SubmapGraph(GraphConfig()))
    matcher = DescriptorMatcher(hamming, 64.0)
    link = estimate_link(case.old, case.new, LinkingConfig(), np.random.default_rng(0), None, matcher)
    assert isinstance(link, LinkEstimate)
    assert case.new.gauge not in {(39, 30), (30, 39)}
    assert gauge_at_overlap(case.new, link.agreeing_keyframes) == (39, 30)
    # An overlap that spans less than the gauge in use does not get it.
    case.new.gauge = (69, 36)
    assert gauge_at_overlap(case.new, link.agreeing_keyframes) == (69, 36)
    assert gauge_at_overlap(case.new, np.array([39])) == (69, 36)
