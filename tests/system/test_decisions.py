"""The decisions of a run on a point world: they are those that were made, and to listen changes nothing."""

from __future__ import annotations

import numpy as np

from dualslam.core.decisions import Decision, DecisionKind
from dualslam.core.types import FrameStatus
from dualslam.system.system import System
from dualslam.testing.point_world import PointWorld, cloud, hand_held, system_in

N = 40
COVERED = frozenset({30, 31})


def run(listen: bool) -> tuple[System, list[Decision]]:
    world = PointWorld(cloud(), hand_held(N), covered=COVERED)
    system, heard = system_in(world), list[Decision]()
    if listen:
        system.events.decisions.write = heard.append
    for frame in world.frames():
        system.step(frame)
    return system, heard


def test_each_decision_is_there_with_comparisons_that_agree_with_it() -> None:
    system, heard = run(listen=True)
    of = {what: [d for d in heard if d.what is what] for what in DecisionKind}
    (started,) = (d for d in of[DecisionKind.START] if d.accepted)
    assert {d.frame for d in of[DecisionKind.START]} == {*range(started.frame + 1), *COVERED}
    # Every later frame is explained by the map or not, as its row says.
    explained = {d.frame: d.accepted for d in of[DecisionKind.FRAME]}
    assert set(explained) == set(range(started.frame + 1, N))
    assert explained == {i: system.rows[i].status is FrameStatus.TRACKED for i in explained}
    assert all(all(gate.passed for gate in d.gates) for d in of[DecisionKind.FRAME] if d.accepted)
    # A keyframe is what has passed one comparison at least.
    made = {d.frame for d in of[DecisionKind.KEYFRAME] if d.accepted}
    (submap,) = system.atlas.submaps.values()
    assert {k for k in submap.keyframes if k > started.frame} <= made  # some were culled
    assert made
    assert all(any(gate.passed for gate in d.gates) == d.accepted for d in of[DecisionKind.KEYFRAME])
    assert {d.frame for d in of[DecisionKind.FRAME] if d.reason} == COVERED

    silent, nothing = run(listen=False)
    assert not nothing
    assert silent.poses.keys() == system.poses.keys()
    assert all(np.array_equal(silent.poses[i].T_kf_cam, system.poses[i].T_kf_cam) for i in silent.poses)
