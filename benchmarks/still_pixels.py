"""What is found to stand still in the image: under overlays of known shape, and where nothing does.

    python benchmarks/still_pixels.py --data DIR kitti_03 7scenes_1000
    python benchmarks/still_pixels.py synthetic:standstill,frames=300,seed=3,width=320,height=240

Prints one line a sequence and overlay: seconds until something was found; after `--seconds` the overlap (intersection
over union) with the true mask, and the share of the image that is hidden falsely. The line `none` has no overlay: it
says which share of the image was ever hidden over the whole sequence, and for how many frames a start of a map would
have waited. No map is made: frames are only looked at.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from dualslam.core.config.corruption import Corruption
from dualslam.core.interfaces import Sequence
from dualslam.frontends.features.images import to_grey
from dualslam.frontends.still_pixels import StillPixels
from dualslam.lab.disturbances import corrupted, hidden_by
from dualslam.run.sources import open_source

OVERLAYS = {
    "cab 28 %": ("cab", 0.28),
    "cab 48 %": ("cab", 0.48),
    "bonnet": ("bonnet", None),
    "bars": ("bars", None),
    "logo": ("logo", None),
    "clock": ("clock", None),
}


def main() -> None:
    """Look at the sequences that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sources", nargs="+")
    parser.add_argument("--data", type=Path, default=Path())
    parser.add_argument("--seconds", type=float, default=3.0)
    args = parser.parse_args()
    for name in args.sources:
        source = name if ":" in name else str(args.data / name)
        for overlay, (kind, strength) in OVERLAYS.items():
            corruption = Corruption.model_validate({"kind": kind, "strength": strength})
            print(name, overlay, under_overlay(open_source(source), corruption, args.seconds), flush=True)
        print(name, "none", without(open_source(source)), flush=True)


def under_overlay(sequence: Sequence, overlay: Corruption, seconds: float) -> str:
    """Say how soon, and how well, an overlay is found."""
    still, true = StillPixels(sequence.camera.size_px), hidden_by([overlay], sequence.camera.size_px)
    first_s = found_s = None
    for frame in corrupted(sequence, [overlay]):
        if frame.image is None:
            continue
        first_s = frame.timestamp_s if first_s is None else first_s
        still.look(frame.timestamp_s, to_grey(frame.image))
        if still.hidden is not None and found_s is None:
            found_s = frame.timestamp_s - first_s
        if frame.timestamp_s - first_s >= seconds:
            break
    hidden = np.zeros_like(true) if still.hidden is None else still.hidden
    overlap = (hidden & true).sum() / (hidden | true).sum()
    when = "not found" if found_s is None else f"found after {found_s:.2f} s"
    return f"{when}, overlap {overlap:.2f}, falsely hidden {100 * (hidden & ~true).mean():.2f} %"


def without(sequence: Sequence) -> str:
    """Say what is found where nothing stands still."""
    still, largest, n_suspicious, n = StillPixels(sequence.camera.size_px), 0.0, 0, 0
    for frame in sequence:
        if frame.image is None:
            continue
        still.look(frame.timestamp_s, to_grey(frame.image))
        n += 1
        n_suspicious += still.is_suspicious
        largest = max(largest, 0.0 if still.hidden is None else float(still.hidden.mean()))
    return f"falsely hidden {100 * largest:.2f} % at most, {n_suspicious} of {n} frames would wait"


if __name__ == "__main__":
    main()
