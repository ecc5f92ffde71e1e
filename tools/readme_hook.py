"""The README as a package index shows it: relative links would lead nowhere there.

Built where `GITHUB_REPOSITORY` is set (the release workflow), they lead to that repository at the version's tag; built
elsewhere, their words stay, and pictures go.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface

RELATIVE = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\((?!https?://|#)([^)\s]+)\)")


def for_index(text: str, repository: str, tag: str) -> str:
    """Return a README without relative links; `repository`: "owner/name", or empty."""

    def replace(found: re.Match[str]) -> str:
        mark, words, target = found.groups()
        if not repository:
            return "" if mark else words
        kind = "raw" if mark else "blob"
        return f"{mark}[{words}](https://github.com/{repository}/{kind}/{tag}/{target})"

    return RELATIVE.sub(replace, text)


class ReadmeHook(MetadataHookInterface):
    """What hatchling asks for the README (pyproject.toml, `tool.hatch.metadata.hooks`)."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Set the README."""
        root = Path(self.root)
        version = re.search(r'__version__ = "(.*)"', (root / "dualslam" / "__init__.py").read_text())
        assert version is not None
        text = for_index((root / "README.md").read_text(), os.environ.get("GITHUB_REPOSITORY", ""), f"v{version[1]}")
        metadata["readme"] = {"content-type": "text/markdown", "text": text}
