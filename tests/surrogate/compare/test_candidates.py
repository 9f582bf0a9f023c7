import json

import jax
import numpy as np
import pytest

from softfin.core.quantities import Command
from softfin.surrogate import save_surrogate
from softfin.surrogate.compare.compare import beyond_limits, candidates
from tests.surrogate import small
from tests.surrogate.compare.test_compare import LOGS, candidate


def test_fits_of_one_configuration_that_chose_other_networks_are_no_seeds_of_one_another(tmp_path):
    paths = [tmp_path / name for name in "abc"]
    for seed, path in enumerate(paths):
        save_surrogate(
            path, small.surrogate(seed), None, {"data_hash": "d"}, configuration={"paper": 1}
        )
    file = paths[2] / "surrogate.json"
    description = json.loads(file.read_text())
    description["networks"]["forcenet"]["layers"][3]["rate"] = 0.2
    file.write_text(json.dumps(description))
    one, other, different = (each.group for each in candidates(paths))
    assert one == other
    assert one != different


def test_beyond_training_commands_that_never_changed_is_counted_over_1_rad_s():
    still = candidate(0)
    limits = still.surrogate.limits._replace(velocity_min=2.0, velocity_max=2.0)

    class Still:
        pass

    steady = still._replace(surrogate=Still())
    steady.surrogate.limits = limits
    log = LOGS[0]
    zero = jax.tree.map(np.zeros_like, log.command.angle)
    same, faster = (
        log._replace(command=Command(zero, np.full_like(zero, speed))) for speed in (2.0, 2.5)
    )
    assert beyond_limits([steady], [same]) == (0, 0)
    assert beyond_limits([steady], [same, faster]) == pytest.approx((0.5, 0.5))
