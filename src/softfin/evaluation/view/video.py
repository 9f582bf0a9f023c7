"""A picture as a file: GIF through Pillow, MP4 through ffmpeg, one frame as PNG."""

import contextlib
import io
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import PIL.Image

from softfin.core.errors import RunError
from softfin.core.quantities import RATE_HZ
from softfin.evaluation.view.picture import Image, Picture
from softfin.storage import artifact as artifacts
from softfin.storage.paths import find_ffmpeg

Report = Callable[[float], None]
"""Called with the part that is done (0 .. 1)."""

COLOURS = 200
"""Colours of a GIF or PNG: enough for the blends of a few plain ones; one of a GIF's 256 is left for what stays."""

SAMPLES = 8
"""Frames from which a GIF's colours are taken."""


def ticks_of(ticks: int, frames_per_second: int) -> range:
    """Return the ticks that are shown, in real time, the last one among them."""
    step = RATE_HZ // frames_per_second
    return range((ticks - 1) % step, ticks, step)


def write_gif(path: Path, picture: Picture, frames_per_second: int, report: Report) -> None:
    """Write all frames, in a loop; all of them in the same colours, so that what stays costs no bytes."""
    ticks = ticks_of(len(picture.footage.shape), frames_per_second)
    samples = [picture.frame(ticks[i]) for i in np.linspace(0, len(ticks) - 1, SAMPLES).astype(int)]
    palette = _palette(np.concatenate(samples))

    def frames() -> Iterator[PIL.Image.Image]:
        for image in _frames(picture, ticks, report):
            yield PIL.Image.fromarray(image).quantize(palette=palette, dither=PIL.Image.Dither.NONE)

    rest = frames()
    buffer = io.BytesIO()
    # Browsers slow down a GIF whose frames take less than 2 hundredths of a second.
    next(rest).save(
        buffer, "GIF", save_all=True, append_images=rest, duration=1000 // frames_per_second, loop=0, optimize=True,
        palette=palette.getpalette(),
    )  # fmt: skip
    artifacts.write_file(path, buffer.getvalue())


def write_png(path: Path, picture: Picture) -> None:
    """Write the last frame."""
    image = picture.frame(len(picture.footage.shape) - 1)
    buffer = io.BytesIO()
    few = PIL.Image.fromarray(image).quantize(palette=_palette(image), dither=PIL.Image.Dither.NONE)
    few.save(buffer, "PNG", optimize=True)
    artifacts.write_file(path, buffer.getvalue())


def write_mp4(path: Path, picture: Picture, frames_per_second: int, report: Report) -> None:
    """Write all frames, through a pipe into ffmpeg, in the format that every browser plays."""
    ticks = ticks_of(len(picture.footage.shape), frames_per_second)
    height, width = picture.frame(0).shape[:2]
    beside = path.with_name(f".{path.stem}.partial.mp4")
    command = [
        find_ffmpeg(path), "-loglevel", "error", "-y",
        "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}",
        "-r", str(frames_per_second), "-i", "-", "-an", "-pix_fmt", "yuv420p", "-movflags", "+faststart", str(beside),
    ]  # fmt: skip
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as ffmpeg:
            assert ffmpeg.stdin is not None
            # Where it stops reading, it says why.
            with contextlib.suppress(BrokenPipeError):
                for image in _frames(picture, ticks, report):
                    ffmpeg.stdin.write(image.tobytes())
            complaint = " ".join(ffmpeg.communicate()[1].decode(errors="replace").split())
        if ffmpeg.returncode:
            raise RunError(f"{path}: ffmpeg failed ({complaint[:300]}); write a .gif or .html instead")
        beside.replace(path)
    except OSError as error:
        raise RunError(f"{path}: cannot be written ({error.strerror or error})") from None
    finally:
        beside.unlink(missing_ok=True)


def _frames(picture: Picture, ticks: range, report: Report) -> Iterator[Image]:
    for count, tick in enumerate(ticks, start=1):
        yield picture.frame(tick)
        report(count / len(ticks))


def _palette(image: Image) -> PIL.Image.Image:
    """Return few colours for an image, with those that most of it has just as they are: white stays white."""
    few = PIL.Image.fromarray(image).quantize(COLOURS, PIL.Image.Quantize.MEDIANCUT)
    colours = np.array(few.getpalette()).reshape(-1, 3)
    every, counts = np.unique(image.reshape(-1, 3), axis=0, return_counts=True)
    for colour in every[np.argsort(counts)[-12:]].astype(int):
        distance = np.abs(colours - colour).sum(axis=1)
        # All neighbours too: Pillow takes one near by for the nearest.
        colours[distance <= max(distance.min(), 12)] = colour
    few.putpalette(colours.ravel().tolist())
    return few
