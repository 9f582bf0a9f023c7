"""Parts about robots with several fins."""

from collections.abc import Sequence

from results.parts.common import TINY_MAP, Figures, Part, Work
from results.record import figure
from results.steps import step

PLANT = "examples/fins/turning.yaml"
COLUMNS = {
    "target": "target",
    "error": "error",
    "error_worst": "worst",
    "error_of_references": "references",
    "ripple": "ripple",
}
"""Figures per axis, by their key in ``robot.json``."""


def robot(seeds: Sequence[int]) -> Part:
    """U-CAT's node with all fins and with one dead: the wrench of fins in a tank."""
    gaits = step("robot-gaits", f"softfin map {PLANT}", 5, tiny=TINY_MAP)
    command = f"softfin robot evaluate ucat {gaits.name} --plant {PLANT} --max-thrust 3"
    tiny = "--targets 2 --repeats 1"
    whole = [step(f"robot-{seed}", f"{command} --seed {seed}", 2, seed, tiny) for seed in seeds]
    dead = [
        step(f"robot-dead-{seed}", f"{command} --dead back_left --seed {seed}", 2, seed, tiny)
        for seed in seeds
    ]

    def read(work: Work) -> Figures:
        figures: Figures = {}
        for prefix, steps in (("", whole), ("dead.", dead)):
            found = [work.json(f"{each.name}/robot.json") for each in steps]
            for column, name in COLUMNS.items():
                summary = "worst" if name == "worst" else "mean"
                for index, axis in enumerate(found[0][column]):
                    unit = "N" if index < 3 else "N m"
                    values = [each[column][axis] for each in found]
                    figures[f"{prefix}{name}.{axis}"] = figure(unit, values, seeds, summary)
            unreachable = [100 * each["references_unreachable"] for each in found]
            figures[f"{prefix}unreachable"] = figure("%", unreachable, seeds)
        return figures

    return Part("The node of U-CAT with four fins", (gaits, *whole, *dead), read)
