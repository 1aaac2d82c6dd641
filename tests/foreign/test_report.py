"""The report in a browser, Chromium: on paper, on a phone, and whether its text can be read."""

from __future__ import annotations

import html
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

SAMPLE = Path(__file__).parents[2] / "recordings" / "samples" / "paper-640.mcap"
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), "")
LARGEST_BYTES, PAGES, PHONE_PX, AA = 1_000_000, 1, 500, 4.5
"""AA: contrast of text by WCAG 2.2, 1.4.3. Chromium's windows are at least 500 px wide."""
MEASURE = """<script>
const linear = v => (v /= 255) <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4;
const numbers = text => text.match(/[0-9.]+/g).map(Number);
const light = ([r, g, b]) => 0.2126 * linear(r) + 0.7152 * linear(g) + 0.0722 * linear(b);
function behind(element) {
  for (; element; element = element.parentElement) {
    const colour = numbers(getComputedStyle(element).backgroundColor);
    if (colour.length < 4 || colour[3] > 0) return colour;
  }
  return [255, 255, 255];
}
document.querySelectorAll("details").forEach(part => part.open = true);
const told = {wide: document.documentElement.scrollWidth, contrast: {}};
told.paper = light(behind(document.body));
const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
while (walker.nextNode()) {
  const text = walker.currentNode, parent = text.parentElement, style = getComputedStyle(parent);
  if (!text.textContent.trim() || ["SCRIPT", "STYLE"].includes(parent.tagName)) continue;
  const ink = parent instanceof SVGElement ? style.fill : style.color;
  const [low, high] = [light(numbers(ink)), light(behind(parent))].sort((a, b) => a - b);
  told.contrast[text.textContent.trim()] = (high + 0.05) / (low + 0.05);
}
const shown = {id: "told", textContent: JSON.stringify(told)};
document.body.append(Object.assign(document.createElement("pre"), shown));
</script>"""

pytestmark = pytest.mark.skipif(not CHROMIUM, reason="no Chromium")


@pytest.fixture(scope="module", params=["passed", "failed"])
def report(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("report")
    (folder / "gates.yaml").write_text("views: 100\n")
    limits = ("--gates", folder / "gates.yaml") if request.param == "failed" else ()
    what = ("solve", SAMPLE, *limits, "-o", folder / "calibration.yaml", "--report", folder / "report.html")
    done = subprocess.run([sys.executable, "-m", "calibrate.cli", *what], capture_output=True, check=False)
    assert done.returncode == (4 if limits else 0)
    return folder / "report.html"


def chromium(page: Path, *options: str) -> str:
    always = ("--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={page.parent / 'profile'}")
    command = [CHROMIUM, *always, *options, page.as_uri()]
    return subprocess.run(command, check=True, capture_output=True, timeout=60, text=True).stdout


def test_it_is_small_and_prints_on_one_page(report: Path) -> None:
    assert report.stat().st_size <= LARGEST_BYTES
    printed = report.with_suffix(".pdf")
    chromium(report, f"--print-to-pdf={printed}")
    assert len(re.findall(rb"/Type\s*/Page\b", printed.read_bytes())) == PAGES


DARK = "--blink-settings=preferredColorScheme=0"
"""Tells pages that the person prefers a dark screen."""


@pytest.mark.parametrize("scheme", [(), (DARK,)])
def test_all_text_has_the_contrast_that_eyes_need_and_none_is_beside_a_phones_screen(
    report: Path, scheme: tuple[str, ...]
) -> None:
    measured = report.with_name("measured.html")
    measured.write_text(report.read_text().replace("</body>", f"{MEASURE}</body>"))
    shown = chromium(measured, f"--window-size={PHONE_PX},900", "--dump-dom", *scheme)
    found = re.search(r'id="told">(.*?)</pre>', shown, re.DOTALL)
    assert found
    told: dict[str, Any] = json.loads(html.unescape(found[1]))
    assert len(told["contrast"]) > 50
    assert {text: ratio for text, ratio in told["contrast"].items() if ratio < AA} == {}
    assert told["wide"] <= PHONE_PX
    assert (told["paper"] < 0.1) == bool(scheme)
