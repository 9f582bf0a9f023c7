"""What each part of the streaming surrogates is worth: the same fit with one thing changed at a
time.

    python -m studies.ablation RUN --dataset dataset --minutes 10 --updates 800 --members 2 --batch 16

Prints a table of free-running errors over 30 s, on the test logs of a dataset, as Markdown, and
writes ablation.json. Each variant keeps its folder in RUN, so a stopped run goes on where it was.
Without --dataset one is recorded first.
"""

import argparse
import json
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
from benchmarks.flops import flops_per_tick
from jaxtyping import Array

from softfin.core.errors import SoftfinError
from softfin.core.quantities import RATE_HZ
from softfin.stages.collect import collect
from softfin.stages.surrogates import fit
from softfin.storage.dataset import Dataset, write_dataset
from softfin.surrogate import StreamingConfig, load_surrogate
from softfin.surrogate.streaming import ensemble
from softfin.surrogate.streaming.nets import ForceNet, ForceState
from softfin.surrogate.streaming.segments import Motion
from studies.compare import compare, load_test_logs

WITHOUT_QUASI_STEADY = "without the quasi-steady force"

VARIANTS: dict[str, tuple[str, ...]] = {
    "as it is": (),
    "without the wake": ("force.wake=0",),
    WITHOUT_QUASI_STEADY: (),
    "fed with measured motion only": ("free_running=[1.0, 1.0]",),
    "fed with predicted motion only": ("free_running=[0.0, 0.0]",),
    "8 units": ("force.units=8",),
    "32 units": ("force.units=32",),
}


class WithoutQuasiSteady(ForceNet):
    """A force network whose coefficients of added mass and drag stay at zero."""

    def step(self, state: ForceState, motion: Motion) -> tuple[ForceState, Array]:
        """Advance by one tick, with the core alone."""
        zero = jax.tree.map(jnp.zeros_like, (self.thrust, self.resistance))
        return ForceNet.step(
            eqx.tree_at(lambda net: (net.thrust, net.resistance), self, zero), state, motion
        )


def shortened(dataset: Path, minutes: float, out: Path) -> Path:
    """The first minutes of a dataset's logs, with all of its test logs."""
    if not (out / "dataset.json").exists():
        data = Dataset.open(dataset)
        left = round(minutes * 60 * RATE_HZ)
        logs = []
        for log in data.load(data.train):
            rows = min(left, len(log.reading.time))
            left -= rows
            if rows:
                parts = (log.command, log.reading)
                command, reading = (type(part)(*(x[:rows] for x in part)) for part in parts)
                logs.append(type(log)(command, reading))
        write_dataset(out, logs, data.load(data.test), {"plant": data.description.get("plant")})
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--dataset", type=Path)
    parser.add_argument("--minutes", type=float, default=10)
    parser.add_argument("--updates", type=int, default=800)
    parser.add_argument("--members", type=int, default=2)
    parser.add_argument("--batch", type=int, default=16)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--horizon", type=float, default=30.0)
    parser.add_argument("--only", nargs="*", default=list(VARIANTS))
    words = parser.parse_args()
    written: dict[str, dict[str, float]] = {}
    if words.dataset is None:
        words.dataset = words.out / "recorded"
        if not (words.dataset / "dataset.json").exists():
            collect(out=words.dataset, logs=max(2, round(words.minutes / 3)), rows=18_000)
    data = shortened(words.dataset, words.minutes, words.out / f"{words.minutes:g}min")
    updates = (f"drive_updates={words.updates // 2}", f"force_updates={words.updates}")
    base = (f"members={words.members}", f"batch={words.batch}", *updates)
    print(
        "| variant | angle RMSE [rad] | force RMSE x, y [N] | mean force, mean error, 95% [N] | "
        "FLOPs a tick |"
    )
    print("| --- | --- | --- | --- | --- |")
    for name in words.only:
        ensemble.ForceNet = WithoutQuasiSteady if name == WITHOUT_QUASI_STEADY else ForceNet
        jax.clear_caches()
        size = (
            f"{words.minutes:g}min-{words.members}x{words.batch}x{words.updates}-seed-{words.seed}"
        )
        folder = words.out / f"{size}-{name.replace(' ', '-')}"
        if not (folder / "surrogate.json").exists():
            try:
                fit(
                    data,
                    out=folder,
                    config=StreamingConfig().changed((*base, *VARIANTS[name])),
                    seed=words.seed,
                    resume=True,
                )
            except SoftfinError as error:
                raise SystemExit(f"{error}") from None
        surrogate = load_surrogate(folder)
        compared = compare({name: surrogate}, load_test_logs(data), (words.horizon,))
        row = compared.candidates[0].horizons[0]
        written[name] = row | {"flops_per_tick": flops_per_tick(surrogate)}
        print(
            f"| {name} | {row['angle_rmse_rad']:.4f} | {row['force_x_rmse_n']:.3f}, "
            f"{row['force_y_rmse_n']:.3f} | "
            f"{row['mean_force_mae_n']:.3f}, {row['mean_force_p95_n']:.3f} | "
            f"{flops_per_tick(surrogate):,} |",
            flush=True,
        )
    (words.out / "ablation.json").write_text(json.dumps(written))


if __name__ == "__main__":
    main()
