"""The benchmark on the example's gaits, on a policy and on a controller of one's own."""

import json
from functools import partial
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
from softfin.core.errors import CommandError, ConfigurationError, CoverageError, RunError
from softfin.core.quantities import PAPER_LIMITS, Command
from softfin.evaluation.benchmark import CASES, BenchmarkProtocol, run_benchmark
from softfin.evaluation.experiment import run_together
from softfin.evaluation.lock_step import (
    PolicyController,
    choose_program,
    run_compiled,
    run_in_python,
)
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
        if min(cell.distance(reference) for cell in self.cells) > 1e-3:
            raise CoverageError(f"reference {reference}: not covered")


@pytest.fixture
def files(tmp_path):
    """Options of a tiny benchmark."""
    (tmp_path / "tank.yaml").write_text(yaml.safe_dump(COARSE))
    (tmp_path / "tiny.yaml").write_text(yaml.safe_dump(BENCHMARK))
    return ("--plant", str(tmp_path / "tank.yaml"), "--config", str(tmp_path / "tiny.yaml"))


def check_cases(summary):
    cases = summary["cases"]
    assert list(cases) == ["references", "moving", "perturbed", "changed", "frequency"]
    assert summary["protocol_version"] == 1
    assert not summary["is_standard"]
    assert summary["configuration"]["seeds"] == 1
    assert [row["reference_n"] for row in cases["references"]["rows"]] == [
        list(reference) for reference in PAPER_REFERENCES
    ]
    assert cases["references"]["mean"]["power"]["electrical"]["mean_w"] > 0
    assert len(cases["moving"]["steps"]["rows"]) == 4
    assert len(cases["moving"]["turns"]["rows"]) == 2
    (perturbed,) = cases["perturbed"]["rows"]
    assert len(perturbed["x"]["error_seeds_n"]) == BENCHMARK["tanks"]
    assert perturbed["worst_tank_n"][0] == pytest.approx(max(perturbed["x"]["error_seeds_n"]))
    assert [row["after_s"] for row in cases["changed"]["rows"]] == [0, 4]
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
    text = capsys.readouterr().out
    assert "six references" in text
    assert "0.4 Hz" in text
    assert "the protocol was changed" in text


def test_feedback_is_added_to_a_controller(files, capsys, monkeypatch):
    kept = {"references": CASES["references"]}
    monkeypatch.setattr("softfin.evaluation.benchmark.CASES", kept)
    errors = []
    for options in ((), ("--feedback", "--seconds", "12")):
        main(["benchmark", str(GAITS), *files, *options, "--json"])
        summary = json.loads(capsys.readouterr().out)
        assert summary["conditions"]["feedback"] == bool(options)
        errors.append(summary["cases"]["references"]["mean"]["x"]["error_n"])
    assert errors[0] != errors[1]
    assert summary["conditions"]["kind"] == "gaits with feedback"


def test_a_controller_in_plain_python_is_entered_by_name(files, capsys):
    main(["benchmark", "tests.evaluation.test_benchmark:Plain", *files, "--json"])
    summary = json.loads(capsys.readouterr().out)
    check_cases(summary)
    # It ignores the reference, so its force does not follow.
    assert all(row["gain"] < 0.2 for row in summary["cases"]["frequency"]["turn"])
    assert summary["conditions"]["kind"] == "Plain"


def test_the_policy_of_the_document_passes_every_case(files, capsys, tmp_path, monkeypatch):
    (code,) = (block.text for block in blocks() if "class Swing" in block.text)
    (tmp_path / "entry.py").write_text(code)
    monkeypatch.chdir(tmp_path)
    main(["benchmark", "entry:policy", *files, "--json"])
    summary = json.loads(capsys.readouterr().out)
    check_cases(summary)
    assert summary["conditions"]["kind"] == "policy"


def test_an_object_is_entered_in_python_and_uncovered_forces_are_reported(monkeypatch):
    protocol = BenchmarkProtocol.build(BENCHMARK)
    kept = {name: CASES[name] for name in ("references", "moving")}
    monkeypatch.setattr("softfin.evaluation.benchmark.CASES", kept)
    scores = run_benchmark(OneCell(), TANK, protocol)
    assert "not covered" in scores["cases"]["moving"]["not_covered"]
    assert "mean" in scores["cases"]["references"]


def test_python_and_the_compiled_program_run_the_same_experiment():
    gaits = softfin.load_controller(GAITS)
    assert choose_program(gaits) is run_compiled
    assert choose_program(Plain()) is run_in_python
    references = np.array([(2, 0), (1, -1)], np.float32)
    keys = jax.random.split(jax.random.key(0), 2)
    run = partial(run_together, gaits, TANK, [(references, 4)], keys)
    compiled = run(run_compiled)[0]
    stepped = run(run_in_python)[0]
    for one, other in zip(jax.tree.leaves(compiled[1:]), jax.tree.leaves(stepped[1:]), strict=True):
        np.testing.assert_allclose(one, other, atol=0.02)
    assert np.ptp(np.asarray(stepped.command.angle)) > 0.5


def test_a_tank_changes_at_its_time():
    after = with_parameters(TANK, stiffness=0.5)
    fin = ChangingTank.between(TANK, after, 1, 1)
    assert fin.limits == TANK.limits
    run = eqx.filter_jit(lambda plant, state: plant.advance(state, Command(1.0, 4.0), 5)[0].force)
    state = TANK.init(jax.random.key(0))
    np.testing.assert_array_equal(run(fin, state), run(TANK, state))
    late = state._replace(ticks=jnp.int32(101))
    np.testing.assert_allclose(run(fin, late), run(after, late), rtol=1e-4)
    assert not np.allclose(run(after, late), run(TANK, late), rtol=1e-2)


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
    with pytest.raises(CommandError, match="command velocity = 99 rad/s: the plant accepts"):
        run_together(
            Fast(),
            TANK,
            [(np.zeros((1, 2), np.float32), 4)],
            jax.random.split(jax.random.key(0), 1),
            run_in_python,
        )


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["nowhere"], "nowhere: no such folder"),
        (["nowhere:name"], "nowhere:name: ModuleNotFoundError"),
        (["tests.evaluation.test_benchmark:BENCHMARK"], "a dict is neither a controller"),
        ([str(GAITS), "--plant", "tests.plants:AnalyticFin"], "must be tank or a tank YAML file"),
        ([str(GAITS), "--seconds", "1"], "seconds = 1: "),
        ([str(GAITS), "--references", "[[1, 0]]"], "references: 1; use six"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_unusable_input_is_one_line(words, message, capsys):
    with pytest.raises(SystemExit) as stop:
        main(["benchmark", *words])
    assert stop.value.code == 2
    assert message in capsys.readouterr().err


def test_references_on_a_line_have_no_turn():
    protocol = BenchmarkProtocol(references=((1, 0),) * 6, seconds=4)
    with pytest.raises(ConfigurationError, match="all have the same x or y"):
        run_benchmark(Plain(), TANK, protocol)
