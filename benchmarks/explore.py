"""The page of ``softfin explore`` in headless Chromium, without a GPU: its size, its first frame,
frames in real time.

The page holds the three controllers and two plants of ``softfin example``, both of which move. The
limit of frames is the display's, 60 a second.
"""

import importlib.resources
import tempfile
import time
from pathlib import Path
from typing import Any

from tests.browser import Browser

from benchmarks.measure import entry
from softfin.stages.explore import explore

SECONDS = 10
TICKS = 3000
FRAMES = """new Promise((done) => {
  let count = 0;
  const began = performance.now(), simulated = loop.time;
  requestAnimationFrame(function frame(now) {
    count++;
    if (now - began < 1000 * %d) requestAnimationFrame(frame);
    else done([1000 * count / (now - began), 10 * (loop.time - simulated) / (now - began)]);
  });
})"""


def main() -> list[dict[str, Any]]:
    example = Path(str(importlib.resources.files("softfin") / "example"))
    with tempfile.TemporaryDirectory() as folder:
        page = Path(folder) / "explore.html"
        explore(
            [example / name for name in ("single", "grid", "gaits")],
            page,
            ("tank", str(example / "surrogate")),
        )
        rows = [entry("explore.html", page.stat().st_size / 1e6, "MB", 1.5, at_least=False)]
        with Browser(1100, 700) as browser:
            start = time.perf_counter()
            browser.open(page)
            rows.append(
                entry(
                    "explore.html, until two frames are drawn",
                    time.perf_counter() - start,
                    "s",
                    1,
                    False,
                )
            )
            browser.frames(120)
            frames, pace = browser.run(FRAMES % SECONDS)
            rows.append(
                entry("explore.html, frames a second in real time", frames, "1/s", 55, pace=pace)
            )
            browser.open(page, "#paused=1")
            script = (
                "(() => { const began = performance.now(); run(%d); return performance.now() "
                "- began; })()"
            )
            spent_ms = browser.run(script % TICKS)
            rows.append(
                entry("explore.html, simulated over real time", 10 * TICKS / spent_ms, "-", 1)
            )
    return rows
