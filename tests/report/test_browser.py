"""The pages in a real browser: drawn, without complaints, without scrolling sideways, on a phone and on a desk."""

from __future__ import annotations

import html
import re
import shutil
import subprocess
from pathlib import Path

import cv2
import pytest

from dualslam.report import RunData, comparison_page, read_run, report_page
from tests.report.conftest import MakeRun, with_events

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
pytestmark = pytest.mark.skipif(BROWSER is None, reason="no Chromium is installed")
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--hide-scrollbars",
    "--enable-logging=stderr",
)
# A window is never narrower than 500 pixels; a frame in it can be. The page's own policy forbids scripts, this one is
# around it.
MEASURE = """<!DOCTYPE html><iframe id="page" width="{width}" height="800" style="border:0" srcdoc="{page}"></iframe>
<script>addEventListener("load", () => {{
  const page = document.getElementById("page").contentDocument.documentElement;
  document.title = `${{page.clientWidth}} ${{page.scrollWidth}}`;
}})</script>"""


def browse(page: Path, profile: Path, width: int, *flags: str) -> subprocess.CompletedProcess[str]:
    command = [str(BROWSER), *FLAGS, f"--user-data-dir={profile}", f"--window-size={width},2400", *flags, page.as_uri()]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)


@pytest.fixture(scope="module")
def pages(broken_run: RunData, make_run: MakeRun, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("pages")
    long_words = with_events(
        broken_run,
        {"event": "failed", "frame": 30, "timestamp_s": 3.0, "submap": 1, "reason": "x" * 200, "detail": "y" * 300},
    )
    runs = [broken_run, read_run(make_run(truth=False, lost=(7, 8, 9)))]
    texts = {"report": report_page(long_words), "compare": comparison_page([*runs, *runs])}
    for name, text in texts.items():
        (folder / f"{name}.html").write_text(text)
    return {name: folder / f"{name}.html" for name in texts}


@pytest.mark.parametrize("name", ["report", "compare"])
@pytest.mark.parametrize("width", [390, pytest.param(1400, marks=pytest.mark.slow)])
def test_a_page_is_drawn_and_fits_the_screen(pages: dict[str, Path], name: str, width: int, tmp_path: Path) -> None:
    shot = tmp_path / "shot.png"
    done = browse(pages[name], tmp_path / "profile", width, f"--screenshot={shot}")
    assert "CONSOLE" not in done.stderr
    image = cv2.imread(str(shot)).astype(int)
    assert image.shape[1] == width
    blue, green, red = image[..., 0], image[..., 1], image[..., 2]
    assert ((blue > red + 60) & (blue > green + 30)).sum() > 2000  # what was tracked
    assert ((red > blue + 80) & (red > green + 80)).sum() > 100  # where it was lost
    measured = tmp_path / "measured.html"
    measured.write_text(MEASURE.format(width=width, page=html.escape(pages[name].read_text())))
    dom = browse(measured, tmp_path / "profile2", 1600, "--dump-dom").stdout
    found = re.search(r"<title>(\d+) (\d+)</title>", dom)
    assert found is not None
    visible, scrolled = map(int, found.groups())
    assert visible == width
    assert scrolled <= width
