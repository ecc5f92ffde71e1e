"""`dualslam explain`: the decisions about a frame, as sentences."""

from __future__ import annotations

import json
from pathlib import Path
from shutil import copy

import pytest

from dualslam.cli import main
from dualslam.cli.explain_command import explain
from dualslam.core.decisions import Decision, DecisionKind, Gate
from dualslam.core.errors import InputError
from dualslam.io.run_folder import DECISIONS, EVENTS, FRAMES, SUMMARY
from tests.report.conftest import MakeRun


@pytest.fixture(scope="module")
def one_run(make_run: MakeRun) -> Path:
    return make_run()


@pytest.fixture
def run(one_run: Path, tmp_path: Path) -> Path:
    for name in (SUMMARY, FRAMES, EVENTS):
        copy(one_run / name, tmp_path)
    return tmp_path


def write(run: Path, *decisions: Decision) -> None:
    (run / DECISIONS).write_text("".join(json.dumps(decision.as_dict()) + "\n" for decision in decisions))


def test_decisions_are_sentences_with_their_comparisons(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    gates = Gate("parallax in degrees", 1.25, ">", 4), Gate("share of landmarks", 0.55, "<", 0.6)
    link = {"frame": 7, "reason": "scale_lost", "detail": "nothing holds it"}
    write(
        run,
        Decision(6, DecisionKind.KEYFRAME, False),
        Decision(7, DecisionKind.KEYFRAME, True, 0, gates),
        Decision(what=DecisionKind.LINK, accepted=False, data={"tries": 2.0}, **link),  # type: ignore[arg-type]
    )
    assert main(["explain", str(run), "--frame", "7"]) == 0
    head, *lines = capsys.readouterr().out.splitlines()
    assert head.startswith("Frame 7 (")
    assert lines == [
        "The frame becomes a keyframe.",
        "  parallax in degrees: 1.25, more than 4: no",
        "  share of landmarks: 0.55, less than 0.6: yes",
        "The link is refused (scale lost: nothing holds it).",
        "  besides: tries 2",
    ]


def test_without_decisions_a_frame_has_its_events_and_how_to_have_more(run: Path) -> None:
    event = {"event": "failed", "frame": 7, "timestamp_s": 0.7, "submap": 0, "lost_since": 6}
    (run / EVENTS).write_text(json.dumps(event) + "\n")
    assert explain(run, 7)[1] == "failed: lost_since 6"
    assert "run again with --decisions" in explain(run, 7)[-1]


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ('{"frame": 7}', "line 1 is not a decision"),
        ('{"what": "link", "frame": "7"}', "frame is not a whole number"),
        ('{"what": "link", "frame": 7}', "line 1 is not a decision"),
    ],
)
def test_damage_and_a_frame_that_is_none_are_said_in_one_sentence(run: Path, line: str, says: str) -> None:
    with pytest.raises(InputError, match="has no frame 4000; it has 0 to"):
        explain(run, 4000)
    (run / DECISIONS).write_text(line + "\n")
    with pytest.raises(InputError, match=says):
        explain(run, 7)
