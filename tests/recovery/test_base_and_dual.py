"""Base is Dual with recovery off, and nothing else is different."""

from __future__ import annotations

import pytest

from dualslam.build import build_system
from dualslam.core.config.files import config_from_dict
from dualslam.core.events import EventKind
from dualslam.lab.synthetic import make_sequence

N = 36
DARK = {"kind": "blackout", "start": 20, "length": 5}


@pytest.mark.slow
def test_while_no_map_is_lost_both_are_the_same() -> None:
    """Also where landmarks are found again in the images, beyond frames that tracking gets over by itself."""
    world = make_sequence("street", N, 3, 320, 240, events=[DARK])
    frames, runs = list(world), []
    for enabled in (True, False):
        system = build_system(config_from_dict({"recovery": {"enabled": enabled}}), world.camera)
        for frame in frames:
            system.step(frame)
        assert not system.events.of_kind(EventKind.FAILED)
        runs.append(dict(system.poses))
    dual, base = runs
    assert dual.keys() == base.keys()
    assert max(dual) == N - 1
    assert min(dual[i].T_kf_cam.tobytes() == base[i].T_kf_cam.tobytes() for i in dual)
