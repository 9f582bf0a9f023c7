"""Run the steps of a rig's commissioning in order, have each one signed, and save them in the
form."""

from pathlib import Path

import numpy as np

from softfin.core.errors import ConfigurationError
from softfin.rig.commissioning.form import (
    STEP_TITLES,
    Form,
    SignedStep,
    bag_folder,
    config_values,
    load_form,
    save_form,
)
from softfin.rig.commissioning.operator import Operator
from softfin.rig.commissioning.steps import StepContext, check_range, choose_weight, run_step
from softfin.rig.computer import Computer
from softfin.rig.config import RigConfig
from softfin.rig.record import date_and_time


def commission_step(
    rig: Path,
    config: RigConfig,
    number: int,
    operator: Operator,
    clock: Computer,
    hour_s: float = 3600.0,
    weight_kg: float | None = None,
) -> SignedStep:
    """Run one step of a rig's commissioning, have it signed, and add it to the form next to the
    rig's file.

    `weight_kg` is the mass of the weight that pulls on the force sensor in step 3; the default
    suits the rig's force limit. Raises ConfigurationError if it exceeds this limit, if the fin
    cannot swing about angle 0, or if an earlier step has not been passed.
    """
    known_kg = choose_weight(config, weight_kg)
    check_range(config)
    form = load_form(rig)
    missing = form.next_step(config)
    if missing is not None and missing < number:
        raise ConfigurationError(
            f"step {number}: step {missing} ({STEP_TITLES[missing]}) has not been passed "
            "with this drive and sensor; run the steps in order"
        )
    # Before the step, which may take an hour.
    date = date_and_time()
    folder = bag_folder(rig) / f"step-{number}-{_attempts(form, number) + 1}"
    operator.tell(f"Step {number} of {len(STEP_TITLES)}: {STEP_TITLES[number]}")
    items = run_step(
        number,
        StepContext(config, operator, folder, clock, np.random.default_rng(), hour_s, known_kg),
    )
    step = SignedStep(
        number=number,
        date=date,
        signed_by=operator.text("Signed by"),
        items=items,
        bags=tuple(str(bag.relative_to(rig.parent)) for bag in sorted(folder.glob("*.mcap"))),
        rig=config_values(config),
    )
    save_form(rig, Form(attempts=(*form.attempts, step)))
    return step


def _attempts(form: Form, number: int) -> int:
    return sum(step.number == number for step in form.attempts)
