"""Animate a plant: choose its commands, simulate it, and draw it as a GIF, PNG or HTML file."""

from collections.abc import Callable
from pathlib import Path
from typing import Literal

import jax
import numpy as np
from pydantic import Field

from softfin.control.controller import Controller, controller_clock
from softfin.core.action_clock import PAPER_CLOCK
from softfin.core.configuration import Configuration
from softfin.core.errors import ConfigurationError
from softfin.core.plant import Plant, check_commands
from softfin.core.quantities import RATE_HZ, Command, Limits
from softfin.core.randomness import named_key
from softfin.data.excitation import ExcitationConfig
from softfin.evaluation import experiment
from softfin.evaluation.view.files import write_gif, write_page, write_png
from softfin.evaluation.view.footage import Footage, film
from softfin.evaluation.view.picture import Picture
from softfin.storage.figures import with_minus_signs
from softfin.task.signals import Recorded

Reference = tuple[float, float]


class StrokeGaitConfig(Configuration):
    """The simplest gait: strokes to both sides of a centre, one per action of the 3 Hz clock."""

    centre_rad: float = 0.0
    """Centre angle of the strokes [rad]; the mean force turns with it, towards -y for positive
    angles."""
    amplitude_rad: float = Field(0.5, ge=0)
    """Commanded angle to each side of the centre [rad]; the default swims forward."""
    velocity_rad_s: float | None = Field(None, gt=0)
    """Velocity of each stroke [rad/s] (default: a stroke takes two thirds of an action, within the
    plant's limits)."""


def stroke_gait(config: StrokeGaitConfig, limits: Limits, ticks: int) -> Command:
    """Return one command per tick, fields ``(ticks,)``; raises CommandError for commands outside
    the plant's limits."""
    # A stroke of 2 A in two thirds of an action: velocity = 2 A rate / (2 / 3).
    velocity = config.velocity_rad_s
    if velocity is None:
        default = 2 * config.amplitude_rad * PAPER_CLOCK.rate_hz / (2 / 3)
        velocity = min(max(default, limits.velocity_min), limits.velocity_max)
    # Rounded up, so that the actions cover all ticks.
    actions = -(-ticks // min(PAPER_CLOCK.ticks))
    sides = np.repeat(np.resize((1.0, -1.0), actions), PAPER_CLOCK.action_ticks(actions))[:ticks]
    angle = config.centre_rad + config.amplitude_rad * sides
    command = Command(angle.astype(np.float32), np.full(ticks, velocity, np.float32))
    check_commands(limits, command)
    return command


class ViewConfig(Configuration):
    """Configuration of a view: motion, duration and image format."""

    seconds: float = Field(10.0, ge=0.1, le=60)
    """Duration from rest, in plant time [s]; within 10 s, the mean over 2 s settles."""
    frames_per_second: Literal[10, 20, 25, 50] = 25
    """Frame rate of a GIF in real time [1/s]; the period must be a multiple of 10 ms, the time unit
    of GIF."""
    dots_per_inch: int = Field(100, ge=50, le=300, multiple_of=10)
    """Resolution of GIF and PNG images, which are 9.6 by 5.2 inches [1/in]."""
    seed: int = Field(0, ge=0)
    """Seed of the plant's noise and of random commands."""
    gait: StrokeGaitConfig = StrokeGaitConfig()
    """Gait of the fin, unless a controller or random commands are used."""
    random: bool = False
    """Whether to use random commands, as for datasets, instead of the gait."""
    excitation: ExcitationConfig = ExcitationConfig()
    """Configuration of the random commands."""
    next_references: tuple[Reference, ...] = ()
    """References (x, y) after the first one [N]; all get an equal share of the time."""


def record_footage(
    plant: Plant,
    config: ViewConfig,
    controller: Controller | None = None,
    reference: Reference | None = None,
) -> Footage:
    """Simulate the plant under the configured commands, or under a controller that tracks a
    reference [N].

    Raises CoverageError if the controller was not trained for one of the later references.
    """
    ticks = round(config.seconds * RATE_HZ)
    key = named_key(config.seed, "view/plant")
    limits = Limits(*plant.limits)
    if controller is not None and reference is not None:
        for following in config.next_references:
            controller.check(following)
        references = (reference, *config.next_references)
        times = tuple(config.seconds * part / len(references) for part in range(len(references)))
        # Experiments last whole seconds, so round up; the extra ticks are cut off below.
        seconds = -(-ticks // RATE_HZ)
        asked = Recorded(time_s=times, force_n=references).sample(seconds * RATE_HZ)
        recording = experiment.run(controller, plant, asked[None], seconds, key[None])
        # The recording has no shapes of the fin, so simulate again: the plant is pure and moves in
        # exactly the same way under the same commands and key.
        held: Command = jax.tree.map(lambda x: x[0, 0, :ticks], recording.command)
        return film(plant, key, held, asked[:ticks], controller_clock(controller))
    if config.next_references:
        raise ConfigurationError(
            "later references are set without a first one; set a controller and a reference"
        )
    if config.random:
        command_key = named_key(config.seed, "view/commands")
        return film(plant, key, config.excitation(command_key, ticks, limits))
    return film(plant, key, stroke_gait(config.gait, limits, ticks))


def draw(
    footage: Footage, out: Path, title: str, config: ViewConfig, report: Callable[[float], None]
) -> None:
    """Draw the footage as a .gif, a .html page or a .png of the last frame, by the suffix of
    `out`."""
    if out.suffix == ".html":
        write_page(out, footage, title)
        return
    picture = Picture(footage, title, config.dots_per_inch)
    if out.suffix == ".png":
        write_png(out, picture)
    else:
        write_gif(out, picture, config.frames_per_second, report)


def view_title(plant: str, config: ViewConfig, reference: Reference | None) -> str:
    """Return a title with the plant and the source of its motion."""
    where = "in the virtual tank" if plant == "tank" else f"in {Path(plant).name}"
    if reference is not None:
        references = [reference, *config.next_references]
        targets = ", then ".join(f"({x:.3g}, {y:.3g})" for x, y in references)
        return with_minus_signs(f"A soft fin {where}, target {targets} N")
    if config.random:
        return f"A soft fin {where}, random commands"
    return with_minus_signs(f"A soft fin {where}, beating about {config.gait.centre_rad:g} rad")
