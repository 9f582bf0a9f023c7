"""What parts need beside softfin's own commands: ``python -m results.scripts NAME ...`` in the work
folder."""

import json
import shutil
import sys
from pathlib import Path

from results import ROOT


def as_test(dataset: str, out: str) -> None:
    """Write the training logs of a dataset as the test logs of another: surrogates are compared on
    test logs."""
    from softfin.storage.dataset import Dataset, write_dataset

    data = Dataset.open(Path(dataset))
    write_dataset(
        Path(out),
        data.load(data.train[:1]),
        data.load(data.train),
        {"plant": data.description.get("plant")},
    )


def tank_r2(published: str, out: str, *seeds: str) -> None:
    """Write R2 of the default tank on 12 unseen segments of each seed, for three ranges of logged
    velocities."""
    import numpy as np

    from softfin.core.configuration import read_yaml
    from softfin.surrogate import load_surrogate
    from softfin.tank.calibration.calibrate import scores
    from softfin.tank.calibration.config import CalibrateConfig
    from softfin.tank.calibration.model import cut, material, read, stacked

    config = CalibrateConfig.build(read_yaml(ROOT / "docs" / "calibration.yaml"))
    found = {}
    for low in (0.5, 0.3, 0.0):
        settings = config.merged({"velocity_rad_s": [low, 1.57], "segments": 2}, "tank_r2")
        rows = []
        for seed in seeds:
            _, logs, _ = material(load_surrogate(Path(published)), settings, seed=int(seed))
            unseen = cut(logs, settings.test_segments, 1200, 200, "test")
            readings = read(stacked([(settings.tank, settings.recording)]), unseen.command)
            row = scores(np.asarray(readings[0]), unseen)
            rows.append(
                {channel: row[channel]["r2"] for channel in ("angle", "force_x", "force_y")}
            )
        found[f"{low:g}"] = rows
    Path(out).mkdir()
    (Path(out) / "r2.json").write_text(json.dumps(found))


def efficiency(out: str, *runs: str) -> None:
    """Gather the seeds of ``studies.data_efficiency``, a run each, and draw its figure."""
    from studies.data_efficiency import draw, gathered

    for run in runs:
        shutil.copytree(Path(run) / "scores", Path(out) / "scores", dirs_exist_ok=True)
    draw(gathered(Path(out)), Path(out) / "data_efficiency.png")


def recurrent(plant: str, out: str, seed: str, steps: str = "30000", seconds: str = "30") -> None:
    """Write baselines.json with the scores of RecurrentPPO, trained and evaluated in a plant."""
    from benchmarks.recurrent import evaluate_recurrent

    from softfin.evaluation.evaluate import EvaluateConfig
    from softfin.gaits.reachable import PAPER_REFERENCES
    from softfin.storage.registry import find_plant

    config = EvaluateConfig(references=PAPER_REFERENCES, seed=int(seed), seconds=int(seconds))
    evaluation = evaluate_recurrent(find_plant(plant), config, int(steps))
    Path(out).mkdir()
    scores = {"recurrent_ppo": evaluation.summary()}
    (Path(out) / "baselines.json").write_text(json.dumps(scores))


def power(surrogate: str, dataset: str, out: str) -> None:
    """Write power.json: how well a surrogate predicts the power of logs that it has not seen.

    Mean power over whole logs, relative to the mean of all of them, and how many means over 2 s the
    90% interval holds.
    """
    import numpy as np

    from softfin.core.power import mechanical_power
    from softfin.storage.dataset import Dataset
    from softfin.surrogate import load_surrogate
    from softfin.surrogate.streaming.ensemble import predict_motion
    from softfin.surrogate.streaming.torque import (
        TORQUE,
        power_means,
        predict_power,
        with_torque,
    )

    burn_in = 300
    data = Dataset.open(Path(dataset))
    logs = list(data.load(data.train))
    model = load_surrogate(Path(surrogate))
    nets = model.members.force
    motion = predict_motion(model.members.drive, logs)
    means, measured = power_means(nets, with_torque(motion, logs), burn_in)
    is_inside = np.abs(means.mean(0) - measured) <= model.power_interval.half_width(means)
    whole = np.array([predict_power(nets, each).mean(0)[burn_in:].mean() for each in motion])
    true = np.array(
        [
            mechanical_power(
                np.asarray(log.channels[TORQUE])[:, None], np.asarray(log.reading.velocity)
            )[burn_in + 1 :].mean()
            for log in logs
        ]
    )
    scores = {
        "log_error": float(np.abs(whole - true).max() / true.mean()),
        "coverage": float(is_inside.mean()),
    }
    Path(out).mkdir()
    (Path(out) / "power.json").write_text(json.dumps(scores))


if __name__ == "__main__":
    {
        "as-test": as_test,
        "tank-r2": tank_r2,
        "efficiency": efficiency,
        "recurrent": recurrent,
        "power": power,
    }[sys.argv[1]](*sys.argv[2:])
