"""Where the parts of a run are worked on: one after the other in this process, or as tasks of a Ray cluster.

A part is a name and an item; the work is a function of the item that gives the same result wherever it runs.
"""

from collections.abc import Callable, Mapping
from typing import Protocol, TypeAlias, TypeVar, runtime_checkable

from softfin.core.choices import EngineName
from softfin.core.errors import ConfigurationError

Item = TypeVar("Item")
Result = TypeVar("Result")

Progress: TypeAlias = Callable[[str, float, str], None]
"""Called with what is going on, how much of it is done (0 .. 1), and the newest figures."""

Work: TypeAlias = Callable[[Item, Progress | None], Result]
"""Of one part; it says how far it is where it is given somebody to tell."""


@runtime_checkable
class Engine(Protocol):
    """Works on all parts of a run."""

    def map(
        self, stage: str, work: Work[Item, Result], parts: Mapping[str, Item], progress: Progress | None
    ) -> list[Result]:
        """The result of every part, in their order; `stage` names the whole in the progress."""
        ...


class LocalEngine:
    """One part after the other, in this process."""

    def map(
        self, stage: str, work: Work[Item, Result], parts: Mapping[str, Item], progress: Progress | None
    ) -> list[Result]:
        """As the contract has it; what a part raises ends the run, and the parts after it are not begun."""

        def within(index: int, name: str) -> Progress | None:
            def report(inner: str, done: float, note: str) -> None:
                assert progress is not None
                progress(stage, (index + done) / len(parts), note if len(parts) == 1 else f"{name}: {note}")

            return None if progress is None else report

        return [work(item, within(i, name)) for i, (name, item) in enumerate(parts.items())]


def find_engine(name: EngineName, cluster: str | None = None) -> Engine:
    """The engine of that name; raises ConfigurationError where Ray is not installed, or a cluster is none of Ray's."""
    if name == "local":
        if cluster is not None:
            raise ConfigurationError(
                f"cluster {cluster}: the local engine has none; give --engine ray, or no --cluster"
            )
        return LocalEngine()
    # Ray is an extra, and takes a second to import.
    from softfin.learning.engine_ray import RayEngine

    return RayEngine(cluster)
