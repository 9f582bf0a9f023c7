"""A fin whose drive has no velocity command, such as a hobby servo: every stage accepts it."""

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import softfin
from softfin.cli import main
from softfin.control.controller import Measured
from softfin.core.quantities import PAPER_LIMITS
from softfin.surrogate import StreamingSurrogate, save_surrogate
from tests.gaits.mapped import WITHIN
from tests.plants import SERVO_VELOCITY_RAD_S
from tests.staged import TRAIN
from tests.surrogate.streaming import small

SERVO = "tests.plants:ServoFin"


@pytest.fixture(scope="module")
def gaits(tmp_path_factory):
    out = tmp_path_factory.mktemp("servo") / "gaits"
    softfin.map_forces(SERVO, out=out, config=WITHIN)
    return out


def commands(path):
    controller = softfin.load_controller(path)
    state = controller.init()
    for _ in range(12):
        state, command = controller.act(state, Measured(0.1, np.zeros(2)), (1.0, 0.0))
        yield command


def test_gaits_for_one_velocity_hold_their_forces(gaits):
    assert {command.velocity for command in commands(gaits)} == {SERVO_VELOCITY_RAD_S}
    summary = softfin.evaluate(gaits, plant=SERVO, seconds=4, repeats=1, reference=((1.0, 0.0),))
    assert summary["mean"]["x"]["error_n"] < 0.1


def test_policies_are_trained_for_one_velocity(tmp_path):
    softfin.train(SERVO, out=tmp_path / "single", config=TRAIN | {"range": "reach"})
    found = list(commands(tmp_path / "single"))
    assert {command.velocity for command in found} == {SERVO_VELOCITY_RAD_S}
    assert np.isfinite([command.angle for command in found]).all()


def test_the_page_and_the_exported_file_are_written(gaits, tmp_path):
    plant = small.surrogate()
    limits = PAPER_LIMITS._replace(velocity_min=3.0, velocity_max=3.0)
    servo = StreamingSurrogate(plant.members, limits, plant.interval, plant.familiarity)
    save_surrogate(tmp_path / "surrogate", servo, None, {})
    page = tmp_path / "page.html"
    main(["explore", "--plant", str(tmp_path / "surrogate"), "--out", str(page)])
    assert page.stat().st_size > 0
    main(["export", str(gaits), "--onnx", str(tmp_path / "gaits.onnx")])


def test_gymnasium_s_checks_pass():
    environment = gymnasium.make("softfin.gym:softfin/ForceTracking-v0", plant=SERVO)
    check_env(environment.unwrapped)
