"""An emulated rig in simulated time: the same for a seed, remembered from command to command."""

import json

import numpy as np
import pytest

from softfin.cli import main
from softfin.core.errors import RigError
from softfin.emulation.rig import kept_rig, rigs, state_file, write_simulated
from softfin.emulation.tank import _tick
from softfin.rig.config import load_rig
from softfin.rig.machine import Target
from softfin.rig.rig import zero_angle, zero_force
from softfin.stages.machines import find_rig
from softfin.tank import Tank


def close_rigs():
    while rigs:
        rigs.popitem()[1].close()


@pytest.fixture(autouse=True)
def pulled_out_after_all():
    yield
    close_rigs()


@pytest.fixture(scope="module")
def tank():
    return Tank()


def made(folder, tank, seed=0):
    folder.mkdir(exist_ok=True)
    write_simulated(folder / "rig.yaml", tank, {}, seed)
    return folder / "rig.yaml"


def moved(file, goal=0.8, ticks=60):
    """Readings of a stroke; each call is as a command of its own."""
    rig = find_rig(load_rig(file))
    rig.open()
    try:
        rig.enable()
        rig.command(Target(goal, 5.0))
        samples = []
        for _ in range(ticks):
            rig.clock.sleep(0.01)
            samples.append(rig.read())
        rig.stop()
    finally:
        rig.close()
        close_rigs()
    return np.array(
        [(s.time, s.angle, s.velocity, s.current, s.force_time, *s.wrench) for s in samples]
    )


def zeroed(file):
    zero_angle(find_rig(load_rig(file)))
    zero_force(find_rig(load_rig(file)), seconds=0.2)
    close_rigs()


def test_the_same_seed_and_commands_give_the_same_readings_and_another_seed_others(tmp_path, tank):
    runs = []
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        file = made(tmp_path / name, tank, seed)
        zeroed(file)
        runs.append(np.concatenate([moved(file), moved(file, -0.5)]))
    assert np.array_equal(runs[0], runs[1])
    assert not np.array_equal(runs[0][:, 5:7], runs[2][:, 5:7])
    assert state_file(tmp_path / "a" / "rig.yaml").read_text() == (
        state_file(tmp_path / "b" / "rig.yaml").read_text()
    )


def test_what_a_command_leaves_is_what_the_next_one_finds(tmp_path, tank):
    file = made(tmp_path, tank)
    with pytest.raises(RigError, match="softfin rig zero --arm"):
        moved(file)
    zeroed(file)
    first = moved(file)
    state = json.loads(state_file(file).read_text())
    assert state["drive"]["referenced"] is True
    second = moved(file, 0.2)
    # It stands where it was stopped, its zero is known, and its noise goes on.
    assert second[0, 1] == pytest.approx(0.8, abs=0.01)
    assert first[-1, 1] == pytest.approx(0.8, abs=0.01)
    assert second[-1, 1] == pytest.approx(0.2, abs=0.01)
    assert not np.array_equal(first[:, 5:7], second[:, 5:7])


def test_one_process_opens_it_many_times_and_it_is_one_rig(tmp_path, tank):
    file = made(tmp_path, tank)
    programs = _tick._cache_size()
    one = kept_rig(load_rig(file))
    other = kept_rig(load_rig(file))
    assert one is other
    # Whatever the tank and its state, one program moves it.
    assert _tick._cache_size() - programs <= 1
    assert find_rig(load_rig(file)).clock is one.clock


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda state: "{", "Expecting"),
        (
            lambda state: json.dumps(state | {"emulation": {"seed": 9, "tank": {}}}),
            "of a different seed or tank",
        ),
        (lambda state: json.dumps({**state, "drive": {}}), "zero_counts"),
        (lambda state: json.dumps({**state, "fin": state["fin"] | {"state": [1]}}), "argument"),
    ],
)
def test_a_state_that_cannot_be_is_refused_in_one_line(tmp_path, tank, change, words):
    file = made(tmp_path, tank)
    rig = kept_rig(load_rig(file))
    rig.save()
    close_rigs()
    state = json.loads(state_file(file).read_text())
    state_file(file).write_text(change(state))
    with pytest.raises(RigError, match=words) as told:
        kept_rig(load_rig(file))
    assert "remove it, then zero the rig again" in str(told.value)
    assert "\n" not in str(told.value)


def test_a_tank_that_cannot_be_is_refused_and_the_tank_of_the_file_is_the_one_behind(
    tmp_path, tank, capsys
):
    (tmp_path / "tank.yaml").write_text("drive: {fastest_rad_s: 4.0}\n")
    main(
        [
            "rig",
            "emulate",
            "--tank",
            str(tmp_path / "tank.yaml"),
            "--rig",
            str(tmp_path / "rig.yaml"),
        ]
    )
    config = load_rig(tmp_path / "rig.yaml")
    assert config.drive.fastest_rad_s == 4.0
    assert config.emulation.tank == {"drive": {"fastest_rad_s": 4.0}}
    text = (tmp_path / "rig.yaml").read_text().replace("    fastest_rad_s", "    fastest_rat_s")
    (tmp_path / "rig.yaml").write_text(text)
    with pytest.raises(RigError, match=r"emulation\.tank: unknown key 'drive\.fastest_rat_s'"):
        kept_rig(load_rig(tmp_path / "rig.yaml"))
