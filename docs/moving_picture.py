"""Film the explorer for the README: the fin of the example beats while its target force changes, and
its mean force follows. Needs Chromium; run in the root folder:

    python -m docs.moving_picture docs/fin.webp
"""

import base64
import io
import sys
import tempfile
from pathlib import Path

from PIL import Image
from tests.browser import Browser

import softfin
from softfin.stages.explore import explore

EXAMPLE = Path(softfin.__file__).parent / "example"
WIDTH = 600
HEIGHT = 340
PIXEL_RATIO = 2
"""Text stays sharp on a high-resolution screen."""
TICKS_PER_FRAME = 5
"""20 frames per second."""
NUM_FRAMES = 120
"""6 s: nine beats of the gaits, so that the last frame continues in the first."""
TARGETS = ("{ x: 2, y: -1 }", "{ x: 2, y: 1 }")
"""Target forces [N], each for half the loop."""
STYLE = """
document.body.style.cssText = "padding: 0; max-width: none";
water.style.cssText = `position: fixed; inset: 0; z-index: 9; border-radius: 0; width: 100vw; height: 100vh`;
"""


def main(target: Path) -> None:
    with tempfile.TemporaryDirectory() as folder, Browser(WIDTH, HEIGHT) as browser:
        page = Path(folder) / "explore.html"
        explore(EXAMPLE / "gaits", out=page)
        browser.call(
            "Emulation.setDeviceMetricsOverride",
            width=WIDTH,
            height=HEIGHT,
            deviceScaleFactor=PIXEL_RATIO,
            mobile=False,
        )
        browser.open(page, "#paused=1&feedback=none")
        browser.run(STYLE)
        browser.frames(2)
        frames = []
        # The first loop only brings the fin into its rhythm.
        for _ in range(2):
            frames = [record_frame(browser, index) for index in range(NUM_FRAMES)]
        frames[0].save(
            target,
            save_all=True,
            append_images=frames[1:],
            duration=10 * TICKS_PER_FRAME,
            loop=0,
            quality=60,
            method=4,
        )


def record_frame(browser: Browser, index: int) -> Image.Image:
    """Advance the fin by one frame and return its picture."""
    half = NUM_FRAMES // len(TARGETS)
    if index % half == 0:
        browser.run(f"choose({TARGETS[index // half]})")
    url = browser.run(f"run({TICKS_PER_FRAME}); draw(); water.toDataURL()")
    png = base64.b64decode(url.split(",")[1])
    picture = Image.open(io.BytesIO(png)).convert("RGBA")
    water = Image.new("RGBA", picture.size, "#eff5fa")
    return Image.alpha_composite(water, picture).convert("RGB")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
