"""Rows of the benchmark that are not controller folders: commands of a rigid fin, sines, and
RecurrentPPO of sb3-contrib.

    python -m studies.benchmark_rows law --surrogate surrogate --out benchmark-law

============= ==============================================================================
``still``     the rest command
``inverse``   the inverse model of the U-CAT robots, a sine at 1 Hz, with its own constant
``law``       the same formula, F = k0 f^2 (1 - cos A), with k0 fitted in the surrogate
``sine``      the sine with the smallest error in the surrogate, for each of the six references
``recurrent`` RecurrentPPO of sb3-contrib (extra ``sb3``), trained in the surrogate
============= ==============================================================================

The first four are open loop. SilentSwim (2026) controls a single fin with the formula of ``law``.
"""

import argparse
import time
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from benchmarks.recurrent import train_recurrent
from jaxtyping import Array, Float

import softfin
from softfin.control.controller import Controller, Measured
from softfin.core.action_clock import ActionClock
from softfin.core.errors import CoverageError
from softfin.core.plant import Plant, rest_command
from softfin.core.quantities import TICK_S, Command, Limits
from softfin.evaluation.benchmark import BenchmarkProtocol
from softfin.evaluation.predict import PolicyController
from softfin.gaits.reachable import PAPER_REFERENCES, Cell, bounding_box, format_force
from softfin.task.task import TaskConfig
from studies.open_loop import UCAT_CONSTANT_N_S2, OpenLoopSearch, ShaftSine, inverse

FREQUENCY_HZ = 1.0
"""Frequency of the inverse model: its mean force over 2 s has no ripple."""

EACH_TICK = ActionClock(ticks=(1,), window_actions=200)
"""Actions of one tick, so that commands can follow a sine, and the paper's window of 2 s."""


TINY = BenchmarkProtocol(seconds=4, seeds=1, tanks=1, change_s=6, rates_hz=(0.1,))


class Still(eqx.Module):
    """Commands the angle of rest."""

    limits: Limits = eqx.field(static=True)

    def init(self) -> tuple[()]:
        """Return the state, which is empty."""
        return ()

    def act(
        self, state: tuple[()], measured: Measured, reference: Array
    ) -> tuple[tuple[()], Command]:
        """Return the rest command."""
        return state, Command(*map(jnp.float32, rest_command(self.limits)))

    def check(self, reference: Any) -> None:
        """Accept every reference."""


class OpenLoop(eqx.Module):
    """Commands a sine that depends only on the reference."""

    limits: Limits = eqx.field(static=True)
    clock: ActionClock = eqx.field(static=True, default=EACH_TICK)

    def init(self) -> Array:
        """Return the number of past ticks."""
        return jnp.zeros((), jnp.int32)

    def act(self, state: Array, measured: Measured, reference: Array) -> tuple[Array, Command]:
        """Return the command of the next tick."""
        state = state + 1
        return state, self.sine(jnp.asarray(reference)).command(self.limits, state * TICK_S)

    def sine(self, reference: Array) -> ShaftSine:
        """Return the sine for a reference (x, y) [N]."""
        raise NotImplementedError


class AmplitudeLaw(OpenLoop):
    """The inverse model of a rigid fin; covers every reference."""

    constant_n_s2: float = eqx.field(static=True, default=UCAT_CONSTANT_N_S2)

    def sine(self, reference: Array) -> ShaftSine:
        """Return the sine of the inverse model."""
        return inverse(reference, FREQUENCY_HZ, self.limits, self.constant_n_s2)

    def check(self, reference: Any) -> None:
        """Accept every reference."""


class SineTable(OpenLoop):
    """Sines for a few references."""

    references: Float[Array, "references 2"] = eqx.field(kw_only=True)
    sines: ShaftSine = eqx.field(kw_only=True)

    def sine(self, reference: Array) -> ShaftSine:
        """Return the sine of the nearest of its references."""
        nearest = jnp.argmin(jnp.linalg.norm(self.references - reference, axis=1))
        return jax.tree.map(lambda values: values[nearest], self.sines)

    def check(self, reference: Any) -> None:
        """Raise CoverageError for a reference without a sine."""
        if not np.isclose(self.references, np.asarray(reference)).all(axis=1).any():
            raise CoverageError(
                f"reference {format_force(reference)} N: the table has no sine for it; use one of "
                "its references"
            )


def build(kind: str, surrogate: Plant, limits: Limits, seed: int, steps: int) -> Controller:
    """Build the controller of a row, within the `limits` of the plant on which it will run."""
    if kind == "still":
        return Still(limits)
    if kind == "inverse":
        return AmplitudeLaw(limits)
    if kind == "recurrent":
        box = bounding_box([Cell.around(reference, 0.0) for reference in PAPER_REFERENCES])
        task = TaskConfig()
        return PolicyController(train_recurrent(surrogate, steps, seed, task, box), limits, task)
    search = OpenLoopSearch(surrogate, limits, seed)
    if kind == "law":
        return AmplitudeLaw(limits, constant_n_s2=search.fitted_constant(FREQUENCY_HZ))
    references = np.array(PAPER_REFERENCES)
    sines = jax.tree.map(jnp.asarray, search.best_sines(references))
    return SineTable(limits, references=jnp.asarray(references), sines=sines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("kind", choices=("still", "inverse", "law", "sine", "recurrent"))
    parser.add_argument("--surrogate", required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seed", type=int, default=0, help="of the search, or of the training")
    parser.add_argument("--steps", type=int, default=30_000, help="actions of the training")
    parser.add_argument("--tiny", action="store_true", help="show only that everything works")
    words = parser.parse_args()
    surrogate = softfin.find_plant(words.surrogate)
    limits = Limits(*softfin.find_plant("tank").limits)
    start = time.process_time()
    steps = 128 if words.tiny else words.steps
    controller = build(words.kind, surrogate, limits, words.seed, steps)
    print(f"{words.kind}: built in {time.process_time() - start:.1f} s of processor time")
    print(softfin.benchmark(controller, out=words.out, config=TINY if words.tiny else None))


if __name__ == "__main__":
    main()
