"""Corners where images have them; blobs where they have few, and these start a map."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import cast

import numpy as np

from dualslam.core.camera.base import Camera
from dualslam.core.config.files import dump_config
from dualslam.core.config.settings import Config, FrontendConfig
from dualslam.core.estimates import FrontendChoice
from dualslam.core.types import Failure, FailureReason, Features, Frame, Start, View
from dualslam.frontends.choice import STARTS_WITHIN, Candidate, choose_frontend
from dualslam.frontends.features.orb import OrbFrontend
from dualslam.frontends.features.sift import SiftFrontend
from dualslam.lab.synthetic import make_sequence
from dualslam.run.front_end import with_frontend_chosen
from dualslam.testing.point_world import CAMERA

N_FEATURES, N_FRAMES = 500, 30


class StartsAt:
    """Starts a map at the n-th view."""

    def __init__(self, n: int | None) -> None:
        self.n, self.n_seen = n, 0

    def collect(self, view: View) -> None: ...

    def add(self, view: View, waited_s: float = 0.0, briefly: bool = False) -> Start | Failure:
        self.n_seen += 1
        return cast(Start, view) if self.n_seen == self.n else Failure(FailureReason.LOW_PARALLAX, "")


def choice(scene: str, orb_at: int | None, sift_at: int | None) -> tuple[FrontendChoice, StartsAt]:
    """Return the choice, and the starter of SIFT, where each starts a map at its n-th frame."""
    world = make_sequence(scene, n_frames=N_FRAMES, seed=1, width=320, height=240, supersampling=1.0)
    uv, numbers, octave = np.zeros((0, 2)), np.zeros(0), np.zeros(0, np.int64)
    nothing = Features(uv, uv, numbers, numbers, octave, numbers, np.zeros((0, 1)))

    def view_of(frame: Frame) -> View:
        return View(frame.index, frame.timestamp_s, nothing, None)

    corners = Candidate(OrbFrontend(N_FEATURES), StartsAt(orb_at), view_of)
    starter = StartsAt(sift_at)
    return choose_frontend(world, corners, Candidate(SiftFrontend(N_FEATURES), starter, view_of), N_FEATURES), starter


def test_a_furnished_room_has_corners_and_no_start_is_tried() -> None:
    chosen, sift = choice("room", orb_at=None, sift_at=1)
    assert chosen.name == "orb"
    assert sift.n_seen == 0


def test_on_white_walls_the_first_to_start_a_map_is_chosen() -> None:
    chosen, _ = choice("ward", orb_at=5, sift_at=4)
    assert chosen.name == "sift"
    assert "starts a map first, at frame 3" in chosen.why
    chosen, sift = choice("ward", orb_at=4, sift_at=4)
    assert chosen.name == "orb"
    assert sift.n_seen == 3


def test_white_walls_are_left_to_corners_where_no_map_starts() -> None:
    chosen, sift = choice("ward", orb_at=None, sift_at=None)
    assert chosen.name == "orb"
    assert sift.n_seen == N_FRAMES < STARTS_WITHIN


class Blank:
    """A sequence whose images cannot be read."""

    name, rate_hz = "blank", 30.0
    camera: Camera = CAMERA

    def __len__(self) -> int:
        return 3

    def __iter__(self) -> Iterator[Frame]:
        return iter([Frame(i, i / 30, None, "torn") for i in range(3)])


def test_a_config_that_names_a_front_end_is_left_alone() -> None:
    config = Config(frontend=FrontendConfig(name="sift"))
    assert with_frontend_chosen(config, Blank()) == (config, None)


def test_images_that_cannot_be_read_are_left_to_corners() -> None:
    config, chosen = with_frontend_chosen(Config(frontend=FrontendConfig(name="auto")), Blank())
    assert chosen is not None
    assert config.frontend.name == chosen.name == "orb"


def test_frames_that_cannot_be_looked_at_are_left_to_corners() -> None:
    config, chosen = with_frontend_chosen(Config(frontend=FrontendConfig(name="auto")), None)
    assert chosen is not None
    assert config.frontend.name == chosen.name == "orb"


def test_settings_of_a_front_end_decide_for_it() -> None:
    options = FrontendConfig(name="auto", options={"n_octaves": 4})
    config, chosen = with_frontend_chosen(Config(frontend=options), Blank())
    assert chosen is not None
    assert config.frontend == options.model_copy(update={"name": "orb"})


def test_a_saved_map_is_continued_by_the_front_end_that_made_it(tmp_path: Path) -> None:
    made_by = FrontendConfig(name="sift", n_features=700)
    (tmp_path / "config.yaml").write_text(dump_config(Config(frontend=made_by)))
    config, _ = with_frontend_chosen(Config(frontend=FrontendConfig(name="auto")), Blank(), tmp_path)
    assert config.frontend == made_by
