"""Write a synthetic sequence as a folder of images with times, calibration and ground truth."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from dualslam.core.errors import OutputError
from dualslam.lab.synthetic.sequence import SyntheticSequence


def render_to_folder(sequence: SyntheticSequence, out: str | Path) -> Path:
    """Render all frames of a sequence into a new folder.

    It holds ``images/NNNNNN.png``, named by frame index, without dropped frames. ``times.txt`` has seconds, one line a
    frame. ``calib.txt`` has ``fx fy cx cy width height``. ``groundtruth_tum.txt`` has ``t tx ty tz qx qy qz qw``,
    camera to world, one line a frame. ``SOURCE.md`` says how to render it again.

    Parameters
    ----------
    sequence : SyntheticSequence
    out : path
        A folder that does not exist yet, or is empty.

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    OutputError
        Where the folder is in use or cannot be written.
    """
    out = Path(out)
    try:
        if out.exists() and (not out.is_dir() or any(out.iterdir())):
            raise OutputError(f"{out} exists and is not an empty folder; name another, or replace it (--overwrite)")
        (out / "images").mkdir(parents=True, exist_ok=True)
        _write_texts(sequence, out)
    except OSError as error:
        raise OutputError(f"{out} cannot be written: {error.strerror or error}") from error
    for frame in sequence:
        path = out / "images" / f"{frame.index:06d}.png"
        if frame.image is None or not cv2.imwrite(str(path), frame.image, [cv2.IMWRITE_PNG_COMPRESSION, 3]):
            raise OutputError(f"{path} cannot be written; is the disk full?")
    return out


def _write_texts(sequence: SyntheticSequence, out: Path) -> None:
    """Write everything but the images."""
    times_s = sequence.timestamps_s[sequence.indices]
    T_world_cam = sequence.ground_truth_T_world_cam[sequence.indices]
    (out / "times.txt").write_text("".join(f"{t:.6f}\n" for t in times_s))
    K = sequence.camera.K
    numbers = (K[0, 0], K[1, 1], K[0, 2], K[1, 2], sequence.camera.width, sequence.camera.height)
    (out / "calib.txt").write_text("# fx fy cx cy width height\n" + " ".join(f"{n:.10g}" for n in numbers) + "\n")
    quat_xyzw = Rotation.from_matrix(T_world_cam[:, :3, :3]).as_quat(canonical=True)
    rows = np.column_stack([times_s, T_world_cam[:, :3, 3], quat_xyzw])
    lines = [f"{row[0]:.6f} " + " ".join(f"{value:.9f}" for value in row[1:]) + "\n" for row in rows]
    (out / "groundtruth_tum.txt").write_text("# t tx ty tz qx qy qz qw (camera to world, metres)\n" + "".join(lines))
    events = [event.model_dump(mode="json", exclude_defaults=True) for event in sequence.events]
    (out / "SOURCE.md").write_text(
        f"# {sequence.name}\n\n"
        "Rendered by `dualslam.lab.synthetic`: no photograph, no recording, no licence of others.\n\n"
        "To render it again (the same images, bit for bit, with the same versions of NumPy and OpenCV):\n\n"
        "```python\nfrom dualslam.lab.synthetic import make_sequence, render_to_folder\n\n"
        f"events = {events!r}\n"
        f"sequence = make_sequence(**{sequence.parameters!r}, events=events)\n"
        f'render_to_folder(sequence, "{out.name}")\n```\n'
    )
