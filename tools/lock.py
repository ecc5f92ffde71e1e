"""Write requirements/*.lock: the version of every package of the development environment, as pip resolves it.

core.lock is what `make demo` installs, dev.lock what `make setup` adds;
kornia.lock is what `make test-all` adds for the front end of that name, apart
because it is as large as all the rest. Run it with `make lock`. The files hold names and versions alone, so that any
index or mirror can serve them.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
HEADER = """\
# {what}: `make lock` writes this file, `make {target}` installs it.
# They resolve alike on Python 3.11, 3.12 and 3.13.
"""
TORCH = "torch==2.13.0"
"""Chosen here and not left to the index: indexes of CPU builds and of CUDA builds do not offer the same versions."""
BUILD = ("hatchling", "editables")
"""What an editable install needs."""
CUDA = ("cuda-", "nvidia-", "triton")
"""What torch's CUDA build brings along. A pin without the build's mark (``+cpu``) is met by any build, so that one lock
serves them all; what the one at hand needs beyond it, pip finds by itself."""


def main() -> None:
    """Resolve the project with its `dev` extra, and with `kornia` too, from nothing, and pin what came out."""
    dev = resolve(f"{ROOT}[dev]", "pip")
    kornia = resolve(f"{ROOT}[dev,kornia]", "pip", TORCH, *(f"{name}=={version}" for name, version in dev.items()))
    core = resolve(str(ROOT), "pip", *BUILD, *(f"{name}=={dev[name]}" for name in BUILD))
    needed = {name: dev[name] for name in core if name in dev}
    write("core.lock", "Versions of what running needs, and of what builds the package", "demo", needed)
    write("dev.lock", "Versions of everything in the development environment", "setup", dev)
    extra = {name: version for name, version in kornia.items() if name not in dev}
    write("kornia.lock", "Versions of what the kornia front end and its tests need besides", "test-all", extra)


def resolve(*requirements: str) -> dict[str, str]:
    """Return name to version of all that pip would install into an empty environment."""
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--dry-run", "--ignore-installed", "--only-binary"]
    command += [":all:", "--report", "-", *requirements]
    report = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    pins = {}
    for item in report["install"]:
        name = re.sub(r"[-_.]+", "-", item["metadata"]["name"]).lower()
        if name != "dualslam" and not name.startswith(CUDA):
            pins[name] = item["metadata"]["version"].partition("+")[0]
    return pins


def write(file: str, what: str, target: str, pins: dict[str, str]) -> None:
    """Write a lock."""
    lock = ROOT / "requirements" / file
    lock.parent.mkdir(exist_ok=True)
    rows = "".join(f"{name}=={version}\n" for name, version in sorted(pins.items()))
    lock.write_text(HEADER.format(what=what, target=target) + rows)
    sys.stdout.write(f"{len(pins)} packages pinned in {lock.relative_to(ROOT)}\n")


if __name__ == "__main__":
    main()
