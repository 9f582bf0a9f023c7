"""Architectures are found by their names, and the ones of other packages are as good as softfin's
own."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest
import yaml

from softfin.cli import main
from softfin.core.errors import ArtifactError, ConfigurationError, PlantError
from softfin.core.plant_identity import identity
from softfin.data.collect import CollectConfig
from softfin.evaluation.report import write_report
from softfin.explorer.contents import plant_data
from softfin.stages.reproduce_config import ReproduceConfig
from softfin.stages.surrogates import fit
from softfin.storage import artifact as artifacts
from softfin.storage.dataset import write_dataset
from softfin.surrogate import (
    FitConfig,
    StreamingConfig,
    StreamingSurrogate,
    Surrogate,
    load_surrogate,
    save_surrogate,
)
from softfin.surrogate.onnx import export_surrogate
from softfin.surrogate.registry import (
    ARCHITECTURES,
    DEFAULT,
    find_architecture,
    find_fitted_architecture,
    find_table_one_rows,
    list_architectures,
)
from softfin.testing import check_surrogate
from tests.patience import HANG_S
from tests.surrogate import gru
from tests.surrogate.streaming import small as streaming

UPDATES = {"units": 4, "updates": 6, "updates_per_scoring": 2, "batch": 4, "ticks": 40}
GRU = {**UPDATES, "burn_in": 10}
TRAIN = {
    "steps": 12,
    "num_evaluations": 1,
    "policy": {"units": 4, "width": 4},
    "ppo": {"num_envs": 2, "num_steps": 6, "num_epochs": 1, "num_minibatches": 1},
}


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    folder = tmp_path_factory.mktemp("registry") / "dataset"
    logs = [streaming.recorded(700, seed) for seed in range(3)]
    write_dataset(folder, logs, [streaming.recorded(700, 9)], {})
    return folder


@pytest.fixture
def installed(tmp_path):
    with gru.installed(tmp_path / "site"):
        yield


def run(capsys, *words):
    capsys.readouterr()
    main([str(word) for word in words])
    return capsys.readouterr().out


def write(path, values):
    path.write_text(yaml.safe_dump(values))
    return path


@pytest.mark.parametrize("name", ARCHITECTURES)
def test_each_architecture_of_softfin_is_what_its_name_says(name):
    architecture = find_architecture(name)
    assert find_fitted_architecture(architecture.config()) is architecture
    scores = dict.fromkeys(architecture.table_one, 0)
    assert find_table_one_rows(scores) is architecture.table_one
    assert architecture.load.__self__ is {"paper": Surrogate, "streaming": StreamingSurrogate}[name]


def test_the_names_are_listed_without_jax():
    code = (
        "import sys; from softfin.surrogate.registry import list_architectures\n"
        "assert list(list_architectures()) == ['streaming', 'paper']\n"
        "assert not {'jax', 'numpy', 'pydantic'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=HANG_S)


def test_what_configures_no_fit_is_refused_with_what_does(dataset, tmp_path):
    with pytest.raises(
        ConfigurationError, match=r"config: CollectConfig does not .*use StreamingConfig, FitConfig"
    ):
        fit(dataset, tmp_path / "s", CollectConfig())


def test_scores_of_an_unknown_architecture_are_refused():
    with pytest.raises(ConfigurationError, match="has the networks oracle; install the package"):
        find_table_one_rows({"oracle": 0})


@pytest.mark.parametrize("config", [FitConfig(), StreamingConfig()])
def test_a_reproduction_keeps_the_architecture_of_its_fit(config):
    run = ReproduceConfig(fit=config)
    again = ReproduceConfig.model_validate(json.loads(run.model_dump_json()))
    assert again == run
    assert type(run.changed(["fit.held_out=0.2"]).fit) is type(config)
    with pytest.raises(ConfigurationError, match=r"--set: unknown key 'fit\.wings'"):
        run.changed(["fit.wings=2"])


@pytest.mark.usefixtures("installed")
def test_the_example_meets_the_contract():
    check_surrogate(gru.surrogate())


@pytest.mark.usefixtures("installed")
def test_an_installed_architecture_is_fitted_compared_trained_in_and_evaluated(
    capsys, tmp_path, dataset
):
    out = tmp_path / "gru"
    config = write(tmp_path / "gru.yaml", GRU)
    said = run(capsys, "fit", dataset, "--model", "gru", "--config", config, "--out", out)
    assert "GRU, commands to angle" in said
    fitted = load_surrogate(out)
    assert (fitted.model, fitted.parameters()) == ("gru", 103)
    description = artifacts.load_description(out, "surrogate")
    assert description["scores"]["gru_force"]["physical"]["rmse"] > 0
    write_report(tmp_path / "report.html", {"surrogate": {"scores": description["scores"]}})
    assert "GRU, commands to force" in (tmp_path / "report.html").read_text()

    other = tmp_path / "streaming"
    save_surrogate(other, streaming.surrogate(), None, {})
    words = ("--dataset", dataset, "--horizons", "1", "--out", tmp_path / "compared", "--json")
    compared = json.loads(run(capsys, "compare", out, other, *words))
    assert [group["model"] for group in compared["groups"]] == ["gru", "streaming"]

    wide = tmp_path / "wide"
    save_surrogate(wide, gru.surrogate(), None, {})
    words = ("--controller", "single", "--out", tmp_path / "controller")
    run(capsys, "train", wide, *words, "--config", write(tmp_path / "train.yaml", TRAIN))
    words = ("--seconds", "3", "--repeats", "1", "--out", tmp_path / "judged")
    scored = run(capsys, "evaluate", tmp_path / "controller", "--plant", wide, *words, "--json")
    assert json.loads(scored)["references"][0]["x"]["error_n"] >= 0

    assert export_surrogate(wide, tmp_path / "gru.onnx").worst < 1e-3
    with pytest.raises(PlantError, match="a surrogate of kind 'gru' cannot run in the page"):
        plant_data("wide", load_surrogate(wide))


@pytest.mark.usefixtures("installed")
def test_a_resumed_fit_of_the_example_equals_an_uninterrupted_one(dataset, tmp_path):
    config = find_architecture("gru").config(**GRU)

    def stop(stage, done, note):
        if stage == "fit" and done > 0.5:
            raise KeyboardInterrupt

    fit(dataset, tmp_path / "whole", config)
    with pytest.raises(KeyboardInterrupt):
        fit(dataset, tmp_path / "cut", config, progress=stop)
    fit(dataset, tmp_path / "cut", config, resume=True)
    weights = [artifacts.load(tmp_path / name, "surrogate")[1] for name in ("whole", "cut")]
    assert weights[0].keys() == weights[1].keys()
    for name, array in weights[0].items():
        np.testing.assert_array_equal(array, weights[1][name])


def test_its_folder_is_refused_where_the_package_is_missing(tmp_path):
    with gru.installed(tmp_path / "site"):
        save_surrogate(tmp_path / "s", gru.surrogate(), None, {})
    with pytest.raises(
        ArtifactError,
        match=r"unknown model 'gru'; .* supports paper, streaming; .* install the package of this model",
    ):
        load_surrogate(tmp_path / "s")


def test_in_another_process_it_is_an_option_of_the_commands(tmp_path):
    code = (
        "from softfin.cli import main\n"
        "from softfin.stages.reproduce_config import ReproduceConfig\n"
        "from softfin_gru import GruConfig\n"
        "run = ReproduceConfig(fit=GruConfig(units=3))\n"
        "assert run.changed(['fit.batch=5']).fit == GruConfig(units=3, batch=5)\n"
        "main(['fit', '--help'])"
    )
    places = os.pathsep.join([*gru.install(tmp_path), *sys.path])
    environment = os.environ | {"PYTHONPATH": places}
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=environment,
        check=True,
        timeout=HANG_S,
        capture_output=True,
        text=True,
    )
    assert "--model streaming|paper|gru" in done.stdout


def test_a_package_that_cannot_be_imported_is_named_and_does_not_get_in_the_way(
    tmp_path, monkeypatch, dataset, capsys
):
    entries = {"broken": "no_such_package:ARCHITECTURE", "paper": "no_such_package:PAPER"}
    gru.write_metadata(tmp_path / "site", entries)
    monkeypatch.syspath_prepend(str(tmp_path / "site"))
    assert list(list_architectures()) == ["streaming", "paper", "broken"]
    assert find_fitted_architecture(FitConfig()).config is FitConfig
    assert DEFAULT in ARCHITECTURES
    with pytest.raises(SystemExit):
        main(["fit", str(dataset), "--model", "broken", "--out", str(tmp_path / "s")])
    assert (
        "surrogate architecture broken: no_such_package:ARCHITECTURE cannot be imported "
        "(ModuleNotFoundError: No module named 'no_such_package'); repair or uninstall its package"
    ) in capsys.readouterr().err


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
DRIVE = PREDICTED["drive"]


def late(history):
    state = GOOD.warm(history)
    return state._replace(tick=state.tick + 1)


def half(self, state, command, ticks):
    state, reading = GOOD.advance_members(state, command, ticks)
    return state, reading._replace(force=reading.force / 2)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"warm": None, "scaling": None}, "has no scaling, warm; a surrogate must have all"),
        ({"model": "oracle"}, "model = 'oracle' is not an installed architecture; install"),
        ({"parameters": lambda: 1.5}, r"parameters\(\) is 1.5; it must be a positive int"),
        ({"init": lambda key: (0, 1)}, "the state starts with no field; it must be a NamedTuple"),
        (
            {"to_files": lambda: ({}, {})},
            "cannot be saved and loaded .*'channels'.*; check to_files",
        ),
        (
            {"to_files": lambda: streaming.surrogate(1).to_files()},
            "differs after saving and loading; to_files must contain",
        ),
        ({"warm": late}, r"history that ends at 3\.33 s, the next reading is at .*must continue"),
        ({"warm": lambda history: GOOD.rest}, "warm and init return different states"),
        (
            {"memory": 301},
            "warm accepts fewer rows than memory; it must raise a softfin.core.errors.LogError",
        ),
        (
            {"predictions": lambda logs: {"drive": DRIVE}},
            "predictions has drive; it must have the rows of Architecture.table_one: drive, force",
        ),
        (
            {"predictions": lambda logs: PREDICTED | {"drive": DRIVE._replace(series=[])}},
            r"drive has series of shapes \[\] for a log of 333 rows; there must be one",
        ),
        (
            {
                "predictions": lambda logs: (
                    PREDICTED | {"drive": DRIVE._replace(channels=("speed",))}
                )
            },
            "drive has the channels speed; they must be among angle_rad",
        ),
        (
            {"advance_members": half.__get__(GOOD)},
            "advance differs from the mean of advance_members",
        ),
        ({"member": lambda index: GOOD}, "member.0. differs from the first row"),
        (
            {"distance": lambda state: np.ones(2)},
            r"distance is \[1. 1.\]; it must be a finite number",
        ),
    ],
)
def test_the_conformance_kit_names_the_fault(changes, words, monkeypatch):
    monkeypatch.setattr("softfin.testing.check_plant", lambda plant: None)
    # A Faulty is no pytree, and to trace it takes long.
    monkeypatch.setattr(
        "softfin.testing.identity", lambda plant: identity(getattr(plant, "_good", plant))
    )
    with pytest.raises(PlantError, match=words):
        check_surrogate(Faulty(GOOD, **changes))
