"""Refits of an ensemble with random weights to logs of a known fin."""

import equinox as eqx
import jax
import numpy as np
import pytest

from softfin.core.errors import ConfigurationError, LogError
from softfin.core.quantities import command_limits
from softfin.storage.run_directory import RunDirectory
from softfin.surrogate import StreamingSurrogate
from softfin.surrogate.streaming import fit as fit_module
from softfin.surrogate.streaming import refit as module
from softfin.surrogate.streaming.ensemble import calibrated
from softfin.surrogate.streaming.refit import Refit
from softfin.surrogate.table_one import table_one
from softfin.surrogate.training import hold_out
from tests.surrogate.streaming import small

TINY = {"drive_updates": 10, "force_updates": 10, "batch": 8, "ticks": 40, "burn_in": 10}
LOG = small.recorded(rows=1000)
LOGS = [small.recorded(rows=400, seed=seed) for seed in range(3)]


@pytest.fixture(autouse=True)
def known_profile(monkeypatch):
    monkeypatch.setattr(fit_module, "identify", lambda logs, seed: (small.PROFILE, 0.0))


def refit(folder, logs, start=None, **changes):
    work = Refit("start", start or small.surrogate(), {})
    config = work.config().merged(TINY | changes, "test")
    return work.fit(logs, config, 0, RunDirectory(folder / "refit", {}))


def force_error(surrogate, logs):
    return table_one(surrogate, logs)["force_free_running"]["physical"]["rmse"]


def same(one, other):
    pairs = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    return all(np.array_equal(a, b) for a, b in pairs)


def test_a_refit_keeps_networks_scales_limits_and_offset_and_improves(tmp_path):
    start = small.surrogate()
    refitted = refit(tmp_path, LOGS)
    assert jax.tree.structure(refitted.members) == jax.tree.structure(start.members)
    assert refitted.limits == start.limits
    assert same(refitted.members.force.offset, start.members.force.offset)
    assert not same(refitted.members, start.members)
    held_out = hold_out(LOGS, 0.3)[1]
    assert force_error(refitted, held_out) < force_error(start, held_out)


def test_a_single_log_is_enough_because_its_end_is_held_out(tmp_path):
    refitted = refit(tmp_path, [LOG])
    assert refitted.interval.logs == 1
    training, held_out = hold_out([LOG], 0.3)
    assert (training[0].rows, held_out[0].rows) == (700, 300)
    np.testing.assert_array_equal(held_out[0].reading.force, LOG.reading.force[700:])
    assert force_error(refitted, held_out) < force_error(small.surrogate(), held_out)


def test_a_refit_that_is_worse_is_discarded_but_the_interval_is_calibrated(tmp_path, monkeypatch):
    start = small.surrogate()

    def fit_badly(*_):
        return eqx.tree_at(lambda s: s.members.force.thrust, start, replace_fn=lambda x: x + 50)

    monkeypatch.setattr(module, "fit_streaming", fit_badly)
    refitted = refit(tmp_path, LOGS)
    assert same(refitted.members, start.members)
    assert same(refitted.familiarity, start.familiarity)
    held_out = hold_out(LOGS, 0.3)[1]
    predicted = small.predict_logs(start.members, held_out)
    forces = [each.force for each in predicted]
    assert refitted.interval == calibrated(forces, held_out, TINY["burn_in"])
    assert refitted.interval != start.interval


@pytest.mark.parametrize(
    "changes", [{"members": 3}, {"drive": {"units": 4}}, {"force": {"wake": 1}}]
)
def test_options_that_change_the_networks_are_refused(tmp_path, changes):
    (option,) = changes
    with pytest.raises(ConfigurationError, match=f"--start start: .*--{option}"):
        refit(tmp_path, LOGS, **changes)


@pytest.mark.parametrize("beyond", [{"reach": 1.8}, {"speeds": (1.0, 3.5)}])
def test_commands_outside_the_limits_are_refused(tmp_path, beyond):
    with pytest.raises(LogError, match="--start start"):
        refit(tmp_path, [*LOGS, small.recorded(rows=400, **beyond)])


def test_commands_within_the_tolerance_are_used(tmp_path, monkeypatch):
    whole = small.surrogate()
    limits = command_limits(LOGS)
    limits = limits._replace(angle_max=limits.angle_max - 0.02)
    start = StreamingSurrogate(whole.members, limits, whole.interval, whole.familiarity)
    monkeypatch.setattr(module, "fit_streaming", lambda *_: whole)
    assert refit(tmp_path, LOGS, start).limits == limits


@pytest.mark.parametrize("factor", [0.1, 10])
def test_a_fin_of_a_different_size_is_refused(tmp_path, factor):
    def scale(log):
        reading = log.reading
        return log._replace(reading=reading._replace(force=reading.force * np.float32(factor)))

    with pytest.raises(LogError, match="--start start"):
        refit(tmp_path, [scale(log) for log in LOGS])
