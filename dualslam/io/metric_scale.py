"""How long a unit of a saved map is, beside the map: ``map/scale.json``."""

from __future__ import annotations

import json
from pathlib import Path

from dualslam.core.errors import InputError
from dualslam.io.atomic import write_text
from dualslam.io.run_folder import MAP

SCALE = "scale.json"


def write_scale(run: Path, metres_per_unit: float, sigma_rel: float | None, words: str) -> None:
    """Keep the scale of a run's map.

    - `run`: run folder with a map.
    - `sigma_rel`: of it, relative.
    - `words`: what it is from.
    """
    content = {"metres_per_unit": metres_per_unit, "sigma_rel": sigma_rel, "from": words}
    write_text(run / MAP / SCALE, json.dumps(content, indent=1) + "\n")


def read_scale(run: Path) -> float | None:
    """Return the metres per unit of a run's map, or None if unknown.

    Raises `InputError` if the file is damaged.
    """
    path = run / MAP / SCALE
    if not path.is_file():
        return None
    try:
        metres = float(json.loads(path.read_text())["metres_per_unit"])
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path} is damaged; run dualslam scale again.") from error
    if not metres > 0:
        raise InputError(f"{path} says that a unit is {metres:g} m long; run dualslam scale again.")
    return metres
