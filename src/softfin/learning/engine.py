"""Where the parts of a run are worked on: one after the other in this process, or by another engine.

A part is a name and an item; the work is a function of the item that gives the same result wherever it runs.
"""

from collections.abc import Callable, Mapping
from typing import TypeAlias, TypeVar

from softfin.core.progress import Progress

Item = TypeVar("Item")
Result = TypeVar("Result")

Work: TypeAlias = Callable[[Item, Progress | None], Result]
"""Work on one part, which reports its progress where it is given a function for that."""


class Engine:
    """Works on one part after the other in this process; other engines override `map`."""

    def map(
        self, stage: str, work: Work[Item, Result], parts: Mapping[str, Item], progress: Progress | None
    ) -> list[Result]:
        """The result of every part, in their order; `stage` names the whole in the progress.

        Here an error of a part ends the run, and the parts after it are not begun.
        """

        def within(index: int, name: str) -> Progress | None:
            def report(_: str, fraction: float, note: str) -> None:
                assert progress is not None
                progress(stage, (index + fraction) / len(parts), note if len(parts) == 1 else f"{name}: {note}")

            return None if progress is None else report

        return [work(item, within(i, name)) for i, (name, item) in enumerate(parts.items())]
