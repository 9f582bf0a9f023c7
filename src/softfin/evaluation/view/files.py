"""A footage as a file: GIF and PNG through Pillow, MP4 through ffmpeg, or an HTML page that plays it by itself."""

import contextlib
import importlib.resources
import io
import json
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
import PIL.Image
from markupsafe import Markup

from softfin.core.action_clock import WINDOW
from softfin.core.canvas import with_canvas
from softfin.core.errors import RunError
from softfin.core.quantities import AXES, RATE_HZ
from softfin.evaluation.view.footage import Footage, scale_of
from softfin.evaluation.view.picture import TRAIL_TICKS, Image, Picture
from softfin.storage import artifact as artifacts
from softfin.storage.paths import find_ffmpeg

Report = Callable[[float], None]
"""Called with the part that is done (0 .. 1)."""

SHAPE_UNIT_M = 1e-4
"""Unit of a page's shapes, which are whole numbers: a fifth of a pixel, in few bytes."""


def ticks_of(ticks: int, frames_per_second: int) -> range:
    """Return the ticks that are shown, in real time, the last one among them."""
    step = RATE_HZ // frames_per_second
    return range((ticks - 1) % step, ticks, step)


def write_gif(path: Path, picture: Picture, frames_per_second: int, report: Report) -> None:
    """Write all frames, in a loop; all of them in the same colours, so that what stays costs no bytes."""
    ticks = ticks_of(len(picture.footage.shape), frames_per_second)
    palette = _palette(picture.frame(-1))
    frames = (_in_colours(image, palette) for image in _frames(picture, ticks, report))
    buffer = io.BytesIO()
    # Browsers slow down a GIF whose frames take less than 2 hundredths of a second.
    next(frames).save(
        buffer, "GIF", save_all=True, append_images=frames, duration=1000 // frames_per_second, loop=0, optimize=True,
        palette=palette.getpalette(),
    )  # fmt: skip
    artifacts.write_file(path, buffer.getvalue())


def write_png(path: Path, picture: Picture) -> None:
    """Write the last frame."""
    image, buffer = picture.frame(-1), io.BytesIO()
    _in_colours(image, _palette(image)).save(buffer, "PNG", optimize=True)
    artifacts.write_file(path, buffer.getvalue())


def write_mp4(path: Path, picture: Picture, frames_per_second: int, report: Report) -> None:
    """Write all frames, through a pipe into ffmpeg, in the format that every browser plays."""
    ticks = ticks_of(len(picture.footage.shape), frames_per_second)
    height, width = picture.frame(0).shape[:2]
    with tempfile.TemporaryDirectory() as folder:
        film = Path(folder) / "film.mp4"
        command = [
            find_ffmpeg(path), "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}",
            "-r", str(frames_per_second), "-i", "-", "-an", "-pix_fmt", "yuv420p", "-movflags", "+faststart", str(film),
        ]  # fmt: skip
        with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as ffmpeg:
            assert ffmpeg.stdin is not None
            # Where it stops reading, it says why.
            with contextlib.suppress(BrokenPipeError):
                for image in _frames(picture, ticks, report):
                    ffmpeg.stdin.write(image.tobytes())
            complaint = " ".join(ffmpeg.communicate()[1].decode(errors="replace").split())
        if ffmpeg.returncode:
            raise RunError(f"{path}: ffmpeg failed ({complaint[:300]}); write a .gif or .html instead")
        artifacts.write_file(path, film.read_bytes())


def _frames(picture: Picture, ticks: range, report: Report) -> Iterator[Image]:
    for count, tick in enumerate(ticks, start=1):
        yield picture.frame(tick)
        report(count / len(ticks))


def _in_colours(image: Image, palette: PIL.Image.Image) -> PIL.Image.Image:
    return PIL.Image.fromarray(image).quantize(palette=palette, dither=PIL.Image.Dither.NONE)


def _palette(image: Image) -> PIL.Image.Image:
    """Return few colours for an image, with those that most of it has just as they are: white stays white."""
    # Enough for the blends of a few plain colours; one of a GIF's 256 is left for what stays.
    few = PIL.Image.fromarray(image).quantize(200, PIL.Image.Quantize.MEDIANCUT)
    colours = np.array(few.getpalette()).reshape(-1, 3)
    every, counts = np.unique(image.reshape(-1, 3), axis=0, return_counts=True)
    for colour in every[np.argsort(counts)[-12:]].astype(int):
        distance = np.abs(colours - colour).sum(axis=1)
        # All neighbours too: Pillow takes one near by for the nearest.
        colours[distance <= max(distance.min(), 12)] = colour
    few.putpalette(colours.ravel().tolist())
    return few


def write_page(path: Path, footage: Footage, title: str) -> None:
    """Write the page: canvas and plain JavaScript, nothing fetched."""
    template, script = (
        importlib.resources.files("softfin.evaluation.view").joinpath(name).read_text("utf-8")
        for name in ("page.html.jinja", "page.js")
    )
    page = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined).from_string(template).render(
        title=title,
        shape_known=footage.shape_known,
        asked=footage.reference is not None,
        force_known=footage.true_force is not None,
        footage=Markup(json.dumps(to_dict(footage), separators=(",", ":"), allow_nan=False)),
        script=Markup(with_canvas(script)),
    )  # fmt: skip
    artifacts.write_file(path, page)


def to_dict(footage: Footage) -> dict[str, Any]:
    """Return the data that the page draws, as plain numbers."""
    series = {"command": (footage.command.angle, 4), "angle": (footage.reading.angle, 4)}
    for i, axis in enumerate(AXES):
        vectors = {"force": footage.force, "mean": footage.average, "reference": footage.reference}
        series |= {f"{name}_{axis}": (part[:, i], 3) for name, part in vectors.items() if part is not None}
    series["thickness"] = (footage.thickness, 5)
    ticks, points = footage.shape.shape[:2]
    return {
        "rate_hz": RATE_HZ,
        "ticks": ticks,
        "force_known": footage.true_force is not None,
        "points": points,
        "window": WINDOW,
        "trail": TRAIL_TICKS,
        "scale": scale_of(footage)._asdict(),
        **{name: [round(float(value), digits) for value in values] for name, (values, digits) in series.items()},
        "shape_unit_m": SHAPE_UNIT_M,
        "shape": np.rint(footage.shape / SHAPE_UNIT_M).astype(int).ravel().tolist(),
    }
