"""Corners where images have them; blobs where they have few and these start a map, and where steps are wide."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import cast

import numpy as np
import pytest

from dualslam.core.camera.base import Camera
from dualslam.core.config.files import dump_config
from dualslam.core.config.settings import Config, FrontendConfig
from dualslam.core.estimates import FrontendChoice
from dualslam.core.types import Failure, FailureReason, Features, Frame, Start, View
from dualslam.frontends.choice import STARTS_WITHIN, Candidate, choose_frontend
from dualslam.frontends.features.orb import OrbFrontend
from dualslam.frontends.features.sift import SiftFrontend
from dualslam.lab.synthetic import make_sequence
from dualslam.run.before import with_frontend_chosen
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


def rendered(scene: str) -> list[Frame]:
    return list(make_sequence(scene, n_frames=N_FRAMES, seed=1, width=320, height=240, supersampling=1.0))


def choice(frames: Iterable[Frame], orb_at: int | None, sift_at: int | None) -> tuple[FrontendChoice, StartsAt]:
    """Return the choice, and the starter of SIFT, where each starts a map at its n-th frame."""
    uv, numbers, octave = np.zeros((0, 2)), np.zeros(0), np.zeros(0, np.int64)
    nothing = Features(uv, uv, numbers, numbers, octave, numbers, np.zeros((0, 1)))

    def view_of(frame: Frame) -> View:
        return View(frame.index, frame.timestamp_s, nothing, None)

    corners = Candidate(OrbFrontend(N_FEATURES), StartsAt(orb_at), view_of)
    starter = StartsAt(sift_at)
    return choose_frontend(frames, corners, Candidate(SiftFrontend(N_FEATURES), starter, view_of), N_FEATURES), starter


def test_a_furnished_room_has_corners_and_no_start_is_tried() -> None:
    chosen, sift = choice(rendered("room"), orb_at=None, sift_at=1)
    assert chosen.name == "orb"
    assert sift.n_seen == 0


def seen_from(x_px: Iterable[int]) -> list[Frame]:
    """Return images of one wall of squares, each 320 pixels of it."""
    squares = np.random.default_rng(0).integers(0, 255, (60, 1000)).astype(np.uint8)
    wall = squares.repeat(4, axis=0).repeat(4, axis=1)
    return [Frame(i, i / 30, np.ascontiguousarray(wall[:, x : x + 320])) for i, x in enumerate(x_px)]


def test_steps_to_and_fro_that_leave_few_corners_are_left_to_blobs() -> None:
    chosen, _ = choice(seen_from(250 * (i % 2) for i in range(N_FRAMES)), orb_at=None, sift_at=None)
    assert (chosen.name, chosen.n_features) == ("sift", 2 * N_FEATURES)
    assert "100% of the steps are mispredicted" in chosen.why


@pytest.mark.parametrize("x_px", [[100 * i for i in range(N_FRAMES)], [80 * (i % 2) for i in range(N_FRAMES)]])
def test_long_steady_steps_or_corners_that_match_are_left_to_corners(x_px: list[int]) -> None:
    assert choice(seen_from(x_px), orb_at=None, sift_at=None)[0].name == "orb"


def test_on_white_walls_the_first_to_start_a_map_is_chosen() -> None:
    chosen, _ = choice(rendered("ward"), orb_at=5, sift_at=4)
    assert chosen.name == "sift"
    assert "starts a map first, at frame 3" in chosen.why
    chosen, sift = choice(rendered("ward"), orb_at=4, sift_at=4)
    assert chosen.name == "orb"
    assert sift.n_seen == 3


def test_white_walls_are_left_to_corners_where_no_map_starts() -> None:
    chosen, sift = choice(rendered("ward"), orb_at=None, sift_at=None)
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
