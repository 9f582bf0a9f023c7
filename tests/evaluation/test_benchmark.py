"""The benchmark on the example's gaits, on a policy and on a controller of one's own."""

import json
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml

import softfin
from softfin.cli import main
from softfin.control.controller import Measured
from softfin.control.feedback import Feedback
from softfin.control.references import check_within
from softfin.core.errors import CommandError, RunError
from softfin.core.quantities import PAPER_LIMITS, Command
from softfin.evaluation.experiment import run
from softfin.evaluation.predict import PolicyController
from softfin.gaits.reachable import PAPER_REFERENCES
from softfin.tank import Tank, TankConfig
from softfin.tank.changing import ChangingTank
from softfin.tank.fin import FinConfig
from softfin.tank.randomization import with_parameters
from softfin.task.references import PAPER_CELLS
from tests.documents import blocks
from tests.staged import BENCHMARK, COARSE

GAITS = Path(softfin.__file__).parent / "example" / "gaits"

TANK = Tank(TankConfig(fin=FinConfig(plates=2), steps_per_tick=4))


class Plain:
    """A controller in plain Python, which JAX cannot compile."""

    def init(self):
        return 1.0

    def act(self, state, measured, reference):
        assert isinstance(float(reference[0]), float)
        return -state, Command(0.8 * state, 3.0)

    def check(self, reference):
        """Covers everything."""


class OneCell(Plain):
    """Covers the six references, but not all forces between them."""

    cells = PAPER_CELLS

    def check(self, reference):
        check_within(self.cells, reference)


@pytest.fixture
def files(tmp_path):
    """Options of a tiny benchmark."""
    (tmp_path / "tank.yaml").write_text(yaml.safe_dump(COARSE))
    (tmp_path / "tiny.yaml").write_text(yaml.safe_dump(BENCHMARK))
    return ("--plant", str(tmp_path / "tank.yaml"), "--config", str(tmp_path / "tiny.yaml"))


def check_cases(summary):
    cases = summary["cases"]
    assert set(cases) == {"references", "moving", "perturbed", "changed", "frequency"}
    assert summary["protocol_version"] == 1
    assert not summary["is_standard"]
    assert summary["configuration"]["seeds"] == 1
    references = cases["references"]
    assert [tuple(row["reference_n"]) for row in references["references"]] == list(PAPER_REFERENCES)
    assert references["conditions"]["judged_by"] == "true force"
    assert references["mean"]["power"]["electrical"]["mean_w"] > 0
    (perturbed,) = cases["perturbed"]
    assert perturbed["width"] == 0.3
    assert len(perturbed["mean"]["x"]["error_seeds_n"]) == BENCHMARK["tanks"]
    assert [row["after_s"] for row in cases["changed"]] == [0, 4]
    for motion in ("turn", "pulse"):
        (row,) = cases["frequency"][motion]
        assert row["rate_hz"] == 0.4
        assert row["window_gain"] == pytest.approx(0.234, abs=1e-3)


def test_the_gaits_of_the_example_pass_every_case(files, tmp_path, capsys):
    out = tmp_path / "out"
    main(["benchmark", str(GAITS), *files, "--out", str(out)])
    summary = json.loads((out / "benchmark.json").read_text())
    check_cases(summary)
    assert (out / "frequency_response.png").stat().st_size > 10_000
    assert summary["cases"]["references"]["mean"]["x"]["error_n"] < 0.5
    described = [row["described"] for row in summary["cases"]["moving"]["rows"]]
    assert described[0] == "step (2, 0) to (3, 0) N at 2 s"
    assert described[4:] == ["one turn, counterclockwise", "one turn, clockwise"]
    text = capsys.readouterr().out
    assert "Table II, gaits, benchmark 1" in text
    assert "  0.4 Hz" in text
    assert "warning: the protocol was changed" in text


@pytest.mark.slow
def test_feedback_corrects_a_fin_that_changes(files, capsys):
    errors = []
    for options in ((), ("--feedback",)):
        main(["benchmark", str(GAITS), *files, "--change-s", "10", *options, "--json"])
        summary = json.loads(capsys.readouterr().out)
        check = summary["cases"]["changed"][-1]
        assert check["after_s"] == 10
        errors.append(np.hypot(*check["rms_n"]))
    assert errors[1] < 0.5 * errors[0]


def test_a_controller_in_plain_python_is_entered_by_name(files, capsys):
    main(["benchmark", "tests.evaluation.test_benchmark:OneCell", *files, "--json"])
    summary = json.loads(capsys.readouterr().out)
    check_cases(summary)
    assert summary["conditions"]["kind"] == "OneCell"
    cases = summary["cases"]
    # It ignores the reference, so its force does not follow.
    assert cases["frequency"]["turn"][0]["gain"] < 0.2
    # The circle about (2, 0) N leaves the cells.
    assert "outside the nearest of 6 cells" in cases["moving"]["not_covered"]


def test_the_policy_of_the_document_passes_every_case(files, capsys, tmp_path, monkeypatch):
    (code,) = (block.text for block in blocks() if "class Swing" in block.text)
    (tmp_path / "entry.py").write_text(code)
    monkeypatch.chdir(tmp_path)
    main(["benchmark", "entry:policy", *files])
    assert "Table II, policy, benchmark 1" in capsys.readouterr().out


class Wrapped:
    """A controller that JAX cannot compile."""

    def __init__(self, controller):
        self.init = controller.init
        self.act = controller.act
        self.check = controller.check


def test_python_and_the_compiled_program_run_the_same_experiment():
    gaits = softfin.load_controller(GAITS)
    references = np.array([(2, 0), (1, -1)], np.float32)
    keys = jax.random.split(jax.random.key(0), 2)
    compiled = run(gaits, TANK, references, 6, keys)
    stepped = run(Wrapped(gaits), TANK, references, 6, keys)
    for one, other in zip(jax.tree.leaves(compiled[1:]), jax.tree.leaves(stepped[1:]), strict=True):
        np.testing.assert_allclose(one, other, atol=0.02)
    assert np.ptp(np.asarray(stepped.command.angle)) > 0.5
    # Feedback moves the reference once it has seen a window.
    corrected = run(Feedback(Wrapped(gaits)), TANK, references, 6, keys)
    moved = np.abs(np.asarray(corrected.command.angle - stepped.command.angle)).max(axis=(0, 1))
    assert moved[:200].max() < 1e-4
    assert moved[200:].max() > 1e-3


def test_a_tank_changes_at_its_time():
    after = with_parameters(TANK, stiffness=0.5)
    fin = ChangingTank.between(TANK, after, 1, 1)
    assert fin.limits == TANK.limits
    force = eqx.filter_jit(lambda plant, state: plant.advance(state, Command(1.0, 4.0), 5)[0].force)
    state = TANK.init(jax.random.key(0))
    np.testing.assert_array_equal(force(fin, state), force(TANK, state))
    late = state._replace(ticks=jnp.int32(101))
    np.testing.assert_allclose(force(fin, late), force(after, late), rtol=1e-4)
    assert not np.allclose(force(after, late), force(TANK, late), rtol=1e-2)


class Far:
    def predict(self, observation, state, episode_start, deterministic):
        return np.full((1, 2), 1.5), None


def test_an_action_outside_its_range_is_refused():
    policy = PolicyController(Far(), PAPER_LIMITS)
    rest = Measured(0.0, np.zeros(2))
    with pytest.raises(RunError, match=r"Far: action .* must be two numbers in \[-1, 1\]; clip it"):
        policy.act(policy.init(), rest, (2, 0))


class Fast(Plain):
    def act(self, state, measured, reference):
        return state, Command(0.0, 99.0)


def test_a_command_outside_the_limits_is_refused():
    keys = jax.random.split(jax.random.key(0), 1)
    with pytest.raises(CommandError, match="command velocity = 99 rad/s: the plant accepts"):
        run(Fast(), TANK, np.zeros((1, 2), np.float32), 4, keys)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["nowhere"], "nowhere: no such folder"),
        (["nowhere:name"], "nowhere:name: ModuleNotFoundError"),
        (["tests.evaluation.test_benchmark:BENCHMARK"], "a dict is neither a controller"),
        ([str(GAITS), "--plant", "tests.plants:AnalyticFin"], "must be tank or a tank YAML file"),
        ([str(GAITS), "--seconds", "1"], "seconds = 1: "),
        ([str(GAITS), "--references", "[[1, 0]]"], "references: 1; use six"),
        (
            [str(GAITS), "--references", str([[1, 0]] * 6)],
            "references: all have the same x or y",
        ),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_unusable_input_is_one_line(words, message, capsys):
    with pytest.raises(SystemExit) as stop:
        main(["benchmark", *words])
    assert stop.value.code == 2
    assert message in capsys.readouterr().err
