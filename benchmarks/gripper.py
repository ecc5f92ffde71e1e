"""Demonstrations by a hand-held gripper: a fisheye camera, 40 % of whose pixels stand still.

python benchmarks/gripper.py --out runs/gripper --demonstrations 20 [--no-mask] [--keep]

The camera moves over a laid table as in the hand of a person who picks something up and puts it down, with turns. Two
fingers and the rim of the lens stand still in the image. A demonstration is whole if 95 % of its frames have a pose in
one map. It is right if each position is within 5 % of the path's length of the truth, aligned by a similarity.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import cv2
import numpy as np
from scipy.interpolate import CubicSpline

import dualslam
from dualslam.core.camera.models import KannalaBrandtCamera
from dualslam.core.types import BoolArray, FloatArray
from dualslam.lab.disturbances.overlays import _texture
from dualslam.lab.metrics.alignment import distances_when_aligned
from dualslam.lab.synthetic.path import pose
from dualslam.lab.synthetic.render import Renderer
from dualslam.lab.synthetic.room import make_room

SIZE_PX = (480, 360)
CAMERA = KannalaBrandtCamera(*SIZE_PX, 262.0, 262.0, 239.5, 179.5, k1=0.02, k2=-0.01, k3=0.0, k4=0.0)
"""Some 105 degrees from left to right, before the rim."""
RIM_DEG = 50.0
RATE_HZ, DURATION_S = 20.0, 6.0
WHOLE, RIGHT = 0.95, 0.05
STILL = 0.40


def motion(seed: int) -> FloatArray:
    """Return the poses (N, 4, 4) of a demonstration: a smooth curve through ten points above the table."""
    rng = np.random.default_rng([seed, 0x6819])
    knots_s = np.linspace(0, DURATION_S, 10)
    low, high = (-0.45, -1.45, -1.35), (0.45, -1.10, -0.75)  # y points down: 1.10 to 1.45 m above the floor
    centres = CubicSpline(knots_s, rng.uniform(low, high, (len(knots_s), 3)))
    # Towards the table, and about.
    angles = CubicSpline(knots_s, np.radians(rng.normal((0, -28, 0), (9, 6, 6), (len(knots_s), 3))))
    times_s = np.arange(round(DURATION_S * RATE_HZ)) / RATE_HZ
    return np.stack([pose(centres(t), *angles(t)) for t in times_s])


def fingers(camera: KannalaBrandtCamera) -> BoolArray:
    """Return the pixels (H, W) that stand still: the rim of the lens and two fingers, `STILL` of the image."""
    width, height = camera.size_px
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    rays = camera.unproject(np.stack([u.ravel(), v.ravel()], 1).astype(float))
    hidden = (np.degrees(np.arccos(rays[:, 2] / np.linalg.norm(rays, axis=1))) > RIM_DEG).reshape(height, width)
    for reach in np.linspace(0.2, 1.0, 81):
        both = np.zeros((height, width), np.uint8)
        for side in (-1, 1):
            x = [0.5 + side * f for f in (0.48, 0.10 + 0.02 / reach, 0.05, 0.42)]
            y = [1.0, 1.0, 1.0 - 0.75 * reach, 1.0 - 0.9 * reach]
            cv2.fillPoly(both, [np.array([[a * width, b * height] for a, b in zip(x, y, strict=True)], np.int32)], 1)
        if (hidden | both.astype(bool)).mean() >= STILL:
            break
    return hidden | both.astype(bool)


class Lens:
    """Turns images of a wide pinhole into those of the fisheye camera."""

    def __init__(self, camera: KannalaBrandtCamera, hidden: BoolArray, seed: int) -> None:
        width, height = camera.size_px
        u, v = np.meshgrid(np.arange(width), np.arange(height))
        rays = camera.unproject(np.stack([u.ravel(), v.ravel()], 1).astype(float))
        xy = (rays[:, :2] / rays[:, 2:]).reshape(height, width, 2)
        reach = np.abs(xy[~hidden]).max(0) + 0.02
        self.size_px = tuple(int(n) for n in 2 * np.ceil(camera.fx * reach))
        self.K = np.array(
            [[camera.fx, 0, self.size_px[0] / 2 - 0.5], [0, camera.fx, self.size_px[1] / 2 - 0.5], [0, 0, 1]]
        )
        at = (xy @ np.diag([camera.fx, camera.fx]) + self.K[:2, 2]).astype(np.float32)
        self._map = np.ascontiguousarray(at[..., 0]), np.ascontiguousarray(at[..., 1])
        rng = np.random.default_rng([seed, 0xF1])
        self._hidden, self._still = hidden, _texture(camera.size_px, rng, mean=90, contrast=70, blur_px=0.6)
        self._rng = rng

    def image(self, wide: np.ndarray) -> np.ndarray:
        """Return the image (H, W) uint8 with the fingers and the sensor's noise."""
        seen = cv2.GaussianBlur(cv2.remap(wide, *self._map, cv2.INTER_LINEAR), (0, 0), 0.6)
        seen = np.where(self._hidden, self._still, seen)
        return np.clip(seen + self._rng.normal(0, 1.5, seen.shape), 0, 255).astype(np.uint8)


def demonstrate(seed: int, mask: BoolArray | None, hidden: BoolArray, keep: Path | None) -> dict[str, object]:
    """Render a demonstration, track it, and compare it with the truth."""
    T_world_cam, lens = motion(seed), Lens(CAMERA, hidden, seed)
    renderer = Renderer(make_room(seed), lens.K, *lens.size_px)
    slam = dualslam.Slam(CAMERA, mask=mask, config=dualslam.load_config(overrides=[f"seed={seed}"]))
    for i, T in enumerate(T_world_cam):
        image = lens.image(renderer.image(T))
        if keep is not None:
            keep.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(keep / f"{i:04d}.png"), image)
        slam.track(image, i / RATE_HZ)
    slam.finish()
    found, true = slam.trajectory, T_world_cam[:, :3, 3]
    path_m = float(np.linalg.norm(np.diff(true, axis=0), axis=1).sum())
    off = (
        distances_when_aligned(found.T_world_cam[:, :3, 3], true[found.index])
        if len(found.index) > 3
        else np.array([np.inf])
    )
    coverage = len(found.index) / len(true)
    return {
        "seed": seed,
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
    parser.add_argument("--first", type=int, default=0, help="seed of the first")
    parser.add_argument("--no-mask", action="store_true", help="let the run find what stands still")
    parser.add_argument("--keep", action="store_true", help="write the images, too")
    args = parser.parse_args()
    hidden = fingers(CAMERA)
    args.out.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(args.out / "mask.png"), np.where(hidden, 0, 255).astype(np.uint8))
    print(f"{100 * hidden.mean():.1f} % of the pixels stand still", flush=True)
    results = []
    for seed in range(args.first, args.first + args.demonstrations):
        keep = args.out / f"{seed:02d}" if args.keep else None
        results.append(demonstrate(seed, None if args.no_mask else hidden, hidden, keep))
        print(json.dumps(results[-1]), flush=True)
        (args.out / "results.json").write_text(json.dumps(results, indent=1) + "\n")
    n_good = sum(bool(r["whole"] and r["right"]) for r in results)
    print(f"{n_good} of {len(results)} are whole and right")


if __name__ == "__main__":
    main()
