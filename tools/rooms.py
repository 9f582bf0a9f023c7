"""Draws the rooms of softfin and what may import what: ``python tools/rooms.py
docs/architecture.png``."""

import sys
import textwrap
import tomllib
from pathlib import Path

from matplotlib.patches import FancyBboxPatch

from softfin.storage.figures import BLUE, GREY, new_figure, save_figure, styled

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "src" / "softfin"


def layers() -> list[list[str]]:
    """The rooms as the linter of imports has them, the lowest layer first."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"][
        "contracts"
    ]
    return [layer.split(" | ") for layer in reversed(contracts[0]["layers"])]


def summary(room: str) -> str:
    """The first sentence of a room's docstring."""
    return (
        (PACKAGE / room / "__init__.py")
        .read_text()
        .split('"""')[1]
        .split("\n")[0]
        .replace("``", "")
        .rstrip(".")
    )


def main(path: Path) -> None:
    """Draw each layer above those that it may import."""
    rows = layers()
    with styled():
        figure = new_figure(8, 0.48 * len(rows))
        axes = figure.subplots()
        for level, rooms in enumerate(rows):
            width = 10 / len(rooms)
            for column, room in enumerate(rooms):
                left = column * width + 0.1
                box = FancyBboxPatch(
                    (left, level + 0.1), width - 0.2, 0.72, "round,pad=0.02", fc="#EAF2F8", ec=BLUE
                )
                axes.add_patch(box)
                axes.text(left + 0.1, level + 0.46, room, weight="bold", va="center", size=10)
                text = textwrap.fill(summary(room), round(11.5 * (width - 1.75)))
                axes.text(left + 1.65, level + 0.46, text, va="center", size=7)
        axes.annotate(
            "",
            (-0.25, 0.2),
            (-0.25, len(rows) - 0.2),
            arrowprops={"arrowstyle": "-|>", "color": GREY},
        )
        axes.text(
            -0.5, len(rows) / 2, "may import", rotation=90, va="center", ha="center", color=GREY
        )
        axes.set(xlim=(-0.8, 10), ylim=(0, len(rows)))
        axes.set_axis_off()
    save_figure(figure, path)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
