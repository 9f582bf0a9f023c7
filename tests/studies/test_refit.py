import json

import numpy as np
from studies.refit import SCORES, WIDTHS, changed_logs, gathered, table


def test_logs_without_noise_are_those_of_the_same_changed_tank(monkeypatch):
    monkeypatch.setattr("studies.refit.ROWS", 300)
    (noisy,) = changed_logs(3, "train", 1, is_silent=False)
    (silent,) = changed_logs(3, "train", 1, is_silent=True)
    np.testing.assert_array_equal(noisy.command.angle, silent.command.angle)
    np.testing.assert_allclose(noisy.reading.angle, silent.reading.angle, atol=1e-4)
    error = np.asarray(noisy.reading.force) - silent.reading.force
    assert 0.01 < error.std() < 0.2
    assert WIDTHS.drift == WIDTHS.misalignment_rad == 0


def test_the_table_has_a_line_for_each_number_of_minutes(tmp_path):
    for name in ("refit-00", "refit-02", "nothing-02"):
        (tmp_path / "scores" / name).mkdir(parents=True)
        for seed in range(2):
            scores = dict.fromkeys(SCORES, 0.1 * (seed + 1))
            (tmp_path / "scores" / name / f"seed-{seed}.json").write_text(json.dumps(scores))
    _, _, none, two = table(gathered(tmp_path)).splitlines()
    assert none.startswith("| 0 | 2 | 0.150 ± 0.071 | \N{EN DASH} | ")
    assert two.startswith("| 2 | 2 | 0.150 ± 0.071 | 0.150 ± 0.071 | ")
