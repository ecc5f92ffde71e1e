"""Is the synthetic world like a real one to a feature detector? Prints the same numbers for recordings and renderings.

``python -m tests.lab.synthetic.realism street room /path/to/recording ...``; a recording is a folder as
`render_to_folder` writes it. Not a test: it measures and asserts nothing.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np

from dualslam.lab.synthetic import make_sequence

N_FRAMES = 300
EVERY = 12


class RecordedSequence:
    """Images and intrinsics of a folder (lens distortion is ignored)."""

    def __init__(self, folder: Path) -> None:
        self.paths = sorted((folder / "images").iterdir())[:N_FRAMES]
        rows = [line for line in (folder / "calib.txt").read_text().splitlines() if not line.startswith("#")]
        fx, fy, cx, cy = (float(x) for x in rows[0].split()[:4])
        self.K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])

    def image(self, i: int) -> np.ndarray:
        """Return a grey image."""
        return cv2.imread(str(self.paths[i]), cv2.IMREAD_GRAYSCALE)


class Rendering:
    """The same for a synthetic scene."""

    def __init__(self, scene: str, seed: int) -> None:
        self.sequence = make_sequence(scene, N_FRAMES, seed)
        self.K = self.sequence.camera.K

    def image(self, i: int) -> np.ndarray:
        """Return a grey image."""
        return self.sequence.frame(i).image


def measure(source: RecordedSequence | Rendering) -> dict[str, float]:
    """Return medians over the sequence."""
    orb = cv2.ORB_create(nfeatures=1500, scaleFactor=1.2, nlevels=8, fastThreshold=12)
    fast = cv2.FastFeatureDetector_create(20)
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING)
    out: dict[str, list[float]] = {}

    def add(name: str, value: float) -> None:
        out.setdefault(name, []).append(value)

    for i in range(0, N_FRAMES - 31, EVERY):
        first = source.image(i)
        megapixels = first.size / 1e6
        add("FAST20 /Mpx", len(fast.detect(first)) / megapixels)
        add("mean grey", float(first.mean()))
        add("contrast (std)", float(first.std()))
        add("gradient", float(np.abs(np.diff(first.astype(np.float32), axis=1)).mean()))
        noise = cv2.Laplacian(first.astype(np.float32), cv2.CV_32F)
        add("Laplacian med", float(np.median(np.abs(noise))))
        grid = np.zeros((8, 10), bool)
        kp_a, desc_a = orb.detectAndCompute(first, None)
        xy_a = np.array([k.pt for k in kp_a])
        cells = (xy_a / first.shape[::-1] * (10, 8)).astype(int)
        grid[cells[:, 1], cells[:, 0]] = True
        add("ORB cells %", 100 * grid.mean())
        for gap in (1, 3, 6):
            kp_b, desc_b = orb.detectAndCompute(source.image(i + gap), None)
            pairs = matcher.knnMatch(desc_a, desc_b, k=2)
            good = [m for m, n in pairs if m.distance < 0.8 * n.distance]
            add(f"matches {gap}", len(good))
            if len(good) < 20:
                add(f"inl% {gap}", 0.0)
                continue
            a = np.array([kp_a[m.queryIdx].pt for m in good])
            b = np.array([kp_b[m.trainIdx].pt for m in good])
            _, mask = cv2.findEssentialMat(a, b, source.K, cv2.RANSAC, 0.999, 1.0)
            add(f"inl% {gap}", 100 * float(mask.mean()))
            add(f"flow px {gap}", float(np.median(np.linalg.norm(a - b, axis=1)[mask.ravel() > 0])))
        if i % (2 * EVERY) == 0:
            alive = klt_lengths(source, i)
            add("KLT median frames", float(np.median(alive)))
            add("KLT alive@10 %", 100 * float((alive >= 10).mean()))
            add("KLT alive@30 %", 100 * float((alive >= 30).mean()))
    return {name: float(np.median(values)) for name, values in out.items()}


def klt_lengths(source: RecordedSequence | Rendering, start: int) -> np.ndarray:
    """Return for how many frames (at most 30) each of 400 corners is tracked, with a forward-backward check."""
    before = source.image(start)
    points = cv2.goodFeaturesToTrack(before, 400, 0.005, 8)
    origin = np.arange(len(points))
    alive = np.zeros(len(points))
    for step in range(1, 31):
        image = source.image(start + step)
        there, ok, _ = cv2.calcOpticalFlowPyrLK(before, image, points, None, winSize=(15, 15))
        back, ok_back, _ = cv2.calcOpticalFlowPyrLK(image, before, there, None, winSize=(15, 15))
        keep = (ok & ok_back).ravel().astype(bool) & (np.linalg.norm(back - points, axis=2).ravel() < 0.7)
        height, width = image.shape
        keep &= ((there >= 0) & (there < (width, height))).all(2).ravel()
        points, origin, before = there[keep], origin[keep], image
        alive[origin] = step
        if len(points) == 0:
            break
    return alive


if __name__ == "__main__":
    cv2.setRNGSeed(0)
    columns: dict[str, dict[str, float]] = {}
    for name in sys.argv[1:]:
        if Path(name).is_dir():
            columns[Path(name).name] = measure(RecordedSequence(Path(name)))
        else:
            scene, _, seed = name.partition(":")
            columns[name] = measure(Rendering(scene, int(seed or 0)))
    names = list(dict.fromkeys(row for column in columns.values() for row in column))
    print(f"{'':20s}" + "".join(f"{c:>14s}" for c in columns))
    for row in names:
        print(f"{row:20s}" + "".join(f"{column.get(row, float('nan')):14.1f}" for column in columns.values()))
