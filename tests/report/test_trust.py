"""The report lists lost scales and doubts, and draws the map's own uncertainty."""

from __future__ import annotations

import re
from dataclasses import replace

from dualslam.report import RunData
from dualslam.report.trust import trust_section
from tests.report.conftest import with_events


def cells(run: RunData) -> list[list[str]]:
    body = str(trust_section(run)).split("<tbody>")[1].split("</tbody>")[0]
    return [re.findall(r"<td[^>]*>(.*?)</td>", row) for row in body.split("<tr>")[1:]]


def test_verdicts_and_doubts_have_a_row_each(broken_run: RunData) -> None:
    run = with_events(
        replace(broken_run, events=[]),
        {
            "event": "failed",
            "frame": 33,
            "submap": 1,
            "reason": "look_alike",
            "detail": "another explains 9, this one 10",
        },
        {"event": "failed", "frame": 34, "submap": 1, "reason": "no_texture", "detail": "dark"},
        {"event": "failed", "frame": 34, "submap": 1, "reason": "scale_lost", "detail": "known to 30%"},
        {"event": "linked", "frame": 35, "submap": 1, "tries": 3.0},
        {"event": "linked", "frame": 36, "submap": 1, "tries": 1.0},
        {"event": "cut", "frame": 37, "submap": 1, "reason": "scale_lost", "left": [3, 4]},
    )
    told = cells(run)
    assert [row[0] for row in told] == ["33", "34", "35", "37"]
    assert "another explains 9" in told[0][3]
    assert told[1][2:] == ["its scale", "not handed on: parted (known to 30%)"]
    assert "try 3" in told[2][3]
    assert told[3][2] == "its scale"
    assert "2 frames" in told[3][3]


def test_claims_are_drawn_and_what_is_not_handed_on_stands_highest(broken_run: RunData) -> None:
    sigmas = [0.01, 0.02, float("inf"), None]
    rows = [replace(row, sigma_scale=sigmas[i % 4], sigma_position_rel=0.001) for i, row in enumerate(broken_run.rows)]
    text = str(trust_section(replace(broken_run, rows=rows)))
    bars = re.findall(r"<title>frames[^<]*: ([^<]*)</title>", text)
    assert "not known" in bars
    assert "95 % below 0.02" in text


def test_a_run_that_claims_nothing_says_so(broken_run: RunData) -> None:
    rows = [replace(row, sigma_scale=None, sigma_position_rel=None) for row in broken_run.rows]
    text = str(trust_section(replace(broken_run, rows=rows, events=[])))
    assert "Nothing was doubted." in text
    assert "<svg" not in text
