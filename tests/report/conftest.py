from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from dualslam.core.config.settings import Config, FrontendConfig
from dualslam.core.events import EventKind
from dualslam.core.types import Frame
from dualslam.lab.synthetic import SyntheticSequence, make_sequence
from dualslam.map.frame_records import FrameResult
from dualslam.report import RunData, read_run
from dualslam.run.session import run_to_folder
from dualslam.run.sources import WorldSequence
from tests.cli.fakes import FakeSystem

N_FRAMES = 40
LOST = tuple(range(20, 26))
MakeRun = Callable[..., Path]


@pytest.fixture(scope="session")
def world() -> SyntheticSequence:
    return make_sequence("street", N_FRAMES, 1, width=160, height=120)


class NoTruth:
    """A sequence as a telephone gives it."""

    def __init__(self, sequence: WorldSequence) -> None:
        self._sequence = sequence
        self.name, self.camera, self.rate_hz = "holiday", sequence.camera, sequence.rate_hz

    def __len__(self) -> int:
        return len(self._sequence)

    def __iter__(self):  # type: ignore[no-untyped-def]
        return iter(self._sequence)


class Eventful(FakeSystem):
    """The fake system, with the events that the real one has after a failure."""

    def step(self, frame: Frame) -> FrameResult:
        result = super().step(frame)
        for event in self.events.of_kind(EventKind.FAILED):
            event.data.update(reason="no_texture", detail="<b>0 features</b>", lost_since=event.frame)
        return result

    def finish(self, interrupted: bool = False) -> None:
        if self.events.of_kind(EventKind.FAILED) and len(self.atlas.submaps) > 1:
            self.events.add(EventKind.REINITIALISED, LOST[-1] + 1, 2.6, 1, first_view=LOST[-1] + 1)
            self.events.add(EventKind.RECOVERY_STARTED, LOST[-1] + 1, 2.6, 1, lost=[0], frames=26)
            walk = {
                "attempt": "sift",
                "frames": 9,
                "new_keyframes": 5,
                "skipped_frames": 6,
                "seconds": 1.25,
                "k": 20,
                "k_r": 7,
            }
            self.events.add(EventKind.RECOVERY_ATTEMPT, 12, 1.2, 1, verdict="the buffer ends", **walk)
            numbers = {"n_pairs": 31.0, "scale": 0.72, "sigma_scale": 0.0021, "sigma_rot_deg": 0.13}
            self.events.add(
                EventKind.LINK_REFUSED,
                15,
                1.5,
                1,
                old_submap=0,
                shared_keyframes=4,
                verdict="9 inliers, 20 needed",
                reason="too_few_inliers",
                **numbers,
            )
        super().finish()


@pytest.fixture(scope="session")
def make_run(world: SyntheticSequence, tmp_path_factory: pytest.TempPathFactory) -> MakeRun:
    """Return a function that writes a run folder: lost frames, truth or none, a name, what happens before a step."""

    def make(
        lost: tuple[int, ...] = LOST,
        truth: bool = True,
        name: str = "run",
        before_step: Callable[[Frame], None] = lambda frame: None,
    ) -> Path:
        out = tmp_path_factory.mktemp("runs") / name
        poses = dict(enumerate(world.ground_truth_T_world_cam))
        sequence = WorldSequence(world)
        run_to_folder(
            Config(seed=3, frontend=FrontendConfig(name="orb")),
            sequence if truth else NoTruth(sequence),
            out,
            build=lambda config, camera: Eventful(poses, lost, before_step),  # type: ignore[arg-type, return-value]
        )
        return out

    return make


@pytest.fixture(scope="session")
def broken_run(make_run: MakeRun) -> RunData:
    """A run that lost track once, was not linked, and has ground truth."""
    return read_run(make_run())


def with_events(run: RunData, *events: dict[str, object]) -> RunData:
    return replace(run, events=[*run.events, *json.loads(json.dumps(events))])
