"""Demonstrations by a hand-held gripper: a fisheye camera of 155 degrees, 40 % of whose pixels stand still.

python benchmarks/gripper.py --out runs/gripper --first 100 --demonstrations 20 [--no-mask] [--keep]

A hand holds the gripper over a laid table, and reaches for a thing. It closes the fingers, carries the thing to
another place, opens them and moves back. The wrist turns and trembles, and images are blurred. What is carried moves
with the camera, and is in no mask. A demonstration is whole if 95 % of its frames have a pose in one map. It is right
if each position is within 5 % of the path's length of the truth, aligned by a similarity.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

import dualslam
from dualslam.core.camera.models import KannalaBrandtCamera
from dualslam.core.geometry import se3
from dualslam.core.types import BoolArray, FloatArray
from dualslam.lab.disturbances.overlays import _texture
from dualslam.lab.metrics.alignment import distances_when_aligned
from dualslam.lab.synthetic.path import Sway, pose
from dualslam.lab.synthetic.render import Renderer
from dualslam.lab.synthetic.room import make_room
from dualslam.lab.synthetic.surfaces import Scene

U8Image = NDArray[np.uint8]

GOPRO = KannalaBrandtCamera(
    2704, 2028, 796.854, 799.228, 1354.427, 1011.485,
    k1=-0.021961, k2=-0.018960, k3=0.0016939, k4=-0.00016807,
)  # fmt: skip
"""A GoPro with its wide lens, as the authors of the Universal Manipulation Interface publish it (2024)."""
SIDE_PX = 480
RIM_DEG = 77.5
"""Half the field of view. Beyond it the lens leaves the sensor black."""
STILL = 0.40
RATE_HZ, EXPOSURE_S = 20.0, 0.008
BLUR_STEP_PX = 1.0
"""Between the views of which a blurred image is the mean, at the middle of the image."""
WAIT_S, GRASP_S = 0.5, 0.4
WHOLE, RIGHT = 0.95, 0.05


def camera() -> KannalaBrandtCamera:
    """Return the camera of the middle square of the image."""
    whole = GOPRO.scaled(SIDE_PX / GOPRO.height)
    return replace(whole, width=SIDE_PX, cx=whole.cx - 0.5 * (whole.width - SIDE_PX))


def motion(seed: int) -> tuple[FloatArray, FloatArray]:
    """Return the camera's poses (N, 2, 4, 4) as exposures begin and end, and how far (N,) fingers are closed."""
    rng = np.random.default_rng([seed, 0x6819])

    def over_table(height_m: tuple[float, float], z_m: tuple[float, float], pitch_deg: float) -> FloatArray:
        """Return a station: x, y, z, yaw, pitch, roll; y points down, and the table is 0.72 m high."""
        low, high = (-0.4, -0.72 - height_m[1], z_m[0]), (0.4, -0.72 - height_m[0], z_m[1])
        turned = np.radians(rng.normal((0, pitch_deg, 0), (15, 8, 15)))
        return np.concatenate([rng.uniform(low, high), turned])

    begin, end = (over_table((0.45, 0.60), (-0.75, -0.50), -35) for _ in range(2))
    thing, place = (over_table((0.34, 0.42), (-0.50, 0.0), -45) for _ in range(2))
    stations = [(begin, WAIT_S), (thing, GRASP_S), (place, GRASP_S), (end, WAIT_S)]
    spans, now_s = [], 0.0
    for _, rest_s in stations:
        leaves_s = now_s + rest_s
        spans.append((now_s, leaves_s))
        now_s = leaves_s + rng.uniform(0.9, 1.6)
    lifts = rng.uniform(0.05, 0.2, len(spans))
    tremor = Sway(rng, [0.002] * 3 + [0.01] * 3, (1.0, 5.0))

    def at(t_s: float) -> FloatArray:
        i = max(i for i, (arrives_s, _) in enumerate(spans) if arrives_s <= t_s)
        found = stations[i][0]
        if t_s > spans[i][1]:
            x = (t_s - spans[i][1]) / (spans[i + 1][0] - spans[i][1])
            s = x**3 * (10 - 15 * x + 6 * x * x)  # of least jerk, as an arm moves
            found = found + s * (stations[i + 1][0] - found)
            found[1] -= lifts[i] * 16 * (s * (1 - s)) ** 2
        found = found + tremor(t_s)
        return pose(found[:3], *found[3:])

    times_s = np.arange(round(spans[-1][1] * RATE_HZ)) / RATE_HZ
    closed = np.interp(times_s, [*spans[1], *spans[2]], [0, 1, 1, 0])
    return np.array([[at(t), at(t + EXPOSURE_S)] for t in times_s]), closed


def fingers(reach: float, closed: float) -> BoolArray:
    """Return the pixels (H, W) of two fingers that reach so far into the image."""
    both = np.zeros((SIDE_PX, SIDE_PX), np.uint8)
    for side in (-1, 1):
        tip = 0.09 - 0.06 * closed
        x = [0.5 + side * f for f in (0.42, 0.12, tip, tip + 0.10)]
        y = [1.0, 1.0, 1.0 - 0.5 * reach, 1.0 - 0.5 * reach]
        cv2.fillPoly(both, [np.array([[a * SIDE_PX, b * SIDE_PX] for a, b in zip(x, y, strict=True)], np.int32)], 1)
    return both.astype(bool)


class Lens:
    """Turns a scene into images of the fisheye camera, with what is fixed to it.

    Attributes
    ----------
    mask : (H, W) bool
        Beyond the lens, and where fingers are at any time: `STILL` of the image.
    """

    def __init__(self, scene: Scene, seed: int) -> None:
        self._camera = camera()
        u, v = np.meshgrid(np.arange(SIDE_PX), np.arange(SIDE_PX))
        rays = self._camera.unproject(np.stack([u.ravel(), v.ravel()], 1).astype(float)).reshape(SIDE_PX, SIDE_PX, 3)
        with np.errstate(invalid="ignore"):
            self._beyond = ~(rays[..., 2] > np.cos(np.radians(RIM_DEG)))
        self._reach = next(r for r in np.linspace(0.1, 1.2, 111) if self._hidden(r).mean() >= STILL)
        self.mask = self._hidden(self._reach)
        # The faces of a cube: ahead, right, left, down, up; somewhat more than 90 degrees each.
        face_px = 2 * round(1.1 * self._camera.fx)
        K = np.array([[0.5, 0, 0.5], [0, 0.5, 0.5], [0, 0, 1]]) * [[face_px / 1.02], [face_px / 1.02], [1]]
        K[:2, 2] = 0.5 * face_px - 0.5
        self._renderer = Renderer(scene, K, face_px, face_px, detail=2.0)
        turns = [(0, 0), (90, 0), (-90, 0), (0, -90), (0, 90)]
        self._faces = [pose(np.zeros(3), np.radians(yaw), np.radians(pitch), 0.0) for yaw, pitch in turns]
        cosines = np.stack([rays @ T[:3, 2] for T in self._faces])
        nearest = np.where(self._beyond, -1, cosines.argmax(0))
        self._lookups: list[tuple[BoolArray, NDArray[np.float32], NDArray[np.float32]]] = []
        for i, T in enumerate(self._faces):
            at = rays @ T[:3, :3] @ K.T
            with np.errstate(invalid="ignore", divide="ignore"):
                at = np.where((nearest == i)[..., None], at[..., :2] / at[..., 2:], -1).astype(np.float32)
            self._lookups.append((nearest == i, np.ascontiguousarray(at[..., 0]), np.ascontiguousarray(at[..., 1])))
        rng = np.random.default_rng([seed, 0xF1])
        self._finger, self._thing = (
            _texture((SIDE_PX, SIDE_PX), rng, mean=m, contrast=c, blur_px=0.6) for m, c in ((60, 40), (130, 80))
        )
        self._seed = seed

    def _hidden(self, reach: float) -> BoolArray:
        return np.asarray(self._beyond | fingers(reach, 0.0) | fingers(reach, 1.0))

    def image(self, index: int, T_world_cam: FloatArray, closed: float) -> U8Image:
        """Return the image (H, W) of a frame, exposed from one pose to another, (2, 4, 4)."""
        total = np.zeros((SIDE_PX, SIDE_PX), np.float32)
        first, last = T_world_cam
        change = se3.log(se3.inverse(first) @ last)
        n = 1 + int(self._camera.fx * np.linalg.norm(change[:3]) / BLUR_STEP_PX)
        during = [first @ se3.exp(change * (k + 0.5) / n) for k in range(n)]
        for T in during:
            for (pixels, u, v), T_cam_face in zip(self._lookups, self._faces, strict=True):
                face = self._renderer.image(T @ T_cam_face)
                total[pixels] += cv2.remap(face, u, v, cv2.INTER_LINEAR)[pixels]
        seen = cv2.GaussianBlur(total / n, (0, 0), 0.6)
        if closed == 1:
            top, half = round(SIDE_PX * (1 - 0.5 * self._reach)), round(0.045 * SIDE_PX)
            held = np.s_[top - half : top + half, SIDE_PX // 2 - half : SIDE_PX // 2 + half]
            seen[held] = self._thing[held]
        both = fingers(self._reach, closed)
        seen[both] = self._finger[both]
        seen[self._beyond] = 4
        noise = np.random.default_rng([self._seed, index]).normal(0, 1.5, seen.shape)
        return np.asarray(np.clip(seen + noise, 0, 255), np.uint8)


def demonstrate(seed: int, use_mask: bool, out: Path, keep: bool) -> dict[str, object]:
    """Render a demonstration, track it, and compare it with the truth."""
    lens = Lens(make_room(seed), seed)
    cv2.imwrite(str(out / "mask.png"), np.where(lens.mask, 0, 255).astype(np.uint8))
    mask = lens.mask if use_mask else None
    slam = dualslam.Slam(camera(), mask=mask, config=dualslam.load_config(overrides=[f"seed={seed}"]))
    exposures, closed = motion(seed)
    for i, (poses, grip) in enumerate(zip(exposures, closed, strict=True)):
        kept = out / f"{seed:03d}" / f"{i:04d}.png"
        image = cv2.imread(str(kept), cv2.IMREAD_GRAYSCALE) if kept.exists() else lens.image(i, poses, grip)
        if keep:
            kept.parent.mkdir(exist_ok=True)
            cv2.imwrite(str(kept), image)
        slam.track(image, i / RATE_HZ)
    slam.finish()
    found, true = slam.trajectory, exposures[:, :, :3, 3].mean(1)
    path_m = float(np.linalg.norm(np.diff(true, axis=0), axis=1).sum())
    off = np.array([np.inf])
    if len(found.index) > 3:
        off = distances_when_aligned(found.T_world_cam[:, :3, 3], true[found.index])
    coverage = len(found.index) / len(true)
    return {
        "seed": seed,
        "frames": len(true),
        "coverage": round(coverage, 3),
        "path_m": round(path_m, 2),
        "ate_m": round(float(np.sqrt((off**2).mean())), 4),
        "worst_share": round(float(off.max()) / path_m, 4),
        "verdict": slam.verdict.level,
        "submaps": len(slam.system.atlas.submaps),
        "whole": coverage >= WHOLE,
        "right": bool(off.max() <= RIGHT * path_m),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--demonstrations", type=int, default=20)
    parser.add_argument("--first", type=int, default=100, help="seed of the first")
    parser.add_argument("--no-mask", action="store_true", help="let the run find what stands still")
    parser.add_argument("--keep", action="store_true", help="write the images, and read those that are there")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    results = []
    for seed in range(args.first, args.first + args.demonstrations):
        results.append(demonstrate(seed, not args.no_mask, args.out, args.keep))
        print(json.dumps(results[-1]), flush=True)
        (args.out / "results.json").write_text(json.dumps(results, indent=1) + "\n")
    n_good = sum(bool(r["whole"] and r["right"]) for r in results)
    print(f"{n_good} of {len(results)} are whole and right")


if __name__ == "__main__":
    main()
