"""The kornia front end's tests need torch, an extra: they are collected only where slow tests are asked for."""

from __future__ import annotations

from pathlib import Path

import pytest


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    fast = config.getoption("markexpr") == "not slow"
    return True if fast and collection_path.name.startswith("test_kornia") else None
