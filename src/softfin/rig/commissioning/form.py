"""The commissioning form: the results of each step, who signed it, and the configuration at the
time.

It is stored beside the rig's file: for rig.yaml in rig.commissioning.json, and for people in
rig.commissioning.md. Every attempt is kept; the latest attempt at a step counts.
"""

import json
from pathlib import Path

from softfin.core.configuration import Configuration
from softfin.core.errors import ConfigurationError, RigError
from softfin.core.json_object import JsonObject
from softfin.rig.axia80.config import ADDRESS_FIELDS
from softfin.rig.config import RigConfig
from softfin.storage import artifact as artifacts

STEP_TITLES = {
    1: "Data sheets, settings of the drive, switch",
    2: "Checks and proof of the stop, fin off the shaft",
    3: "Angle and force by hand",
    4: "Every way to stop, small motion",
    5: "Full motion, fin off the shaft",
    6: "Fin on the shaft, in air and in water",
    7: "One hour of random motion",
    8: "Several fins on one robot",
}
"""Titles of the steps by number, in order."""

VOIDING = ("drive", "sensor")
"""Parts of the rig's file that, when changed, void all steps signed so far."""


class Item(Configuration):
    """One value that was measured or answered, and what was required of it."""

    what: str
    value: str
    required: str
    passed: bool


class SignedStep(Configuration):
    """One attempt at a step."""

    number: int
    date: str
    """Date and time, as ISO 8601."""
    signed_by: str
    items: tuple[Item, ...]
    bags: tuple[str, ...] = ()
    """Recordings of the step, relative to the rig's file."""
    rig: JsonObject
    """Configuration of the rig then."""

    @property
    def passed(self) -> bool:
        """Whether every item was as required; a step without items was not carried out."""
        return bool(self.items) and all(item.passed for item in self.items)


class Form(Configuration):
    """The form of one rig."""

    attempts: tuple[SignedStep, ...] = ()
    """All attempts, the oldest first."""

    def latest(self, number: int) -> SignedStep | None:
        """Return the latest attempt at a step; None if there was none."""
        return next((step for step in reversed(self.attempts) if step.number == number), None)

    def is_passed(self, number: int, config: RigConfig) -> bool:
        """Whether the latest attempt at a step passed, with the drive and the sensor set up as they
        are now."""
        step = self.latest(number)
        return (
            step is not None
            and step.passed
            and _voiding_parts(step.rig) == _voiding_parts(config_values(config))
        )

    def next_step(self, config: RigConfig) -> int | None:
        """Return the number of the first step that is not passed; None if all are."""
        return next((number for number in STEP_TITLES if not self.is_passed(number, config)), None)

    def warning(self, config: RigConfig) -> str | None:
        """Return a line for a rig that is not commissioned, or no longer; None if it is."""
        number = self.next_step(config)
        if number is None:
            return None
        state = (
            "not commissioned"
            if self.latest(number) is None
            else "no longer commissioned, or a step failed"
        )
        return (
            f"rig of {config.fin}: {state}: step {number} of {len(STEP_TITLES)} is not passed; see "
            "docs/commissioning.md and run: softfin rig commission --arm"
        )


def form_file(rig: Path) -> Path:
    """Return the file of a rig's form."""
    return rig.with_suffix(".commissioning.json")


def bag_folder(rig: Path) -> Path:
    """Return the folder of the recordings that are made while a rig is commissioned."""
    return rig.with_name(f"{rig.stem}-commissioning")


def load_form(rig: Path) -> Form:
    """Load the form of a rig's file; an empty one if there is none. Raises RigError if it cannot be
    used."""
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
    """Save the form of a rig's file, as JSON and for people; raises RunError."""
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
    """Return a rig's configuration for JSON."""
    return config.model_dump(mode="json")


def _voiding_parts(rig: JsonObject) -> JsonObject:
    return {
        part: {name: value for name, value in rig[part].items() if name not in ADDRESS_FIELDS}
        for part in VOIDING
    }
