"""A plant made visible: what it is commanded is decided here, then filmed, then drawn as the kind of file asked for."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
from pydantic import Field, field_validator

from softfin.control.controller import Controller
from softfin.core.configuration import Configuration
from softfin.core.errors import ConfigurationError
from softfin.core.plant import Plant
from softfin.core.quantities import RATE_HZ, Command, Limits
from softfin.core.randomness import key_of
from softfin.data.excitation import ExcitationConfig, excite
from softfin.evaluation import experiment
from softfin.evaluation.view.beating import BeatConfig, beat
from softfin.evaluation.view.footage import Footage, film
from softfin.evaluation.view.page import write_page
from softfin.evaluation.view.picture import Picture
from softfin.evaluation.view.video import write_gif, write_mp4, write_png
from softfin.task.signals import Recorded

Reference = tuple[float, float]

Report = Callable[[float], None]


class ViewConfig(Configuration):
    """What is shown, and how long."""

    seconds: float = Field(10.0, ge=0.1, le=60)
    """Of the plant's time, from rest [s]; ten show the mean over 2 s settle."""
    frames_per_second: int = 25
    """Of GIF and MP4, in real time [1/s]: 10, 20, 25 or 50, each frame a reading of the plant."""
    dots_per_inch: int = Field(100, ge=50, le=300)
    """Of GIF, MP4 and PNG, which are 9.6 by 5.2 inch [1/in]; a multiple of 10."""
    seed: int = Field(0, ge=0)
    """Of the plant's noise and of random commands."""
    beat: BeatConfig = BeatConfig()
    """What the fin is commanded, unless a controller or random commands do it."""
    random: bool = False
    """Random commands, such as datasets are recorded under, in place of the beat."""
    excitation: ExcitationConfig = ExcitationConfig()
    """The random commands."""
    then: tuple[Reference, ...] = ()
    """References (x, y) [N] that a controller is asked for after its first, each for an equal part of the time."""

    @field_validator("frames_per_second")
    @classmethod
    def _whole_ticks(cls, value: int) -> int:
        if value not in (10, 20, 25, 50):
            raise ValueError("there are 10, 20, 25 and 50 frames a second: whole numbers of 10 ms apart, as GIF counts")
        return value

    @field_validator("dots_per_inch")
    @classmethod
    def _even(cls, value: int) -> int:
        if value % 10:
            raise ValueError("it must be a multiple of 10: a film's width and height are even numbers of pixels")
        return value


def footage_of(
    plant: Plant, config: ViewConfig, controller: Controller | None = None, reference: Reference | None = None
) -> Footage:
    """The plant under the configuration's commands, or under those of a controller that holds a reference [N].

    Raises CoverageError where the controller was not trained for one of those that follow.
    """
    ticks = round(config.seconds * RATE_HZ)
    key = key_of(config.seed, "view/plant")
    limits = Limits(*plant.limits)
    if controller is not None and reference is not None:
        for following in config.then:
            controller.check(following)
        seconds = -(-ticks // RATE_HZ)
        asked = _one_after_the_other((reference, *config.then), config.seconds).sample(seconds * RATE_HZ)
        recording = experiment.run(controller, plant, asked[None], seconds, key[None])
        # The plant is pure: under the same commands and key it moves again as it did for the controller.
        held: Command = jax.tree.map(lambda x: x[0, 0, :ticks], recording.command)
        return film(plant, key, held, asked[:ticks])
    if config.then:
        raise ConfigurationError("references one after the other, and no first one; give a controller and a reference")
    commands = (
        excite(key_of(config.seed, "view/commands"), ticks, limits, config.excitation)
        if config.random
        else beat(config.beat, limits, ticks)
    )
    return film(plant, key, commands)


def _one_after_the_other(references: tuple[Reference, ...], seconds: float) -> Recorded:
    parts = len(references)
    return Recorded(time_s=tuple(seconds * part / parts for part in range(parts)), force_n=references)


def draw(footage: Footage, out: Path, title: str, config: ViewConfig, report: Report) -> None:
    """Draw the footage as what the name asks for: .gif, .mp4, .html, or its last frame as .png."""
    if out.suffix == ".html":
        write_page(out, footage, title)
        return
    picture = Picture(footage, title, config.dots_per_inch)
    writers: dict[str, Callable[[], Any]] = {
        ".gif": lambda: write_gif(out, picture, config.frames_per_second, report),
        ".mp4": lambda: write_mp4(out, picture, config.frames_per_second, report),
        ".png": lambda: write_png(out, picture),
    }
    writers[out.suffix]()


def title_of(plant: str, config: ViewConfig, reference: Reference | None) -> str:
    """In words: which fin, and what moves it."""
    where = "in the virtual tank" if plant == "tank" else f"in {Path(plant).name}"
    if reference is not None:
        asked = ", then ".join(f"({x:.3g}, {y:.3g})" for x, y in (reference, *config.then))
        return f"A soft fin {where}, asked for {asked} N".replace("-", "\N{MINUS SIGN}")
    if config.random:
        return f"A soft fin {where}, random commands"
    return f"A soft fin {where}, beating about {config.beat.centre_rad:g} rad".replace("-", "\N{MINUS SIGN}")
