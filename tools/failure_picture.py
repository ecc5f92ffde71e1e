"""Draw docs/failure.svg: a failure, reverse tracking and the fusion, from a real run on a synthetic street.

    python tools/failure_picture.py

The same seed gives the same picture. What is drawn is what the run found: nothing is placed by hand but the new map in
the middle panel, which before the link has no place at all and is drawn below the old one, in its own frame and unit.
"""

from __future__ import annotations

from pathlib import Path

import dualslam

dualslam.limit_threads()

import numpy as np  # noqa: E402 - after the number of threads is set

from dualslam.core.geometry import sim3  # noqa: E402
from dualslam.core.geometry.umeyama import umeyama  # noqa: E402
from dualslam.core.types import Failure, FloatArray, FrameStatus  # noqa: E402
from dualslam.map.submap import Submap  # noqa: E402
from dualslam.report.markup import Markup, coordinate, tag  # noqa: E402

OUT = Path(__file__).resolve().parent.parent / "docs" / "failure.svg"
COVERED = range(60, 67)
SETTINGS = (
    f"corruptions=[{{kind: blackout, start: {COVERED.start}, length: {len(COVERED)}}}]",
    "tracking.max_lost_s=0.25",
    "calibration.refine=false",
)
FIRST, LAST = 30, 94
WIDTH, PANEL, GAP, HEIGHT, TOP = 1260, 400, 30, 368, 96
PAPER = "#f4f6f9"
OLD, NEW, LOST, GOOD, QUIET, INK = "#1f5fa8", "#c46a00", "#c01f2e", "#107a46", "#5a6270", "#16191f"


def main() -> None:
    """Run, draw, write."""
    config = dualslam.load_config(overrides=SETTINGS)
    sequence = dualslam.corrupted(dualslam.open_source("synthetic:street,frames=100,seed=5"), config.corruptions)
    system = dualslam.build_system(config, sequence.camera)
    for frame in sequence:
        system.step(frame)
    system.finish()
    truth = np.asarray(sequence.ground_truth.T_world_cam)
    OUT.write_text(Picture(system, truth).svg() + "\n", encoding="utf-8")


class Picture:
    """Three panels over one run."""

    def __init__(self, system: dualslam.System, truth: FloatArray) -> None:
        (self.link,) = system.atlas.links
        self.old, self.new = (system.atlas.submaps[m] for m in (self.link.a, self.link.b))
        self.rows, self.poses = system.rows, system.poses
        self.linked = next(e.data for e in system.events if e.event == "linked")
        # From the world to the paper: forward of the middle of the drive to the right, metres.
        way = truth[FIRST : LAST + 1, :3, 3]
        down = truth[:, :3, 1].mean(axis=0)
        right = way[-1] - way[0]
        right -= (right @ down) * down / (down @ down)
        right /= np.linalg.norm(right)
        self.axes = np.stack([right, np.cross(right, down / np.linalg.norm(down))])
        self.centre = way.mean(axis=0)
        self.truth = truth[:, :3, 3]
        self.S_world_old = self._placed(self.old)
        self.S_world_new = self.S_world_old @ self.link.S_a_b
        self.scale = PANEL / (1.12 * np.ptp((way - self.centre) @ right))

    def _placed(self, submap: Submap) -> FloatArray:
        ids = sorted(submap.keyframes)
        alignment = umeyama(submap.keyframe_poses(ids)[:, :3, 3], self.truth[ids])
        assert not isinstance(alignment, Failure)
        return alignment.S_dst_src

    # --- from the world to the paper

    def uv(self, xyz: FloatArray, panel: int, drop: float = 0.0) -> FloatArray:
        """Return pixels (N, 2) of points in the world."""
        plane = (np.atleast_2d(xyz) - self.centre) @ self.axes.T * self.scale
        x = panel * (PANEL + GAP) + PANEL / 2 + plane[:, 0]
        return np.column_stack([x, TOP + 105 + drop - plane[:, 1]])

    def frames(self, submap: Submap, S: FloatArray) -> tuple[list[int], FloatArray]:
        """Return indices and places in the world of the frames that stand in a submap now."""
        ids = [i for i in sorted(self.poses) if self.poses[i].submap_id == submap.id and FIRST <= i <= LAST]
        T = [submap.resolve_anchor(self.poses[i].keyframe_id, self.poses[i].T_kf_cam) for i in ids]
        return ids, sim3.act(S, np.array(T)[:, :3, 3])

    def landmarks(self, submap: Submap, S: FloatArray, panel: int, colour: str, drop: float = 0.0) -> Markup:
        """Draw a map's landmarks, those within the panel."""
        near = submap.landmarks["alive"] & (submap.landmarks["distance_mu"] < 4)
        uv = self.uv(sim3.act(S, submap.landmarks["xyz_mu"][near]), panel, drop)
        left = panel * (PANEL + GAP)
        inside = (uv[:, 0] > left + 3) & (uv[:, 0] < left + PANEL - 3) & (uv[:, 1] > TOP + 4) & (uv[:, 1] < HEIGHT - 4)
        d = "".join(f"M{coordinate(u)} {coordinate(v)}h0" for u, v in uv[inside][::2].tolist())
        return tag("path", d=d, stroke=colour, stroke_width=1.6, stroke_linecap="round", opacity=0.45, fill="none")

    # --- panels

    def svg(self) -> Markup:
        """Return the picture."""
        panels = [self._failure(), self._make_attempt(), self._fused()]
        words = [self._words(i, *text) for i, text in enumerate(self._texts())]
        label = "Three steps of a recovery: a map is lost, a new map tracks in reverse, a similarity joins the two"
        return tag(
            "svg",
            tag("title", label),
            tag("rect", width=WIDTH, height=HEIGHT, rx=8, fill="#ffffff"),
            [
                tag("rect", x=i * (PANEL + GAP), y=TOP, width=PANEL, height=HEIGHT - TOP, rx=6, fill=PAPER)
                for i in range(3)
            ],
            panels,
            words,
            xmlns="http://www.w3.org/2000/svg",
            viewBox=f"-10 -6 {WIDTH + 20} {HEIGHT + 12}",
            font_family="system-ui, sans-serif",
            role="img",
        )

    def _failure(self) -> list[Markup]:
        lost = int(COVERED.start)
        ids = [i for i in sorted(self.old.keyframes.keys() | self.old.anchors.keys()) if i >= FIRST]
        before = self.truth[FIRST:lost]
        T = np.array([self.old.resolve_anchor(i, np.eye(4)) for i in ids])
        places = self.uv(sim3.act(self.S_world_old, T[:, :3, 3]), 0)
        gap = self.uv(self.truth[lost - 1 : COVERED.stop + 1], 0)
        return [
            self.landmarks(self.old, self.S_world_old, 0, OLD),
            _line(self.uv(before, 0), OLD, 3),
            _dots(places, OLD, 3.4),
            _line(gap, LOST, 4, dash="1 8"),
            _cross(gap[0], LOST),
        ]

    def _make_attempt(self) -> list[Markup]:
        # Before the link the new map has a frame and a unit of its own: drawn as if its unit were the old one.
        unit = float(sim3.scale(self.S_world_old))
        R = sim3.rotation(self.S_world_new)
        first = min(k for k in self.new.keyframes if k >= COVERED.stop)
        start = sim3.act(self.S_world_new, self.new.T_submap_kf[first][:3, 3][None])[0]
        own = sim3.from_parts(unit, R, start - unit * R @ self.new.T_submap_kf[first][:3, 3])
        drop = 92.0
        shared = [int(k) for k in self.linked["agreeing_keyframes"] if k >= FIRST]
        old = self.uv(sim3.act(self.S_world_old, self.old.keyframe_poses(shared)[:, :3, 3]), 1)
        new = self.uv(sim3.act(own, self.new.keyframe_poses(shared)[:, :3, 3]), 1, drop)
        recovered_frames = sorted(k for k in self.new.keyframes if FIRST <= k <= first + 2)
        way = self.uv(sim3.act(own, self.new.keyframe_poses(recovered_frames)[:, :3, 3]), 1, drop)
        return [
            self.landmarks(self.old, self.S_world_old, 1, OLD),
            self.landmarks(self.new, own, 1, NEW, drop),
            [_line(np.stack(pair), GOOD, 1, dash="3 3") for pair in zip(old, new, strict=True)],
            _line(self.uv(self.truth[FIRST : COVERED.start], 1), OLD, 3),
            _dots(old, OLD, 3.4),
            _line(way, NEW, 3),
            _dots(new, NEW, 3.4),
            _arrow(way[::-1], NEW),
        ]

    def _fused(self) -> list[Markup]:
        shapes = [
            self.landmarks(self.old, self.S_world_old, 2, OLD),
            self.landmarks(self.new, self.S_world_new, 2, NEW),
        ]
        for submap, S, colour in ((self.old, self.S_world_old, OLD), (self.new, self.S_world_new, NEW)):
            ids, xyz = self.frames(submap, S)
            uv = self.uv(xyz, 2)
            pieces = np.split(uv, np.flatnonzero(np.diff(ids) > 1) + 1)
            shapes += [_line(piece, colour, 3) for piece in pieces]
            back = [n for n, i in enumerate(ids) if self.rows[i].status is not FrameStatus.TRACKED]
            shapes.append(_dots(uv[back], GOOD, 5))
        shared = [int(k) for k in self.linked["agreeing_keyframes"] if k >= FIRST]
        at = self.uv(sim3.act(self.S_world_old, self.old.keyframe_poses(shared)[:, :3, 3]), 2)
        gap = self.uv(self.truth[COVERED.start - 1 : COVERED.stop + 1], 2)
        return [_line(gap, LOST, 3, dash="1 8"), *shapes, _dots(at, GOOD, 3.4)]

    def _texts(self) -> list[tuple[str, str, str]]:
        d = self.linked
        n_recovered = sum(row.status is FrameStatus.RECOVERED for row in self.rows.values())
        n_bypassed = sum(row.status is FrameStatus.BYPASSED for row in self.rows.values())
        return [
            (
                "1  Tracking fails. The map is kept.",
                f"The lens is covered: frames {COVERED.start} to {COVERED[-1]}.",
                "blue: the map that was lost",
            ),
            (
                "2  A new map tracks in reverse",
                "in a frame and unit of its own, from images alone,",
                f"until it holds {len(d['agreeing_keyframes'])} keyframes of the old one.",
            ),
            (
                "3  A verified similarity joins them",
                f"{d['inliers']} of {d['matches']} landmark pairs agree: scale {d['scale']:.2f}.",
                f"green: {n_recovered} frames recovered, {n_bypassed} by-passed",
            ),
        ]

    @staticmethod
    def _words(panel: int, title: str, line: str, note: str) -> list[Markup]:
        x = panel * (PANEL + GAP)
        return [
            tag("text", title, x=x + 2, y=28, font_size=21, font_weight=600, fill=INK),
            tag("text", line, x=x + 2, y=56, font_size=16, fill=QUIET),
            tag("text", note, x=x + 2, y=79, font_size=16, fill=QUIET),
        ]


def _line(uv: FloatArray, colour: str, width: float, dash: str | None = None) -> Markup:
    d = "M" + "L".join(f"{coordinate(u)} {coordinate(v)}" for u, v in uv.tolist())
    style = {"stroke": colour, "stroke_width": width, "stroke_linecap": "round", "stroke_linejoin": "round"}
    return tag("path", d=d, fill="none", stroke_dasharray=dash, **style)


def _dots(uv: FloatArray, colour: str, radius: float) -> list[Markup]:
    style = {"fill": colour, "stroke": "#ffffff", "stroke_width": 1}
    return [tag("circle", cx=float(u), cy=float(v), r=radius, **style) for u, v in uv.tolist()]


def _cross(at: FloatArray, colour: str) -> Markup:
    u, v = at.tolist()
    d = "".join(
        f"M{coordinate(u - 7)} {coordinate(v + s * 7)}L{coordinate(u + 7)} {coordinate(v - s * 7)}" for s in (1, -1)
    )
    return tag("path", d=d, stroke=colour, stroke_width=3.5, stroke_linecap="round", fill="none")


def _arrow(uv: FloatArray, colour: str) -> list[Markup]:
    """Draw an arrow beside a way, in the direction in which its points follow each other."""
    along = uv[-1] - uv[0]
    off = np.array([-along[1], along[0]]) / np.linalg.norm(along)
    side = off if off[1] > 0 else -off
    shaft = uv + 20 * side
    head = shaft[-1]
    back = (shaft[-2] - head) / np.linalg.norm(shaft[-2] - head)
    wings = [head + 11 * (back + s * 0.5 * np.array([-back[1], back[0]])) for s in (1, -1)]
    return [_line(shaft, colour, 2), _line(np.stack([wings[0], head, wings[1]]), colour, 2)]


if __name__ == "__main__":
    main()
