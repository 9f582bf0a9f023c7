"""Parts about robots with several fins."""

from collections.abc import Sequence

from results.parts.common import Figures, Part, Work
from results.record import figure
from results.steps import step

TINY = "--set hold_s=20 --set path_s=20 --set settled_s=6 --set wrenches=2"


def robot(seeds: Sequence[int]) -> Part:
    """U-CAT with all fins and with one that dies: wrenches, holding, paths."""
    # Seeds of trials count on from the first.
    command = f"softfin robot evaluate ucat --repeats {len(seeds)} --seed {seeds[0]}"
    whole = step("robot", f"{command} --baselines", 4, tiny=TINY)
    # Each fin dies in one of the first four; the others have other directions of current and push.
    dead = step(
        "robot-dead",
        f"{command} --task hold --task lemniscate --task lissajous --dead",
        2,
        tiny=TINY,
    )

    def read(work: Work) -> Figures:
        figures: Figures = {}
        # Wrenches are drawn once, by the first seed.
        first = seeds[:1]
        for prefix, name in (("", "robot"), ("dead.", "robot-dead")):
            found = work.json(f"{name}/robot.json")
            for task in ("hold", "lemniscate", "lissajous"):
                rows = found[task]
                trials = [row["seed"] for row in rows]
                for key, score, factor in (
                    ("position", "position_rms_m", 100),
                    ("worst", "position_worst_m", 100),
                    ("attitude", "attitude_rms_deg", 1),
                ):
                    unit = "degrees" if key == "attitude" else "cm"
                    figures[f"{prefix}{task}.{key}"] = figure(
                        unit, [factor * row[score] for row in rows], trials
                    )
            if "wrenches" in found:
                for key in (
                    "force_error_n",
                    "force_error_worst_n",
                    "moment_error_nm",
                    "moment_error_worst_nm",
                    "roll_ripple_ratio",
                ):
                    figures[key] = figure("", [found["wrenches"][key]], first)
        for name, row in work.json("robot/robot.json")["baselines"].items():
            key = name.replace(" ", "-")
            for score in ("force_error_n", "moment_error_nm"):
                figures[f"{key}.{score}"] = figure("", [row["wrenches"][score]], first)
            figures[f"{key}.roll_ripple"] = figure(
                "N m", [row["wrenches"]["ripple"]["roll"]], first
            )
            for task in ("hold", "lemniscate"):
                trials = [each["seed"] for each in row[task]]
                figures[f"{key}.{task}"] = figure(
                    "cm", [100 * each["position_rms_m"] for each in row[task]], trials
                )
                figures[f"{key}.{task}.attitude"] = figure(
                    "degrees", [each["attitude_rms_deg"] for each in row[task]], trials
                )
        figures["reach"] = figure("N", [work.json("robot/robot.json")["reach_n"][0]])
        return figures

    pictures = {"docs/robot.png": "robot/lemniscate.png"}
    return Part("U-CAT with four fins", (whole, dead), read, pictures)
