"""Faults inside the system, on a scene of points; and a corrupted run made again from its own config."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dualslam.core.config.files import load_config
from dualslam.core.events import EventKind
from dualslam.core.types import Failure, FailureReason, FrameStatus
from dualslam.lab.disturbances import Corruption, FaultScript
from dualslam.run.session import run_to_folder
from dualslam.run.sources import open_source
from dualslam.system.system import System
from dualslam.testing.point_world import PointWorld, cloud, hand_held, system_in
from dualslam.workers.desk import WorkerDesk
from tests.cli.conftest import _own_environment  # noqa: F401 (used by every test)

N = 45


def run(*corruptions: dict[str, object], backwards: bool = False, **settings: object) -> System:
    world = PointWorld(cloud(), hand_held(N))
    system = system_in(world, **settings)
    script = FaultScript([Corruption.model_validate(c) for c in corruptions])
    system._state.parts = replace(
        system._state.parts,
        view_of=script.around_views(system._state.parts.view_of),
        new_odometry=script.around_odometry(system._state.parts.new_odometry),
    )
    for frame in world.frames()[:: -1 if backwards else 1]:
        system.step(frame)
    system.finish(interrupted=True)  # without the refinement that moves all of a map
    return system


@pytest.fixture(scope="module")
def clean() -> System:
    return run()


def test_without_faults_nothing_is_touched() -> None:
    def view_of(frame: object) -> Failure:
        return Failure(FailureReason.UNREADABLE)

    script = FaultScript([Corruption.model_validate({"kind": "blur"})])
    assert script.around_views(view_of) is view_of
    assert script.around_odometry(system_in) is system_in  # type: ignore[arg-type, comparison-overlap]


def test_a_solver_error_ends_the_submap_once() -> None:
    system = run({"kind": "solver_error", "start": 25})
    (failed,) = system.events.of_kind(EventKind.FAILED)
    assert failed.data["reason"] == "solver"
    assert "failure lab" in failed.data["detail"]
    assert failed.frame >= 25
    assert len(system.atlas.submaps) == 2


def test_few_features_are_a_reproducible_part_of_them() -> None:
    world = PointWorld(cloud(), hand_held(N))
    fault = {"kind": "few_features", "start": 3, "length": 2, "strength": 0.75}

    def rows(seed: int, i: int) -> np.ndarray:
        script = FaultScript([Corruption.model_validate(fault | {"seed": seed})])
        frame = next(f for f in world.frames() if f.index == i)
        view = script.around_views(lambda f: world.view(f.index))(frame)
        assert not isinstance(view, Failure)
        return view.features.uv_px

    n = len(world.view(3).features)
    assert len(rows(0, 3)) == round(0.25 * n)
    assert np.array_equal(rows(0, 3), rows(0, 3))
    assert not np.array_equal(rows(0, 3), rows(1, 3))
    assert len(rows(0, 5)) == len(world.view(5).features)


def test_too_few_features_lose_the_track() -> None:
    system = run({"kind": "few_features", "start": 20, "length": 5, "strength": 0.98})
    assert [system.rows[i].status for i in range(20, 25)] == [FrameStatus.LOST] * 5
    assert system.rows[26].status is FrameStatus.TRACKED


def test_faults_count_in_the_source_whichever_way_it_is_read() -> None:
    fault = {"kind": "wrong_pose", "start": 25, "length": 1, "strength": 15}
    system = run(fault, backwards=True)
    lost = [row.index for row in system.rows.values() if row.status is FrameStatus.LOST]
    assert [system.numbers.index_of(number) for number in lost] == [25]


def test_a_wrong_pose_that_the_map_contradicts_is_taken_out_again(clean: System) -> None:
    """The frame is lost, for a reason that says so; nothing of it stays, and the next frames are as good as ever."""
    faulty = run({"kind": "wrong_pose", "start": 25, "length": 1, "strength": 15})
    assert faulty.rows[25].status is FrameStatus.LOST
    assert [i for i in range(5, N) if faulty.rows[i].status is not FrameStatus.TRACKED] == [25]
    assert not faulty.events.of_kind(EventKind.FAILED)
    (submap,) = faulty.atlas.submaps.values()
    assert 25 not in submap.keyframes
    assert not (submap.landmarks["alive"] & (submap.landmarks["first_kf"] == 25)).any()
    assert clean_to_faulty_deg(clean, faulty, 40) < 0.2


def test_a_wrong_pose_goes_into_the_map_as_a_keyframe_where_nothing_is_refused(clean: System) -> None:
    """By the angle that was asked for, and by as much of the depth; the frames before it are not touched."""
    fault = {"kind": "wrong_pose", "start": 25, "length": 1, "strength": 8}
    faulty = run(fault, health={"max_refused": 1.0})
    submap = faulty.atlas.submaps[0]
    assert 25 in submap.keyframes
    before = [i for i in clean.poses if i < 25]
    assert all(np.array_equal(clean.poses[i].T_kf_cam, faulty.poses[i].T_kf_cam) for i in before)
    turned = clean_to_faulty_deg(clean, faulty, 25)
    assert turned > 4


def clean_to_faulty_deg(clean: System, faulty: System, i: int) -> float:
    poses = [s.atlas.submaps[0].resolve_anchor(s.poses[i].keyframe_id, s.poses[i].T_kf_cam) for s in (clean, faulty)]
    R = poses[0][:3, :3].T @ poses[1][:3, :3]
    return float(np.degrees(np.arccos(np.clip((np.trace(R) - 1) / 2, -1, 1))))


@pytest.mark.slow
def test_a_corrupted_run_can_be_made_again_from_its_config(tmp_path: Path) -> None:
    source = "synthetic:room,frames=45,seed=2,width=320,height=240"
    corruptions = (
        "corruptions=[{kind: noise, start: 20, length: 3}, {kind: drop, start: 30, length: 2},"
        " {kind: few_features, start: 34, length: 2, strength: 0.5, seed: 4},"
        " {kind: wrong_pose, start: 38, length: 1, seed: 5}]"
    )
    first = run_to_folder(load_config(None, [corruptions]), open_source(source), tmp_path / "one")
    again = run_to_folder(load_config(tmp_path / "one" / "config.yaml"), open_source(source), tmp_path / "two")
    assert first.summary["frames"] == again.summary["frames"] == 43
    assert first.summary["posed"] > 20
    texts = [(tmp_path / name / "trajectory.txt").read_bytes() for name in ("one", "two")]
    assert texts[0] == texts[1]


@pytest.mark.slow
@pytest.mark.parametrize("workers", [0, 1])
def test_a_killed_worker_costs_its_recovery_and_nothing_else(workers: int) -> None:
    world = PointWorld(cloud(), hand_held(70), covered=frozenset(range(35, 50)))
    system = system_in(world, recovery={"enabled": True, "workers": workers})
    script = FaultScript([Corruption.model_validate({"kind": "kill_worker", "start": 30})])
    system._state.parts = replace(system._state.parts, view_of=script.around_views(system._state.parts.view_of))
    executor = system.desk.executor
    if isinstance(executor, WorkerDesk):
        executor.on_start = script.kill_worker
    else:
        executor._is_lost = script.loses  # type: ignore[attr-defined]
    for frame in world.frames():
        system.step(frame)
    system.finish()
    (failed,) = system.events.of_kind(EventKind.RECOVERY_FAILED)
    assert failed.data["reason"] == "worker"
    assert failed.frame <= 69  # by the schedule a walk's answer is used 60 frames after its request, or at the end
    (linked,) = system.events.of_kind(EventKind.LINKED)
    assert linked.frame == 69  # by the walk that is made once more when the run ends
    assert len(system.atlas.submaps) == 2
    assert system.rows[69].status is FrameStatus.TRACKED


@pytest.mark.slow
def test_the_command_line_takes_a_file_of_corruptions(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from dualslam.cli import main

    file = tmp_path / "spoil.yaml"
    file.write_text("- {kind: blur, start: 3, length: 2}\n")
    source = "synthetic:street,frames=6,seed=1"
    main(["run", source, "--out", str(tmp_path / "run"), "--corrupt", str(file), "--quiet"])
    (corruption,) = load_config(tmp_path / "run" / "config.yaml").corruptions
    assert (str(corruption.kind), corruption.start, corruption.length) == ("blur", 3, 2)
    file.write_text("kind: blur\n")
    assert main(["run", source, "--out", str(tmp_path / "other"), "--corrupt", str(file)]) == 2
    assert "corruptions are a list" in capsys.readouterr().err
