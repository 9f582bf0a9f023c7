"""The commissioning form: for each step, its results, who signed it, and the configuration at that
time.

It is stored next to the rig's file: for rig.yaml in rig.commissioning.json, and in readable form in
rig.commissioning.md. Every attempt is kept; the latest attempt at each step counts.
"""

import json
from pathlib import Path

from softfin.core.configuration import Configuration
from softfin.core.errors import ConfigurationError, RigError
from softfin.core.json_object import JsonObject
from softfin.rig.config import RigConfig
from softfin.rig.device import drop_address
from softfin.storage import artifact as artifacts

STEP_TITLES = {
    1: "Data sheets, drive settings, switch",
    2: "Checks and proof of the stop, fin off the shaft",
    3: "Angle and force by hand",
    4: "Every way to stop, small motion",
    5: "Full motion, fin off the shaft",
    6: "Fin on the shaft, in air and in water",
    7: "One hour of random motion",
    8: "Several fins on one robot",
}
"""Titles of the steps, by number and in order."""

VOIDING = ("drive", "sensor")
"""Parts of the rig's file; changing them invalidates all signed steps."""


class Item(Configuration):
    """One measured or answered value, and the requirement for it."""

    what: str
    value: str
    required: str
    passed: bool


class SignedStep(Configuration):
    """One attempt at a step."""

    number: int
    date: str
    """Date and time in ISO 8601 format."""
    signed_by: str
    items: tuple[Item, ...]
    bags: tuple[str, ...] = ()
    """Recordings of the step, as paths relative to the rig's file."""
    rig: JsonObject
    """Configuration of the rig at that time."""

    @property
    def passed(self) -> bool:
        """Whether every item passed; a step without items was not carried out."""
        return bool(self.items) and all(item.passed for item in self.items)


class Form(Configuration):
    """The form of one rig."""

    attempts: tuple[SignedStep, ...] = ()
    """All attempts, oldest first."""

    def latest(self, number: int) -> SignedStep | None:
        """Return the latest attempt at a step, or None if there is none."""
        return next((step for step in reversed(self.attempts) if step.number == number), None)

    def is_passed(self, number: int, config: RigConfig) -> bool:
        """Return whether the latest attempt at a step passed with the current drive and sensor
        configuration."""
        step = self.latest(number)
        return (
            step is not None
            and step.passed
            and _voiding_parts(step.rig) == _voiding_parts(config_values(config))
        )

    def next_step(self, config: RigConfig) -> int | None:
        """Return the number of the first step that has not been passed; None if all have."""
        return next((number for number in STEP_TITLES if not self.is_passed(number, config)), None)

    def warning(self, config: RigConfig) -> str | None:
        """Return a one-line warning if the rig is not, or no longer, commissioned; None
        otherwise."""
        number = self.next_step(config)
        if number is None:
            return None
        state = (
            "not commissioned"
            if self.latest(number) is None
            else "no longer commissioned, or a step failed"
        )
        return (
            f"rig of {config.fin}: {state}: step {number} of {len(STEP_TITLES)} has not been "
            "passed; see docs/commissioning.md and run: softfin rig commission --arm"
        )


def form_file(rig: Path) -> Path:
    """Return the path of a rig's form."""
    return rig.with_suffix(".commissioning.json")


def bag_folder(rig: Path) -> Path:
    """Return the folder for recordings made during the commissioning of a rig."""
    return rig.with_name(f"{rig.stem}-commissioning")


def load_form(rig: Path) -> Form:
    """Load the form for a rig's file, or an empty one if there is none; raises RigError if it is
    invalid."""
    file = form_file(rig)
    if not file.exists():
        return Form()
    try:
        return Form.build(json.loads(file.read_bytes()), str(file))
    except (OSError, ValueError, RecursionError, ConfigurationError) as error:
        raise RigError(
            f"{file}: not a commissioning form ({error}); move it away and start again"
        ) from None


def save_form(rig: Path, form: Form) -> None:
    """Save the form for a rig's file as JSON and as Markdown; raises RunError if it cannot be
    written."""
    artifacts.write_file(form_file(rig), form.model_dump_json(indent=2) + "\n")
    artifacts.write_file(form_file(rig).with_suffix(".md"), form_text(form, rig.name))


def form_text(form: Form, name: str) -> str:
    """Return the form as Markdown."""
    lines = [f"# Commissioning of {name}", ""]
    for number, title in STEP_TITLES.items():
        lines += [f"## {number}. {title}", ""]
        step = form.latest(number)
        if step is None:
            lines += ["Not carried out.", ""]
            continue
        lines += ["| what | found | required | |", "| --- | --- | --- | --- |"]
        for item in step.items:
            mark = "passed" if item.passed else "**failed**"
            lines.append(f"| {item.what} | {item.value} | {item.required} | {mark} |")
        result = "Passed" if step.passed else "Failed"
        lines += ["", f"{result}; signed by {step.signed_by}, {step.date}."]
        if step.bags:
            lines.append(f"Recordings: {', '.join(step.bags)}.")
        lines.append("")
    return "\n".join(lines)


def config_values(config: RigConfig) -> JsonObject:
    """Return a rig's configuration as a JSON object."""
    return config.model_dump(mode="json")


def _voiding_parts(rig: JsonObject) -> JsonObject:
    # A change of address does not void a step: the devices are still the same.
    return {part: drop_address(rig[part]) for part in VOIDING}
