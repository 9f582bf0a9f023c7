"""Animates a plant: chooses its commands, simulates it, and draws it as the requested kind of
file."""

from collections.abc import Callable
from pathlib import Path
from typing import Literal

import jax
import numpy as np
from pydantic import Field

from softfin.control.controller import Controller
from softfin.core.action_clock import ACTION_RATE_HZ, ACTION_TICKS, action_ticks
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
    """Angle about which the fin strokes [rad]; the mean force turns with it, a positive one towards
    -y."""
    amplitude_rad: float = Field(0.5, ge=0)
    """Largest commanded angle on both sides of the centre [rad]; half a radian swims forward."""
    velocity_rad_s: float | None = Field(None, gt=0)
    """Velocity of each stroke [rad/s]; None: so that a stroke takes two thirds of an action, within
    the plant's limits."""


def stroke_gait(config: StrokeGaitConfig, limits: Limits, ticks: int) -> Command:
    """Return one command per tick, fields ``(ticks,)``; raises CommandError for commands outside
    the plant's limits."""
    filling = min(
        max(2 * config.amplitude_rad * ACTION_RATE_HZ / (2 / 3), limits.velocity_min),
        limits.velocity_max,
    )
    actions = -(-ticks // min(ACTION_TICKS))
    sides = np.repeat(np.resize((1.0, -1.0), actions), action_ticks(actions))[:ticks]
    angle = config.centre_rad + config.amplitude_rad * sides
    command = Command(
        angle.astype(np.float32), np.full(ticks, config.velocity_rad_s or filling, np.float32)
    )
    check_commands(limits, command)
    return command


class ViewConfig(Configuration):
    """Configuration of a view: plant, motion, duration."""

    seconds: float = Field(10.0, ge=0.1, le=60)
    """Duration of the plant's time, from rest [s]; in ten seconds the mean over 2 s settles."""
    frames_per_second: Literal[10, 20, 25, 50] = 25
    """Frames of a GIF, in real time [1/s]: the period is a whole number of 10 ms, the unit of
    GIF."""
    dots_per_inch: int = Field(100, ge=50, le=300, multiple_of=10)
    """Resolution of GIF and PNG, which are 9.6 by 5.2 inch [1/in]."""
    seed: int = Field(0, ge=0)
    """Seed of the plant's noise and of random commands."""
    gait: StrokeGaitConfig = StrokeGaitConfig()
    """Commands of the fin, unless a controller or random commands move it."""
    random: bool = False
    """Random commands, as in recordings of datasets, in place of the gait."""
    excitation: ExcitationConfig = ExcitationConfig()
    """The random commands."""
    next_references: tuple[Reference, ...] = ()
    """References (x, y) [N] after the first one, each for an equal part of the time."""


def record_footage(
    plant: Plant,
    config: ViewConfig,
    controller: Controller | None = None,
    reference: Reference | None = None,
) -> Footage:
    """The plant under the configuration's commands, or under those of a controller that tracks a
    reference [N].

    Raises CoverageError if the controller was not trained for one of the later ones.
    """
    ticks = round(config.seconds * RATE_HZ)
    key = named_key(config.seed, "view/plant")
    limits = Limits(*plant.limits)
    if controller is not None and reference is not None:
        for following in config.next_references:
            controller.check(following)
        references = (reference, *config.next_references)
        times = tuple(config.seconds * part / len(references) for part in range(len(references)))
        seconds = -(-ticks // RATE_HZ)
        asked = Recorded(time_s=times, force_n=references).sample(seconds * RATE_HZ)
        recording = experiment.run(controller, plant, asked[None], seconds, key[None])
        # The plant is pure: under the same commands and key it moves exactly as it did for the
        # controller.
        held: Command = jax.tree.map(lambda x: x[0, 0, :ticks], recording.command)
        return film(plant, key, held, asked[:ticks])
    if config.next_references:
        raise ConfigurationError(
            "references one after the other, and no first one; give a controller and a reference"
        )
    if config.random:
        return film(
            plant, key, config.excitation(named_key(config.seed, "view/commands"), ticks, limits)
        )
    return film(plant, key, stroke_gait(config.gait, limits, ticks))


def draw(
    footage: Footage, out: Path, title: str, config: ViewConfig, report: Callable[[float], None]
) -> None:
    """Draw the footage as a .gif, a .html page or, its last frame, as .png, by the name of
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
    """Describe which fin is shown and what moves it."""
    where = "in the virtual tank" if plant == "tank" else f"in {Path(plant).name}"
    if reference is not None:
        asked = ", then ".join(
            f"({x:.3g}, {y:.3g})" for x, y in (reference, *config.next_references)
        )
        return with_minus_signs(f"A soft fin {where}, target {asked} N")
    if config.random:
        return f"A soft fin {where}, random commands"
    return with_minus_signs(f"A soft fin {where}, beating about {config.gait.centre_rad:g} rad")
