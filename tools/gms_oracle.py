"""Ask OpenCV contrib's `matchGMS` about many pairs, for `tests/frontends/features/test_gms.py`, and compare it with
ours.

    pip install --no-deps --target DIR opencv-contrib-python-headless
    python tools/gms_oracle.py DIR                      write tests/frontends/features/gms_oracle.npz anew
    python tools/gms_oracle.py DIR --images FOLDER ...  compare on real pairs, of which nothing is kept

The contrib wheel and the one that this project depends on are both called cv2, so that contrib is never installed: it
lies in a folder of its own, which only a second process imports from. Both times are of one thread and of the matcher
alone; contrib's is taken inside that process, from its own types to its own types.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

ROOT = Path(__file__).resolve().parent.parent
FIXTURE = ROOT / "tests" / "frontends" / "gms_oracle.npz"
SETTINGS = ((False, False), (True, False), (False, True), (True, True))
"""Rotation and zoom."""
STEP_PX = 1 / 16
"""Pixels are rounded to that, to be stored in two bytes; it also puts some on the very edge of a cell."""


@dataclass(frozen=True)
class Pair:
    """Matched pixels (M, 2), (M, 2) and the size of both images."""

    uv_a: NDArray[np.float64]
    uv_b: NDArray[np.float64]
    size_px: tuple[int, int]


def main() -> None:
    """Collect pairs, ask contrib, compare, and write the fixture where the pairs are not real ones."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("contrib", type=Path, metavar="DIR")
    parser.add_argument("--images", type=Path, nargs="+", default=[], metavar="FOLDER")
    parser.add_argument("--pairs", type=int, default=16, help="of each folder")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    pairs = [pair for folder in args.images for pair in real_pairs(folder, args.pairs)]
    pairs = pairs or [*made_up_pairs(40), *rendered_pairs(12)]
    masks, contrib_ms, version = ask_contrib(pairs, args.contrib)
    compare(pairs, masks, contrib_ms, version)
    if not args.images:
        store(pairs, masks, version)


def made_up_pairs(n: int) -> list[Pair]:
    """A turn, a zoom and a shear of random points, and random matches between."""
    pairs = []
    for seed in range(n):
        rng = np.random.default_rng([seed, 20])
        size = rng.integers(200, 1300, 2)
        uv_a = rng.uniform(0, 1, (int(rng.integers(60, 700)), 2)) * (size - 1)
        turn, zoom = rng.uniform(-np.pi, np.pi) if seed % 2 else 0.0, rng.choice([0.5, 0.7, 1.0, 1.0, 1.4, 2.0])
        A = zoom * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        A += rng.normal(0, 0.05, (2, 2))
        uv_b = (uv_a - size / 2) @ A.T + size / 2 + rng.normal(0, 2, uv_a.shape)
        wrong = rng.random(len(uv_a)) < rng.uniform(0.1, 0.8)
        uv_b[wrong] = rng.uniform(0, 1, (int(wrong.sum()), 2)) * (size - 1)
        inside = ((uv_b >= 0) & (uv_b <= size - 1)).all(axis=1)
        pairs.append(Pair(rounded(uv_a[inside]), rounded(uv_b[inside]), (int(size[0]), int(size[1]))))
    return pairs


def rendered_pairs(n: int) -> list[Pair]:
    """Nearest ORB descriptors of rendered frames, in the street and in the room, the second image also turned."""
    from dualslam.lab.synthetic import make_sequence

    pairs = []
    for scene in ("street", "room"):
        sequence = make_sequence(scene, n_frames=40 + 2 * n, seed=3, width=480, height=360)
        for i in range(n):
            first = sequence.frame(3 * i).image
            second = sequence.frame(3 * i + 1 + i % 7).image
            assert first is not None
            assert second is not None
            pairs.append(nearest_pair(first, np.ascontiguousarray(np.rot90(second, 2)) if i % 3 == 2 else second, 600))
    return pairs


def real_pairs(folder: Path, n: int) -> list[Pair]:
    """Nearest ORB descriptors of images of a folder that are 1 to 8 apart."""
    files = sorted(folder.iterdir())
    first = np.linspace(0, len(files) - 9, n).astype(int).tolist()
    read = [(cv2.imread(str(files[i]), 0), cv2.imread(str(files[i + 1 + k % 8]), 0)) for k, i in enumerate(first)]
    return [nearest_pair(np.asarray(a), np.asarray(b), 2000) for a, b in read]


def nearest_pair(a: NDArray[np.uint8], b: NDArray[np.uint8], n_features: int) -> Pair:
    """Return the pair of two images: for each feature of a the nearest of b."""
    from dualslam.frontends.features.orb import OrbFrontend

    frontend = OrbFrontend(n_features)
    features_a, features_b = frontend.extract(a), frontend.extract(b)
    uv_b = features_b.uv_px[frontend.nearest(features_a, features_b)]
    return Pair(rounded(features_a.uv_px), rounded(uv_b), (a.shape[1], a.shape[0]))


def rounded(uv_px: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return pixels as multiples of STEP_PX."""
    return np.asarray(np.rint(uv_px / STEP_PX) * STEP_PX)


def ask_contrib(pairs: list[Pair], contrib: Path) -> tuple[list[list[NDArray[np.bool_]]], NDArray[np.float64], str]:
    """Masks of contrib for each pair and each of SETTINGS, its milliseconds (P, 4), and its version."""
    with tempfile.TemporaryDirectory() as scratch:
        asked, answered = Path(scratch) / "asked.npz", Path(scratch) / "answered.npz"
        np.savez(asked, **packed(pairs))
        environment = {**os.environ, "PYTHONPATH": str(contrib)}
        subprocess.run([sys.executable, "-c", ANSWER, str(asked), str(answered)], check=True, env=environment)
        with np.load(answered) as answer:
            per_setting = np.split(answer["masks"], np.cumsum([len(pair.uv_a) for pair in pairs])[:-1], axis=1)
            return [list(masks) for masks in per_setting], answer["ms"], str(answer["version"])


ANSWER = """
import sys, time
import numpy as np, cv2
cv2.setNumThreads(1)
asked = np.load(sys.argv[1])
masks, ms, begin = [], [], 0
for n, size in zip(asked["n"].tolist(), asked["size_px"].tolist()):
    rows = slice(begin, begin + n)
    begin += n
    a, b = [[cv2.KeyPoint(u / 16, v / 16, 1.0) for u, v in asked[k][rows].tolist()] for k in ("uv_a", "uv_b")]
    matches = [cv2.DMatch(i, i, 0.0) for i in range(n)]
    mask, took = np.zeros((4, n), bool), []
    for s, (rotation, zoom) in enumerate(((0, 0), (1, 0), (0, 1), (1, 1))):
        start = time.process_time()
        kept = cv2.xfeatures2d.matchGMS(size, size, a, b, matches, bool(rotation), bool(zoom), 6.0)
        took.append(1e3 * (time.process_time() - start))
        mask[s, [match.queryIdx for match in kept]] = True
    masks.append(mask)
    ms.append(took)
np.savez(sys.argv[2], masks=np.concatenate(masks, axis=1), ms=ms, version=cv2.__version__)
"""


def packed(pairs: list[Pair]) -> dict[str, NDArray[np.generic]]:
    """Return the pairs as arrays, one behind the other."""
    return {
        "n": np.array([len(pair.uv_a) for pair in pairs], np.int64),
        "size_px": np.array([pair.size_px for pair in pairs], np.int64),
        "uv_a": np.concatenate([np.rint(pair.uv_a / STEP_PX) for pair in pairs]).astype(np.uint16),
        "uv_b": np.concatenate([np.rint(pair.uv_b / STEP_PX) for pair in pairs]).astype(np.uint16),
    }


def compare(
    pairs: list[Pair], masks: list[list[NDArray[np.bool_]]], contrib_ms: NDArray[np.float64], version: str
) -> None:
    """Print how many pairs give the same matches, and both times."""
    from dualslam.frontends.features.motion_statistics import supported_matches

    n = np.array([len(pair.uv_a) for pair in pairs])
    print(f"{len(pairs)} pairs, {n.min()} to {n.max()} matches (median {np.median(n):.0f}); contrib {version}")
    for s, (rotation, zoom) in enumerate(SETTINGS):
        same, ours_ms = 0, []
        for pair, mask in zip(pairs, masks, strict=True):
            start = time.process_time()
            ours = supported_matches(pair.uv_a, pair.uv_b, pair.size_px, pair.size_px, rotation=rotation, zoom=zoom)
            ours_ms.append(1e3 * (time.process_time() - start))
            same += np.array_equal(ours, mask[s])
        kept = sum(int(mask[s].sum()) for mask in masks) / n.sum()
        print(
            f"rotation {rotation!s:5} zoom {zoom!s:5}: {same} of {len(pairs)} identical, {kept:.0%} of the matches "
            f"kept, contrib {np.median(contrib_ms[:, s]):.1f} ms, ours {np.median(ours_ms):.1f} ms a pair (median, CPU)"
        )


def store(pairs: list[Pair], masks: list[list[NDArray[np.bool_]]], version: str) -> None:
    """Write the fixture."""
    joined = np.concatenate([np.stack(mask) for mask in masks], axis=1)
    np.savez_compressed(FIXTURE, **packed(pairs), masks=np.packbits(joined, axis=1), version=np.array(version))
    print(f"{FIXTURE.relative_to(ROOT)}: {FIXTURE.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
