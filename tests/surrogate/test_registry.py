"""Architectures are found by their names, and one of your own is as good as softfin's."""

import json
import subprocess
import sys

import numpy as np
import pytest
import yaml

from softfin.cli import main
from softfin.core.errors import ArtifactError, ConfigurationError, PlantError
from softfin.core.plant_identity import identity
from softfin.evaluation.report import write_report
from softfin.explorer.contents import plant_data
from softfin.stages.surrogates import fit
from softfin.storage import artifact as artifacts
from softfin.storage.dataset import write_dataset
from softfin.surrogate import (
    FitConfig,
    StreamingSurrogate,
    Surrogate,
    load_surrogate,
    save_surrogate,
)
from softfin.surrogate.registry import ARCHITECTURES, find_architecture
from softfin.testing import check_surrogate
from tests.patience import HANG_S
from tests.surrogate import gru
from tests.surrogate.streaming import small as streaming

UPDATES = {"units": 4, "updates": 6, "updates_per_scoring": 2, "batch": 4, "ticks": 40}
GRU = {**UPDATES, "burn_in": 10}


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    folder = tmp_path_factory.mktemp("registry") / "dataset"
    logs = [streaming.recorded(700, seed) for seed in range(3)]
    write_dataset(folder, logs, [streaming.recorded(700, 9)], {})
    return folder


@pytest.fixture
def in_its_folder():
    with gru.in_its_folder():
        yield


def run(capsys, *words):
    capsys.readouterr()
    main([str(word) for word in words])
    return capsys.readouterr().out


@pytest.mark.parametrize("name", ARCHITECTURES)
def test_each_architecture_of_softfin_is_what_its_name_says(name):
    architecture = find_architecture(name)
    assert architecture.config.model == name
    assert architecture.load.__self__ is {"paper": Surrogate, "streaming": StreamingSurrogate}[name]


def test_an_unknown_name_is_refused_without_jax():
    code = (
        "import sys; from softfin.surrogate.registry import find_architecture\n"
        "try:\n    find_architecture('oracle')\n"
        "except Exception as error:\n"
        "    assert type(error).__name__ == 'ConfigurationError'\n"
        "    assert not {'jax', 'numpy', 'pydantic'} & set(sys.modules)\n"
        "else:\n    raise AssertionError"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=HANG_S)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("oracle", "surrogate architecture oracle: unknown"),
        ("no_such_package:A", "'no_such_package'"),
        ("json:ARCHITECTURE", "'json' has no attribute"),
        ("json:dumps", "a function is not a softfin.surrogate.Architecture"),
        ("..json:dumps", "TypeError"),
    ],
)
def test_a_name_that_is_no_architecture_is_refused(name, words, tmp_path):
    with pytest.raises(ConfigurationError, match=words):
        find_architecture(name)
    save_surrogate(tmp_path / "s", streaming.surrogate(), None, {})
    file = tmp_path / "s" / "surrogate.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"model": name}))
    with pytest.raises(ArtifactError, match=words):
        load_surrogate(tmp_path / "s")


def test_the_configuration_of_another_architecture_is_refused(tmp_path):
    (tmp_path / "log.csv").touch()
    with pytest.raises(
        ConfigurationError, match="config: is of type FitConfig; use a StreamingConfig"
    ):
        fit(tmp_path / "log.csv", out=tmp_path / "out", config=FitConfig())


@pytest.mark.usefixtures("in_its_folder")
def test_the_example_meets_the_contract():
    check_surrogate(gru.surrogate())


@pytest.mark.usefixtures("in_its_folder")
def test_an_architecture_of_your_own_is_fitted_and_reported(capsys, tmp_path, dataset):
    out = tmp_path / "gru"
    config = tmp_path / "gru.yaml"
    config.write_text(yaml.safe_dump(GRU))
    printed = run(capsys, "fit", dataset, "--model", gru.NAME, "--config", config, "--out", out)
    assert "GRU, commands to angle" in printed
    fitted = load_surrogate(out)
    assert (fitted.model, fitted.parameters()) == (gru.NAME, 103)
    description = artifacts.load_description(out, "surrogate")
    assert description["model"] == gru.NAME
    assert description["scores"]["gru_force"]["physical"]["rmse"] > 0
    write_report(tmp_path / "report.html", {"surrogate": {"scores": description["scores"]}})
    assert "GRU, commands to force" in (tmp_path / "report.html").read_text()
    with pytest.raises(PlantError, match="cannot run on the page"):
        plant_data("gru", fitted)


@pytest.mark.usefixtures("in_its_folder")
def test_a_resumed_fit_of_the_example_equals_an_uninterrupted_one(dataset, tmp_path):
    config = find_architecture(gru.NAME).config(**GRU)

    def stop(stage, done, note):
        if stage == "fit" and done > 0.5:
            raise KeyboardInterrupt

    fit(dataset, out=tmp_path / "whole", model=gru.NAME, config=config)
    with pytest.raises(KeyboardInterrupt):
        fit(dataset, out=tmp_path / "cut", model=gru.NAME, config=config, progress=stop)
    fit(dataset, out=tmp_path / "cut", model=gru.NAME, config=config, resume=True)
    weights = [artifacts.load(tmp_path / name, "surrogate")[1] for name in ("whole", "cut")]
    assert weights[0].keys() == weights[1].keys()
    for name, array in weights[0].items():
        np.testing.assert_array_equal(array, weights[1][name])


def test_its_folder_is_refused_where_its_module_is_missing(tmp_path):
    with gru.in_its_folder():
        save_surrogate(tmp_path / "s", gru.surrogate(), None, {})
    with pytest.raises(ArtifactError, match="'softfin_gru'"):
        load_surrogate(tmp_path / "s")


class Faulty:
    """A good surrogate with one fault: members that are another's, or None for a missing one."""

    def __init__(self, good, **changes):
        self._good = good
        self._changes = changes

    def __getattr__(self, name):
        if name.startswith("__") or self._changes.get(name, 0) is None:
            raise AttributeError(name)
        return self._changes.get(name, getattr(self._good, name))


GOOD = streaming.surrogate()
PREDICTED = GOOD.predictions([streaming.recorded(433)])


def late(history):
    state = GOOD.warm(history)
    return state._replace(tick=state.tick + 1)


def predicting(**changes):
    return lambda logs: PREDICTED | {"drive": PREDICTED["drive"]._replace(**changes)}


def half(self, state, command, ticks):
    state, reading = GOOD.advance_members(state, command, ticks)
    return state, reading._replace(force=reading.force / 2)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"warm": None, "scaling": None}, "has no scaling, warm"),
        ({"model": "oracle"}, "model = 'oracle'"),
        ({"parameters": lambda: 1.5}, r"parameters\(\) is 1.5"),
        ({"init": lambda key: (0, 1)}, "the state starts with no field"),
        ({"to_files": lambda: ({}, {})}, r"'channels'.*to_files"),
        ({"to_files": lambda: streaming.surrogate(1).to_files()}, "differs after saving"),
        ({"warm": late}, r"history that ends at 3\.33 s"),
        ({"warm": lambda history: GOOD.rest}, "warm and init return different states"),
        ({"memory": 301}, "warm accepts fewer rows than memory"),
        ({"predictions": predicting(series=[])}, r"drive has series of shapes \[\]"),
        ({"predictions": predicting(channels=("speed",))}, "drive has the channels speed"),
        ({"advance_members": half.__get__(GOOD)}, "the mean of advance_members"),
        ({"distance": lambda state: np.ones(2)}, r"distance is \[1. 1.\]"),
    ],
)
def test_the_conformance_kit_names_the_fault(changes, words, monkeypatch):
    monkeypatch.setattr("softfin.testing.plants.check_plant", lambda plant: None)
    # A Faulty is no pytree, and to trace it takes long.
    monkeypatch.setattr(
        "softfin.testing.plants.identity", lambda plant: identity(getattr(plant, "_good", plant))
    )
    with pytest.raises(PlantError, match=words):
        check_surrogate(Faulty(GOOD, **changes))
