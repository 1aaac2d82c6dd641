"""The report as a browser prints it: Chromium."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

SAMPLE = Path(__file__).parents[2] / "recordings" / "samples" / "paper-640.mcap"
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), "")
LARGEST_BYTES, PAGES = 1_000_000, 2


@pytest.mark.skipif(not CHROMIUM, reason="no Chromium")
def test_it_is_small_and_prints_on_two_pages(tmp_path: Path) -> None:
    report, printed = tmp_path / "report.html", tmp_path / "report.pdf"
    what = ("solve", SAMPLE, "-o", tmp_path / "calibration.yaml", "--report", report)
    subprocess.run([sys.executable, "-m", "calibrate.cli", *what], check=True, capture_output=True)
    assert report.stat().st_size <= LARGEST_BYTES
    options = ("--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path / 'profile'}")
    target = f"--print-to-pdf={printed}"
    subprocess.run([CHROMIUM, *options, target, report.as_uri()], check=True, capture_output=True, timeout=60)
    assert len(re.findall(rb"/Type\s*/Page\b", printed.read_bytes())) == PAGES
