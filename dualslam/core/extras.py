"""How to install an extra, for messages of what needs one."""

from __future__ import annotations

from pathlib import Path

_ROOT = Path(__file__).resolve().parents[2]


def how_to_install(extra: str) -> str:
    """Return the command that installs an extra: of this checkout, or of the installed wheel."""
    if (_ROOT / "pyproject.toml").is_file():
        return f'pip install -e "{_ROOT}[{extra}]"'
    return f'pip install "dualslam[{extra}]"'
