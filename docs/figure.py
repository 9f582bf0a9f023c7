"""Make a run's figure small enough for the README: ``python docs/figure.py RUN/.../experiments.png
docs/NAME.png``."""

import sys

from PIL import Image

WIDTH = 1200
COLOURS = 128

source, target = sys.argv[1:]
image = Image.open(source).convert("RGB")
image = image.resize((WIDTH, round(image.height * WIDTH / image.width)), Image.Resampling.LANCZOS)
image.quantize(COLOURS).save(target, optimize=True)
