"""First calls from Python, with arguments that look right."""

import json
import subprocess
import sys

import pytest

# The tests check the types of all arguments at run time, so these calls are made in a process that
# does not.
SCRIPT = """
import json, sys
from pathlib import Path
import jax, softfin

softfin.write_example("example")
controller = softfin.load_controller("example/single")
measured = (0.0, (0.0, 0.0))
calls = {
    "positional": lambda: softfin.fit("logs", Path("s")),
    "unknown": lambda: softfin.fit("logs", out="s", epochs=3),
    "no path": lambda: softfin.evaluate(controller, plant="tank"),
    "one of two": lambda: softfin.evaluate("example/single", controller),
    "number": lambda: softfin.inspect_logs(3),
    "None": lambda: softfin.load_surrogate(None),
    "config": lambda: softfin.map_forces("tank", out="m", config=[1]),
    "misspelt": lambda: softfin.CollectConfig(log=3),
    "misspelt within": lambda: softfin.TankConfig(sensor={"noise": 1}),
    "existing output": lambda: softfin.write_example("example"),
    "page of a wrong kind": lambda: softfin.explore("example/single", out="a.pdf"),
    "flat measurement": lambda: controller.act(controller.init(), (0.0, 0.0), (1.0, 0.0)),
    "no measurement": lambda: controller.act(controller.init(), None, (1.0, 0.0)),
    "one number": lambda: controller.act(controller.init(), measured, 3.0),
}
for plant in (softfin.Tank(), softfin.load_surrogate("example/surrogate")):
    kind = type(plant).__name__
    state = plant.init(jax.random.key(0))
    calls[f"{kind} key"] = lambda plant=plant: plant.init(0)
    calls[f"{kind} command"] = lambda plant=plant, state=state: plant.advance(state, (0.1, 2.0), 33)
errors = {}
for name, call in calls.items():
    try:
        call()
    except Exception as error:
        errors[name] = (type(error).__name__, str(error))
print(json.dumps(errors))
"""

EXPECTED = {
    "positional": ("ConfigurationError", "softfin.fit: "),
    "unknown": ("ConfigurationError", "its parameters are dataset, out, "),
    "no path": ("ConfigurationError", "softfin.evaluate: controllers: "),
    "one of two": ("ConfigurationError", "softfin.evaluate: controllers: "),
    "number": ("ConfigurationError", "softfin.inspect_logs: "),
    "None": ("ConfigurationError", "softfin.load_surrogate: path: "),
    "config": ("ConfigurationError", "use a MapConfig"),
    "misspelt": ("ConfigurationError", "did you mean 'logs'"),
    "misspelt within": ("ConfigurationError", "did you mean 'noise_n'"),
    "existing output": ("ArtifactError", "use overwrite=True to replace it"),
    "page of a wrong kind": ("ConfigurationError", "out a.pdf: must end in .html"),
    "flat measurement": ("RunError", "(angle, (force_x, force_y))"),
    "no measurement": ("RunError", "(angle, (force_x, force_y))"),
    "one number": ("RunError", "(angle, (force_x, force_y))"),
    "Tank key": ("PlantError", "jax.random.key(0)"),
    "Tank command": ("CommandError", "softfin.Command(angle, velocity)"),
    "StreamingSurrogate key": ("PlantError", "jax.random.key(0)"),
    "StreamingSurrogate command": ("CommandError", "softfin.Command(angle, velocity)"),
}


@pytest.fixture(scope="module")
def errors(tmp_path_factory):
    made = subprocess.run(
        [sys.executable, "-c", SCRIPT],
        cwd=tmp_path_factory.mktemp("calls"),
        check=True,
        capture_output=True,
        text=True,
    )
    return json.loads(made.stdout)


@pytest.mark.parametrize("call", EXPECTED)
def test_a_wrong_argument_is_an_error_of_one_line(call, errors):
    kind, text = errors[call]
    expected_kind, part = EXPECTED[call]
    assert kind == expected_kind
    assert part in text
    assert "\n" not in text
    assert "--" not in text
