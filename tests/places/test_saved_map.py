"""A run that goes on in the map of another: it finds itself there, in its frame and unit, and changes nothing of it."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from dualslam.atlas.stored_map import StoredMap
from dualslam.build import build_system
from dualslam.core.config.settings import Config
from dualslam.core.events import EventKind
from dualslam.core.geometry import se3
from dualslam.core.geometry.umeyama import umeyama
from dualslam.core.types import Failure, Frame, Track, View
from dualslam.frontends.tracking.visual import VisualFrontEnd
from dualslam.io.map_store import load_atlas, save_atlas
from dualslam.run.results import frame_rows, trajectories_of
from dualslam.system.system import System
from dualslam.testing.point_world import CAMERA, PointWorld
from tests.places.worlds import N_LAP, lap, ring, run, wall

N_FIRST = 70


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The map of the first part of a lap."""
    system = run(lap(), n=N_FIRST)
    system.finish()
    folder = tmp_path_factory.mktemp("first") / "map"
    save_atlas(folder, system.atlas, system.poses, system.camera)
    return folder


@cache
def second_world() -> PointWorld:
    """Another day: the camera comes from the middle of the first run's way, and goes beyond its end."""
    T = ring(N_LAP)[30:100] @ se3.from_parts(np.eye(3), np.array([0.05, 0.02, 0.05]))
    return PointWorld(wall(), T, seed=0)


def go_on(folder: Path, world: PointWorld, localise: bool = False, n: int | None = None, **settings: object) -> System:
    fixed = {"camera": {"model_sigma_px": 0.0}, "calibration": {"refine": False}}
    config = Config.model_validate(fixed | settings)
    system = build_system(config, CAMERA, saved=load_atlas(folder), localise=localise)

    def view_of(frame: Frame) -> View:
        return world.view(frame.index)

    system._state.parts = replace(system._state.parts, view_of=view_of)
    for frame in world.frames()[:n]:
        system.step(frame)
    system.finish()
    return system


def truth_in_first(saved: StoredMap, index: np.ndarray) -> np.ndarray:
    """True centres of the second run's frames, in the saved map's frame and unit."""
    system_T = {p.index: saved.atlas.submaps[0].resolve_anchor(p.keyframe_id, p.T_kf_cam) for p in saved.poses.values()}
    own = sorted(system_T)
    a = np.array([system_T[i][:3, 3] for i in own])
    b = ring(N_LAP)[own][:, :3, 3]
    S = umeyama(b, a).S_dst_src  # type: ignore[union-attr]
    return second_world().T_world_cam[index][:, :3, 3] @ S[:3, :3].T + S[:3, 3]


def test_localise_finds_every_frame_that_the_map_shows_and_adds_nothing(first: Path) -> None:
    saved = load_atlas(first)
    system = go_on(first, second_world(), localise=True)
    assert system.numbers.first_id == saved.next_id == N_FIRST
    main = trajectories_of(system).main
    assert main.index[:30].tolist() == list(range(30)), "from the first frame on, by the source's own count"
    error = np.linalg.norm(main.T_world_cam[:30, :3, 3] - truth_in_first(saved, main.index[:30]), axis=1)
    assert error.max() < 0.05
    assert list(system.atlas.submaps) == list(saved.atlas.submaps)
    assert not system._state.record.observations, "no frame is to be posed anew"
    for m, submap in saved.atlas.submaps.items():
        now = system.atlas.submaps[m]
        assert list(now.keyframes) == list(submap.keyframes)
        assert np.array_equal(now.landmarks["xyz_mu"], submap.landmarks["xyz_mu"])
        assert len(now.observations) == len(submap.observations)
    assert [row.index for row in frame_rows(system, main)] == list(range(70))


def test_a_map_is_extended_in_its_own_frame_and_numbers_go_on(first: Path) -> None:
    saved = load_atlas(first)
    system = go_on(first, second_world())
    main = trajectories_of(system).main
    assert main.index.tolist() == list(range(70))
    error = np.linalg.norm(main.T_world_cam[:, :3, 3] - truth_in_first(saved, main.index), axis=1)
    assert error.max() < 0.3
    old = {k for m in saved.atlas.submaps.values() for k in (*m.keyframes, *m.anchors)}
    new = {k for m in system.atlas.submaps.values() for k in m.keyframes} - old
    assert new
    assert min(new) >= N_FIRST
    assert saved.poses.keys() <= system.poses.keys(), "where the first run's frames were is still known"


@pytest.mark.slow
def test_a_map_that_is_used_again_and_again_stays_as_large_as_its_place(first: Path, tmp_path: Path) -> None:
    """The same way four times, a hand's breadth beside the first: what is there already is gone by, not made anew."""
    T = ring(N_LAP)[10:60] @ se3.from_parts(np.eye(3), np.array([0.05, 0.02, 0.05]))
    way, folder = PointWorld(wall(), T, seed=0), first
    n_keyframes = [len(load_atlas(first).atlas.submaps[0].keyframes)]
    n_rows, n_new = [], []
    for use in range(4):
        system = go_on(folder, way)
        assert len(trajectories_of(system).main) == len(T)
        (submap,) = system.atlas.submaps.values()
        n_keyframes.append(len(submap.keyframes))
        n_new.append(sum(k >= system.numbers.first_id for k in submap.keyframes))
        n_rows.append(len(submap.observations) + len(submap.landmarks) + len(submap.anchors))
        folder = tmp_path / str(use)
        save_atlas(folder, system.atlas, system.poses, system.camera)
    assert n_new[0] <= 8, "beside a map of 30 keyframes"
    assert max(n_new[1:]) <= 2
    assert n_keyframes[-1] <= n_keyframes[1] + 2
    assert n_rows[-1] < 1.1 * n_rows[1]


@pytest.mark.slow
def test_a_run_goes_over_to_the_submap_that_has_the_place_already(tmp_path: Path) -> None:
    """From one full submap into the next, as the first run did, and not into a new one."""
    small = {"max_keyframes": 20, "rollover_keyframes": 6}
    system, folder = run(lap(), n=100, graph=small), tmp_path / "0"
    system.finish()
    n_submaps = len(system.atlas.submaps)
    assert n_submaps > 2
    save_atlas(folder, system.atlas, system.poses, system.camera)
    T = ring(N_LAP)[5:95] @ se3.from_parts(np.eye(3), np.array([0.05, 0.02, 0.05]))
    sizes = [sum(len(submap.keyframes) for submap in system.atlas.submaps.values())]
    for use in range(1, 4):
        system = go_on(folder, PointWorld(wall(), T, seed=0), graph=small)
        assert len(trajectories_of(system).main) == len(T)
        assert len(system.atlas.components()) == 1
        over = [e for e in system.events.of_kind(EventKind.RELOCALISED) if "from_submap" in e.data]
        assert [(e.data["from_submap"], e.submap) for e in over] == [(0, 1), (1, 2)]
        sizes.append(sum(len(submap.keyframes) for submap in system.atlas.submaps.values()))
        folder = tmp_path / str(use)
        save_atlas(folder, system.atlas, system.poses, system.camera)
    assert len(system.atlas.submaps) == n_submaps
    assert sizes[-1] <= sizes[1] + 3


@pytest.mark.slow
def test_in_real_time_a_frame_is_posed_by_one_other_keyframe_at_most(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same, in parts: while there is a live map, none of its frames is held up by several looks at another."""
    small = {"max_keyframes": 20, "rollover_keyframes": 6}
    system = run(lap(), n=100, graph=small)
    system.finish()
    save_atlas(tmp_path / "0", system.atlas, system.poses, system.camera)
    tried: list[tuple[int, bool]] = []
    relocalise = VisualFrontEnd.relocalise

    def noted(front_end: VisualFrontEnd, view: View, keyframe_id: int) -> Track | Failure:
        tried.append((len(system.rows), system.live is not None))
        return relocalise(front_end, view, keyframe_id)

    monkeypatch.setattr(VisualFrontEnd, "relocalise", noted)
    T = ring(N_LAP)[5:95] @ se3.from_parts(np.eye(3), np.array([0.05, 0.02, 0.05]))
    world = PointWorld(wall(), T, seed=0)
    config = Config.model_validate(
        {"camera": {"model_sigma_px": 0.0}, "calibration": {"refine": False}, "graph": small}
    )
    system = build_system(config, CAMERA, saved=load_atlas(tmp_path / "0"))
    system._state.parts = replace(system._state.parts, view_of=lambda frame: world.view(frame.index))
    system.pace.clock = lambda: 0.0  # how busy the machine is does not count
    system.pace.note(0.0)
    assert system.pace.in_real_time
    for frame in world.frames():
        system.step(frame)
    system.finish()
    over = [e for e in system.events.of_kind(EventKind.RELOCALISED) if "from_submap" in e.data]
    assert [(e.data["from_submap"], e.submap) for e in over] == [(0, 1), (1, 2)]
    assert len(trajectories_of(system).main) == len(T)
    in_step = Counter(step for step, live in tried if live)
    assert len(in_step) >= 3
    assert max(in_step.values()) == 1


def test_the_folder_is_not_changed(first: Path) -> None:
    before = {path.name: path.read_bytes() for path in first.iterdir()}
    go_on(first, second_world(), n=20)
    assert {path.name: path.read_bytes() for path in first.iterdir()} == before


def test_another_world_is_not_found(first: Path) -> None:
    other = PointWorld(wall(seed=5), ring(N_LAP)[:40], seed=9)
    localised = go_on(first, other, localise=True)
    assert not len(trajectories_of(localised).main)
    extended = go_on(first, other)
    found = trajectories_of(extended)
    assert not len(found.main)
    assert found.unlinked
    assert not extended.events.of_kind(EventKind.MERGED, EventKind.LOOP_CLOSED, EventKind.GAP_RELOCALISED)


def test_a_mirrored_world_is_not_found(first: Path) -> None:
    mirrored = PointWorld(wall() * (-1, 1, 1), ring(N_LAP)[:40], seed=0)
    assert not len(trajectories_of(go_on(first, mirrored, localise=True)).main)


def test_the_camera_is_kept_with_the_map(first: Path) -> None:
    camera = load_atlas(first).camera
    assert camera is not None
    assert camera.to_dict() == CAMERA.to_dict()
