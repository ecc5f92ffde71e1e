"""Colours of statuses and submaps, as RGBA: the hues of the report, for the recording and for the live view."""

from __future__ import annotations

from dualslam.core.types import FrameStatus

STATUS_COLOURS = {
    FrameStatus.TRACKED: 0x3D8BE0FF,
    FrameStatus.RECOVERED: 0x22A565FF,
    FrameStatus.BYPASSED: 0xD08A1AFF,
    FrameStatus.LOST: 0xE8505BFF,
    FrameStatus.INITIALISING: 0x848D9BFF,
    FrameStatus.DROPPED: 0x9A63E0FF,
    FrameStatus.UNREADABLE: 0x6B7079FF,
}
"""In tones that show on a light ground and on a dark one."""
ELSEWHERE, TRUTH_COLOUR, MATCH_COLOUR = 0xA9AFB8FF, 0x808895FF, 0x94A9C4FF
CONDEMNED_COLOUR = 0x9A5B60FF
SUBMAP_COLOURS = (0x8DA0CBFF, 0xFC8D62FF, 0x66C2A5FF, 0xE78AC3FF, 0xA6D854FF, 0xFFD92FFF, 0xE5C494FF)
"""One a submap, from the first again after the last: neighbours differ, for people who see few colours too."""


def rgb(rgba: int) -> tuple[int, int, int]:
    """Return red, green and blue, 0 to 255."""
    return rgba >> 24, rgba >> 16 & 255, rgba >> 8 & 255


def submap_rgb(submap_id: int) -> tuple[int, int, int]:
    """Return the colour of a submap."""
    return rgb(SUBMAP_COLOURS[submap_id % len(SUBMAP_COLOURS)])
