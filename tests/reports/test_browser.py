"""The page in a real browser; skipped where there is none, unless it is required."""

import os
import shutil
import subprocess
from pathlib import Path

import cv2
import pytest
from patience import PATIENCE

from neurosim.reports import write_report

REFERENCE = Path(__file__).resolve().parents[2] / "data" / "reference"
NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")


@pytest.fixture
def browser() -> str:
    result = next((path for name in NAMES if (path := shutil.which(name))), None)
    if result is None:
        if os.environ.get("NEUROSIM_BROWSER_REQUIRED"):
            pytest.fail("a browser is required here, and there is none")
        pytest.skip("no Chromium on this computer")
    return result


def run(browser: str, folder: Path, *words: str) -> subprocess.CompletedProcess:
    return subprocess.run(
        [
            browser,
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--no-first-run",
            "--disable-background-networking",
            "--disable-component-update",
            "--disable-sync",
            f"--user-data-dir={folder / 'profile'}",
            *words,
        ],
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=True,
    )


def test_a_browser_shows_the_report(browser, tmp_path):
    page = tmp_path / "report.html"
    write_report([REFERENCE], page)
    shown = run(browser, tmp_path, "--dump-dom", page.as_uri()).stdout
    assert "5,010" in shown or "5010" in shown
    assert shown.count("<svg") >= 3
    picture = tmp_path / "page.png"
    run(browser, tmp_path, "--window-size=1000,1400", f"--screenshot={picture}", page.as_uri())
    pixels = cv2.imread(str(picture))
    assert pixels.shape[:2] == (1400, 1000)
    assert pixels.std() > 5  # something is drawn
