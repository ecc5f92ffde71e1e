from __future__ import annotations

import os
import re
import shutil
import signal
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest

from dualslam.atlas.atlas import Atlas, Link, LinkKind
from dualslam.core.errors import InputError
from dualslam.core.geometry import se3, sim3, so3
from dualslam.core.types import Frame, FrameStatus, Keyframe
from dualslam.io.map_store import save_atlas
from dualslam.io.run_folder import MAP_PAGE, RunFolder
from dualslam.lab.synthetic import SyntheticSequence
from dualslam.map.submap import Submap
from dualslam.report import RunData, SampleKeeper, read_run, report_page
from dualslam.report.canvas import Canvas, nice_step, ticks
from dualslam.report.failures import stories
from dualslam.report.markup import Markup, tag
from dualslam.report.page import headline
from dualslam.report.placement import place, plane_from_above
from dualslam.report.run_data import PosedRows, _map_points
from dualslam.report.timeline import _axis
from tests.cli.fakes import NO_FEATURES
from tests.report.conftest import LOST, N_FRAMES, MakeRun, with_events

VOID = {"meta", "link", "img", "br"}


class Outline(HTMLParser):
    """Checks that elements are closed in order, and collects what is needed to judge a page."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.feed(page)
        self.close()
        assert self.open == []

    def handle_starttag(self, name: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((name, dict(attrs)))
        if name not in VOID:
            self.open.append(name)

    def handle_endtag(self, name: str) -> None:
        assert self.open.pop() == name

    def handle_data(self, data: str) -> None:
        if self.open[-1:] != ["style"]:
            self.text += data

    def of_class(self, word: str) -> list[dict[str, str | None]]:
        return [a for _, a in self.elements if word in (a.get("class") or "").split()]


def outline(run: RunData) -> Outline:
    return Outline(report_page(run))


def test_every_run_leaves_a_report_that_needs_nothing_else(broken_run: RunData) -> None:
    page = (broken_run.path / "report.html").read_text()
    assert page == report_page(broken_run)
    found = Outline(page)
    assert not re.search(r"https?://|@import|url\(", page)
    assert all(name != "script" for name, _ in found.elements)
    for _, attributes in found.elements:
        for key in ("src", "href"):
            assert (attributes.get(key) or "data:").startswith(("data:", MAP_PAGE)), "what lies beside may be led to"


def test_it_says_what_happened(broken_run: RunData) -> None:
    text = outline(broken_run).text
    assert "Tracking failed once: not linked; 50.0 % of 40 frames" in text
    assert "Tracking was lost at frame 20" in text
    assert "<b>0 features</b>" in text  # as words
    assert "The one link that was tried was refused: too few inliers" in text
    assert "refused: too few inliers - 9 inliers, 20 needed" in text
    assert "Reverse tracking" in text
    assert "20 frames from before the loss and 7 since" in text
    for words in ("sift", "9 frames", "the buffer ends", "1.25 s", "31", "0.72 ± 0.21 %", "± 0.13°", "4 shared"):
        assert words in text
    assert "seed" in text


def test_a_map_that_was_found_again_counts_as_such(broken_run: RunData) -> None:
    again = {"event": "relocalised", "frame": 26, "timestamp_s": 2.6, "submap": 0, "n_inliers": 80}
    events = [event for event in broken_run.events if event["event"] in ("initialised", "failed")] + [again]
    counts = {"relocalised": 1, "loops": 2, "merges": 0}
    found = outline(run := replace(broken_run, events=events, summary=broken_run.summary | counts))
    assert headline(run).startswith("Tracking failed once: seen again; 2 loops; 50.0 % of 40 frames")
    assert [a["title"] for a in found.of_class("at") if (a.get("title") or "").startswith("frame 26: a place")]
    assert "1 relocalisation; 2 loops" in found.text
    assert headline(replace(run, events=[])).startswith("Tracking never failed; 1 relocalisation; 2 loops; ")
    twice = [{"event": "failed", "frame": f, "timestamp_s": 0.1 * f, "submap": m} for f, m in ((20, 0), (35, 1))]
    both = replace(run, events=[twice[0], again, twice[1]])
    assert headline(both).startswith("Tracking failed 2 times: 1 seen again, 1 not linked; 2 loops; ")


def test_ticks_stand_at_frames(broken_run: RunData) -> None:
    few = replace(broken_run, rows=broken_run.rows[:2])
    ticks_of_axis = re.findall(r'class="at tick"[^>]*>([^<]*)<', str(_axis(few)))
    assert ticks_of_axis == ["0", "1"]


def test_hostile_words_stay_words(broken_run: RunData) -> None:
    hostile = "<script>alert('x')</script>\" onload=\"x"
    run = with_events(broken_run, {"event": hostile, "frame": 1, "timestamp_s": 0.1, "submap": None, "detail": hostile})
    run = replace(run, summary=run.summary | {"sequence": hostile}, config_text=hostile, config={hostile: hostile})
    found = outline(run)
    assert all(name != "script" and "onload" not in attributes for name, attributes in found.elements)
    assert hostile in found.text


def test_each_map_is_laid_on_the_truth_by_itself(broken_run: RunData) -> None:
    turned = sim3.from_parts(3.0, so3.exp(np.array([0.4, -1.0, 0.2])), np.array([5.0, 6.0, 7.0]))
    (m, posed), main = next(iter(broken_run.unlinked.items())), broken_run.main
    moved = PosedRows(posed.row, np.stack([sim3.act_on_pose(turned, T) for T in posed.T_map_cam]))
    bent = main.T_map_cam.copy()
    bent[0, :3, 3] += [0.0, 0.0, 0.5]
    scene = place(replace(broken_run, unlinked={m: moved}, main=PosedRows(main.row, bent)))
    assert [p.submap for p in scene.placed] == [None, m]
    assert scene.unit == "m"
    assert np.nanmax(scene.placed[1].error) < 1e-6
    assert 0.2 < scene.placed[0].error[0] < 0.6
    assert np.argmax(scene.placed[0].error) == 0


def test_above_is_against_the_cameras_down(world: SyntheticSequence) -> None:
    T = np.asarray(world.ground_truth_T_world_cam)
    turned = se3.from_parts(so3.exp(np.array([1.0, 0.5, -0.3])), np.zeros(3)) @ T
    for poses in (T, turned):
        xyz, down = poses[:, :3, 3], poses[:, :3, 1].mean(axis=0)
        axes, view = plane_from_above(xyz, down)
        assert np.allclose(axes @ axes.T, np.eye(2), atol=1e-9)
        assert np.allclose(np.cross(axes[0], axes[1]), -down / np.linalg.norm(down), atol=1e-6)
        assert "from above" in view
        flat = (xyz - xyz[0]) @ axes.T
        assert flat[-1, 0] > abs(flat[-1, 1])  # the way goes to the right
    _, view = plane_from_above(T[:, :3, 3], np.zeros(3))
    assert "all angles" in view


def test_a_failure_is_marked_on_the_path_and_in_time(broken_run: RunData) -> None:
    found = outline(broken_run)
    marks = [a for a in found.of_class("break") if a.get("style")]
    (lane,) = [a for a in marks if "top" not in str(a["style"])]
    assert lane["style"] == f"left:{100 * (LOST[0] + 0.5) / N_FRAMES:.2f}%"
    assert len([a for a in marks if "top" in str(a["style"])]) >= 1
    lost = found.of_class("st-lost")
    assert [(a["x"], a["width"]) for a in lost] == [(str(LOST[0]), str(len(LOST)))]
    assert {"gap", "truth"} <= {c for _, a in found.elements for c in (a.get("class") or "").split()}


def test_no_status_is_told_by_colour_alone(broken_run: RunData) -> None:
    found = outline(broken_run)
    for status in {row.status for row in broken_run.rows}:
        assert str(status) in found.text
    for name, attributes in found.elements:
        if name == "svg":
            assert attributes.get("aria-label") or attributes.get("aria-hidden") == "true"
        if name == "img":
            assert attributes.get("alt")


def test_the_frames_around_a_gap_are_kept(broken_run: RunData) -> None:
    assert sorted(broken_run.samples) == [LOST[0] - 1, LOST[0], LOST[-1], LOST[-1] + 1]
    assert len([a for name, a in outline(broken_run).elements if name == "img"]) == 4
    for jpeg in broken_run.samples.values():
        image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_GRAYSCALE)
        assert image.shape == (120, 160)


def test_samples_are_bounded_and_a_blink_leaves_none() -> None:
    kept: list[int] = []
    keeper = SampleKeeper(lambda index, jpeg: kept.append(index))
    image = np.zeros((40, 60), np.uint8)
    statuses = ([FrameStatus.TRACKED] * 5 + [FrameStatus.LOST] * 2) * 3
    for i, status in enumerate(statuses):
        keeper.take(Frame(i, i / 10, image), status)
    assert kept == []
    for i in range(1000):
        status = FrameStatus.LOST if i % 10 < 5 else FrameStatus.TRACKED
        keeper.take(Frame(100 + i, i / 10, image), status)
    keeper.finish()
    assert 30 < len(kept) < 60
    assert len(set(kept)) == len(kept)


def test_colour_frames_are_kept_in_their_colours() -> None:
    kept: dict[int, bytes] = {}
    keeper = SampleKeeper(kept.__setitem__)
    red = np.zeros((40, 60, 3), np.uint8)
    red[..., 0] = 255
    keeper.take(Frame(0, 0.0, red), FrameStatus.INITIALISING)
    keeper.take(Frame(1, 0.1, None, "torn"), FrameStatus.UNREADABLE)
    keeper.finish()
    assert list(kept) == [0]
    blue, _, red_again = cv2.imdecode(np.frombuffer(kept[0], np.uint8), cv2.IMREAD_COLOR).mean(axis=(0, 1))
    assert red_again > 240
    assert blue < 15


def test_a_map_that_the_main_one_took_over_is_told_without_a_link(broken_run: RunData) -> None:
    event = {"event": "registered", "frame": 39, "timestamp_s": 3.9, "submap": 1, "old_submaps": [0], "frames": 20}
    text = outline(with_events(broken_run, event)).text
    assert "✓ taken over by the main map" in text
    assert "All its frames are among the 20 frames that were registered in submap 1: no link is needed." in text
    assert "The two maps are not joined" not in text


def test_a_map_that_was_seen_again_is_told_without_a_restart(broken_run: RunData) -> None:
    failed = next(i for i, e in enumerate(broken_run.events) if e["event"] == "failed")
    lost = broken_run.events[failed]
    again = next(i for i in sorted(broken_run.samples) if i > lost["frame"])
    event = {"event": "relocalised", "frame": again, "timestamp_s": 1.0, "submap": lost["submap"]}
    events = [*broken_run.events[: failed + 1], event, *broken_run.events[failed + 1 :]]
    text = outline(replace(broken_run, events=events)).text
    assert "✓ seen again" in text
    assert f"relocalised at frame {again}" in text
    assert f"{again} seen again" in text, "the picture's words"
    assert "was started at frame" not in text


def test_a_run_without_truth_draws_its_maps_apart(make_run: MakeRun) -> None:
    run = read_run(make_run(truth=False))
    assert not (run.path / "groundtruth.txt").exists()
    text = outline(run).text
    assert "No ground truth" in text
    assert "Submap 1, not linked, in its own frame and unit: 14 frames." in text
    assert "ATE" not in text.split("Trajectory")[0]


def test_missing_and_doubtful_stretches_are_on_the_path_without_a_truth(make_run: MakeRun) -> None:
    run = read_run(make_run(truth=False))
    kept = (run.main.row < 5) | (run.main.row > 7)
    main = replace(run.main, row=run.main.row[kept], T_map_cam=run.main.T_map_cam[kept])
    rows = [replace(row, doubt="scale") if 3 <= i <= 9 else row for i, row in enumerate(run.rows)]
    found = outline(replace(run, main=main, rows=rows))
    assert "frames 5 to 7: no pose in this map" in found.text
    for frames in ("frames 3 to 4", "frames 8 to 9"):
        assert f"{frames}: doubtful (scale), main map" in found.text
    assert "no pose (a straight line)" in found.text
    assert "doubtful: a reason of the verdict" in found.text
    assert not outline(run).of_class("doubtful")


def test_a_run_without_a_map_says_so(make_run: MakeRun) -> None:
    run = read_run(make_run(lost=tuple(range(N_FRAMES))))
    found = outline(run)
    assert "No map: none of 40 frames has a pose." in found.text
    assert "never began" in found.text
    assert len([name for name, _ in found.elements if name == "img"]) == 2  # the first frame and the last


def test_solutions_of_the_atlas_have_a_table(broken_run: RunData) -> None:
    event = {
        "event": "atlas_solved",
        "frame": 40,
        "timestamp_s": 4.0,
        "submap": 0,
        "submaps": [0, 1],
        "factors": {"within": 12, "recovery": 1, "loop": 1},
        "cost_before": 129.2,
        "cost_after": 0.34,
        "rejected": [{"connection": "loop", "submap": 1, "other_submap": 0, "keyframe": 9, "other_keyframe": 3}],
        "largest_bend": 0.018,
        "largest_move": 1.4e-20,
    }
    without = [e for e in broken_run.events if e["event"] != "atlas_solved"]
    page = report_page(replace(broken_run, events=[*without, event]))
    for words in ("Connections between submaps", "12 within, 1 recovery, 1 loop", "129", "loop 0-1", "0.018"):
        assert words in page
    assert "e-20" not in page  # what rounding leaves of nought
    assert "Connections between submaps" not in report_page(replace(broken_run, events=without))


def test_landmarks_of_all_linked_submaps_come_in_the_main_maps_frame(tmp_path: Path) -> None:
    S = sim3.from_parts(2.0, so3.exp(np.array([0.0, 0.5, 0.0])), np.array([1.0, 0.0, 3.0]))
    xyz = np.random.default_rng(0).uniform([-1, -1, 2], [1, 1, 4], (40, 3))
    atlas = Atlas()
    for m, points in enumerate((xyz, (xyz - S[:3, 3]) @ np.linalg.inv(S[:3, :3]).T)):
        submap = Submap(m, np.eye(3), np.zeros(32, np.uint8))
        submap.add_keyframe(Keyframe(m, 0.1 * m, NO_FEATURES), np.eye(4))
        submap.add_landmarks(points, np.zeros((40, 32), np.uint8), np.ones(40), m)
        submap.remove_landmarks(np.arange(5))
        atlas.add(submap)
    atlas.link(Link(0, 1, S, np.eye(7), LinkKind.RECOVERY))
    save_atlas(tmp_path / "map", atlas, {})
    points = _map_points(tmp_path / "map", {1})  # where 0 has no frame left, it is the world all the same
    assert len(points) == 70
    assert np.allclose(points[:35], xyz[5:])
    assert np.allclose(points[35:], xyz[5:])


def test_pictures_of_an_earlier_run_go_with_it(make_run: MakeRun) -> None:
    folder = make_run()
    (folder / "samples" / "mine.txt").write_text("mine")
    RunFolder(folder, overwrite=True).close()
    assert [file.name for file in (folder / "samples").iterdir()] == ["mine.txt"]
    assert not (folder / "groundtruth.txt").exists()


@pytest.mark.slow
def test_a_page_stays_small_however_much_happens(broken_run: RunData) -> None:
    failed = next(e for e in broken_run.events if e["event"] == "failed")
    found = outline(replace(broken_run, events=[failed | {"submap": m} for m in range(900)]))
    assert "900 events, of which the first 500 are here and all in events.jsonl" in found.text
    assert len(found.of_class("close-up")) == 20
    assert len(report_page(broken_run)) < 150_000


def test_signs_of_trouble_are_told(broken_run: RunData) -> None:
    events = [e | {"suspected_since": 17} if e["event"] == "failed" else e for e in broken_run.events]
    assert "signs of trouble since frame 17" in outline(replace(broken_run, events=events)).text


def test_an_interrupted_run_says_so(make_run: MakeRun) -> None:
    def interrupt(frame: Frame) -> None:
        if frame.index == 9:
            os.kill(os.getpid(), signal.SIGINT)

    run = read_run(make_run(lost=(), before_step=interrupt))
    assert "This run was interrupted" in outline(run).text
    assert len(run.rows) == 10


def test_a_link_tells_its_numbers(broken_run: RunData) -> None:
    linked = {
        "event": "linked",
        "frame": 26,
        "timestamp_s": 2.6,
        "submap": 1,
        "old_submap": 0,
        "matches": 440,
        "inliers": 394,
        "agreeing_keyframes": [12, 15, 18],
        "seconds": 0.29,
        "scale": 0.7203,
        "sigma_scale": 0.0053,
    }
    run = with_events(broken_run, linked, {"event": "fused", "frame": 26, "submap": 1, "old_submap": 0, "bypassed": 2})
    (story,) = stories(run)
    assert story.linked is not None
    text = outline(run).text
    assert "the recovery linked it in 0.29 s after 1 refused link: scale 0.7203 ± 0.53 %" in text
    assert "394 of 440 landmark pairs agree; keyframes 12, 15, 18 agree one by one" in text
    assert "By-passed at the lost map's end: 2 frames." in text
    assert len(outline(run).of_class("agreeing")) == 3


def test_a_folder_that_is_no_run_is_bad_input(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no summary\.json"):
        read_run(tmp_path)
    with pytest.raises(InputError, match="no such folder"):
        read_run(tmp_path / "nowhere")


@pytest.mark.parametrize(
    ("file", "old", "new", "words"),
    [
        ("frames.csv", r"(?s)(submap,.*?\n)(.*\n){5}", r"\1", r"trajectory\.txt has a pose at .* has no frame"),
        ("frames.csv", r"(?s)\n.*", "\n", r"frames\.csv has no frame"),
        ("frames.csv", r",\d+\.\d{3},", ",inf,", "line 2: not a row of frames.csv .inf is no finite number"),
        ("summary.json", r'"coverage": [\d.]+', '"coverage": "all"', "coverage is not a number"),
        ("summary.json", r'"first_id": \d+', '"first_id": null', "first_id is not a whole number"),
        ("events.jsonl", r'"frame": \d+', '"frame": []', "line 1: frame is not a whole number"),
        ("events.jsonl", r'"frame": \d+, ', "", "an event has no frame or no time"),
        ("events.jsonl", r'"timestamp_s": [\d.]+', '"timestamp_s": "x"', "line 1: timestamp_s is not a number"),
    ],
)
def test_a_run_folder_that_was_cut_off_or_edited_is_one_sentence(
    broken_run: RunData, tmp_path: Path, file: str, old: str, new: str, words: str
) -> None:
    run = shutil.copytree(broken_run.path, tmp_path / "edited")
    text = (run / file).read_text()
    edited = re.sub(old, new, text, count=1)
    assert edited != text
    (run / file).write_text(edited)
    with pytest.raises(InputError, match=words):
        read_run(run)


def test_markup_escapes_what_is_not_markup() -> None:
    assert tag("p", "a < b", Markup("<br>"), [1, None], title='"') == '<p title="&quot;">a &lt; b<br>1</p>'
    with pytest.raises(TypeError):
        tag("p", object())


def test_ticks_are_round_and_inside() -> None:
    assert ticks(0, 100, 6) == [0, 20, 40, 60, 80, 100]
    assert ticks(3, 3.9, 4)[0] >= 3
    assert nice_step(0.7) == 0.5
    for low, high in ((0, 1), (17, 801), (-3.2, 0.1)):
        found = ticks(low, high, 6)
        assert 2 <= len(found) <= 7
        assert min(found) >= low - 1e-9
        assert max(found) <= high + 1e-9


def test_a_canvas_holds_what_it_is_drawn_around() -> None:
    rng = np.random.default_rng(0)
    for scale in ([1, 1], [100, 0.1], [0.01, 3], [0, 0]):
        uv = rng.normal(size=(50, 2)) * scale
        canvas = Canvas.around(uv.min(0), uv.max(0))
        xy = canvas.to_svg(uv)
        assert (xy >= 0).all()
        assert (xy <= [1000, canvas.height]).all()


def test_the_verdict_stands_first_with_its_reasons(make_run: MakeRun) -> None:
    run = read_run(make_run())
    page = report_page(run)
    told = run.summary["verdict"]
    assert told["level"] == "usable", "six frames have no pose, and the map after them is not joined"
    assert f"Verdict: {told['level']}." in page
    for reason in told["reasons"]:
        assert page.index(reason["text"]) < page.index("Every frame")
    del run.summary["verdict"]
    assert "Verdict:" not in report_page(run)
