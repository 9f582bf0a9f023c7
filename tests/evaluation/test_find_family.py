"""The family of a fin: found in the tank, stored beside its controller, used by feedback."""

import dataclasses
import importlib
import json
from pathlib import Path

import numpy as np
import pytest

import softfin
from softfin.control.family import FEATURES, load_family, save_family
from softfin.control.store import load_controller
from softfin.core.errors import ArtifactError, ConfigurationError
from softfin.core.operations import NUMPY
from softfin.evaluation.find_family import FamilyConfig
from softfin.gaits.reachable import Cell
from softfin.tank import Tank
from tests.gaits.known import save_known
from tests.plants import StrokeFin

find_family_module = importlib.import_module("softfin.evaluation.find_family")

TINY = {"fins": 20, "nodes": 3, "nominal_nodes": 3, "coefficients": 3}


@pytest.fixture(scope="module")
def gaits(tmp_path_factory) -> Path:
    """Gaits with the family of the tank."""
    folder = save_known(tmp_path_factory.mktemp("family") / "gaits")
    softfin.family(folder, config=TINY)
    return folder


def test_a_family_explains_most_of_what_its_fins_do(gaits):
    family = load_family(gaits, load_controller(gaits))
    assert family is not None
    assert family.nominal.shape == (3, 3, 6, len(FEATURES))
    assert family.features.shape == (3, 3, 6, 3, len(FEATURES))
    spanned = np.sqrt((np.asarray(family.force) ** 2).sum(axis=2).mean())
    assert spanned > 0.03
    assert np.sqrt((np.asarray(family.force_noise) ** 2).mean()) < 0.7 * spanned
    assert np.asarray(family.feature_spread)[FEATURES.index("motor_power")] > 0.1


def test_between_the_nodes_it_is_interpolated(gaits):
    family = load_family(gaits, load_controller(gaits))
    assert family is not None
    middle = (np.asarray(family.low) + np.asarray(family.high)) / 2
    quarter = (np.asarray(family.low) + middle) / 2
    places = np.stack([middle, quarter, np.asarray(family.low) - 9])
    (force,) = family.interpolate(NUMPY, places, family.force)
    table = np.asarray(family.force)
    np.testing.assert_allclose(force[0], table[1, 1], atol=1e-4)
    np.testing.assert_allclose(force[1], table[:2, :2].mean(axis=(0, 1)), atol=1e-4)
    np.testing.assert_allclose(force[2], table[0, 0], atol=1e-4)


def test_feedback_uses_the_family_of_the_folder(gaits):
    options = {"reference": ((1.0, 0.0),), "seconds": 6, "repeats": 1, "feedback": True}
    plain = softfin.evaluate(gaits, **{**options, "feedback": False})
    both = softfin.evaluate(gaits, **options)
    torque = softfin.evaluate(gaits, **options, config={"feedback": {"uses": "torque"}})
    errors = [result["mean"]["x"]["error_n"] for result in (plain, both, torque)]
    assert len(set(errors)) == 3


def test_a_family_is_for_the_weights_of_its_controller(gaits, tmp_path):
    copy = save_known(tmp_path / "copy")
    (copy / "family").mkdir()
    for file in (gaits / "family").iterdir():
        (copy / "family" / file.name).write_bytes(file.read_bytes())
    description = copy / "family" / "family.json"
    found = json.loads(description.read_text())
    description.write_text(json.dumps({**found, "controller_sha256": "0"}))
    with pytest.raises(ArtifactError, match="made for a controller with different weights"):
        load_family(copy, load_controller(copy))
    few = {**found, "configuration": {**found["configuration"], "fins": 19}}
    description.write_text(json.dumps(few))
    with pytest.raises(ArtifactError, match="made from 19 fins, expected at least 20"):
        load_family(copy, load_controller(copy))
    description.write_text(json.dumps(found))
    (copy / "family" / "weights.safetensors").write_bytes(b"")
    with pytest.raises(ArtifactError, match="damaged"):
        load_family(copy, load_controller(copy))


def test_a_family_whose_friction_has_another_shape_is_damaged(gaits, tmp_path):
    copy = save_known(tmp_path / "copy")
    controller = load_controller(gaits)
    family = load_family(gaits, controller)
    keys = {"configuration": {"fins": 20}}
    save_family(copy, controller, family._replace(friction=family.friction[:, :2]), keys)
    with pytest.raises(ArtifactError, match=r"damaged \(arrays of shape"):
        load_family(copy, controller)


def test_gaits_are_run_only_at_references_within_their_cell(gaits, monkeypatch):
    """It may be smaller than the reach."""
    controller = load_controller(gaits)
    cell = Cell(low=(0.5, -0.5), high=(1.0, 0.5))
    tried = []

    def run(controller, fin, references):
        tried.append(np.asarray(references))
        return find_family_module._Steady(
            np.zeros((len(references), 2)),
            np.zeros((len(references), 6, len(FEATURES))),
            np.zeros((len(references), 6, 2)),
        )

    monkeypatch.setattr(find_family_module, "_run_references", run)
    find_family_module.find_family(
        dataclasses.replace(controller, cells=(cell,)), Tank(), FamilyConfig.build(TINY)
    )
    for x, y in np.concatenate(tried).tolist():
        assert cell.distance((x, y)) < 1e-6


def test_no_family_is_none(tmp_path):
    folder = save_known(tmp_path / "gaits")
    assert load_family(folder, load_controller(folder)) is None
    with pytest.raises(ConfigurationError, match=r"uses = torque: .*softfin family"):
        softfin.evaluate(folder, config={"feedback": {"uses": "torque"}})


def test_only_a_tank_has_parameters_that_change(gaits):
    with pytest.raises(ConfigurationError, match=r"must be tank or a tank YAML file"):
        softfin.family(gaits, plant=StrokeFin())


def test_fins_that_do_not_differ_are_refused(gaits):
    widths = dict.fromkeys(FamilyConfig().widths.model_dump(), 0.0)
    with pytest.raises(ConfigurationError, match="widths: all are 0"):
        softfin.family(gaits, config={**TINY, "widths": widths})


def test_too_few_fins_are_refused(gaits):
    with pytest.raises(ConfigurationError, match="fins = 19"):
        softfin.family(gaits, config={"fins": 19})


def test_an_evaluation_states_the_interval_of_feedback_and_how_often_it_held(gaits):
    options = {"reference": ((1.0, 0.0), (1.5, 0.5)), "seconds": 12, "repeats": 2}
    found = softfin.evaluate(gaits, **options, feedback=True)
    assert min(found["feedback"]["half_width_n"]) > 0
    assert 0 <= found["feedback"]["coverage"] <= 1
    assert found["feedback"]["level"] >= 1
    assert "90% interval" in str(found)
    assert "feedback" not in softfin.evaluate(gaits, **options)
