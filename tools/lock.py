"""Write requirements/dev.lock: the version of every package that a development environment holds, as pip resolves it.

Run it with `make lock`. The file holds names and versions alone, so that any index or mirror can serve it.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
HEADER = """\
# Versions of everything in the development environment: `make lock` writes this file, `make setup` installs it.
# They resolve alike on Python 3.11, 3.12 and 3.13.
"""


def main() -> None:
    """Resolve the project with its `dev` extra from nothing and pin what came out."""
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--dry-run", "--ignore-installed", "--only-binary"]
    command += [":all:", "--report", "-", f"{ROOT}[dev]", "pip"]
    report = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    pins = {}
    for item in report["install"]:
        name = re.sub(r"[-_.]+", "-", item["metadata"]["name"]).lower()
        if name != "dualslam":
            pins[name] = item["metadata"]["version"]
    lock = ROOT / "requirements" / "dev.lock"
    lock.parent.mkdir(exist_ok=True)
    lock.write_text(HEADER + "".join(f"{name}=={version}\n" for name, version in sorted(pins.items())))
    sys.stdout.write(f"{len(pins)} packages pinned in {lock.relative_to(ROOT)}\n")


if __name__ == "__main__":
    main()
